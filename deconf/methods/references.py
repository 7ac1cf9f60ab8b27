"""Reference policies, without learning, on the environments that evaluation steps.

The exact policies hold the posterior of theta on a grid, or by particles where it has more than two latents, unless
each has a grid of its own, as those of patches have: `conditional` takes its own actions for evidence, Eq. (2), and
`interventional` does not, Eq. (5).
"""

from dataclasses import dataclass
from typing import Any

from deconfounded.deconf.core.deployment import deployments
from deconfounded.deconf.core.sizes import Configuration
from deconfounded.deconf.exact import GRID, GRID_OF_TWO, grid_size
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.particles import exact_agent
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent


@dataclass(frozen=True)
class ExactConfig(Configuration):
    """grid: the k of `Task.theta_grid`: values of a single latent; 0, as for bandits, most often: the default."""

    grid: int = GRID


def _exact(given: Given, conditional: bool) -> Agent:
    env, expert = given.environment
    return exact_agent(env, expert, conditional, given.config.grid or grid_size(env.task))


EXACT: dict[str, Any] = {
    **{"exact": True, "on_control": ExactConfig(), "on_bandit": ExactConfig(0)},
    **{"two_latents": {"grid": GRID_OF_TWO}, "smoke": {"grid": 9}},
}


@uses("environment", version=2, cost=1, **EXACT)
def conditional(given: Given) -> Agent:
    """The exact conditional policy: the optimum of naive cloning."""
    return _exact(given, True)


@uses("environment", version=2, cost=4, **EXACT, deployments=deployments("episode", "mode", "mean"))
def interventional(given: Given) -> Agent:
    """The exact interventional policy, by posterior sampling, given the state: what deconfounded imitation aims at."""
    return _exact(given, False)


@uses("environment", cost=1)
def expert(given: Given) -> ExpertAgent:
    """The expert, which sees theta: 1 in every score."""
    return ExpertAgent(*given.environment)


@uses(cost=1)
def random(given: Given) -> RandomAgent:
    """Uniform actions: 0 in every score."""
    return RandomAgent(given.action_space)
