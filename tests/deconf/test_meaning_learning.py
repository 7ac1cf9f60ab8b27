"""Learning by what it means: padding is read by nobody, gradients are clipped, exploration is what it says."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.beliefs import EvidenceBelief
from deconfounded.deconf.core.data import Batch, Draws, Signature
from deconfounded.deconf.core.latent_agent import DeconfoundedAgent, Explorer
from deconfounded.deconf.core.latent_model import LatentModel
from deconfounded.deconf.core.layers import Linear
from deconfounded.deconf.core.models import VariationalModel, new_model
from deconfounded.deconf.core.nets import Scales, Whitener, gaussian_log_prob
from deconfounded.deconf.core.online import OnlineBelief
from deconfounded.deconf.equations import masked_mean
from deconfounded.deconf.methods import dagger as dagger_method
from deconfounded.deconf.methods import deconfounded, deconfounded_mean, rma
from deconfounded.deconf.methods.dagger import DaggerAgent
from deconfounded.deconf.methods.deconfounded_mean import MeanAgent, MeanConfig
from deconfounded.deconf.methods.dpt import DptAgent
from deconfounded.deconf.methods.flow_bc import FlowAgent
from deconfounded.deconf.methods.naive_obs import ObsAgent
from deconfounded.deconf.methods.naive_transformer import TransformerAgent
from deconfounded.deconf.methods.sequence_bc import RecurrentAgent
from deconfounded.envs.streams import Array
from deconfounded.experts.trials import Trials
from tests.tools import FEW

FLAT = Signature(obs=2, action=1, actions=0, binary=False)


def draws() -> Draws:
    return Draws([np.random.default_rng(i) for i in range(2)], "cpu")


@pytest.fixture
def batch() -> Batch:
    """Trials of two seeds, 4 of up to 9 steps, that ended after 9, 6, 6 and 2."""
    random = draws()
    obs = random.normal(4, 10, 2)
    ends = torch.tensor([9, 6, 6, 2])
    mask = (torch.arange(9) < ends[:, None]).float().expand(2, 4, 9)
    return Batch(obs[:, :, :-1], 2 * random.uniform(4, 9, 1) - 1, obs[:, :, 1:], mask)


def poisoned(batch: Batch) -> Batch:
    """The same trials, with other numbers in their padding."""
    over = batch.mask[..., None] == 0
    filled = (x.masked_fill(over, value) for x, value in zip(batch.tensors[:3], (50.0, 0.7, -30.0), strict=True))
    return Batch(*filled, batch.mask)


def test_scales_read_no_padding(batch: Batch) -> None:
    """Mean and deviation are those of the steps that took place, by hand."""
    scales = Scales.of(FLAT, poisoned(batch))
    columns = (batch.obs, batch.next_obs - batch.obs, batch.action, batch.action)
    for one, data in zip((scales.obs, scales.change, scales.action, scales.label), columns, strict=True):
        for seed in range(2):
            rows = data[seed][batch.mask[seed] == 1]
            torch.testing.assert_close(one.mean[seed], rows.mean(0))
            torch.testing.assert_close(one.std[seed], rows.std(0, correction=0))


def test_a_masked_mean_is_over_what_counts() -> None:
    assert masked_mean(torch.tensor([1.0, 3.0, 50.0]), torch.tensor([1.0, 1.0, 0.0])).item() == 2
    assert masked_mean(torch.tensor([50.0]), torch.tensor([0.0])).item() == 0


def test_steps_are_drawn_from_those_that_took_place(batch: Batch) -> None:
    """Each of the 23 about as often: 20,000 draws, five standard errors."""
    index = batch.draw_steps(20_000, draws())
    assert batch.steps(index).mask.all()
    counts = torch.stack([torch.bincount(one, minlength=36) for one in index])[batch.mask.flatten(1) == 1]
    expected = 20_000 / 23
    assert (counts - expected).abs().max() < 5 * expected**0.5


Loss = Callable[[Batch], Tensor]


def losses(batch: Batch) -> dict[str, Loss]:
    """What each agent and model is trained to make small, without random numbers of one call in another."""
    scales = Scales.of(FLAT, batch)
    shape = {"width": 16, "layers": 1, "heads": 2, "window": 9}
    recurrent, blind = RecurrentAgent.new(8, scales, draws()), ObsAgent.new(8, scales, draws())
    transformer = TransformerAgent.new(shape, scales, draws())
    dagger = DaggerAgent.new(16, 3, False, scales, draws())
    dpt = DptAgent.blank({**shape, "forgets": False}, scales, draws())
    flow = FlowAgent.blank({"width": 8, "history": 3, "ahead": 2, "executed": 1, "integration": 1}, scales, draws())
    adapter = rma.Adapter(8, 1, scales, draws())
    student = rma.RmaAgent(adapter, recurrent.policy)
    by_name: dict[str, Loss] = {
        "naive_rnn": lambda given: recurrent.loss(given, given.action, recurrent.memory.start(4))[0],
        "naive_obs": lambda given: blind.loss(given, given.action, blind.memory.start(4))[0],
        "naive_transformer": lambda given: transformer.held_out_loss(given),
        "dpt": lambda given: dpt.loss(given, given.action),
        "flow_bc": lambda given: flow.loss(given, given.action, None, draws()),
        "dagger": lambda given: dagger.loss(given, given.action, None, draws()),
        "rma": lambda given: student.loss(given, given.action, adapter.start(4))[0],
    }
    mean, config = MeanAgent.new("evidence", 3, 16, scales, draws()), MeanConfig(inference_steps=200)
    by_mean = mean.model.eval()
    by_name["deconfounded_mean"] = lambda given: deconfounded_mean.inference_loss(by_mean, given, config, draws())
    for kind in ("linear", "innovations", "evidence", "gru", "discrete"):
        model = new_model(kind, 3, 16, scales, draws()).eval()
        agent = DeconfoundedAgent.new(kind, 3, 16, scales, draws())
        belief = agent.model.belief(agent.model.final_memory(batch)).detach()
        by_name[f"{kind} model"] = lambda given, model=model: model.loss(given, None, 0.1, draws())  # type: ignore[misc]
        by_name[f"{kind} policy"] = lambda given, agent=agent, belief=belief: agent.loss(given, belief, None, draws())  # type: ignore[misc]
        by_name[f"{kind} memory"] = lambda given, model=model: model.final_memory(given).flatten()  # type: ignore[misc]
    return by_name


def test_losses_and_memories_read_no_padding(batch: Batch) -> None:
    """They are what they are with other numbers in it, and not what they are with another last step."""
    other = Batch(*(x.clone() for x in batch.tensors))
    other.next_obs[:, 0, 8] += 1
    other.action[:, 0, 8] *= -1
    for name, loss in losses(batch).items():
        torch.testing.assert_close(loss(poisoned(batch)), loss(batch), rtol=1e-5, atol=1e-6, msg=name)
        assert not torch.allclose(loss(other), loss(batch), rtol=1e-5, atol=1e-6), name


@pytest.mark.parametrize(("size", "right"), [(1e3, 1.0), (1e-3, None)])
def test_gradients_are_clipped_seed_by_seed(size: float, right: float | None) -> None:
    """To norm 1, of all parameters together; small ones are left as they are, and so is a small one beside a large."""
    layers = [Linear(3, 2, draws()), Linear(2, 1, draws())]
    optimizer = Adam(layers, 1e-3)
    x = draws().normal(5, 3)
    loss = layers[1](layers[0](x)).flatten(1).mean(1) * torch.tensor([size, 1e-3])
    expected = torch.autograd.grad(loss.sum(), optimizer.parameters)
    optimizer.step(layers[1](layers[0](x)).flatten(1).mean(1) * torch.tensor([size, 1e-3]))
    before = torch.cat([gradient.flatten(1) for gradient in expected], 1).norm(dim=1)
    norms = optimizer.gradient.norm(dim=1)
    assert before[1] < 0.1
    torch.testing.assert_close(norms[1], before[1])
    torch.testing.assert_close(norms[0], before[0] if right is None else torch.tensor(right), rtol=1e-4, atol=1e-6)


class TestExploration:
    def explorer(self, share: float) -> Explorer:
        """Of 8 trials for each of two seeds; its policy is sure, and its latents of expert trials are 7."""
        agent = DeconfoundedAgent.new("evidence", 3, 16, Scales.plain(FLAT, 2), draws())
        made = Explorer(agent, torch.full((2, 4, 3), 7.0), share)
        made.begin(16)
        made.reset([np.random.default_rng(i) for i in range(2)])
        return made

    def test_every_other_trial_is_blind_to_its_history(self) -> None:
        """Its latent is one of expert trials for an episode; in the others it is drawn from the belief."""
        latent = self.explorer(0.1).latent()
        assert (latent[:, ::2] == 7).all()
        assert (latent[:, 1::2] != 7).all()

    def test_trials_that_begin_one_by_one(self) -> None:
        """As in a program that has one environment: every other one is blind, of all that begin."""
        of_one_seed = Draws([np.random.default_rng(0)], "cpu")
        agent = DeconfoundedAgent.new("evidence", 3, 16, Scales.plain(FLAT, 1), of_one_seed)
        made, blind = Explorer(agent, torch.full((1, 4, 3), 7.0), 0.1), []
        for _ in range(6):
            made.begin(1)
            made.reset([np.random.default_rng(0)])
            blind.append(bool((made.latent() == 7).all()))
        assert blind == [True, False] * 3

    def test_a_share_of_actions_is_random(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Of a policy that always says .5: as many others as asked for, uniform in [-1, 1]."""
        for share in (0.0, 0.3, 1.0):
            explorer = self.explorer(share)
            monkeypatch.setattr(explorer.policy, "sample", lambda features, _: torch.full((2, 8, 1), 0.5))
            acted = np.stack([explorer.act(np.zeros((16, 2), np.float32)) for _ in range(100)])
            random = acted != 0.5
            assert random.mean() == pytest.approx(share, abs=0.05)
            if share:
                assert acted[random].mean() == pytest.approx(0, abs=0.12)
                assert acted[random].std() == pytest.approx(3**-0.5, abs=0.05)


