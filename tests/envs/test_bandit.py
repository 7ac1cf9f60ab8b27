"""The bandit's closed forms: Eq. (3), (4), (5), (8) and (9), by hand and against science's Monte Carlo."""

import numpy as np
import pytest

from deconfounded import envs
from deconfounded.deconf.equations import belief_update
from deconfounded.deconf.exact import ExactAgent, Grid
from deconfounded.experts import policy
from deconfounded.experts.agent import ExpertAgent
from deconfounded.experts.rollout import run_trials

N = 6_000


@pytest.fixture(scope="module")
def env() -> envs.BatchEnv:
    return envs.BatchEnv(envs.get("bandit"), N)


def test_beliefs_by_hand() -> None:
    """Pull arm 0, paid; pull arm 1, not paid. Products of 3/4 and 1/4, and for Eq. (9) of 6/10 and 1/10 as well."""
    task = envs.get("bandit")
    env = envs.BatchEnv(task, 1)
    env.reset(0)
    grid = Grid(env, policy.load(task), 0)
    zero, one, obs = np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1))
    steps = [(zero, zero, one), (one, one, zero)]  # state, action, next state
    interventional, conditional = grid.prior(1), grid.prior(1)
    for state, action, after in steps:
        dynamics, acted = grid.log_dynamics(state, action, after), grid.log_policy(obs, action)
        interventional = belief_update(interventional, dynamics)
        conditional = belief_update(conditional, dynamics, acted)
    by_dynamics = np.array([3 / 4 * 3 / 4, 1 / 4 * 1 / 4, 1 / 4 * 3 / 4, 1 / 4 * 3 / 4, 1 / 4 * 3 / 4])
    by_actions = np.array([6 / 10 * 1 / 10, 1 / 10 * 6 / 10, 1 / 100, 1 / 100, 1 / 100])
    np.testing.assert_allclose(np.exp(interventional[0]), by_dynamics / by_dynamics.sum(), rtol=1e-12)
    both = by_dynamics * by_actions
    np.testing.assert_allclose(np.exp(conditional[0]), both / both.sum(), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("who", "pulls", "curve"),
    [
        ("expert", 60.0, [0.60] * 6),
        ("interventional", 54.1, [0.201, 0.280, 0.373, 0.494, 0.591, 0.600]),
        ("conditional", 32.3, [0.201, 0.271, 0.306, 0.325, 0.331, 0.333]),
    ],
)
def test_exact_policies(env: envs.BatchEnv, who: str, pulls: float, curve: list[float]) -> None:
    """Best-arm pulls of 100 and P(best arm) at t = 1, 5, 10, 20, 50, 100, within 4 standard errors."""
    expert = policy.load(env.task)
    agent = ExpertAgent(env, expert) if who == "expert" else ExactAgent(env, expert, who == "conditional")
    trials, returns, _ = run_trials(env, agent, 1, seed=5)
    assert abs(returns.mean() - pulls) < 4 * returns.std() / np.sqrt(N) + 0.05  # published to one decimal
    best = (trials.action[:, 0, :, 0] == env.theta).mean(0)
    np.testing.assert_allclose(best[[0, 4, 9, 19, 49, 99]], curve, atol=4 * 0.5 / np.sqrt(N) + 0.0005)


@pytest.mark.parametrize("arm", [-1, 5, 2.5])
def test_there_are_five_arms(arm: float) -> None:
    env = envs.BatchEnv(envs.get("bandit"), 1)
    env.reset(0)
    with pytest.raises(envs.InputError, match=r"each must be a whole number 0\.\.4"):
        env.step(np.array([[arm]]))


def test_a_picture_of_the_arms() -> None:
    """The best arm stands on green; the arm that was pulled is yellow if it paid, and grey if it did not."""
    draw = envs.get("bandit").renderer(np.array([3.0]))
    for paid, colour in ((1.0, (250, 190, 40)), (0.0, (110, 110, 110))):
        picture = draw(np.array([paid]), np.array([1.0]))
        columns = [60 * arm + 40 for arm in range(5)]
        bases, arms = picture[170, columns].tolist(), picture[100, columns].tolist()
        assert [base == [40, 160, 70] for base in bases] == [arm == 3 for arm in range(5)]
        assert [tuple(arm) for arm in arms] == [colour if arm == 1 else (225,) * 3 for arm in range(5)]


@pytest.mark.slow
def test_payouts(env: envs.BatchEnv) -> None:
    """Eq. (4): 3/4 for the best arm, 1/4 for others, 4 standard errors."""
    trials = run_trials(env, ExpertAgent(env, policy.load(env.task)), 1, seed=6).trials
    best = trials.action[:, 0, :, 0] == env.theta
    paid = trials.obs[:, 0, 1:, 0]
    assert abs(paid[best].mean() - 0.75) < 4 * 0.5 / np.sqrt(best.sum())
    assert abs(paid[~best].mean() - 0.25) < 4 * 0.5 / np.sqrt((~best).sum())
