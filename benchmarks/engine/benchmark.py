"""The benchmark's job: train one method with some seeds, deploy it, and write down what came of it."""

import contextlib
import errno
import secrets
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import label
from deconfounded.benchmarks.engine.context import EVALUATION, Context, stream
from deconfounded.benchmarks.engine.guest_host import Guest, fit_guest
from deconfounded.benchmarks.engine.job_files import in_name
from deconfounded.benchmarks.engine.jobs import Job, JobMonitor
from deconfounded.benchmarks.engine.provider import deployed, fit
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.monitor import Training
from deconfounded.deconf.equations import imitation_objective
from deconfounded.envs.support.errors import error_line
from deconfounded.envs.task import Array
from deconfounded.experts import saved_agents
from deconfounded.experts.agent import Agent, AgentWrapper
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.trials import Trials, of_steps

CLIPPED = ("expert", "naive_rnn", "deconfounded")  # recorded for the video, in the first seed
FULL = (errno.ENOSPC, errno.EDQUOT)  # of a disk
QUANTILE = 0.85  # of the first latent, in the trial of the video


class Recorder(AgentWrapper):
    """Passes everything on to an agent; keeps what it knows at the end of each episode, and a clip of one trial.

    The clip, if it is filmed, is of the first task.episodes of that trial of the first seed whose first latent is
    nearest that QUANTILE: the same trial for every method, as seeds are shared. Its rows are an episode's start,
    without an action, and each step after it; with what the agent knows then.
    """

    def __init__(self, agent: Agent, env: envs.BatchEnv, filmed: bool = False) -> None:
        super().__init__(agent)
        self.env, self.filmed = env, filmed

    def begin(self, n: int) -> None:
        super().begin(n)
        self.features_after: list[NDArray[np.float32]] = []  # [N, F] of each episode
        self.episode = 0
        self.clip: dict[str, list[Any]] = {}

    def note(self) -> None:
        """Keep what the agent knows now that an episode is over. Raises InputError if only some episodes have that."""
        features = self.agent.features()
        if self.episode > 1 and (features is None) == bool(self.features_after):
            now, before = ("None", "an array") if features is None else ("an array", "None")
            who = f"method {self.agent.name}" if isinstance(self.agent, Guest) else type(self.agent).__name__
            what = f"features of {who} were {now} after episode {self.episode}, and {before} before"
            raise envs.InputError(f"{what}; they must be an array after each episode, or None after each")
        if features is not None:
            self.features_after.append(features.copy())

    def reset(self, rngs: Sequence[np.random.Generator]) -> None:
        if self.episode == 0:
            theta = self.env.theta[: self.env.n // len(rngs), 0]
            self.trial = int(np.abs(theta - np.quantile(theta, QUANTILE)).argmin())
        else:
            self.note()
        super().reset(rngs)
        self.episode += 1
        self._film(np.zeros(self.env.task.action_width))

    def _film(self, action: Array) -> None:
        if not self.filmed or self.episode > self.env.task.episodes:
            return
        row = {"state": self.env.state[self.trial].copy(), "action": action, "episode": self.episode - 1}
        if (features := self.agent.features()) is not None:
            row["known"] = features[self.trial].copy()
        for kind, value in row.items():
            self.clip.setdefault(kind, []).append(value)

    def observe(
        self, obs: NDArray[np.float32], action: Array, next_obs: NDArray[np.float32], alive: NDArray[np.bool_]
    ) -> None:
        super().observe(obs, action, next_obs, alive)
        if alive[self.trial]:
            self._film(action[self.trial])


class CurveMonitor(JobMonitor):
    """Keeps the losses of training, at some 400 updates, and shows them to TensorBoard if the job asks for it."""

    def __init__(self, job: Job, share: float) -> None:
        super().__init__(job, share)
        self.writer: Any = None
        self.noted = 0  # the last update whose losses are kept
        if job.track:
            from torch.utils.tensorboard import SummaryWriter

            name = f"{job.method}-{in_name(job.seeds)}"
            self.writer = SummaryWriter(str(job.folder.parent / "tensorboard" / name))

    def update(self, done: int, total: int, losses: dict[str, float], agent: Agent | None = None) -> None:
        super().update(done, total, losses, agent)
        if done - self.noted >= max(total // 400, 1):
            self.noted = done
            for kind, loss in losses.items():
                self.kept.setdefault(kind, []).append((done, loss))
                if self.writer is not None:
                    self.writer.add_scalar(f"loss/{kind}", loss, done)

    def load(self) -> Training | None:
        training = super().load()
        self.noted = max((points[-1][0] for points in self.kept.values()), default=0)
        return training

    def close(self) -> float:
        if self.writer is not None:
            self.writer.close()
        return super().close()


class BenchmarkJob(Job):
    """Train and evaluate one method with some seeds."""

    def run(self) -> str:
        monitor = CurveMonitor(self, 0.8)
        training, evaluation = self.salts or (secrets.token_hex(8), "") if self.guest else ("", "")
        context = self.context(monitor, training)
        with contextlib.ExitStack() as guests:
            if self.guest is None:
                agents = deployed(self.method, fit(context, self.method))
            elif not self.walled:
                agents = {"": fit_guest(context, self.method, self.guest)}
            else:
                guest = Guest(context, self.method, self.guest.reference, self.guest.uses)
                agents = {"": guests.enter_context(contextlib.closing(guest))}
                evaluation = evaluation or secrets.token_hex(8)  # drawn now that its agent cannot change any more
            trained, filmed = monitor.worked(), self.method in CLIPPED and 0 in self.seeds
            names, salt = {way: label(self.method, way) for way in agents}, self.salt + evaluation
            scored = {
                names[way]: evaluate(context, agent, self.about.learned, salt, filmed and not way)
                for way, agent in agents.items()
            }
            monitor.elsewhere = sum(agent.cpu for agent in agents.values() if isinstance(agent, Guest))
            # First, since a seed's file says that it is finished:
            notes = [self._keep(way, agent) for way, agent in agents.items()]
            meta: dict[str, Any] = {"curve": monitor.kept, "tier": self.about.tier}
            meta |= {"agents": {name: way for way, name in names.items()}}
            meta |= {"salts": [training, evaluation]} if self.guest else {}
            for i, seed in enumerate(self.seeds):
                arrays: dict[str, Any] = {}
                for name, (per_trial, probes, clip) in scored.items():
                    own = {key: value[context.rows(i)] for key, value in per_trial.items()} | {"probe": probes[i]}
                    arrays |= {f"{name}/{key}": value for key, value in (own | (clip if seed == 0 else {})).items()}
                self.save(seed, arrays, monitor, meta)
        return "; ".join([f"trained in {trained:.0f} s, all in {monitor.close():.0f} s", *filter(None, notes)])

    def _keep(self, deployment: str, agent: Agent) -> str:
        """Leave each seed's agent beside the jobs, for `deconfounded.load`; returns why one could not be kept."""
        note, name = "", label(self.method, deployment)
        for i, (seed, folder) in enumerate(zip(self.seeds, self.agent_folders(deployment), strict=True)):
            about = {"task": self.task, "method": name, "seed": seed, "spaces": spaces(envs.get(self.task))}
            try:
                if folder.exists():  # the agent of results that are no longer there
                    shutil.rmtree(folder)
                if isinstance(agent, Guest):
                    note = agent.keep(folder, about)
                elif isinstance(agent, LearnedAgent):
                    saved_agents.save(agent.of_seed(i), folder, **about)
            except Exception as error:  # the results stand, whatever becomes of the agent
                shutil.rmtree(folder, ignore_errors=True)  # what of it was written
                if isinstance(error, OSError) and error.errno in FULL:
                    raise  # a later run goes on from the checkpoint, and keeps it
                note = f"its agent is not kept: {error_line(error)}"
        return note


def spaces(task: envs.Task) -> dict[str, int]:
    """What an agent must fit: O, A, and the number of discrete actions or 0."""
    return {"observations": len(task.observation), "action": task.action_width, "actions": task.n_actions}


def evaluate(
    context: Context, agent: Agent, learned: bool, salt: str = "", filmed: bool = False
) -> tuple[dict[str, Array], Array, dict[str, Array]]:
    """Deploy in all trials: theta [N, E, L] (at first), returns and Eq. (1) [N, E]; probes [S, E or 0]; a clip."""
    task, seeds = context.task, context.seeds
    # Learned agents go on for twice the episodes they were trained on.
    episodes = task.episodes * (2 if learned and task.episodes > 1 else 1)
    recorder = Recorder(agent, context.env, filmed)
    streams = [stream(EVALUATION, seed, salt) for seed in seeds]
    trials, returns, theta = run_trials(context.env, recorder, episodes, streams)
    recorder.note()
    at_end = theta[:, :, -1] if task.switches else theta
    encoded = task.encode_theta(at_end)
    groups = map(context.rows, range(len(seeds)))
    probes = [[probe(x[rows], encoded[rows, e]) for e, x in enumerate(recorder.features_after)] for rows in groups]
    clip = {key: np.array(value) for key, value in recorder.clip.items()}
    if filmed:
        clip["trial"] = np.array(recorder.trial)
    if "known" in clip:  # theta, as it can be read off at the end of the last episode
        clip["read"] = probes[0][task.episodes - 1][1](clip.pop("known"))
    r2 = np.array([[score for score, _ in each] for each in probes])
    first = theta[:, :, 0] if task.switches else theta
    return {"theta": first, "returns": returns, "objective": objective(context.expert, trials, theta)}, r2, clip


def objective(expert: Expert, trials: Trials, theta: Array) -> Array:
    """Eq. (1) [B, E]: how likely the expert that sees a roll-out's theta finds an imitator's actions, by episode."""
    b, e, t = trials.mask.shape
    obs, action = (x.reshape(b * e * t, -1) for x in (trials.obs[:, :, :-1], trials.action))
    log_expert = expert.log_prob(obs, action, of_steps(theta, t).reshape(b * e * t, -1)).reshape(b, e, t)
    return imitation_objective(log_expert, trials.mask)


def probe(features: Array, theta: Array) -> tuple[float, Callable[[Array], Array]]:
    """Held-out R^2 of a linear probe for encoded theta [N, F'] in features [N, F], and the probe: [M, F] -> [M, F'].

    It is fitted to the first half. 1: theta can be read off; 0 or less: no better than its mean. The probe is ridge
    regression, and its penalty is chosen on the first half, by leave-one-out: with one for all, features as many as
    trials would only be memorised. It does not extrapolate: where a feature hardly varies in the first half, the second
    may be far outside.
    """
    # Here, since most commands that import this module probe nothing:
    from sklearn.linear_model import RidgeCV
    from sklearn.metrics import r2_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    half = len(features) // 2
    first = features[:half].astype(float)
    reader = make_pipeline(StandardScaler(), RidgeCV(np.logspace(0, 4, 9))).fit(first, theta[:half])
    low, high = first.min(0), first.max(0)

    def read(given: Array) -> Array:
        return reader.predict(given.clip(low, high)).reshape(len(given), theta.shape[1])

    return float(r2_score(theta[half:], read(features[half:]), multioutput="variance_weighted")), read
