"""Baselines: past actions are hidden or dropped, transformers are causal, GAIL's environments hide theta."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.distributions import Normal, kl_divergence

from deconfounded import envs
from deconfounded.benchmarks.engine.catalogue import DEFAULT, METHODS
from deconfounded.benchmarks.engine.context import Context
from deconfounded.benchmarks.engine.provider import Provider, Vector, fit
from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.agents import LearnedAgent
from deconfounded.deconf.core.data import Batch, Draws, Signature, joined_theta
from deconfounded.deconf.core.gru import GruMemory
from deconfounded.deconf.core.monitor import Monitor, Training
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.transformer import rotated, rotation
from deconfounded.deconf.given import Environments
from deconfounded.deconf.methods import deconfounded_mean, gail, memoryless_bc, rma
from deconfounded.deconf.methods.dadp import DadpAgent, contexts
from deconfounded.deconf.methods.deconfounded_mean import MeanAgent, MeanConfig
from deconfounded.deconf.methods.dml_il import DmlAgent, moment_loss, sources
from deconfounded.deconf.methods.gail import Discriminator, GailAgent, GailConfig
from deconfounded.deconf.methods.gail_ppo import SequencePolicy, new_ppo
from deconfounded.deconf.methods.naive_dropout import ActionDropoutAgent
from deconfounded.deconf.methods.naive_obs import ObsAgent, ObsMemory
from deconfounded.deconf.methods.naive_transformer import TransformerAgent
from deconfounded.deconf.methods.palr import PalrAgent, PalrConfig, hscic
from deconfounded.envs.streams import Array
from deconfounded.experts.agent import Agent, RandomAgent
from deconfounded.experts.rollout import run_trials
from deconfounded.experts.train import train
from deconfounded.experts.trials import Trials
from tests.tools import tiny_preset

CONTROL = "slippery_cartpole"
VARIANTS = [f"deconfounded_{name}" for name in ("gru", "discrete", "forgetting", "large", "offline")]
NEW = [name for name, method in METHODS.items() if method.learned and name not in (*DEFAULT, *VARIANTS)]
FLAT = Signature(obs=2, action=1, actions=0, binary=False)


def streams(n: int = 1) -> Draws:
    return Draws([np.random.default_rng(i) for i in range(n)], "cpu")


def random_batch(draws: Draws, trials: int = 3, steps: int = 7) -> Batch:
    """Random trials, with next observations that are those of the next step."""
    obs = draws.normal(trials, steps + 1, 2)
    action = 2 * draws.uniform(trials, steps, 1) - 1
    return Batch(obs[:, :, :-1], action, obs[:, :, 1:], torch.ones(len(draws), trials, steps))


def other_actions(batch: Batch) -> Batch:
    return Batch(batch.obs, -batch.action, batch.next_obs, batch.mask)


def scales(batch: Batch) -> Scales:
    return Scales.of(FLAT, batch)


def test_tiers() -> None:
    """Tiers follow from declared data: rma alone sees theta."""
    tiers = {
        **dict.fromkeys(("naive_transformer", "naive_obs", "naive_dropout", "palr", "dml_il", "dadp", "flow_bc"), "1"),
        **dict.fromkeys(("deconfounded_mean", "gail"), "2"),
        "rma": "sees theta",
        "dpt": "3",
    }
    assert {name: METHODS[name].tier for name in tiers} == tiers
    assert set(tiers) <= set(NEW)


class TestPastActions:
    def test_naive_obs_does_not_read_actions(self) -> None:
        """Its memory does not depend on actions; naive_rnn's does."""
        draws = streams(2)
        batch = random_batch(draws)
        for kind, same in ((ObsMemory, True), (GruMemory, False)):
            memory = kind(8, scales(batch), draws)
            first, second = (memory(b, memory.start(3))[:, :, -1] for b in (batch, other_actions(batch)))
            assert torch.equal(first, second) == same

    def test_naive_obs_acts_alike(self) -> None:
        draws = streams()
        batch = random_batch(draws)
        chosen = []
        for seen in (batch, other_actions(batch)):
            agent = ObsAgent.new(8, scales(batch), streams())
            agent.begin(3)
            agent.reset([np.random.default_rng(5)])
            for t in range(7):
                agent.remember(seen[:, :, t])
            chosen.append(agent.act(batch.obs[0, :, 0].numpy()))
        np.testing.assert_array_equal(*chosen)

    def test_dropout_is_for_training_alone(self) -> None:
        """In training losses are random, and of the actions a fifth is kept, times 5; elsewhere none is dropped."""
        draws = streams()
        batch = random_batch(draws, 50, 40)
        agent = ActionDropoutAgent.new(8, scales(batch), draws)
        agent.dropout, state, seen = 0.8, agent.memory.start(50), []
        embed = agent.memory._embed

        def spy(given: Batch) -> torch.Tensor:
            seen.append(agent.memory.action_mask)
            return embed(given)

        agent.memory._embed = spy  # type: ignore[method-assign]
        first, second = (agent.loss(batch, batch.action, state)[0] for _ in range(2))
        assert (first != second).all()
        assert seen[0] is not None
        assert seen[0].unique().tolist() == pytest.approx([0, 5])
        assert seen[0].mean().item() == pytest.approx(1, abs=0.2)  # 2,000 draws; four standard errors
        assert (seen[0].amax(2) != seen[0].amin(2)).all()  # some of each trial's
        assert torch.equal(agent.held_out_loss(batch), agent.held_out_loss(batch))
        agent.begin(50)
        agent.remember(batch[:, :, 0])
        assert seen[2:] == [None] * 3


