"""A diagnosis: the verdict, the figures with their ranges, and what they mean in plain words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from deconfounded.deconf.diagnosis.advice import HEADLINES, IF_WRONG, Next, Verdict
from deconfounded.deconf.diagnosis.thresholds import GOOD, SMALL_COST, STAKES


class Figure(NamedTuple):
    """The mean over refits, and their range."""

    value: float
    low: float
    high: float

    @staticmethod
    def of(refits: Sequence[float]) -> "Figure":
        """The figure of the refits' values."""
        return Figure(sum(refits) / len(refits), min(refits), max(refits))

    def __format__(self, spec: str) -> str:
        """With `%`, in percent."""
        if spec == "%":
            return f"{self.value:.0%} ({self.low:.0%} to {self.high:.0%})"
        return str(self)

    def __str__(self) -> str:
        value, low, high = (f"{x:,.0f}" if abs(x) >= 100 else f"{x:.2g}" for x in self)
        return f"{value} ({low} to {high})"


def with_tier(verdict: str, tier: int | None) -> str:
    """A verdict in a table or a list: `confounded` has its tier with it, if that is known."""
    return f"{verdict}, Tier {tier}" if verdict == "confounded" and tier else verdict


@dataclass(frozen=True)
class Diagnosis:
    """The verdict, figures by name, the reasons, the paper's tier that is needed (None: unknown), and what to do next.

    conclusion, cost, sure, wrong: plain sentences on what the data show, what it costs, how sure that is, and what a
    wrong verdict would look like. `reasons` have the figures. Figures are those of Findings, and three more. `gap`: the
    predicted loss by naive cloning, in scores by trajectories; `gap_by_actions`: by Eq. (1); `ratio`: the evidence of
    actions over that of dynamics, in expert trials. agreeing: refits that say the same if judged alone; dissenting:
    what the others say, each verdict once.
    """

    verdict: Verdict
    figures: dict[str, Figure]
    reasons: tuple[str, ...]
    tier: int | None
    next: Next
    conclusion: str = ""
    agreeing: int = 0
    refits: int = 0
    dissenting: tuple[str, ...] = ()

    @property
    def headline(self) -> str:
        """A title."""
        mild = self.tier == 2 and 1 - self.figures["naive"].value < SMALL_COST
        return HEADLINES[self.verdict] + ", at a small cost" * mild

    @property
    def cost(self) -> str:
        """What cloning would cost."""
        if self.verdict == "cannot tell" or self.tier == 3:
            return "Not known from these data."
        if self.verdict != "confounded":
            keeps_course = self.figures["naive"].low > GOOD
            if not keeps_course and max(self.figures[key].high for key in ("stakes", "paired_stakes")) >= STAKES:
                return "Not known from these data."
            return "Next to nothing, as far as the learned model of your system shows."
        naive, latent = (self.figures[key] for key in ("naive", "latent"))
        lost, rest = (Figure(1 - x.value, 1 - x.high, 1 - x.low) for x in (naive, latent))
        return (
            f"In the learned model of your system, a clone with a memory leaves the expert's course by {lost:%} of"
            " what an expert would that acts on a wrong value of what is hidden. A policy that infers it from what the"
            f" world does leaves it by {rest:%}: that is possible in the model, and no promise for a trained agent."
            " Where the reward hardly depends on the course, less is lost: logs do not hold the reward."
        )

    @property
    def sure(self) -> str:
        """How sure the verdict is."""
        dissent = f" (the others: {', '.join(self.dissenting)})" if self.dissenting else ""
        text = f"{self.agreeing} of {self.refits} random splits of your trials say the same if judged alone{dissent}."
        if self.verdict == "cannot tell":
            return text
        if self.agreeing < self.refits:
            return f"Not very: {text} More trials make it surer."
        return f"Fairly: {text} They share most of their data and the same kind of model, so that this is no proof."

    @property
    def wrong(self) -> str:
        """What a wrong verdict would look like; empty if there is none."""
        text = IF_WRONG.get((self.verdict, self.tier))
        return f"If this is wrong, {text}" if text else ""
