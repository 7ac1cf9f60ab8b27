"""Models of the dynamics with a latent, theta_hat, which they infer from a history: the interface."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from deconfounded.deconf.core.adam import Adam
from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.dynamics import DynamicsHead
from deconfounded.deconf.core.nets import Inputs
from deconfounded.envs.support.errors import InputError


class LatentModel(nn.Module, ABC):
    """A model that infers theta_hat [D]. A *belief* is the parameters [P] of a distribution over theta_hat.

    `kept` [S]: the share of the memory that outlives an episode, 1 unless theta drifts. `drift.choose_kept` chooses one
    of 0, .1, ..., 1 to the power of `share_power`.
    """

    kind: str
    latent: int
    width: int
    inputs: Inputs
    dynamics: DynamicsHead
    kept: Tensor
    share_power: int = 1
    read_width: int = 0  # of what `read` gives; 0: it has no `read`

    def __init__(self, draws: Draws) -> None:
        super().__init__()
        self.register_buffer("kept", torch.ones(len(draws), device=draws.device))

    def forget(self, memory: Tensor, share: Tensor | None = None) -> Tensor:
        """The memory [S, N, M] with which the next episode of a trial begins. share [S, N]: by default, `kept`."""
        share = self.kept[:, None] if share is None else share
        return torch.lerp(self.start(memory.shape[1]), memory, share[..., None])

    @abstractmethod
    def start(self, n: int) -> Tensor:
        """The memory [S, N, M] of n histories without a transition, for each seed."""

    @abstractmethod
    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory after one more transition (step: no time axis); unchanged where its mask is 0."""

    @abstractmethod
    def final_memory(self, batch: Batch) -> Tensor:
        """The memory [S, B, M] after whole trials; [S, B T, M], one a step, if the latent may change within."""

    @abstractmethod
    def belief(self, memory: Tensor) -> Tensor:
        """[..., M] -> [..., P]."""

    @abstractmethod
    def sample(self, belief: Tensor, draws: Draws) -> Tensor:
        """theta_hat [S, ..., D] from beliefs [S, ..., P]."""

    @abstractmethod
    def mean(self, belief: Tensor) -> Tensor:
        """The mean [..., D] of theta_hat: of one-hot values their probabilities."""

    def mode(self, belief: Tensor) -> Tensor:
        """The likeliest theta_hat [..., D]: of Gaussians the mean."""
        return self.mean(belief)

    def for_cloning(self, belief: Tensor, draws: Draws) -> Tensor:
        """The theta_hat [S, ..., D] on which policies are cloned, of beliefs [S, ..., P] about whole trials."""
        return self.sample(belief, draws)

    def course(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Memories [S, B, T + 1, M] after 0, 1, ..., T transitions, and [S, B, 1 or T, M] of `final_memory`."""
        raise NotImplementedError

    def read(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """What a second network (`online.py`) reads [..., read_width] of memories [..., M], and the belief's mean."""
        raise NotImplementedError

    def log_next(self, memory: Tensor, step: Batch, draws: Draws) -> Tensor:
        """log p_psi(s' | s, a, theta_hat) [S, N] of a step (no time axis), under the belief of the memory [S, N, M]."""
        theta_hat = self.sample(self.belief(memory), draws)
        return self.dynamics.log_prob(step.obs, step.action, step.next_obs, theta_hat)[..., 0]

    @abstractmethod
    def loss(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        """The loss [S] on trials [S, B, T]. steps: how many of them are predicted; None: all."""

    def loss_on_sets(self, batch: Batch, steps: int | None, beta: float, draws: Draws) -> Tensor:
        """The loss [S] where the belief of a random half of a trial's steps predicts the other half.

        Raises InputError for a model that cannot.
        """
        raise InputError(f"model {self.kind} has no belief of a set of steps; choose linear, innovations or evidence")

    def set_prior(self, belief: Tensor, draws: Draws) -> None:
        """Fit p(theta_hat), or the scale of latents, to beliefs [S, B, P] of whole trials."""

    def latent_stds(self) -> Tensor:
        """The stds [S, D] of theta_hat over trials, as `set_prior` has fitted them."""
        raise NotImplementedError

    def learn(self, optimizer: Adam, batch: Batch, steps: int | None, beta: float, draws: Draws) -> float:
        """One update on `loss`; returns its mean over seeds."""
        loss = self.loss(batch, steps, beta, draws)
        optimizer.step(loss)
        return loss.mean().item()


@torch.no_grad()
def final_belief(model: LatentModel, trials: Batch, part: int = 64) -> Tensor:
    """Beliefs q_phi(theta_hat_H | tau) after whole trials, [S, B, P]; in parts of so many, to save memory.

    [S, B T, P], one a step, if the latent may change within a trial.
    """
    indices = torch.arange(len(trials), device=trials.mask.device).split(part)
    return torch.cat([model.belief(model.final_memory(trials[:, i])) for i in indices], 1)
