"""Logs of other origins as Trials, and Trials as Minari data sets.

A reader for each format returns a table (`table.py`), whose rows become episodes (`rows.py`) and Trials (`logs.py`).
"""

from deconfounded.experts.datasets.logs import Log, read, read_together
from deconfounded.experts.datasets.minari_sets import collect, read_theta, write

__all__ = ["Log", "collect", "read", "read_theta", "read_together", "write"]
