"""What a diagnosis says: verdicts and their headlines, what a wrong verdict would look like, and what to do next."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from deconfounded.deconf.diagnosis.remark import listed

Verdict = Literal["confounded", "not confounded", "nothing at stake", "cannot tell"]
HEADLINES: dict[Verdict, str] = {
    "confounded": "Confounded",
    "not confounded": "Not confounded",
    "nothing at stake": "Past actions predict, nothing is at stake",
    "cannot tell": "Cannot tell",
}
IF_WRONG: dict[tuple[Verdict, int | None], str] = {
    ("confounded", 2): (
        "a naive clone does as well as the agent that explores. It takes minutes to train: compare the two in a few"
        " trials before you rely on either."
    ),
    ("confounded", 3): (
        "what differs between trials is a habit, and no goal: whichever of the experts' ways a clone takes is right,"
        " and its episodes end as well as theirs."
    ),
    ("not confounded", 1): (
        "a clone begins well, then commits to a course that the expert would have corrected, and repeats it with"
        " certainty: another one in each trial. Look for that in its first trials."
    ),
    ("nothing at stake", 1): (
        "a clone fails in whole trials, and does well in others. If that happens, something differs between trials that"
        " the expert observes, and your columns do not show."
    ),
}
"""By verdict and tier: 'If this is wrong, ...'."""

PASSING = (
    "Past actions tell a clone of the expert's next one, but what they tell passes: pauses, noise that lasts, a memory"
    " of the expert's own, or a speed or another state that no column shows. A clone that goes by its own past actions"
    " loses nothing by it."
)


SHOWN_ACTIONS = (
    "Or your columns show past actions, as stacked frames or a filter of actions do, and a clone without a memory reads"
    " them too: leave them out (--obs), and diagnose again."
)


class Next(NamedTuple):
    """What to do, and a line of Python that does it with `trials`; explore and query are the user's functions."""

    advice: str
    fit: str = ""


CLONE = Next(
    "Clone the expert; a memory does no harm here.",
    "naive_rnn.train(trials, naive_rnn.RecurrentConfig(), np.random.default_rng(0))",
)
CLONE_HABITS = Next(
    "Clone the expert. A memory of past actions copies pauses, noise and habits too; cut out of the logs what you do"
    " not want copied. A clone without a memory (the printed lines) copies none of them, if your columns show all that"
    " the expert acts on at a moment, speeds too.",
    "memoryless_bc.train(trials, memoryless_bc.MemorylessConfig(), np.random.default_rng(0))",
)


def clone_with_memory(columns: Sequence[str]) -> Next:
    """Advice where a clone without a memory lacks a part of the state, on which these columns depend."""
    advice = (
        f"Clone the expert, with a memory: what your system does next ({listed(columns)}) depends on the step before"
        " too, as where a speed is not observed, or actions take effect late. A clone without a memory knows nothing of"
        " that. A memory copies pauses, noise and habits too; cut out of the logs what you do not want copied."
    )
    return Next(advice, CLONE.fit)


EXPLORE = Next(
    "Explore by a policy that does not see what is hidden, and learn from what the world answers (Tier 2, Algorithm 1)."
    " The printed lines learn from your log of exploration alone; trials in which the agent itself acts do better.",
    "deconfounded.train(trials, explore, deconfounded.DeconfoundedConfig(), np.random.default_rng(0))",
)
QUERY = Next(
    "If you can, let the clone observe it, by a sensor or by a person's word. If the world shows it somewhere, ask the"
    " expert for its actions in states that the clone visits (Tier 3, the printed lines). If nothing shows it, no data"
    " helps, and no clone can know where to go.",
    "dagger.train(query, dagger.DaggerConfig(), np.random.default_rng(0))",
)
EXPLORE_FIRST = Next(
    "Explore a little, by a behaviour that does not know what is hidden, varies its actions and stays where the expert"
    " goes, such as a memoryless clone with some random actions; and diagnose again with it (--explore). Or try the"
    " printed lines, which need no more data (Tier 1, Algorithm 3).",
    "deconfounded_offline.train(trials, deconfounded_offline.OfflineConfig(), np.random.default_rng(0))",
)
VARY_LATENT = Next("Record trials under other conditions too, and diagnose again.")
EXPLORE_MORE = Next(
    "Explore more, where the expert goes, by any policy that does not see what is hidden, and diagnose again."
)
MORE_TRIALS = Next("Record more trials of the same kind, and diagnose again.")