class TestPalr:
    def test_leakage_is_penalised(self) -> None:
        """HSCIC is large for x = y, and small where x and y depend on each other through z alone, or not at all."""
        noise = streams().normal(3, 200, 2)[0]
        z, y = noise[0], noise[0] + noise[1]
        values = {
            "leaks": hscic(y, y, z, 1e-2),
            "by z alone": hscic(noise[0] + noise[2], y, z, 1e-2),
            "nothing": hscic(noise[2], y, z, 1e-2),
        }
        assert values["leaks"] > 5 * values["by z alone"]
        assert values["leaks"] > 5 * values["nothing"]
        assert min(values.values()) > -1e-4  # a squared distance

    def test_training_reduces_leakage(self) -> None:
        """A memory need not depend on the last action: with the penalty it depends less."""
        leakage = []
        for penalty in (0.0, 30.0):
            draws = streams()
            batch = random_batch(draws, 8, 20)
            agent = PalrAgent.new(8, scales(batch), draws)
            agent.config = PalrConfig(penalty=penalty, samples=100)
            optimizer = Adam([agent.memory, agent.policy], 1e-2)
            for _ in range(30):
                optimizer.step(agent.loss(batch, batch.action, agent.memory.start(8))[0])
            with torch.no_grad():
                states = agent.memory(batch, agent.memory.start(8))[:, :, :-1]
                leakage.append(agent.leakage(states, batch, batch.action).item())
        assert leakage[1] < 0.75 * leakage[0]  # with few samples, the estimate is never 0

    def test_no_penalty_in_the_reported_loss(self) -> None:
        draws = streams()
        batch = random_batch(draws)
        agent = PalrAgent.new(8, scales(batch), draws)
        plain = agent.held_out_loss(batch)
        agent.config = PalrConfig(penalty=1e3, samples=20)
        assert torch.equal(agent.held_out_loss(batch), plain)
        assert (agent.loss(batch, batch.action, agent.memory.start(3))[0] > plain).all()