def test_a_schedule_is_a_cosine_that_ends_with_training() -> None:
    """The rate is half in the middle, and 0 after the last update."""
    layer = Linear(2, 1, draws())
    optimizer, rates = Adam([layer], 0.1, 10), []
    for _ in range(10):
        optimizer.step(layer(torch.ones(2, 3, 2)).flatten(1).mean(1))
        rates.append(optimizer.rate)
    assert rates[4] == pytest.approx(0.05)
    assert rates[-1] == pytest.approx(0, abs=1e-9)


def test_a_whitener_follows_its_first_batches() -> None:
    """By a twentieth in each of the updates that it has, and in none afterwards."""
    whitener, x, kept = Whitener(2, draws()), 5 + 2 * draws().normal(50, 2), 0.95**3
    whitener.updates_left = 3
    for _ in range(5):
        whitener(x, torch.ones(2, 50))
    torch.testing.assert_close(whitener.mean, (1 - kept) * x.mean(1))
    torch.testing.assert_close(whitener.variance, kept + (1 - kept) * x.var(1, correction=0))


def test_a_gaussian_density_has_the_gradient_of_autograd() -> None:
    mean, std = (draws().normal(3, 2).double() for _ in range(2))
    x, std = mean + 0.7, std.abs() + 0.3
    expected = torch.distributions.Normal(mean, std).log_prob(x).sum(-1)
    torch.testing.assert_close(gaussian_log_prob(x, mean, std), expected)
    given = [mean.requires_grad_(), std.requires_grad_()]
    assert torch.autograd.gradcheck(lambda *given: gaussian_log_prob(x.detach(), *given), given)


