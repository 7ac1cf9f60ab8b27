"""A model whose dynamics are linear in the latent: likelihoods in closed form, and what it learns of a ball."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.correlated import Correlated, posterior_root
from deconfounded.deconf.core.data import Batch, Signature
from deconfounded.deconf.core.drift import choose_kept
from deconfounded.deconf.core.latent_model import final_belief
from deconfounded.deconf.core.linear_model import ALIKE, ERROR, Evidence, ExactLinearModel, LinearModel, weigh
from deconfounded.deconf.core.models import VariationalModel
from deconfounded.deconf.core.nets import Scales
from deconfounded.deconf.core.online import OnlineBelief
from deconfounded.deconf.methods.deconfounded_offline import exact
from deconfounded.envs.support.errors import InputError
from tests.deconf.ball import STEPS, pushed, streams


def untrained(latent: int, data: Batch) -> LinearModel:
    return LinearModel(latent, 32, Scales.of(Signature(1, 1, 0, False), data), streams())


def fitted(model: LinearModel, data: Batch, updates: int) -> LinearModel:
    draws, optimizer = streams(), Adam([model], 1e-2, updates)
    for update in range(updates):
        model.learn(optimizer, data.beginnings(update, 0.1).draw_trials(32, draws), None, 0.0, draws)
    return model.eval()


@pytest.fixture(scope="module")
def trained() -> LinearModel:
    data, _ = pushed(256, np.random.default_rng(0))
    return fitted(untrained(2, data), data, 900)


def test_likelihood_of_a_trial() -> None:
    """Its changes are jointly normal, with covariance of noise and of G G^T: half of each trial's steps are missing."""
    data, _ = pushed(3, np.random.default_rng(1))
    data.mask[:, :, ::2] = 0
    model = untrained(2, data)
    with torch.no_grad():
        model.dynamics.log_std.fill_(-0.3)
        expected, gains = model.dynamics.parts(data.obs, data.action)
        innovation = model.dynamics.change(data.next_obs - data.obs) - expected
        effects = gains[0, :, 1::2, 0]
        noise = np.exp(-0.6) + ERROR * effects.square().sum(-1)
        covariance = effects @ effects.mT + torch.diag_embed(noise)
        likelihood = MultivariateNormal(torch.zeros(STEPS // 2), covariance).log_prob(innovation[0, :, 1::2, 0])
        constant = 0.5 * np.log(2 * np.pi)
        surprise = model.surprise(model.final_memory(data))
    assert surprise.item() == pytest.approx(-likelihood.sum().item() / (3 * STEPS / 2) - constant, rel=1e-4)


def test_mean_of_evidence_under_a_belief() -> None:
    """Against 400,000 samples, to five standard errors."""
    gaussian, draws = Correlated(2), streams()
    belief = torch.tensor([[0.3, -0.2, 0.5, 0.4, 0.7]])[None]
    precision = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    weighted = torch.tensor([0.8, -0.4], dtype=torch.float64)
    drawn = gaussian.sample(belief.expand(1, 400_000, -1), draws)[0].double()
    likelihood = (drawn @ weighted - ((drawn @ precision) * drawn).sum(-1) / 2).exp()
    closed = gaussian.log_expected(belief, precision[None, None], weighted[None, None]).exp().item()
    assert closed == pytest.approx(likelihood.mean().item(), abs=5 * likelihood.std().item() / 400_000**0.5)


def test_gradients_in_closed_form() -> None:
    """Those of densities, of evidence under a belief and of a trial's likelihood: as torch differentiates them."""
    generator = torch.Generator().manual_seed(0)
    gaussian, data = Correlated(3), pushed(4, np.random.default_rng(1))[0]
    belief, theta_hat, weighted = (torch.randn(5, n, generator=generator).double() for n in (9, 3, 3))
    belief[:, 3:6] = 0.2 + belief[:, 3:6].abs()
    belief.requires_grad_()
    half = torch.randn(5, 7, 3, generator=generator).double()
    evidence = half.mT @ half

    mean, std, lower = gaussian.split(belief)
    whitening = gaussian.triangle(lower) / std[..., None]
    normal = MultivariateNormal(mean, precision_matrix=whitening.mT @ whitening)
    own = gaussian.log_prob(belief, theta_hat)
    torch.testing.assert_close(own, normal.log_prob(theta_hat))
    alike_in(belief, own.square(), normal.log_prob(theta_hat).square())

    after = normal.precision_matrix + evidence  # Bayes: the evidence is the prior times the likelihood by the posterior
    at = torch.linalg.solve(after, (normal.precision_matrix @ mean[..., None])[..., 0] + weighted)
    likelihood = (weighted * at).sum(-1) - (evidence @ at[..., None])[..., 0].mul(at).sum(-1) / 2
    log_expected = likelihood + normal.log_prob(at) - MultivariateNormal(at, precision_matrix=after).log_prob(at)
    own = gaussian.log_expected(belief, evidence, weighted)
    torch.testing.assert_close(own.double(), log_expected, rtol=1e-5, atol=1e-5)
    alike_in(belief, own.double().square(), log_expected.square())

    model = untrained(2, data)
    effects = [x.detach().requires_grad_() for x in model._effects(data)[:3]]
    arguments = (*effects, *model._effects(data)[3:])
    terms, total = Evidence.apply(*arguments)
    assert not terms.requires_grad
    alike_in(effects, model.surprise(total), _surprise(model, weigh(*arguments)[0].sum(2)))


def alike_in(x: Tensor | list[Tensor], own: Tensor, other: Tensor) -> None:
    for one, two in zip(*(torch.autograd.grad(y.sum(), x, retain_graph=True) for y in (own, other)), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


def _surprise(model: LinearModel, memory: Tensor) -> Tensor:
    """`LinearModel.surprise` by determinants, which torch differentiates."""
    precision, weighted, squares = model._sums(memory)
    after = precision + torch.eye(model.latent)
    fitted = (weighted * torch.linalg.solve(after, weighted)).sum(-1)
    total = (squares - fitted + torch.linalg.slogdet(after).logabsdet) / 2 + memory[..., -2]
    return total.sum(-1) / memory[..., -1].sum(-1)


def test_likelihood_of_the_next_step() -> None:
    """That of the dynamics, of 200,000 samples of the belief, to five standard errors."""
    data, _ = pushed(3, np.random.default_rng(1))
    model, draws, count = untrained(2, data).eval(), streams(), 200_000
    with torch.no_grad():
        model.dynamics.log_std.fill_(-0.4)
        memory, step = model.final_memory(data[:, :, :4]), data[:, :, 4]
        exact = model.log_next(memory, step, draws)[0].exp()
        belief = model.belief(memory)
        for i in range(3):
            obs, action, next_obs = (
                x[:, i : i + 1].expand(1, count, -1) for x in (step.obs, step.action, step.next_obs)
            )
            theta_hat = model.sample(belief[:, i : i + 1].expand(1, count, -1), draws)
            expected, gains = model.dynamics.parts(obs, action)
            rest = model.dynamics.change(next_obs - obs) - expected - (gains * theta_hat[..., None, :]).sum(-1)
            noise = (np.exp(-0.8) + ERROR * gains.square().sum(-1)).sqrt()
            likelihood = torch.distributions.Normal(0, noise).log_prob(rest)[0, :, 0].exp().double()
            error = 5 * likelihood.std().item() / count**0.5
            assert error < 0.01 * exact[i].item()
            assert exact[i].item() == pytest.approx(likelihood.mean().item(), abs=error)


def test_likelihoods_of_steps_are_that_of_their_trial() -> None:
    """By exact inference, one step after another; a belief that a network gives predicts otherwise."""
    data, _ = pushed(3, np.random.default_rng(1))
    draws = streams()
    for kind, same in ((ExactLinearModel, True), (LinearModel, False)):
        model = kind(2, 16, Scales.of(Signature(1, 1, 0, False), data), draws).eval()
        with torch.no_grad():
            memory, total = model.start(3), torch.zeros(1, 3)
            for t in range(STEPS):
                total += model.log_next(memory, data[:, :, t], draws)
                memory = model.update(memory, data[:, :, t])
            whole = -3 * STEPS * (model.surprise(memory) + np.log(2 * np.pi) / 2)
        assert (total.sum().item() == pytest.approx(whole.item(), rel=1e-4)) == same


def test_exact_dynamics_are_believed() -> None:
    """With the latents' stds that the posterior states: no network stands between."""
    data, _ = pushed(3, np.random.default_rng(1))
    scales, draws = Scales.of(Signature(1, 1, 0, False), data), streams()
    model = exact(VariationalModel("innovations", 2, 16, scales, draws), draws)
    assert isinstance(model, ExactLinearModel)


def test_inference_in_dynamics_that_are_given() -> None:
    """Of transitions drawn from them, with latents from the prior, the posterior holds these: errors are its stds."""
    data, _ = pushed(600, np.random.default_rng(1))
    draws = streams()
    learned = VariationalModel("innovations", 2, 16, Scales.of(Signature(1, 1, 0, False), data), draws)
    model = exact(learned, draws).eval()
    model.error.zero_()  # the dynamics have none
    with torch.no_grad():
        learned.dynamics.log_std.fill_(-1.5)
        theta_hat = draws.normal(600, 2)
        each = theta_hat[:, :, None].expand(-1, -1, STEPS, -1).flatten(1, 2)
        flat = data.flat()
        next_obs = learned.dynamics.sample(flat.obs, flat.action, each, draws).view_as(data.obs)
        posterior = model._posterior(model.final_memory(Batch(data.obs, data.action, next_obs, data.mask)))
    mean, log_std = posterior[..., :2], posterior[..., 2:4]
    assert ((mean - theta_hat) / log_std.exp()).square().mean().item() == pytest.approx(1, abs=0.15)
    assert (mean - theta_hat).square().mean() < 0.6, "and it is narrower than the prior"


def test_memory_adds_up() -> None:
    """Step by step it is that of the whole trial; steps that did not take place leave it as it is."""
    data, _ = pushed(5, np.random.default_rng(1))
    data.mask[:, 2:, STEPS // 2 :] = 0
    model = untrained(3, data).eval()
    memory = model.start(5)
    for t in range(STEPS):
        memory = model.update(memory, data[:, :, t])
    torch.testing.assert_close(memory, model.final_memory(data), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(memory[:, 2:], model.final_memory(data[:, 2:, : STEPS // 2]), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_the_action_does_not_stand_in_for_theta(trained: LinearModel) -> None:
    """Exploration pushes the ball against theta, so that a regression on place and action finds a quarter of a push.

    f has the push that an action gives, 1, and G has theta's.
    """
    data, _ = pushed(4096, np.random.default_rng(2))
    last = torch.cat([data.obs, data.action], -1)[0, :, -8:].flatten(0, 1)
    change = (data.next_obs - data.obs)[0, :, -8:].flatten(0, 1)
    assert torch.linalg.lstsq(last, change).solution[1].item() < 0.4
    actions = torch.linspace(-2, 2, 5)[None, :, None]
    with torch.no_grad():
        expected, gains = trained.dynamics.parts(torch.zeros_like(actions), actions)
    f = trained.dynamics.change.inverse(expected)[0, :, 0]
    assert ((f[-1] - f[0]) / 4).item() == pytest.approx(1, abs=0.15)
    size = (gains.square().sum(-1).sqrt() * trained.dynamics.change.std)[0, :, 0]
    assert size.numpy() == pytest.approx(1, abs=0.3)


@pytest.mark.slow
def test_belief_is_the_posterior(trained: LinearModel) -> None:
    """On fresh trials its mean is as near theta as that of the exact posterior, by a linear map of the latents.

    After t steps that is t / (t + 1) times the mean innovation. The belief in the course of a trial is as far from the
    latent of the whole as the posterior is, whose variance falls by 1 / (t + 1) - 1 / (STEPS + 1).
    """
    (data, _), (fresh, theta) = (pushed(n, np.random.default_rng(n)) for n in (256, 2048))
    online = OnlineBelief(trained, 32, streams())
    trained.set_prior(final_belief(trained, data), streams())
    online.fit(trained, data, 300, streams())
    innovation = (fresh.next_obs - fresh.obs - fresh.action)[0, ..., 0]
    with torch.no_grad():
        whole = trained.for_cloning(final_belief(trained, fresh), streams())[0]
        weights = torch.linalg.lstsq(whole, theta[:, None]).solution
        assert ((whole @ weights)[:, 0] - theta).square().mean() < 1.5 / (STEPS + 1)
        for t in (4, 12):
            memory = trained.final_memory(fresh[:, :, :t])
            exact = innovation[:, :t].sum(1) / (t + 1)
            least = (exact - theta).square().mean()
            own = (trained.mean(trained.belief(memory))[0] @ weights)[:, 0]
            assert (own - theta).square().mean() < 1.25 * least + 0.01
            belief = online(trained, memory)
            drawn, mean = ((x[0] @ weights)[:, 0] for x in (online.sample(belief, streams()), online.mean(belief)))
            assert (mean - theta).square().mean() < 1.25 * least + 0.01
            learned = 1 / (t + 1) - 1 / (STEPS + 1)
            assert (drawn - mean).square().mean().item() == pytest.approx(learned, rel=0.5)


def test_sets_and_beginnings_have_the_same_likelihood() -> None:
    """What a trial tells does not depend on the order of its steps; only the beliefs that are trained differ."""
    data, _ = pushed(6, np.random.default_rng(4))
    model = untrained(2, data)
    with torch.no_grad():
        model.prediction_loss = lambda before, after: torch.zeros(1)  # type: ignore[method-assign]
        of_course, of_sets = (loss(data, None, 0.0, streams()) for loss in (model.loss, model.loss_on_sets))
    torch.testing.assert_close(of_course, of_sets)


def test_evidence_without_noise() -> None:
    """A step of a column is worth 1 / ERROR readings of theta_hat and no more, however exact it is."""
    data, theta = pushed(64, np.random.default_rng(5))
    data = Batch(data.obs, data.action, data.obs + data.action + theta[None, :, None, None], data.mask)
    model, draws = untrained(2, data), streams()
    with torch.no_grad():
        model.dynamics.log_std.fill_(-12)
    optimizer = Adam([model], 1e-2, 30)
    for _ in range(30):
        model.learn(optimizer, data, None, 0.0, draws)
    with torch.no_grad():
        precision = model._sums(model.final_memory(data))[0].diagonal(dim1=-2, dim2=-1).sum(-1)
        assert precision.max().item() == pytest.approx(STEPS / ERROR, rel=1e-3)
        belief = model.belief(model.final_memory(data))
    assert torch.isfinite(belief).all()


@pytest.mark.slow
def test_steps_that_no_dynamics_explain() -> None:
    """A second column is an angle, which turns by how far the ball is off and wraps: theta is in the first alone."""

    def wrapped(n: int, seed: int) -> tuple[Batch, torch.Tensor]:
        data, theta = pushed(n, rng := np.random.default_rng(seed))
        turned = torch.cat([torch.zeros(1, n, 1, 1), 0.3 * data.obs], 2).cumsum(2)
        angle = torch.remainder(turned + torch.tensor(rng.uniform(0, 6.3, (1, n, 1, 1)), dtype=torch.float32), 6.3)
        obs, next_obs = (
            torch.cat(pair, -1) for pair in ((data.obs, angle[:, :, :-1]), (data.next_obs, angle[:, :, 1:]))
        )
        return Batch(obs, data.action, next_obs, data.mask), theta

    data, _ = wrapped(256, 0)
    scales = Scales.of(Signature(2, 1, 0, False), data)
    model = fitted(LinearModel(2, 32, scales, streams()), data, 600)
    fresh, theta = wrapped(2048, 1)
    with torch.no_grad():
        whole = model.mean(final_belief(model, fresh))[0]
    weights = torch.linalg.lstsq(whole, theta[:, None]).solution
    assert ((whole @ weights)[:, 0] - theta).square().mean() < 0.3


def test_evidence_is_predicted_from_what_was_before() -> None:
    """The belief after t steps of a trial predicts the evidence of its others, step t + 1 among them."""
    data, _ = pushed(6, np.random.default_rng(4))
    model = untrained(2, data)
    pairs = []
    model.prediction_loss = lambda *pair: pairs.append(pair) or torch.zeros(1)  # type: ignore[func-returns-value, method-assign]
    model.loss(data, None, 0.0, streams())
    (before, after), (course, whole) = pairs[0], model.course(data)
    done = before[0, :, -1].long()
    assert (done.min().item(), done.max().item()) == (0, STEPS - 1)
    trial = torch.cdist(before[0] + after[0], whole[0, :, 0]).argmin(1)
    torch.testing.assert_close(before[0], course[0, trial, done], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(before[0] + after[0], whole[0, trial, 0], rtol=1e-4, atol=1e-3)


def test_an_error_alike_in_all_steps_is_allowed_for() -> None:
    """The mean innovation of n steps has variance 1 / n of noise and 1 / ALIKE of f's error, given theta_hat."""
    data, _ = pushed(3, np.random.default_rng(1))
    model, n, gain, seen = untrained(1, data), 30, 1.5, 0.7
    after = torch.tensor([[[n * gain**2, n * gain * seen, n * gain * seen, n * seen**2, 0, n]]])
    losses, exact = [], []
    for mean, std in ((0.2, 0.3), (-0.4, 1.0)):
        model.belief = lambda memory, mean=mean, std=std: torch.tensor([[[mean, std]]])  # type: ignore[method-assign]
        losses.append(model.prediction_loss(after, after).item() * n / (1 + n / ALIKE))
        scale = torch.tensor((gain * std) ** 2 + 1 / n + 1 / ALIKE).sqrt()
        exact.append(-torch.distributions.Normal(gain * mean, scale).log_prob(torch.tensor(seen)).item())
    assert losses[0] - losses[1] == pytest.approx(exact[0] - exact[1], rel=1e-4)


@pytest.mark.slow
def test_how_much_of_earlier_episodes_is_kept(trained: LinearModel) -> None:
    """Nearly all where theta stays, nothing where it is drawn anew: halves of trials, and of others' trials."""
    data, _ = pushed(512, np.random.default_rng(6))
    halves = data[:, :, : STEPS // 2].tensors, data[:, :, STEPS // 2 :].tensors
    for shift, low, high in ((0, 0.7, 1.0), (1, 0.0, 0.01)):
        paired = [torch.stack([one, other.roll(shift, 1)], 2).flatten(1, 2) for one, other in zip(*halves, strict=True)]
        choose_kept(trained, Batch(*paired), 2, streams())
        assert low <= trained.kept.item() <= high
    trained.kept.fill_(1)


def test_evidence_that_is_strong_at_first() -> None:
    """What follows is a difference of large sums: where its rounding exceeds it, training goes on."""
    data, _ = pushed(64, np.random.default_rng(5))
    model = untrained(4, data)
    terms = model._terms(data)
    terms[:, :, : STEPS // 2] *= 1e9
    terms[:, :, STEPS // 2 :, :-1] *= 30
    terms[..., -1] = 1
    sums = terms.cumsum(2)
    before, total = sums[:, :, ::3].flatten(1, 2), sums[:, :, -1].requires_grad_()
    after = (total[:, :, None] - sums[:, :, ::3]).flatten(1, 2).detach()
    assert (torch.linalg.eigvalsh(model._sums(after)[0]) < -1).any(), "rounding exceeds the prior"
    for _ in range(5):
        (model.prediction_loss(before, after) + model.surprise(total)).sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in model.reader.parameters())
    assert torch.isfinite(total.grad).all()


def test_a_posterior_of_rounded_sums() -> None:
    """1 + P is not positive definite any more where P is rounded: its root is that of a matrix nearby."""
    direction = torch.tensor([1.0, 0.7, -0.3])
    precision = (1e9 * torch.outer(direction, direction)).double()
    precision[0, 1] = precision[1, 0] = precision[0, 1] * (1 + 1e-7)
    assert torch.linalg.cholesky_ex(precision + torch.eye(3)).info > 0
    root = posterior_root(precision)
    assert (root @ root.T - precision).abs().max() < 1e-4 * precision.max()
    other = torch.diag(torch.tensor([1e4, 3.0, 2.0])).double()
    difference = other - 1e3 * torch.diag(torch.tensor([0.0, 0.0, 1.0])).double()  # rounding, of sums of 1e10
    both = posterior_root(torch.stack([precision, other, difference]))
    assert torch.equal(both[1], posterior_root(other))
    assert torch.equal(both[0], root)
    assert torch.isfinite(both).all()
    assert not torch.isfinite(posterior_root(torch.stack([other, other * torch.nan]))[1]).all()


def test_training_that_diverges_says_so() -> None:
    """Numbers that are not finite reach the optimiser, which has a line for them; no factorisation fails first."""
    data, _ = pushed(8, np.random.default_rng(6))
    model = untrained(2, data)
    with torch.no_grad():
        model.dynamics.gains[-1].bias.fill_(1e25)
    with pytest.raises(InputError, match="lower learning rate"):
        model.learn(Adam([model], 1e-2, 10), data, None, 0.0, streams())