class TestDmlIl:
    def test_the_moment_is_that_of_the_policy(self) -> None:
        """Noise that moves the state and the action: a regression on states is biased, one on roll-outs is not."""
        z, u, first, second = streams().normal(4, 1, 50_000, 1)[0]
        state, action = z + u, 2 * (z + u) - u
        slopes = torch.linspace(0, 4, 81)

        def best(*states: torch.Tensor) -> float:
            residuals = [(action - slopes[:, None, None] * x[0]) for x in states]  # [81, 50_000, 1]
            return slopes[moment_loss(residuals, torch.ones(81, 50_000)).argmin()].item()

        assert best(state, state) == pytest.approx(1.5, abs=0.051)
        assert best(z + first, z + second) == pytest.approx(2, abs=0.051)

    @pytest.mark.slow
    def test_histories_end_before_the_noise(self) -> None:
        """In training and in deployment the policy reads the memory of k steps ago, or of the episode's beginning."""
        draws, lag = streams(), 3
        batch = random_batch(draws, 3, 12)
        mask = np.ones((3, 2, 12), bool)
        mask[1, 0, 7:] = mask[1, 1, 5:] = mask[[0, 2], 1] = False  # an episode of the second trial ends there
        of_zeros = Trials(np.zeros((3, 2, 13, 1)), np.zeros((3, 2, 12, 1)), mask)  # none tells where one begins
        source = sources(of_zeros, lag, 1)[..., :12]
        assert source[0, 0].tolist() == [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8]
        assert source[0, 1].tolist() == [0, 0, 0, 0, 1, 2, 3, 7, 7, 7, 7, 8]
        agent = DmlAgent.new(2, 8, lag, scales(batch), draws)
        with torch.no_grad():
            read = agent.history.at(batch, 12 + source[:, 1])  # in the second trial
            agent.begin(3)
            for t in range(12):
                if t in (0, 7):
                    agent.reset([np.random.default_rng(t)])
                torch.testing.assert_close(agent._memories[0][0, 1], read[0, t])
                agent.remember(batch[:, :, t])


class TestDadp:
    def test_contexts_are_of_other_episodes(self) -> None:
        """Of a trial of 4 episodes, each of its others is in the context of an episode half of the time."""
        memories = torch.eye(4).expand(1, 2000, 4, 4)
        made = contexts(memories, streams())
        assert torch.equal(made.diagonal(dim1=2, dim2=3), torch.zeros(1, 2000, 4))
        assert made.unique().tolist() == [0, 1]
        assert made.sum(-1).unique(return_counts=True)[1].min() > 1800  # 0, 1, 2 or 3 of them: 2000 each
        assert made.mean((0, 1))[~torch.eye(4, dtype=torch.bool)].sub(0.5).abs().max() < 0.06

    def test_it_acts_on_earlier_episodes_alone(self) -> None:
        """What happens in an episode does not change its latent, which is 0 in the first; the next episode reads it."""
        draws = streams()
        batch = random_batch(draws)
        agent = DadpAgent.new(2, 8, scales(batch), draws)
        agent.begin(3)
        latents = []
        for _ in range(2):
            agent.reset([np.random.default_rng(5)])
            for t in range(2):
                latents.append(agent.latent(agent._context))
                agent.remember(batch[:, :, t])
        assert torch.equal(latents[0], torch.zeros(1, 3, 2))
        assert torch.equal(latents[1], latents[0])
        assert torch.equal(latents[3], latents[2])
        assert (latents[2] != 0).all()


def transformer(batch: Batch, window: int, layers: int = 2) -> TransformerAgent:
    shape = {"width": 16, "layers": layers, "heads": 2, "window": window}
    return TransformerAgent.new(shape, scales(batch), streams(len(batch.mask)))