def test_an_optimizer_that_is_restored_goes_on_as_before() -> None:
    """With both moments, the count and the rate of each seed."""
    layer, restored = Linear(2, 1, draws()), Linear(2, 1, draws())
    optimizer = Adam([layer], 0.1, 10)

    def updated(of: Linear, by: Adam, size: float) -> Tensor:
        by.step((size * of(torch.ones(2, 3, 2))).flatten(1).mean(1))
        return by.parameters[0].clone()

    for size in (0.3, 0.01, 0.2):
        updated(layer, optimizer, size)
    other = Adam([restored], 0.1, 10)
    restored.load_state_dict(layer.state_dict())
    other.load_state_dict(optimizer.state_dict())
    for size in (0.1, 0.4):
        torch.testing.assert_close(updated(restored, other, size), updated(layer, optimizer, size), rtol=0, atol=0)


def test_later_rounds_get_more_updates() -> None:
    """In proportion to the labels that there are; at least one."""
    assert dagger_method.by_round(100, 4) == [10, 20, 30, 40]
    assert dagger_method.by_round(2, 3) == [1, 1, 1]


def test_dagger_learns_what_the_expert_would_have_done(monkeypatch: pytest.MonkeyPatch) -> None:
    """Roll-outs whose actions are .5, and labels of -.5: the loss is of the labels, evidence of the actions."""
    seen: list[tuple[Tensor, Tensor]] = []
    loss = DaggerAgent.loss

    def spy(self: DaggerAgent, given: Batch, label: Tensor, *rest: object) -> Tensor:
        seen.append((given.action, label))
        return loss(self, given, label, *rest)  # type: ignore[arg-type]

    def query(behaviour: object) -> tuple[Trials, np.ndarray]:
        obs = np.random.default_rng(0).random((8, 1, 6, 2))
        trials = Trials(obs, np.full((8, 1, 5, 1), 0.5), np.ones((8, 1, 5), bool))
        return trials, -trials.action

    monkeypatch.setattr(DaggerAgent, "loss", spy)
    dagger_method.train(
        query, dagger_method.DaggerConfig(16, 3, rounds=2, updates=2, batch=4), [np.random.default_rng(0)]
    )
    assert len(seen) == 2
    assert all((action == 0.5).all() and (label == -0.5).all() for action, label in seen)


