"""The colour of each method, in all pictures and pages."""

from __future__ import annotations

import zlib

COLOURS = {
    "expert": "#222222",
    "interventional": "#2ca02c",
    "conditional": "#d62728",
    "deconfounded": "#1f77b4",
    "deconfounded_gru": "#17becf",
    "deconfounded_discrete": "#9467bd",
    "deconfounded_offline": "#a8a91e",
    "dagger": "#e377c2",
    "naive_rnn": "#ff7f0e",
    "oracle_bc": "#7f7f7f",
    "blind_bc": "#8c564b",
    "random": "#b8b8b8",
}
OTHERS = ("#5254a3", "#637939", "#8c6d31", "#ad494a", "#7b4173", "#3182bd", "#e6550d", "#31a354", "#756bb1", "#843c39")


def colour(method: str) -> str:
    """A method's own, or one that its name decides."""
    return COLOURS.get(method, OTHERS[zlib.crc32(method.encode()) % len(OTHERS)])