class TestTransformer:
    def test_is_causal(self) -> None:
        """Features do not depend on later tokens, but on earlier ones."""
        batch = random_batch(streams(2))
        agent = transformer(batch, 7)
        changed = Batch(*(x.clone() for x in batch.tensors))
        changed.obs[:, :, 4:] += 1
        changed.action[:, :, 3:] *= -1
        changed.next_obs[:, :, 3:] += 1
        first, second = (agent.net(agent.tokens(b)) for b in (batch, changed))
        torch.testing.assert_close(first[:, :, :4], second[:, :, :4], rtol=0, atol=1e-6)
        assert (first[:, :, 4:] - second[:, :, 4:]).abs().amax(-1).min() > 1e-3

    def test_cache_is_the_full_pass(self) -> None:
        """Step by step, with resets and masked steps, features are those of a pass over the real steps; to 1e-5."""
        draws = streams(2)
        batch = random_batch(draws, 3, 12)
        agent = transformer(batch, 12)
        waits = draws.uniform(3, 30) < 0.4
        waits[0, 0] = waits[0, 1, ::2] = False
        agent.begin(6)
        agent.reset([np.random.default_rng(i) for i in range(2)])
        full, at = agent.net(agent.tokens(batch)), torch.zeros(2, 3, dtype=torch.int64)
        seen = 0
        for t in range(30):
            now = Batch(*(torch.gather(x, 2, at.view(2, 3, 1, *[1] * (x.dim() - 3)).expand(
                2, 3, 1, *x.shape[3:]))[:, :, 0] for x in batch.tensors))  # fmt: skip
            with torch.no_grad():
                agent.choose(now.obs)
            expected = torch.stack([full[s, range(3), at[s]] for s in range(2)])
            torch.testing.assert_close(agent._features, expected, rtol=0, atol=1e-5)
            goes = ((~waits[:, :, t]) & (at < 11)).float()
            agent.remember(Batch(now.obs, now.action, now.next_obs, goes))
            at += goes.long()
            seen += int(goes.sum())
            if t == 10:
                agent.reset([np.random.default_rng(i) for i in range(2)])
        assert seen > 40

    def test_window(self) -> None:
        """With one layer, features after 20 steps are those of the last 8 tokens, at any position of each trial."""
        batch = random_batch(streams(2), 3, 20)
        batch.mask[0, 1, :3] = batch.mask[0, 2, :9] = 0  # of the other seed all trials have as many steps
        agent = transformer(batch, 8, layers=1)
        agent.begin(6)
        agent.reset([np.random.default_rng(i) for i in range(2)])
        for t in range(20):
            with torch.no_grad():
                agent.choose(batch.obs[:, :, t])
            agent.remember(batch[:, :, t])
        expected = agent.net(agent.tokens(batch)[:, :, -8:])[:, :, -1]
        torch.testing.assert_close(agent._features, expected, rtol=0, atol=1e-5)

    def test_attention_goes_by_how_far_apart_tokens_are(self) -> None:
        """By a cosine for each pair of columns, of the distance over their wavelength: 2 pi, and 1000^.5 times that."""
        query, key = (rotated(torch.ones(2, 4), rotation(torch.tensor(at), 4)) for at in ([3, 103], [8, 108]))
        expected = 2 * (np.cos(5) + np.cos(5 / 1000**0.5))
        assert (query * key).sum(-1).tolist() == pytest.approx([expected] * 2, abs=1e-4)

    def test_held_out_loss_is_the_mean_over_steps(self) -> None:
        batch = random_batch(streams(), 40)
        batch.mask[0, 33:, 3:] = 0
        agent = transformer(batch, 7)
        with torch.no_grad():
            torch.testing.assert_close(agent.held_out_loss(batch), agent.loss(batch, batch.action))


