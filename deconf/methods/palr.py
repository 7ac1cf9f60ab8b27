"""Past-action-leakage regularisation, PALR (Seo et al., 2023): naive_rnn with a penalty on what its memory leaks.

The paper imitates from observation histories; past actions leak through them alone. Here they are inputs of the memory,
as of `naive_rnn`, since a transition without its action may tell nothing of theta.

The penalty is the Hilbert-Schmidt conditional independence criterion, HSCIC (Park and Muandet, 2020): the dependence of
memory and previous action, given the expert's next action, by kernels; 0 where they are conditionally independent. It
covers the last action alone: older actions may leak, and so may a theta that was wrongly inferred from them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from deconfounded.deconf.core.data import Batch, take_steps
from deconfounded.deconf.equations import imitation_loss
from deconfounded.deconf.given import Given
from deconfounded.deconf.method import uses
from deconfounded.deconf.methods.sequence_bc import SMOKE, RecurrentAgent, RecurrentConfig, train_recurrent


@dataclass(frozen=True)
class PalrConfig(RecurrentConfig):
    """penalty: weight of the HSCIC; samples: steps of a chunk on which it is estimated; ridge: of its regression."""

    penalty: float = 0.1
    samples: int = 128
    ridge: float = 1e-2


def kernel(x: Tensor) -> Tensor:
    """The Gaussian kernel matrix [n, n] of rows [n, F]: exp(-d^2 / m), where m is the mean of d^2 over all pairs."""
    squares = (x[:, None] - x[None]).square().sum(-1)
    return torch.exp(-squares / squares.detach().mean().clamp(min=1e-6))


def hscic(x: Tensor, y: Tensor, given: Tensor, ridge: float) -> Tensor:
    """The squared distance of P(x, y | z) from P(x | z) P(y | z), as kernel embeddings, averaged over z.

    x [n, F], y [n, G], given [n, H]: joint samples of x, y and z. ridge: of the regressions on z, for each sample.
    """
    kx, ky, kz = kernel(x), kernel(y), kernel(given)
    n = len(x)
    weight = torch.linalg.solve(kz + n * ridge * torch.eye(n, device=x.device), kz)  # a column for each z
    by_x, by_y = kx @ weight, ky @ weight
    joint = (weight * ((kx * ky) @ weight)).sum(0)
    mixed = (weight * by_x * by_y).sum(0)
    product = (weight * by_x).sum(0) * (weight * by_y).sum(0)
    return (joint - 2 * mixed + product).mean()


class PalrAgent(RecurrentAgent):
    """naive_rnn's agent with PALR's loss."""

    config: PalrConfig | None = None  # in training

    def configure(self, config: PalrConfig) -> None:
        self.config = config

    def loss(self, batch: Batch, label: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        log_policy, states = self._log_policy(batch, label, state)
        loss = imitation_loss(log_policy.flatten(1), batch.mask.flatten(1))
        if self.config is not None:
            loss = loss + self.config.penalty * self.leakage(states[:, :, :-1], batch, label)
        return loss, states[:, :, -1].detach()

    def leakage(self, memories: Tensor, batch: Batch, label: Tensor) -> Tensor:
        """HSCIC [S] of memories [S, B, T, W] before steps and the previous actions, given the expert's next actions."""
        assert self.config is not None
        if batch.mask.shape[2] < 2:
            return memories.new_zeros(len(memories))
        encode, later = self.memory.inputs.scales.encode, batch[:, :, 1:]
        index = later.draw_steps(self.config.samples, self.noise)
        columns = (memories[:, :, 1:], encode(batch.action[:, :, :-1]), encode(label[:, :, 1:]))
        samples = (take_steps(column, index) for column in columns)
        # Seed by seed: a product over a stack may have another order for one seed than for several.
        values = torch.stack([hscic(x, y, given, self.config.ridge) for x, y, given in zip(*samples, strict=True)])
        return values * (later.mask.flatten(1).sum(1) > 0)  # 0 for padding alone


@uses(
    "demonstrations",
    version=2,
    cost=4,
    on_control=PalrConfig(penalty=1.0),
    on_bandit=PalrConfig(penalty=1.0, updates=2000, batch=128, chunk=50, learning_rate=1e-2),
    **SMOKE,
)
def fit(given: Given) -> PalrAgent:
    """Clone the demonstrations."""
    return train_recurrent(PalrAgent, given.source, given.config, given.rngs, given.monitor)
