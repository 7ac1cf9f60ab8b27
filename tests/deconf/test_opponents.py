"""Opponents of 2023 to 2026: what a context tells DPT, and what a flow draws, chunk by chunk."""

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded.deconf.core.data import Draws, Signature
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.methods import dpt, flow_bc
from deconfounded.deconf.methods.dpt import DptAgent, DptConfig
from deconfounded.deconf.methods.flow_bc import FlowAgent, FlowConfig
from deconfounded.experts.trials import Trials
from tests.deconf.test_baselines import random_batch, scales, streams

SHAPE = {"width": 16, "layers": 2, "heads": 2, "window": 12, "forgets": False}


class TestDpt:
    def test_step_by_step_it_answers_as_in_training(self) -> None:
        """In deployment a query's features are those of `answers` after as many transitions; to 1e-5."""
        batch = random_batch(streams(2), 3, 12)
        agent = DptAgent.blank(SHAPE, scales(batch), streams(2))
        every = torch.arange(12).expand(2, 3, 12)
        with torch.no_grad():
            expected = agent.net.answers(agent.transitions(batch), agent.queries(batch.obs), every)
            agent.begin(6)
            agent.reset([np.random.default_rng(i) for i in range(2)])
            for t in range(12):
                agent.choose(batch.obs[:, :, t])
                torch.testing.assert_close(agent._features, expected[:, :, t], rtol=0, atol=1e-5)
                agent.remember(batch[:, :, t])

    @pytest.mark.parametrize("forgets", [False, True])
    def test_what_is_left_of_the_episode_before(self, forgets: bool) -> None:
        """Its transitions are read on, or, where theta drifts, not at all."""
        batch = random_batch(streams(2), 3, 12)
        agent = DptAgent.blank({**SHAPE, "forgets": forgets}, scales(batch), streams(2))
        seen = torch.full((2, 3, 1), 0 if forgets else 4)
        with torch.no_grad():
            query = agent.queries(batch.obs[:, :, 4:5])
            expected = agent.net.answers(agent.transitions(batch), query, seen)
            agent.begin(6)
            for first, last in ((0, 4), (4, 5)):
                agent.reset([np.random.default_rng(i) for i in range(2)])
                for t in range(first, last):
                    agent.choose(batch.obs[:, :, t])
                    features = agent._features.clone()
                    agent.remember(batch[:, :, t])
        torch.testing.assert_close(features, expected[:, :, 0], rtol=0, atol=1e-5)

    def test_a_query_reads_what_it_may(self) -> None:
        """Neither later transitions nor other queries; but the transitions before."""
        batch = random_batch(streams(2), 3, 12)
        agent = DptAgent.blank(SHAPE, scales(batch), streams(2))
        context, queries, seen = agent.transitions(batch), agent.queries(batch.obs), torch.full((2, 3, 12), 5)
        first = agent.net.answers(context, queries, seen)
        later, before, other_queries = context.clone(), context.clone(), queries.clone()
        later[:, :, 5:] += 1
        before[:, :, 4] += 1
        other_queries[:, :, 1:] += 1
        with torch.no_grad():
            torch.testing.assert_close(agent.net.answers(later, queries, seen), first)
            torch.testing.assert_close(agent.net.answers(context, other_queries, seen)[:, :, 0], first[:, :, 0])
            assert ((agent.net.answers(before, queries, seen) - first).abs().amax(-1) > 1e-4).all()

    def test_queries_are_of_steps_that_took_place(self) -> None:
        """And read so many transitions at most; where they are not from anywhere, all before them."""
        mask = torch.tensor([[[1.0] * 9, [1.0] * 2 + [0.0] * 7]])
        for anywhere in (1.0, 0.0):
            index, seen = dpt.draw_queries(mask, 4, DptConfig(queries=400, anywhere=anywhere), streams())
            steps, most = (9, 2) if anywhere else (4, 2), (4, 2)
            assert [set(row.tolist()) for row in index[0]] == [set(range(n)) for n in steps]
            assert seen.amax(-1).tolist() == [[n - 1 + anywhere for n in most]]
            assert torch.equal(index, seen) == (anywhere == 0)

    def test_of_a_trial_without_a_step(self) -> None:
        """There is no query; its place is that trial's first, which the loss leaves out."""
        mask = torch.tensor([[[0.0] * 9, [1.0] * 9]])
        for anywhere in (1.0, 0.0):
            index, seen = dpt.draw_queries(mask, 4, DptConfig(queries=40, anywhere=anywhere), streams())
            assert not index[0, 0].any()
            assert not seen[0, 0].any()

    def test_it_infers_theta_in_context(self) -> None:
        """A hidden push is to one side or the other, and the expert acts by it: after ten actions, so does it."""
        rng = np.random.default_rng(0)

        def rollouts(n: int) -> tuple[Trials, np.ndarray]:
            push, action = rng.choice([-1.0, 1.0], (n, 1, 1, 1)), rng.uniform(-1, 1, (n, 1, 20, 1))
            moved = np.concatenate([np.zeros((n, 1, 1, 1)), (action + 0.5 * push).cumsum(2)], 2)
            return Trials(moved, action, np.ones((n, 1, 20), bool)), (0.5 * push + 0 * action).astype(np.float32)

        amounts = {
            "rounds": 1,
            "updates": 80,
            "batch": 16,
            "queries": 16,
            "anywhere": 1.0,
            "shortest": 1.0,
            "learning_rate": 1e-2,
        }
        config = DptConfig(width=16, layers=1, heads=2, **amounts)
        agent = dpt.train(lambda behaviour: rollouts(64), config, rng)
        trials, label = rollouts(50)
        obs, action = trials.obs[:, 0], trials.action[:, 0]
        agent.begin(50)
        agent.reset([rng])
        for t in range(10):
            agent.act(obs[:, t])
            agent.observe(obs[:, t], action[:, t], obs[:, t + 1], np.ones(50, bool))
        assert (np.sign(agent.act(obs[:, 10])) == np.sign(label[:, 0, 0])).mean() > 0.9


