"""Is a task confounded, and by how much? `deconf certify --task slippery_cartpole`

Four measurements: how much evidence of theta the dynamics and the expert's actions hold, what the exact policies score,
what it costs an expert to assume a wrong theta, and what a clone without memory scores. Only the last one is trained,
and the dynamics of a task without a likelihood. The exit status is 1 if the task does not pass.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.console import Parser, place, whole
from deconfounded.benchmarks.engine import identity, sources
from deconfounded.benchmarks.engine.catalogue import EXACT
from deconfounded.benchmarks.engine.context import DEMOS, EXPLORATION, stream
from deconfounded.benchmarks.engine.progress import Progress
from deconfounded.benchmarks.output.certificate import check_kept, picture
from deconfounded.benchmarks.output.scoring import check_expert, normalise
from deconfounded.benchmarks.output.trial_scores import standard_error
from deconfounded.deconf.exact import GRID, Grid, grid_of, grid_size
from deconfounded.deconf.particles import PARTICLES, Particles, exact_agent, needs_particles
from deconfounded.envs.streams import Array
from deconfounded.envs.support.files import check_folder, write_json
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import run_trials

EPISODES, SEED, TRIALS = 5, 0, 64
STAGES = ("evidence", "interventional", "conditional", "stakes", "blind BC")
LEVELS = 5  # of theta in the stakes matrix, for one latent
PARTS = 8  # of trials, each of which is left out for a standard error
MOST = 16  # levels of many latents, drawn from all combinations
THRESHOLDS = {
    "blind_bc": ("<=", 0.7),
    "wrong_theta": ("<=", 0.65),
    "conditional_last": ("<=", 0.7),
    "interventional_last": (">=", 0.95),
}


class EvidenceRecorder(ExpertAgent):
    """The expert; beside it the evidence of each step, and the posterior that dynamics alone would give.

    Evidence is for the true theta over the others of the grid; the posterior is of particles where they are given.
    """

    def __init__(self, env: envs.BatchEnv, expert: Expert, grid: Grid, particles: Particles | None = None) -> None:
        super().__init__(env, expert)
        self.grid, self.particles = grid, particles

    def begin(self, n: int) -> None:
        super().begin(n)
        if self.particles:
            self.particles.begin(n)
        self.log_belief = self._updated = self.grid.prior(n)
        self._truth, self._steps = np.full((n, len(self.env.task.latents)), np.nan), 0
        self.dynamics: list[Array] = []  # nats for the true theta over another one of the grid, a step
        self.actions: list[Array] = []
        self.estimates: list[Array] = []  # of theta [N, L], at the end of each episode
        self.truths: list[Array] = []  # theta [N, L] then

    def note(self) -> None:
        """Keep the estimate of the theta of an episode's last step that took place, now that it is over."""
        mean = self.particles.mean(self.particles.log_weight) if self.particles else self.grid.mean(self._updated)
        self.estimates.append(mean)
        self.truths.append(self._truth)

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        super().reset(rngs)
        if self.dynamics:
            self.note()
            waited = self.grid.predict_steps(self.log_belief, self.env.task.horizon - self._steps)
            self.log_belief = self.grid.predict(waited)
        if self.particles:
            self.particles.reset(self._rng)
        self._steps = 0

    def act(self, obs: NDArray[np.float32]) -> Array:
        self._state, self._theta = self.env.state, self.env.theta.copy()
        return super().act(obs)

    def _wrong(self, values: Array) -> Array:
        """The mean of values [N, K] over the thetas of the grid that are wrong, [N]."""
        wrong = (self.grid.theta != self._theta[:, None]).any(-1)  # a category is in the grid itself
        return np.where(wrong, values, 0).sum(-1) / wrong.sum(-1)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        log_dynamics = self.grid.log_dynamics(self._state, action, self.env.state)
        true = self.grid.log_true(self._state, action, self.env.state, self._theta)
        self.dynamics.append(self._wrong(true[:, None] - log_dynamics)[alive])
        acted = self.expert.log_prob(obs, action, self._theta)
        self.actions.append(self._wrong(acted[:, None] - self.grid.log_policy(obs, action))[alive])
        if self.particles:
            self.particles.learn(self._state, obs, action, self.env.state, alive)
        updated = self.grid.updated(self.log_belief, self._state, obs, log_dynamics)
        took_place = alive.reshape(-1, *[1] * (updated.ndim - 1))
        self._updated = np.where(took_place, updated, self._updated)
        self._truth = np.where(alive[:, None], self._theta, self._truth)
        self.log_belief = self.grid.predict_steps(np.where(took_place, updated, self.log_belief))
        self._steps += 1


class Stakes(NamedTuple):
    """levels [J, L]; scores and mean returns [J, J] of an expert under the row's theta that is given the column's.

    wrong: the mean score where these are far from each other; error: its standard error.
    """

    levels: Array
    scores: Array
    returns: Array
    wrong: float
    error: float