class TestMean:
    @staticmethod
    def agent(draws: Draws, batch: Batch, kind: str = "gru") -> MeanAgent:
        return MeanAgent.new(kind, 3, 16, scales(batch), draws)

    @pytest.mark.parametrize("kind", ["gru", "evidence"])
    def test_acts_on_the_mean(self, kind: str) -> None:
        """The latent is the belief's mean, without a draw, and in training that of the same step."""
        draws = streams(2)
        batch = random_batch(draws)
        agent = self.agent(draws, batch, kind)
        agent.begin(6)
        agent.reset([np.random.default_rng(i) for i in range(2)])
        means = deconfounded_mean.running_mean(agent.model, batch)
        for t in range(7):
            with torch.no_grad():
                assert torch.equal(agent.latent(), agent.latent())
                torch.testing.assert_close(agent.latent(), means[:, :, t], rtol=0, atol=1e-5)
                agent.remember(batch[:, :, t])

    def test_kl_is_from_the_belief_a_step_before(self) -> None:
        """What beta adds is torch's own KL, in the mean of steps that took place; the first is from N(0, 1)."""
        draws = streams()
        batch = random_batch(draws)
        batch.mask[:, 1:, 4:] = 0
        agent, state = self.agent(draws, batch), draws.state_dict()
        losses = []
        for beta in (0.0, 1.0):
            draws.load_state_dict(state)
            config = MeanConfig(beta=beta, inference_steps=50)
            losses.append(deconfounded_mean.inference_loss(agent.model, batch, config, draws))
        mean, std = agent.model.encoder.posterior(agent.model.encoder(batch)[:, :, :-1])
        now = Normal(mean, std)
        before = Normal(
            torch.cat([torch.zeros_like(mean[:, :, :1]), mean[:, :, :-1]], 2),
            torch.cat([torch.ones_like(std[:, :, :1]), std[:, :, :-1]], 2),
        )
        expected = kl_divergence(now, before).sum(-1)[batch.mask > 0].mean()[None]
        torch.testing.assert_close(losses[1] - losses[0], expected, rtol=1e-3, atol=1e-5)

    def test_a_latent_predicts_steps_ahead(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Errors are known for changes that grow by 1 a step and a model that predicts 0."""
        steps, ahead = 12, 4
        obs = torch.arange(steps + 1.0).cumsum(0).reshape(1, 1, -1, 1).expand(1, 2, -1, 2)  # changes 1, 2, ...
        batch = Batch(obs[:, :, :-1], torch.zeros(1, 2, steps, 1), obs[:, :, 1:], torch.ones(1, 2, steps))
        draws = streams()
        agent = self.agent(draws, batch)
        model = agent.model
        monkeypatch.setattr(model.dynamics, "forward", lambda obs, *rest: torch.zeros_like(obs)[..., None, :])
        monkeypatch.setattr(model.dynamics, "change", torch.nn.Identity())
        config = MeanConfig(beta=0.0, ahead=ahead, inference_steps=20_000)
        loss = deconfounded_mean.inference_loss(model, batch, config, draws).item()
        pairs = [(t + k + 1) ** 2 for t in range(steps) for k in range(ahead) if t + k < steps]
        assert loss == pytest.approx(ahead * np.mean(pairs), rel=0.03)


def made(method: str, task: str = CONTROL, seeds: tuple[int, ...] = (0,), monitor: Monitor | None = None) -> Agent:
    """An agent after a few updates, from the data that its method declares."""
    context = Context(envs.get(task), tiny_preset(), seeds, monitor)
    return fit(context, method)


class TestRma:
    def test_its_targets_are_theta(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """On the bandit the best arm by its targets pays 3 times in 4, others 1 in 4."""
        handed: list[Any] = []

        def spy(*given: Any) -> Any:
            handed.extend(given)
            raise KeyboardInterrupt

        monkeypatch.setattr(rma, "train", spy)
        context = Context(envs.get("bandit"), replace(tiny_preset(), explore_trials=100), [0, 1])
        with pytest.raises(KeyboardInterrupt):
            fit(context, "rma")
        trials, theta = handed[2](None)
        assert theta.shape == (200, 1, 5)
        best = trials.action[:, 0, :, 0] == theta[:, 0].argmax(-1)[:, None]
        paid = trials.obs[:, 0, 1:, 0]
        assert paid[best].mean() == pytest.approx(0.75, abs=0.03)  # 4,000 pulls; four standard errors
        assert paid[~best].mean() == pytest.approx(0.25, abs=0.02)
        assert context.monitor.budget["exploration_trials"] == [100, 100]
        assert context.monitor.budget["thetas"] == [104, 104]

    def test_targets_at_steps(self) -> None:
        """A step's theta is its episode's, though episodes end early."""
        mask = np.array([[[1, 0, 0], [1, 1, 0]]], bool)
        theta = np.array([[[0.1], [0.2]]])
        trials = Trials(np.zeros((1, 2, 4, 1)), np.zeros((1, 2, 3, 1)), mask)
        assert joined_theta(trials, theta, 1)[0, 0, :3, 0].tolist() == pytest.approx([0.1, 0.2, 0.2])

    def test_an_oracle_is_cloned_by_the_theta_of_each_step(self) -> None:
        """Theta differs from step to step, is the expert's action, and episodes end early."""
        rng = np.random.default_rng(0)
        theta = rng.uniform(-1, 1, (64, 2, 8, 1))
        mask = np.arange(8) < rng.integers(1, 9, (64, 2, 1))
        trials = Trials(np.zeros((64, 2, 9, 1)), theta * mask[..., None], mask)
        acting_theta = rng.uniform(-0.9, 0.9, (50, 1))
        config = memoryless_bc.MemorylessConfig(width=32, updates=300, batch=256)
        oracle = memoryless_bc.train(trials, config, rng, theta, lambda: acting_theta)
        oracle.begin(50)
        oracle.reset([rng])
        np.testing.assert_allclose(oracle.act(np.zeros((50, 1), np.float32)), acting_theta, atol=0.15)

    def test_the_student_sees_no_theta(self) -> None:
        """In deployment it acts alike after the same history under every theta."""
        agent = made("rma")
        chosen = []
        for theta in (-1, 1):
            env = envs.BatchEnv(envs.get(CONTROL), 4)
            low, high = env.task.latents[0].low, env.task.latents[0].high
            obs = env.reset(0, {"theta": [low if theta < 0 else high]})
            agent.begin(4)
            agent.reset([np.random.default_rng(0)])
            for _ in range(3):
                action = agent.act(obs)
                agent.observe(obs, action, obs, np.ones(4, bool))
            chosen.append(agent.act(obs))
        np.testing.assert_array_equal(*chosen)


def gail_env(n: int = 3, task: str = CONTROL) -> tuple[Any, Vector]:
    """GAIL's vector environment, and the environments behind it."""
    from deconfounded.deconf.methods.gail_ppo import TrialVecEnv

    context = Context(envs.get(task), tiny_preset(), [0])
    provider, width = Provider(context, ["exploration"], context.rngs), len(context.task.observation)
    environments = Environments(provider, provider("environments", 0, n), n)
    none: Callable[..., NDArray[np.float32]] = lambda obs, action, then: np.zeros(len(obs), np.float32)  # noqa: E731
    made = TrialVecEnv(environments, context.task.action_space, np.zeros(width), np.ones(width), none)
    return made, provider._vectors[0]


class TestGail:
    @pytest.mark.slow
    def test_the_agent_is_what_ppo_trained(self) -> None:
        """Step by step the same distribution of actions as Stable-Baselines3's policy; to 1e-5."""
        for task in (CONTROL, "bandit"):
            (env, _), config = gail_env(4, task), GailConfig(width=8, envs=4, steps=16, minibatch=16, epochs=1)
            ppo = new_ppo(env, config, 0)
            trials = run_trials(envs.BatchEnv(envs.get(task), 4), RandomAgent(envs.get(task).action_space), 1, 0).trials
            signature = Signature.of(trials)
            agent = GailAgent.blank({"width": 8}, Scales.plain(signature, 1), streams())
            agent.load_policy(0, ppo.policy)
            agent.begin(4)
            agent.reset([np.random.default_rng(0)])
            state = tuple(torch.zeros(1, 4, 8) for _ in range(2))
            data, before = Batch.of(trials, 1), np.zeros((4, signature.action_features + 1))
            before[:, -1] = 1
            for t in range(5):
                step = data[:, :, t]
                inputs = torch.as_tensor(np.concatenate([step.obs[0].numpy(), before], -1)).float()
                theirs, state = ppo.policy.get_distribution(inputs, state, torch.zeros(4))
                with torch.no_grad():
                    agent.choose(step.obs)
                    features = agent._next[..., :8]
                    one = agent.policy.log_prob(features, step.action)[0]
                    action = step.action[0, :, 0] if signature.actions else step.action[0]
                    torch.testing.assert_close(one, theirs.log_prob(action), rtol=0, atol=1e-5)
                agent.remember(step)
                encoded = signature.encode_action(step.action)[0].numpy()
                before = np.concatenate([encoded, np.zeros((4, 1))], -1)

    @pytest.mark.parametrize("begin", [(), (0,), (0, 3), (0, 5, 19)], ids=str)
    def test_sequences_read_at_once_are_those_read_step_by_step(self, begin: tuple[int, ...]) -> None:
        """Outputs, the state after and gradients are sb3-contrib's own to 1e-5, wherever episodes start."""
        draws = torch.Generator().manual_seed(0)
        features, starts = torch.randn(4 * 7, 3, generator=draws), torch.zeros(4 * 7)
        starts[list(begin)] = 1
        lstm, state = torch.nn.LSTM(3, 5), tuple(torch.randn(1, 4, 5, generator=draws) for _ in range(2))
        results, calls = [], list[object]()
        lstm.register_forward_hook(lambda *call: calls.append(call))
        for policy in (SequencePolicy, SequencePolicy.__base__):
            lstm.zero_grad()
            out, after = policy._process_sequence(features, state, starts, lstm)
            (out.sum() + after[1].sum()).backward()
            results.append([out, *after, *(weight.grad.clone() for weight in lstm.parameters())])
            if policy is SequencePolicy:
                assert len(calls) == (7 if any(i % 7 for i in begin) else 1)
        torch.testing.assert_close(*results, rtol=0, atol=1e-5)

    def test_discriminator_tells_them_apart(self) -> None:
        """A constant against a random action: its logit, the reward, is above 0 for one, below for the other."""
        draws = streams(2)
        own = random_batch(draws, 64, 4)[:, :, 0]
        expert = Batch(own.obs, torch.full_like(own.action, 0.5), own.next_obs, own.mask)
        net = Discriminator(16, scales(own), draws)
        optimizer = Adam([net], 1e-2)
        for _ in range(150):
            optimizer.step(net.loss(expert, own))
        for i in range(2):
            rewards = [net.of_seed(i).reward(b.obs[i].numpy(), b.action[i].numpy(), b.next_obs[i].numpy())
                       for b in (expert, own)]  # fmt: skip
            assert (rewards[0] > 0).mean() > 0.9
            assert (rewards[1] < 0).mean() > 0.9
            np.testing.assert_allclose(rewards[0], net(expert)[i].detach(), atol=1e-5)

    def test_a_discriminator_reads_standard_columns(self) -> None:
        """Observations, actions and changes of the expert have a mean of 0 and a deviation of 1 there."""
        own, seen = random_batch(streams(2), 64, 4), list[torch.Tensor]()
        own = Batch(30 + own.obs, 0.1 * own.action, 30 + own.next_obs, own.mask)
        net = Discriminator(16, scales(own), streams(2))
        net.net.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
        net(own.flat())
        torch.testing.assert_close(seen[0].mean(1), torch.zeros(2, 5), rtol=0, atol=1e-4)
        torch.testing.assert_close(seen[0].std(1, correction=0), torch.ones(2, 5), rtol=0, atol=1e-4)

    def test_what_outlives_an_episode(self) -> None:
        """Its memory, and not the action before: a flag of the start stands in its place."""
        batch = random_batch(streams())
        agent = GailAgent.blank({"width": 8}, scales(batch), streams())
        agent.begin(3)
        agent.reset([np.random.default_rng(0)])
        with torch.no_grad():
            agent.choose(batch.obs[:, :, 0])
        agent.remember(batch[:, :, 0])
        memory = agent.features()
        agent.reset([np.random.default_rng(0)])
        np.testing.assert_array_equal(agent.features(), memory)
        assert memory.any()
        assert agent._before.tolist() == [[[0, 1]] * 3]

    def test_its_environments_hide_theta(self) -> None:
        """Its observation is the task's, the previous action, and a flag of an episode's start."""
        vec, behind = gail_env()
        obs, width = vec.reset(), len(envs.get(CONTROL).observation)
        plain = envs.BatchEnv(envs.get(CONTROL), 3)
        np.testing.assert_array_equal(obs[:, :width], plain.reset(behind.seeds))
        assert obs.shape == (3, width + 2)
        assert obs[:, width:].tolist() == [[0, 1]] * 3
        action = np.full((3, 1), 0.25)
        obs, _, done, infos = vec.step(action)
        np.testing.assert_array_equal(obs[:, :width], plain.step(action)[0])
        assert obs[:, width:].tolist() == [[0.25, 0]] * 3
        assert not done.any()
        assert infos == [{}] * 3

    def test_a_trial_is_an_episode_of_ppo(self) -> None:
        """theta changes when `done` is true, after as many episodes as the task has, and at no other step."""
        vec, behind = gail_env()
        vec.reset()
        episodes, theta, ended = np.zeros(3, int), behind.batch.theta.copy(), 0
        for action in 2 * np.random.default_rng(0).random((400, 3, 1)) - 1:
            obs, _, done, infos = vec.step(action)
            episodes += obs[:, -1] == 1
            assert not obs[obs[:, -1] == 1, -2].any()  # the action before an episode's start
            kept = (behind.batch.theta == theta).all(-1)
            np.testing.assert_array_equal(kept, ~done)
            assert (episodes[done] == envs.get(CONTROL).episodes).all()
            for i in np.flatnonzero(done):
                assert infos[i]["terminal_observation"].shape == obs[i].shape
                assert infos[i]["TimeLimit.truncated"]  # a trial ends by its length, and not in a state worth nothing
                last = vec.transitions[-1][2][i]
                np.testing.assert_array_equal(infos[i]["terminal_observation"][: len(last)], last)
            episodes[done], ended = 0, ended + int(done.sum())
            theta = behind.batch.theta.copy()
        assert ended > 3
        assert behind.context.monitor.budget["exploration_trials"] == [3 + ended]

    @pytest.mark.slow
    def test_interactions_are_counted(self) -> None:
        """Two rounds of 32 steps in 2 environments, for each seed; global generators are restored."""
        monitor = Monitor()
        state, numbers = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
        made("gail", seeds=(0, 1), monitor=monitor)
        assert monitor.budget["interactions"] == [128, 128]
        assert monitor.budget["expert_trials"] == [4, 4]
        assert min(monitor.budget["exploration_trials"]) >= 4
        assert torch.equal(torch.get_rng_state(), state)
        np.testing.assert_array_equal(np.random.get_state()[1], numbers)  # noqa: NPY002


def test_gail_without_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gail, "find_spec", lambda name: None)
    with pytest.raises(envs.InputError, match=r"^gail needs sb3-contrib; install deconfounded-imitation\[train\]$"):
        made("gail")


