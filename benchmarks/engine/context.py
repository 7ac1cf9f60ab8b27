"""The data of one task and some seeds, made when first asked for. What of it a method is handed: see provider.py."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.engine import identity
from deconfounded.benchmarks.engine.protocols import STANDARD, applied
from deconfounded.deconf.core.monitor import Monitor
from deconfounded.envs.streams import Array, Streams
from deconfounded.experts import policy
from deconfounded.experts.agent import Agent, ExpertAgent, RandomAgent
from deconfounded.experts.rollout import Rollout, run_trials, thetas
from deconfounded.experts.trials import Trials, joined, of_steps

if TYPE_CHECKING:
    from deconfounded.benchmarks.engine.presets import Preset

DEMOS, EXPLORATION, EVALUATION, GUEST = 1, 2, 3, 4  # each purpose has seeds of its own


def demonstrations_file(folder: Path, seed: int) -> Path:
    """Where the jobs of a folder keep a seed's demonstrations."""
    return folder / f"demonstrations-{seed}.npz"


def stream(purpose: int, seed: int, salt: str = "") -> int:
    """A seed for one purpose of one run, far from all others; with a salt, one that nobody can have looked at."""
    entropy = [purpose, seed, *salt.encode("utf-8", "surrogateescape")]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0] >> 1)


class Context:
    """One task, preset and some seeds: data, made when first asked for, and the environments agents are scored in.

    Seeds lie side by side: trials are in as many equal groups as there are seeds.
    """

    def __init__(
        self,
        task: envs.Task,
        preset: "Preset",
        seeds: Sequence[int],
        monitor: Monitor | None = None,
        folder: Path | None = None,
        expert: str | None = None,
        salt: str = "",
        protocol: str = STANDARD,
    ) -> None:
        """folder: where each seed's demonstrations are kept, for all methods; or nowhere. expert: see policy.load.

        salt: of demonstrations and exploration, where nobody must be able to guess their thetas.
        """
        self.task, self.scored = (applied(protocol, task, evaluation) for evaluation in (False, True))
        self.preset, self.seeds, self.monitor = preset, list(seeds), monitor or Monitor()
        self.folder, self.named_expert, self.salt, self.protocol = folder, expert, salt, protocol
        self.expert = policy.load(task, expert)

    @cached_property
    def env(self) -> envs.BatchEnv:
        """The environments that agents are scored in."""
        return envs.BatchEnv(self.scored, self.preset.eval_trials * len(self.seeds))

    def rows(self, i: int) -> slice:
        """Trials, of those that agents are scored in, of the i-th seed."""
        return slice(i * self.preset.eval_trials, (i + 1) * self.preset.eval_trials)

    def _expert_trials(self, n: int, seeds: Sequence[int]) -> Trials:
        env = envs.BatchEnv(self.task, n * len(seeds))
        seeds = [stream(DEMOS, seed, self.salt) for seed in seeds]
        return run_trials(env, ExpertAgent(env, self.expert), self.task.episodes, seeds).trials

    def _kept(self, seed: int) -> tuple[Path, str]:
        """Where a seed's demonstrations are kept, and what they are made of."""
        assert self.folder is not None
        what = (self.task, self.named_expert, self.preset.expert_trials, seed, self.protocol)
        made_of = identity.demonstrations(*what)
        return demonstrations_file(self.folder, seed), made_of

    def has_demonstrations(self, seed: int) -> bool:
        """Whether they are in the folder: whole, and of this seed, task and expert."""
        try:
            return bool(Trials.load(*self._kept(seed)))
        except envs.InputError:
            return False

    def _demonstrated(self, seed: int) -> Trials:
        """The demonstrations of one seed, made once: what is in the folder is taken from there."""
        if self.folder is None:
            return self._expert_trials(self.preset.expert_trials, [seed])
        try:
            return Trials.load(*self._kept(seed))
        except envs.InputError:
            trials = self._expert_trials(self.preset.expert_trials, [seed])
            trials.save(*self._kept(seed))
            return trials

    @cached_property
    def demonstrations(self) -> Trials:
        """Expert trials, without theta."""
        self.monitor.spend("expert_trials", [self.preset.expert_trials] * len(self.seeds))
        return joined([self._demonstrated(seed) for seed in self.seeds])

    @property
    def demonstrated_theta(self) -> Array:
        """The theta of the demonstrations' roll-out, drawn once more from their seeds: for the oracle alone."""
        n = self.preset.expert_trials * len(self.seeds)
        return thetas(self.task, n, self.task.episodes, [stream(DEMOS, seed, self.salt) for seed in self.seeds])

    def demonstrate(self, rngs: Sequence[np.random.Generator]) -> Trials:
        """Fresh expert trials."""
        self.monitor.spend("expert_trials", [self.preset.fresh] * len(rngs))
        return self._expert_trials(self.preset.fresh, [int(rng.integers(2**31)) for rng in rngs])

    @property
    def rngs(self) -> list[np.random.Generator]:
        """For initial weights and batches; the same for every method of a seed."""
        return [np.random.default_rng([seed, 0, *self.salt.encode()]) for seed in self.seeds]

    def _roll_out(self, n: int, agent: Agent | None, rngs: Sequence[np.random.Generator]) -> Rollout:
        env = envs.BatchEnv(self.task, n * len(rngs))
        self.monitor.spend("exploration_trials", [n] * len(rngs))
        seeds = [stream(EXPLORATION, int(rng.integers(2**31))) for rng in rngs]
        behaviour = agent or RandomAgent(self.task.action_space)
        return run_trials(env, behaviour, self.task.episodes, seeds)

    def explore(self, agent: Agent | None, rngs: Sequence[np.random.Generator], n: int | None = None) -> Trials:
        """Trials under fresh thetas, by an agent that knows nothing of them; None: uniformly random actions."""
        return self._roll_out(n or self.preset.explore_trials, agent, rngs).trials

    def explore_with_theta(self, agent: Agent | None, rngs: Sequence[np.random.Generator]) -> tuple[Trials, Array]:
        """The same, and the encoded theta of each episode, as of a roll-out."""
        trials, _, theta = self._roll_out(self.preset.explore_trials, agent, rngs)
        self.monitor.spend("thetas", [len(trials) // len(rngs)] * len(rngs))
        return trials, self.task.encode_theta(theta)

    def query(
        self, agent: Agent | None, rngs: Sequence[np.random.Generator], n: int | None = None
    ) -> tuple[Trials, NDArray[np.float32]]:
        """Such trials, and what the expert, which sees theta, would have done at each step [B, E, T, A]."""
        trials, _, theta = self._roll_out(n or self.preset.query_trials, agent, rngs)
        self.monitor.spend("queries", trials.mask.reshape(len(rngs), -1).sum(1).tolist())
        shape = trials.action.shape
        obs = trials.obs[:, :, :-1].reshape(len(trials), -1, trials.obs.shape[-1])
        theta = of_steps(theta, shape[2]).reshape(len(trials), obs.shape[1], -1)
        random = Streams([np.random.default_rng(rng.integers(2**31)) for rng in rngs])
        labels = [self.expert.act(obs[:, t], theta[:, t], random) for t in range(obs.shape[1])]
        return trials, np.stack(labels, 1).reshape(shape).astype(np.float32)