@pytest.mark.parametrize("model", ["linear", "innovations", "gru"])
def test_dynamics_are_learned_from_exploration_alone(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the policy from the expert: its actions are .5, those of exploration -.5."""
    seen: dict[str, list[Tensor]] = {"dynamics": [], "policy": []}

    def spied(kind: type, method: str, what: str) -> None:
        true = getattr(kind, method)

        def spy(self: object, *given: object, **rest: object) -> object:
            seen[what].extend(batch.action for batch in given if isinstance(batch, Batch))
            return true(self, *given, **rest)

        monkeypatch.setattr(kind, method, spy)

    spied(LatentModel, "learn", "dynamics")
    spied(OnlineBelief, "fit", "dynamics")
    spied(DeconfoundedAgent, "loss", "policy")
    rng = np.random.default_rng(0)
    expert, explored = (
        Trials(rng.random((8, 1, 6, 2)), np.full((8, 1, 5, 1), action), np.ones((8, 1, 5))) for action in (0.5, -0.5)
    )
    config = deconfounded.DeconfoundedConfig(**{**FEW, "model": model})
    deconfounded.train(expert, lambda behaviour: explored, config, rng)
    for what, action in (("dynamics", -0.5), ("policy", 0.5)):
        assert len(seen[what]) > 1
        assert all((each == action).all() for each in seen[what]), what


def loaded_mass(n: int, rng: np.random.Generator) -> tuple[Array, Batch]:
    """Theta [n, 2] and trials of masses on two axes, whose speeds an action moves ten times as much as the hidden load.

    The observation, a sine and a cosine of each position and the speeds, is exact but for gusts on the speeds.
    """
    theta, place, speed = rng.uniform(-1, 1, (n, 2)), rng.normal(size=(n, 2)), rng.normal(size=(n, 2))
    seen, actions = [np.concatenate([np.sin(place), np.cos(place), speed], 1)], []
    for _ in range(60):
        actions.append(rng.uniform(-1, 1, (n, 2)))
        place = place + 0.3 * speed
        push = 2 * np.tanh(2 * actions[-1]) * np.cos(place) + 0.4 * theta
        speed = 0.7 * speed + push + 0.5 * rng.normal(size=(n, 2))
        seen.append(np.concatenate([np.sin(place), np.cos(place), speed], 1))
    obs, action = (torch.tensor(np.stack(x, 1), dtype=torch.float32)[None] for x in (seen, actions))
    return theta, Batch(obs[:, :, :-1], action, obs[:, :, 1:], torch.ones(1, n, 60))


def trained(data: Batch, latent: int, updates: int, rng: np.random.Generator, kind: str = "evidence") -> LatentModel:
    """A model of that kind, trained on continuous trials."""
    streams, signature = Draws([rng], "cpu"), Signature(data.obs.shape[-1], data.action.shape[-1], 0, False)
    model = new_model(kind, latent, 32, Scales.of(signature, data), streams)
    optimizer = Adam([model], 5e-3, updates)
    for update in range(updates):
        batch = data.beginnings(update, 0.25).draw_trials(16, streams)
        model.learn(optimizer, batch, 256, 1e-3 * min(1, 2 * update / updates), streams)
    return model


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "least"), [("evidence", 0.45), ("innovations", 0.6), ("linear", 0.6)])
def test_a_small_effect_is_learned_beside_large_ones(kind: str, least: float) -> None:
    """Of two loads, small beside the noise, the belief knows most after 60 steps, on trials it has not seen.

    R2 of a linear probe, mean over loads; .92 is what the exact filter has.
    """
    rng = np.random.default_rng(0)
    (_, data), (theta, fresh) = loaded_mass(96, rng), loaded_mass(200, rng)
    model = trained(data, 8, 300, rng, kind)
    with torch.no_grad():
        inferred = model.mean(model.belief(model.final_memory(fresh)))[0].double().numpy()
    inputs = np.concatenate([inferred, np.ones((200, 1))], 1)
    left = theta[100:] - inputs[100:] @ np.linalg.lstsq(inputs[:100], theta[:100], rcond=None)[0]
    assert 1 - (left**2).mean() / theta[100:].var() > least


def steered(n: int, informed: float, rng: np.random.Generator) -> Batch:
    """Trials of a rudder that a hidden sign turns; a share of explorers know it, and steer to 0, others at random."""
    sign, place = rng.choice([-1.0, 1.0], n), rng.normal(size=n)
    seen, actions = [place], []
    for _ in range(40):
        back = np.where(np.arange(n) < informed * n, -sign * place, rng.uniform(-2, 2, n))
        actions.append(back + 0.1 * rng.normal(size=n))
        place = 0.9 * place + 0.5 * sign * actions[-1] + 0.3 * rng.normal(size=n)
        seen.append(place)
    obs, action = (torch.tensor(np.stack(x, 1)[..., None], dtype=torch.float32)[None] for x in (seen, actions))
    return Batch(obs[:, :, :-1], action, obs[:, :, 1:], torch.ones(1, n, 40))


@pytest.mark.slow
def test_what_is_expected_of_a_step_is_blind_to_theta() -> None:
    """Informed actions bring the rudder back by .5 a step, on average; blind to theta, they do nothing on average.

    So the innovations of such steps are to be .5 towards 0. Those from the plain mean of changes are .15 to .19.
    """
    rng = np.random.default_rng(0)
    data, fresh = steered(96, 0.8, rng), steered(200, 1.0, rng)
    model = trained(data, 4, 150, rng)
    assert isinstance(model, VariationalModel)
    belief = model.encoder
    assert isinstance(belief, EvidenceBelief)
    with torch.no_grad():
        inputs = torch.cat([belief.inputs.obs(fresh.obs), belief.inputs.action(fresh.action)], -1)
        innovation = fresh.next_obs - fresh.obs - belief.change.inverse(belief.expected(inputs))
        towards = -(innovation * fresh.obs).sum() / fresh.obs.square().sum()
    assert 0.25 < towards < 0.75
