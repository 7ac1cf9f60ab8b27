"""A GRU (Cho et al., 2014) along time, with a gradient of its own that takes a CPU less time than autograd's."""

from typing import Any

import torch
from torch import Tensor

from deconfounded.deconf.core.nets import affine

tanh_backward = torch.ops.aten.tanh_backward.grad_input  # fused
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input


class GruScan(torch.autograd.Function):
    """Inputs x [S, B, T, 3 W] after a memory h [S, B, W] -> memories [S, B, T + 1, W].

    The last axis holds the gates r and z and the candidate n: r, z = sigmoid(x + h U + b), n = tanh(x + r (h U + b)).
    Where mask [S, B, T] is 1, h <- z h + (1 - z) n; where it is 0, h stays. weight U [S, W, 3 W], bias b [S, 1, 3 W].
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, memory: Tensor, weight: Tensor, bias: Tensor, mask: Tensor) -> Tensor:
        w, steps = memory.shape[-1], inputs.shape[2]
        gate_inputs, new_inputs = inputs.permute(2, 0, 1, 3).contiguous().split((2 * w, w), -1)
        masks = mask.permute(2, 0, 1)[..., None]
        memories = memory.new_empty(steps + 1, *memory.shape)
        gates, news, recurrents = (memory.new_empty(steps, *memory.shape[:-1], k * w) for k in (2, 1, 1))
        memories[0] = memory
        columns = (gate_inputs, new_inputs, masks, memories[:-1], memories[1:])
        for gate_input, new_input, real, before, after, gate, reset, keep, new, recurrent in zip(
            *map(torch.unbind, (*columns, gates, *gates.chunk(2, -1), news, recurrents)), strict=True
        ):
            to_gates, to_new = affine(bias, before, weight).split((2 * w, w), -1)
            torch.add(gate_input, to_gates, out=gate).sigmoid_()
            recurrent.copy_(to_new)
            torch.addcmul(new_input, reset, to_new, out=new).tanh_()
            torch.lerp(before, new, (1 - keep) * real, out=after)
        ctx.save_for_backward(memories, gates, news, recurrents, masks, weight)
        return memories.permute(1, 2, 0, 3).contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        memories, gates, news, recurrents, masks, weight = ctx.saved_tensors
        w = news.shape[-1]
        grad = grads[0].permute(2, 0, 1, 3).contiguous()
        inner = gates.new_empty(*news.shape[:-1], 3 * w)  # gradient of h U + b
        outer = torch.empty_like(inner)  # gradient of x
        by_gate = torch.empty_like(gates[0])
        by_reset, by_keep = by_gate.split(w, -1)
        gate_grads, new_grads = inner.split((2 * w, w), -1)
        columns = (memories[:-1], gates, *gates.chunk(2, -1), news, recurrents, masks, grad[:-1])
        columns = (*columns, inner, gate_grads, new_grads, outer[..., 2 * w :])
        h, transposed = grad[-1], weight.transpose(1, 2).contiguous()
        backwards = zip(*(column.unbind()[::-1] for column in columns), strict=True)
        for before, gate, reset, keep, new, recurrent, real, direct, whole, to_gate, to_new, to_input in backwards:
            moved = (1 - keep).mul_(real)
            tanh_backward(h * moved, new, grad_input=to_input)
            torch.mul(to_input, reset, out=to_new)
            torch.mul(to_input, recurrent, out=by_reset)
            torch.mul(torch.sub(before, new).mul_(real), h, out=by_keep)
            sigmoid_backward(by_gate, gate, grad_input=to_gate)
            h = affine(torch.addcmul(direct, h, 1 - moved), whole, transposed)
        outer[..., : 2 * w] = gate_grads
        rows, out = (x.transpose(0, 1).flatten(1, 2) for x in (memories[:-1], inner))
        # Seed by seed: a product or a sum over a stack has another order for one seed than for several.
        by_weight = torch.cat([a.transpose(1, 2) @ b for a, b in zip(rows.split(1), out.split(1), strict=True)])
        by_bias = torch.cat([row.sum(1, keepdim=True) for row in out.split(1)])
        return outer.permute(1, 2, 0, 3).contiguous(), h, by_weight, by_bias, None