@pytest.mark.slow
def test_stable_baselines_leaves_no_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither in a baseline's rounds nor for an expert."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    made("gail")
    train(envs.get(CONTROL), 2048, 0, lambda *_: None, n=16)
    assert not [*tmp_path.glob("SB3*")]


@pytest.mark.parametrize("method", ["deconfounded_mean", "gail", "rma"])
def test_no_rounds_is_one_line(method: str) -> None:
    settings = tiny_preset().configured(method, rounds=0)
    with pytest.raises(envs.InputError, match=r"^rounds of \w+Config was 0; it must be int, from 1 up$"):
        fit(Context(envs.get("bandit"), settings, [0]), method)


class Interrupted(Monitor):
    """Keeps every checkpoint; a training that is given one goes on from there."""

    def __init__(self, before: Training | None = None) -> None:
        super().__init__()
        self.before, self.saved, self.counts = before, list[Training](), list[int]()

    def update(self, done: int, *_: Any) -> None:
        self.counts.append(done)

    def save(self, state: Callable[[], Training]) -> None:
        self.saved.append(copy.deepcopy(state()))

    def load(self) -> Training | None:
        return self.before


@pytest.mark.slow
@pytest.mark.parametrize("method", [*NEW, "deconfounded_large"])
def test_interrupted_training_resumes(method: str) -> None:
    """An agent of resumed training acts, bit for bit, as one without interruption, and so does a loaded one.

    Updates go on to be counted where they stood.
    """
    monitor, task = Interrupted(), envs.get("bandit")
    whole = made(method, "bandit", monitor=monitor)
    assert isinstance(whole, LearnedAgent)
    agents = [whole, type(whole).from_state(*whole.state())]
    resumed = [Interrupted(monitor.saved[i]) for i in (0, -1)]  # the last is of a whole training
    agents += [made(method, "bandit", monitor=each) for each in resumed]
    for each in resumed:
        assert each.counts == monitor.counts[len(monitor.counts) - len(each.counts) :]
    actions: list[Array] = []
    for agent in agents:
        for key, array in whole.state()[1].items():  # few updates may leave all actions as they were
            np.testing.assert_array_equal(agent.state()[1][key], array, err_msg=key)
        actions.append(run_trials(envs.BatchEnv(task, 4), agent, 2, 1).trials.action)
    for others in actions[1:]:
        np.testing.assert_array_equal(others, actions[0])


def test_arrays_of_a_seed_of_two() -> None:
    agent = made("blind_bc", seeds=(0, 1))
    assert isinstance(agent, LearnedAgent)
    whole = agent.state()[1]
    for seed in (0, 1):
        for key, array in agent.of_seed(seed).state()[1].items():
            np.testing.assert_array_equal(array, whole[key][seed : seed + 1] if whole[key].ndim else whole[key])
    assert any((x[0] != x[1]).any() for x in whole.values() if x.ndim)


@pytest.mark.slow
@pytest.mark.parametrize("method", NEW)
def test_a_seed_of_two_alone(method: str) -> None:
    agent = made(method, seeds=(0, 1))
    assert isinstance(agent, LearnedAgent)
    env = envs.BatchEnv(envs.get(CONTROL), 4)
    both = run_trials(env, agent, 2, [5, 6]).trials.action
    alone = run_trials(envs.BatchEnv(env.task, 2), agent.of_seed(1), 2, [6]).trials.action
    np.testing.assert_array_equal(alone, both[2:])