def stakes(task: envs.Task, expert: Expert, trials: int) -> Stakes:
    """What it costs to assume a wrong theta, in so many trials, at least PARTS, of each pair.

    Each row is scored by its own expert and its own random actions, and is NaN where these are as good: nothing is at
    stake under that theta. Theta does not switch meanwhile.
    """
    task = task.without_switches()
    levels = np.unique(task.theta_grid(LEVELS), axis=0)
    levels = levels[np.sort(np.random.default_rng(SEED).permutation(len(levels))[:MOST])]
    j = len(levels)
    true = np.repeat(levels, j * trials, 0)
    assumed = np.tile(np.repeat(levels, trials, 0), (j, 1))
    env = envs.BatchEnv(task, j * j * trials)
    returns = run_trials(env, ExpertAgent(env, expert, assumed), 1, SEED, true).returns
    random = run_trials(env, RandomAgent(task.action_space), 1, SEED, true).returns
    matrix = returns.reshape(j, j, trials)
    random, far, part = random.reshape(j, j, trials), far_pairs(task, levels), np.arange(trials) % PARTS
    scored = scores(matrix, random)
    without = [np.nanmean(scores(matrix[..., part != i], random[..., part != i])[far]) for i in range(PARTS)]
    error = float(np.std(without) * (PARTS - 1) ** 0.5)  # jackknife
    return Stakes(levels, scored, matrix.mean(-1), float(np.nanmean(scored[far])), error)


def scores(returns: Array, random: Array) -> Array:
    """Scores [J, J] of returns [J, J, N] under a row's theta, given a column's; random: those of random actions."""
    matrix = returns.mean(-1)
    zero, one = random.mean((1, 2))[:, None], np.diag(matrix)[:, None]
    return np.divide(matrix - zero, one - zero, out=np.full(matrix.shape, np.nan), where=one > zero)


def far_pairs(task: envs.Task, levels: Array) -> NDArray[np.bool_]:
    """[J, J] pairs at least half of the range apart in some latent; any two different categories are."""
    far = np.zeros((len(levels), len(levels)), bool)
    for i, latent in enumerate(task.latents):
        values = levels[:, i]
        if latent.distribution == "categorical":
            far |= values[:, None] != values
        else:
            far |= np.abs(latent.cdf(values)[:, None] - latent.cdf(values)) >= 0.5 - 1e-9
    return far


