"""Adam over the parameters of S seeds side by side."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from deconfounded.envs.support.errors import InputError

BETAS, EPSILON = (0.9, 0.999), 1e-8


class Adam:
    """Adam over stacked parameters, each seed's gradient clipped to norm 1; with `updates`, cosine decay.

    A seed's parameters become views of one flat row, so that an update is a few operations. The newest Adam of a module
    owns its parameters: an older one raises RuntimeError when it steps. `gradient` [S, N]: the last update's, clipped.
    `rate`: the next one's.
    """

    def __init__(self, modules: Iterable[nn.Module], learning_rate: float, updates: int | None = None) -> None:
        modules = list(modules)
        self.parameters = list(dict.fromkeys(p for module in modules for p in module.parameters()))  # some are shared
        self._trained = ", ".join(type(module).__name__ for module in modules)
        sizes = [p[0].numel() for p in self.parameters]
        # Rows are a multiple of 64 bytes long: products round by where in memory their factors lie.
        rows = self.parameters[0].new_zeros(len(self.parameters[0]), -(-sum(sizes) // 16) * 16)
        self._flat, self.gradient = rows[:, : sum(sizes)], torch.zeros_like(rows)[:, : sum(sizes)]
        with torch.no_grad():
            for p, own in zip(self.parameters, self._flat.split(sizes, 1), strict=True):
                own.copy_(p.flatten(1))
                p.data = own.unflatten(1, p.shape[1:])
        self.rate, self._updates = learning_rate, updates
        self._mean, self._square = (torch.zeros_like(rows)[:, : sum(sizes)] for _ in range(2))
        self._done = [rows.new_zeros(()) for _ in rows]

    def state_dict(self) -> dict[str, Any]:
        """Both moments [S, N], how many updates were made, and the learning rate of the next."""
        return {"mean": self._mean, "square": self._square, "done": int(self._done[0]), "rate": self.rate}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore all of it."""
        self._mean.copy_(state["mean"])
        self._square.copy_(state["square"])
        for done in self._done:
            done.fill_(state["done"])
        self.rate = state["rate"]

    def step(self, loss: Tensor) -> None:
        """Take one step on losses [S]. Raises InputError, which names the update, if a gradient is not finite."""
        if self.parameters[0].data_ptr() != self._flat.data_ptr():
            raise RuntimeError(f"another Adam trains {self._trained}: this one is out of date")
        grads = torch.autograd.grad(loss.sum(), self.parameters, allow_unused=True, materialize_grads=True)
        torch.cat([grad.flatten(1) for grad in grads], 1, out=self.gradient)
        # Seed by seed: a sum over a stack has another order for one seed than for several.
        squares = torch.stack([row.square().sum() for row in self.gradient])
        if not all(map(math.isfinite, (*loss.flatten().tolist(), *squares.tolist()))):
            self._fail(loss)
        self.gradient *= (1 / (squares.sqrt() + 1e-6)).clamp(max=1)[:, None]
        # Seed by seed: the fused kernel rounds the end of a tensor otherwise than its middle. torch.optim.Adam itself
        # would import torch._dynamo: one or two seconds in every process that trains.
        flat, clipped, mean, square = (list(x) for x in (self._flat, self.gradient, self._mean, self._square))
        adam(
            flat, clipped, mean, square, [], self._done, fused=True, amsgrad=False, beta1=BETAS[0], beta2=BETAS[1],
            lr=self.rate, weight_decay=0, eps=EPSILON, maximize=False,
        )  # fmt: skip
        done, updates = int(self._done[0]), self._updates
        if updates and done <= updates:  # from one rate to the next, as torch's CosineAnnealingLR
            before, now = (1 + math.cos(math.pi * n / updates) for n in (done - 1, done))
            self.rate = now / before * self.rate

    def _fail(self, loss: Tensor) -> None:
        update = 1 + int(self._done[0])
        value = next((x for x in loss.flatten().tolist() if not math.isfinite(x)), None)
        what = "its gradient was NaN or too large" if value is None else f"it was {value}"
        raise InputError(
            f"the loss of {self._trained} failed in update {update}: {what}; a lower learning rate may help, or data of"
            " about unit size"
        )