class TestFlow:
    @pytest.mark.parametrize("actions", [0, 2])
    def test_it_draws_from_the_experts_distribution(self, actions: int) -> None:
        """Two actions, of probability .7 and .3 after the same observations: not their mean."""
        rng = np.random.default_rng(0)
        obs, second = np.zeros((64, 1, 11, 2)), rng.random((64, 1, 10, 1)) < 0.3
        trials = Trials(obs, second if actions else second - 0.5, np.ones((64, 1, 10), bool), actions)
        config = FlowConfig(width=32, history=1, ahead=1, updates=150, batch=16, steps=128, learning_rate=1e-2)
        agent = flow_bc.train(trials, config, rng)
        agent.begin(1000)
        agent.reset([rng])
        drawn = agent.act(np.zeros((1000, 2), np.float32)) + (0 if actions else 0.5)
        assert (drawn > 0.5).mean() == pytest.approx(0.3, abs=0.1)
        assert (np.abs(drawn - 0.5) < 0.25).mean() < 0.15

    def test_it_integrates_the_flow(self) -> None:
        """Given the exact ends of paths to N(m, s^2), noise x ends at m + s x; to .03 in ten steps."""
        mean, std, steps = 0.4, 0.3, 10
        signature = Signature(obs=2, action=1, actions=0, binary=False)
        shape = {"width": 8, "history": 3, "ahead": 4, "executed": 1, "integration": steps}
        policy = FlowAgent.blank(shape, Scales.plain(signature, 1), streams()).policy

        def end(x: Tensor, share: Tensor, phases: Tensor, embedded: Tensor) -> Tensor:
            tau = phases[..., :1].acos() / torch.pi
            return mean + std**2 * tau / (std**2 * tau**2 + (1 - tau) ** 2) * (x - tau * mean)

        policy.end = end  # type: ignore[method-assign]
        policy.decode = lambda x: x  # type: ignore[method-assign]
        drawn = policy.sample(torch.zeros(1, 500, 2 + 3 * 4), steps, streams())
        noise = streams().normal(500, 4)
        torch.testing.assert_close(drawn.flatten(2), mean + std * noise, rtol=0, atol=0.03)

    def test_a_chunk_is_executed_before_the_next_is_drawn(self) -> None:
        """Of four actions two: the second does not depend on what was observed meanwhile, and the third does."""
        signature = Signature(obs=2, action=1, actions=0, binary=False)
        shape = {"width": 8, "history": 3, "ahead": 4, "executed": 2, "integration": 2}
        acted = []
        for seen in (0.0, 1.0):
            agent = FlowAgent.blank(shape, Scales.plain(signature, 1), streams())
            agent.begin(5)
            agent.reset([np.random.default_rng(0)])
            acted.append([agent.act(np.full((5, 2), seen * (t > 0), np.float32)) for t in range(3)])
        same = [np.array_equal(*pair) for pair in zip(*acted, strict=True)]
        assert same == [True, True, False]

    def test_the_history_of_training_is_that_of_deployment(self) -> None:
        """Features of each step of an episode: the observation, and the three steps before it.

        Its chunk is of this action and the next; at the end of an episode the last is repeated.
        """
        draws: Draws = streams(2)
        batch = random_batch(draws, 2, 6)
        shape = {"width": 8, "history": 3, "ahead": 2, "executed": 1, "integration": 1}
        agent, given = FlowAgent.blank(shape, scales(batch), draws), []
        loss = agent.policy.loss
        agent.policy.loss = lambda features, *rest: (given.append((features, rest[0])), loss(features, *rest))[1]  # type: ignore[method-assign]
        agent.loss(batch, batch.action, None, draws)
        features, chunk = (x.unflatten(1, (2, 6)) for x in given[0])
        agent.begin(4)
        agent.reset([np.random.default_rng(i) for i in range(2)])
        for t in range(6):
            now = torch.cat([agent.scales.obs(batch.obs[:, :, t]), agent._past.flatten(2)], -1)
            torch.testing.assert_close(features[:, :, t], now)
            agent.remember(batch[:, :, t])
        assert torch.equal(chunk[:, :, :5, 1], batch.action[:, :, 1:])
        assert torch.equal(chunk[:, :, 5, 1], batch.action[:, :, 5])