def certify(
    task: envs.Task,
    expert: Expert,
    trials: int = TRIALS,
    grid: int | None = None,
    done: Callable[[str], None] = lambda stage: None,
) -> dict[str, Any]:
    """Measure a task; `verdict` is `passed` if every check holds. Scores: 0 = random actions, 1 = the expert.

    grid: the k of `Task.theta_grid`, by default that of the exact policies; of learned dynamics, that of one latent.
    done: called with the name of each stage when it is over.
    """
    env = envs.BatchEnv(task, trials)
    if constant := [latent for latent in task.latents if latent.low == latent.high]:
        what = f"{constant[0].name} of {task.name} was {constant[0].low:g} in all draws of theta"
        raise envs.InputError(f"{what}; it must vary, or be left out")
    learned: dict[str, Any] = {}
    thetas: int | Grid = grid or grid_size(task)
    if not task.has_likelihood:
        from deconfounded.deconf.learned_reference import LearnedGrid, learn  # sklearn takes a second

        model = learn(task, expert, 2 * trials, stream(EXPLORATION, SEED))
        thetas, learned = LearnedGrid(env, expert, grid or GRID, model), {"r2": model.r2, "exponent": model.exponent}

    def returns(agent: Agent) -> Array:
        return run_trials(env, agent, EPISODES, SEED).returns

    many = needs_particles(task) and not learned
    particles = Particles(env, expert, conditional=False) if many else None
    known = thetas if isinstance(thetas, Grid) else grid_of(env, expert, LEVELS if many else thetas)
    recorder = EvidenceRecorder(env, expert, known, particles)
    best = run_trials(env, recorder, EPISODES, SEED).returns  # thetas are the same in every run: seeds are shared
    recorder.note()
    random = returns(RandomAgent(task.action_space))
    zero, one = float(random.mean()), float(best.mean())
    check_expert(task.name, zero, one)
    done(STAGES[0])
    policies = {"interventional": returns(exact_agent(env, expert, False, thetas))}
    static = {}
    if task.drifts or task.switches:
        static["static"] = returns(exact_agent(env, expert, False, thetas, static=True))
    done(STAGES[1])
    policies |= {"conditional": returns(exact_agent(env, expert, True, thetas)), **static}
    done(STAGES[2])
    staked = stakes(task, expert, max(trials // 2, PARTS))
    done(STAGES[3])

    demo_env = envs.BatchEnv(task, 2 * trials)
    from deconfounded.deconf.methods import memoryless_bc  # torch takes seconds: what checks its input goes without

    demos = run_trials(demo_env, ExpertAgent(demo_env, expert), EPISODES, stream(DEMOS, SEED)).trials
    blind = returns(memoryless_bc.train(demos, memoryless_bc.MemorylessConfig(), np.random.default_rng(SEED)))
    done(STAGES[4])

    means = {name: x.mean(0) for name, x in policies.items()}
    curves = {name: {"return": x.tolist(), "score": normalise(x, zero, one).tolist()} for name, x in means.items()}
    scored = {"blind_bc": blind.mean(1)} | {f"{name}_last": policies[name][:, -1] for name in EXACT}
    references = random.mean(1), best.mean(1)
    measured = {
        name: (float(normalise(x.mean(), zero, one)), standard_error(x, *references)) for name, x in scored.items()
    }
    measured["wrong_theta"] = staked.wrong, staked.error
    checks = {}
    for name, (relation, bound) in THRESHOLDS.items():
        value, error = measured[name]
        holds = value <= bound if relation == "<=" else value >= bound
        required = {"required": f"{relation} {bound}", "passed": holds, "sure": abs(value - bound) > 2 * error}
        checks[name] = {"measured": round(value, 4), "error": round(error, 4), **required}
    pairs = zip(recorder.estimates, recorder.truths, strict=True)
    dynamics, actions = (float(np.concatenate(x).mean()) for x in (recorder.dynamics, recorder.actions))
    ratio = actions / dynamics if dynamics else None  # None where expert trials hold no evidence of theta
    score = [[None if np.isnan(value) else value for value in row] for row in staked.scores.tolist()]
    return {
        "task": task.name,
        "task_version": task.version,
        **({"text": sources.digest(files)} if (files := sources.of_task(task)) else {}),  # of a task from outside
        **({"learned_dynamics": learned} if learned else {}),  # of the references, which are exact without them
        "verdict": "passed" if all(check["passed"] for check in checks.values()) else "failed",
        "checks": checks,
        "return_random": zero,
        "return_expert": one,
        **curves,
        "evidence_nats_per_step": {"dynamics": dynamics, "actions": actions, "delusion_ratio": ratio},
        "inferability": [inferability(task, *pair) for pair in pairs],
        "stakes": {"levels": staked.levels.tolist(), "score": score, "return": staked.returns.tolist()},
        "trials": trials,
        "grid": len(recorder.grid.theta),
        **({"particles": PARTICLES} if many else {}),
        "seed": SEED,
        "versions": identity.versions(),
    }


def inferability(task: envs.Task, estimate: Array, truth: Array) -> dict[str, float]:
    """How well estimates [N, L] from expert trials agree with theta: R^2, or accuracy of a categorical latent."""
    inferable = {}
    for i, latent in enumerate(task.latents):
        if latent.distribution == "categorical":
            inferable[latent.name] = float((estimate[:, i] == truth[:, i]).mean())
        else:
            residual = estimate[:, i] - truth[:, i]
            inferable[latent.name] = float(1 - (residual**2).mean() / truth[:, i].var())
    return inferable


def main() -> None:
    parser = Parser(__doc__, "--task", "--expert")
    folder = Path("results") / "certificates"
    parser.add_argument("--out", type=place, default=folder, help=f"output folder; default: {folder}")
    about = f"of each policy: more where returns are noisy; default: {TRIALS}"
    parser.add_argument("--trials", type=whole(2, 10_000), default=TRIALS, help=about)
    args = parser.parse_args()
    task = envs.get(args.task)
    envs.check_task(task)
    expert = policy.load(task, args.expert)
    check_folder(folder := args.out)
    check_kept(folder / f"{task.name}.json", task, args.trials)
    start, progress = time.time(), Progress(len(STAGES), task.name, every_s=0)
    result = certify(task, expert, args.trials, done=lambda stage: progress.update(1, f"({stage} done)"))
    progress.close()
    write_json(folder / f"{task.name}.json", result)
    picture(result, folder / f"{task.name}.png")
    for name, check in result["checks"].items():
        value = f"{check['measured']:.3f} +- {check['error']:.3f} (required {check['required']})"
        doubt = "" if check["sure"] else ": within two standard errors; --trials says more"
        print(f"{'ok  ' if check['passed'] else 'FAIL'} {name}: {value}{doubt}")
    if learned := result.get("learned_dynamics"):
        fit = "R2 {r2:.3f} on held-out trials; likelihoods to the power {exponent:g}".format(**learned)
        print(f"conditional, interventional and evidence are of learned dynamics, not exact: {fit}")
    nats = "dynamics {dynamics:.3g} nats, actions {actions:.3g} nats".format(**result["evidence_nats_per_step"])
    inferred = ", ".join(f"{name} {value:.2f}" for name, value in result["inferability"][-1].items())
    print(f"evidence a step: {nats}; theta from expert trials (R2, or the share that is right): {inferred}")
    print(f"{task.name}: certificate {result['verdict']}, in {time.time() - start:.0f} s -> {folder}")
    if result["verdict"] == "failed":
        raise SystemExit(1)
