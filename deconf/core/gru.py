"""A GRU (Cho et al., 2014) along time, with a gradient of its own that takes a CPU less time than autograd's."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from deconfounded.deconf.core.layers import add_product, parameter_gradients


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
