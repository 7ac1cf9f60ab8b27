"""A GRU (Cho et al., 2014) along time, with a gradient of its own that takes a CPU less time than autograd's."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from deconfounded.deconf.core.beliefs import Belief
from deconfounded.deconf.core.data import Batch, Draws
from deconfounded.deconf.core.layers import Linear, add_product, affine, parameter_gradients
from deconfounded.deconf.core.nets import Embedding, Scales


class GruScan(torch.autograd.Function):
    """Inputs x [S, B, T, 3 W] after a memory h [S, B, W] -> memories [S, B, T + 1, W].

    The last axis holds the gates r and z and the candidate n: r, z = sigmoid(x + h U + b), n = tanh(x + r (h U + b)).
    Where mask [S, B, T] is 1, h <- z h + (1 - z) n; where it is 0, h stays: z is 1. weight U [S, W, 3 W], bias b
    [S, 1, 3 W]. Time is the first axis within, and a step of time is as few operations as there can be.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, memory: Tensor, weight: Tensor, bias: Tensor, mask: Tensor) -> Tensor:
        w, steps = memory.shape[-1], inputs.shape[2]
        x = inputs.permute(2, 0, 1, 3)
        recurrent = bias.expand(*x.shape).clone(memory_format=torch.contiguous_format)  # x + h U + b, b alone for n
        recurrent[..., : 2 * w] += x[..., : 2 * w]
        new = x[..., 2 * w :].contiguous()
        padding = (mask == 0).permute(2, 0, 1)[..., None]
        paddings = padding.unbind() if padding.any() else [None] * steps
        gates = memory.new_empty(steps, *memory.shape[:-1], 2 * w)
        memories = memory.new_empty(steps + 1, *memory.shape)
        memories[0] = memory
        columns = (recurrent, *recurrent.split((2 * w, w), -1), gates, *gates.chunk(2, -1), new, memories[1:])
        before = memories[0]
        for padded, (whole, to_gates, to_new, gate, reset, keep, n, after) in zip(
            paddings, zip(*map(torch.unbind, columns), strict=True), strict=True
        ):
            add_product(whole, before, weight)
            torch.sigmoid(to_gates, out=gate)
            n.addcmul_(reset, to_new).tanh_()
            if padded is not None:
                keep.masked_fill_(padded, 1)
            before = torch.lerp(n, before, keep, out=after)
        ctx.save_for_backward(memories, gates, new, recurrent, weight)
        return memories.permute(1, 2, 0, 3).contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        memories, gates, new, recurrent, weight = ctx.saved_tensors
        w = new.shape[-1]
        reset, keep = gates.chunk(2, -1)
        moved = 1 - keep
        to_new = (1 - new.square()).mul_(moved)  # of n's input, for each unit of the gradient of the memory
        # inner: of h U + b, which this gradient multiplies as well.
        by_reset = (recurrent[..., 2 * w :] * to_new).mul_(reset).mul_(1 - reset)
        by_keep = (memories[:-1] - new).mul_(keep).mul_(moved)
        inner = torch.stack([by_reset, by_keep, to_new * reset], -2)
        flat = inner.flatten(-2)  # of the same memory
        grad = grads[0].permute(2, 0, 1, 3).contiguous()
        transposed = weight.transpose(1, 2).contiguous()
        columns = (inner, flat, keep, grad[:-1])
        h = grad[-1]
        for by_gate, by_unit, kept, before in zip(*(column.unbind()[::-1] for column in columns), strict=True):
            by_gate.mul_(h[..., None, :])
            h = add_product(before.addcmul_(h, kept), by_unit, transposed)
        outer = torch.cat([flat[..., : 2 * w], to_new.mul_(grad[1:])], -1)
        by_weight, by_bias = parameter_gradients(*(x.transpose(0, 1).flatten(1, 2) for x in (memories[:-1], flat)))
        return outer.permute(1, 2, 0, 3), h, by_weight, by_bias, None


class GruMemory(nn.Module):
    """A GRU (Cho et al., 2014) over embedded transitions (s, a, s'): the history encoder of appendix D.

    Gates are initialised for time constants of 1 to 100 steps (Tallec and Ollivier, 2018). With torch's initialisation
    a memory lasts two steps, and one seed of five of `dagger` never learns to infer theta.
    """

    def __init__(self, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__()
        self.width, self.seeds = width, len(draws)
        self.inputs = Embedding(width, scales, draws)
        self.input, self.recurrent = Linear(3 * 32, 3 * width, draws), Linear(width, 3 * width, draws)
        with torch.no_grad():
            keep = slice(width, 2 * width)
            self.input.bias[..., keep] = torch.log(1 + 98 * draws.uniform(1, width))
            self.recurrent.bias[..., keep] = 0

    def start(self, n: int) -> Tensor:
        """The memory [S, N, W] of empty histories."""
        return self.recurrent.weight.new_zeros(self.seeds, n, self.width)

    def _embed(self, batch: Batch) -> Tensor:
        before, after = self.inputs.obs(torch.stack([batch.obs, batch.next_obs], 1)).unbind(1)
        return self.input(torch.cat([before, self.inputs.action(batch.action), after], -1))

    def forward(self, batch: Batch, memory: Tensor) -> Tensor:
        """Transitions [S, B, T, ...] after a memory [S, B, W] -> memories [S, B, T + 1, W]."""
        return GruScan.apply(self._embed(batch), memory, self.recurrent.weight, self.recurrent.bias, batch.mask)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        """Memory [S, N, W] after one more transition; unchanged where its mask is 0. A step of `GruScan`, alone."""
        w = self.width
        x = self._embed(step)
        recurrent = affine(self.recurrent.bias + F.pad(x[..., : 2 * w], (0, w)), memory, self.recurrent.weight)
        reset, keep = torch.sigmoid(recurrent[..., : 2 * w]).chunk(2, -1)
        new = torch.addcmul(x[..., 2 * w :], reset, recurrent[..., 2 * w :]).tanh()
        return torch.lerp(new, memory, keep.masked_fill(step.mask[..., None] == 0, 1))


class GruBelief(Belief):
    """The paper's belief: GruMemory, then linear to a mean and a softplus variance.

    Its inputs are initialised to unit scale: He's initialisation for the observations' embedding, action embeddings of
    about 1, and a tanh's gain for the GRU's input. Otherwise Eq. (6) stays for thousands of updates on the plateau
    where the latent is ignored. (Not so for the memories of policies: with it, dagger is worse on `forked_path`.)
    """

    def __init__(self, latent: int, width: int, scales: Scales, draws: Draws) -> None:
        super().__init__(latent, draws)
        self.memory = GruMemory(width, scales, draws)
        self.inputs = self.memory.inputs
        self.out = Linear(width, 2 * latent, draws)
        with torch.no_grad():
            for layer in self.inputs.embed_obs:
                if isinstance(layer, Linear):
                    layer.weight.mul_(6**0.5)
                    layer.bias.zero_()
            self.inputs.embed_action.weight.mul_(3)
            self.memory.input.weight.mul_(3)

    def forward(self, batch: Batch) -> Tensor:
        return self.memory(batch, self.start(len(batch)))

    def start(self, n: int) -> Tensor:
        return self.memory.start(n)

    def update(self, memory: Tensor, step: Batch) -> Tensor:
        return self.memory.update(memory, step)

    def posterior(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        mean, raw = self.out(memory).chunk(2, -1)
        return mean, (F.softplus(raw) + 1e-6).sqrt()
