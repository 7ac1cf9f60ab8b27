"""A GRU (Cho et al., 2014) along time with its own gradient: a CPU needs less time for it than for autograd's."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from deconfounded.deconf.core.nets import affine

tanh_backward = torch.ops.aten.tanh_backward.grad_input  # fused
sigmoid_backward = torch.ops.aten.sigmoid_backward.grad_input


class GruScan(torch.autograd.Function):
    """From a memory [S, B, W], through what enters each step [S, B, T, 3 W], to memories [S, B, T + 1, W].

    A row's thirds are of the gates r and z and of the candidate n: r, z = sigmoid(in + h U + b), n = tanh(in + r (h U +
    b)). Where mask [S, B, T] is 1, h moves towards n by 1 - z; where it is 0, h stays. weight U [S, W, 3 W], bias b [S,
    1, 3 W].
    """

    @staticmethod
    def forward(ctx: Any, entering: Tensor, memory: Tensor, weight: Tensor, bias: Tensor, mask: Tensor) -> Tensor:
        w, steps = memory.shape[-1], entering.shape[2]
        given, new_given = entering.permute(2, 0, 1, 3).contiguous().split((2 * w, w), -1)
        open_ = mask.permute(2, 0, 1)[..., None]
        memories = memory.new_empty(steps + 1, *memory.shape)
        gates, news, recurrents = (memory.new_empty(steps, *memory.shape[:-1], k * w) for k in (2, 1, 1))
        memories[0] = memory
        columns = (given, new_given, open_, memories[:-1], memories[1:], gates, *gates.chunk(2, -1), news, recurrents)
        for both, enters, goes, before, after, gate, reset, keep, new, inner in zip(
            *map(torch.unbind, columns), strict=True
        ):
            gated, candidate = affine(bias, before, weight).split((2 * w, w), -1)
            torch.add(both, gated, out=gate).sigmoid_()
            inner.copy_(candidate)
            torch.addcmul(enters, reset, candidate, out=new).tanh_()
            torch.lerp(before, new, (1 - keep) * goes, out=after)
        ctx.save_for_backward(memories, gates, news, recurrents, open_, weight)
        return memories.permute(1, 2, 0, 3).contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
        memories, gates, news, recurrents, open_, weight = ctx.saved_tensors
        w = news.shape[-1]
        grad = grads[0].permute(2, 0, 1, 3).contiguous()
        inner = gates.new_empty(*news.shape[:-1], 3 * w)  # gradient of h U + b
        entering = torch.empty_like(inner)  # gradient of what enters
        by_gate = torch.empty_like(gates[0])
        by_reset, by_keep = by_gate.split(w, -1)
        to_gates, to_candidate = inner.split((2 * w, w), -1)
        given = (memories[:-1], gates, *gates.chunk(2, -1), news, recurrents, open_, grad[:-1])
        columns = (*given, inner, to_gates, to_candidate, entering[..., 2 * w :])
        h, back = grad[-1], weight.transpose(1, 2).contiguous()
        each = zip(*(column.unbind()[::-1] for column in columns), strict=True)
        for before, gate, reset, keep, new, candidate, goes, then, whole, gated, inside, enters in each:
            moved = (1 - keep).mul_(goes)
            tanh_backward(h * moved, new, grad_input=enters)
            torch.mul(enters, reset, out=inside)
            torch.mul(enters, candidate, out=by_reset)
            torch.mul(torch.sub(before, new).mul_(goes), h, out=by_keep)
            sigmoid_backward(by_gate, gate, grad_input=gated)
            h = affine(torch.addcmul(then, h, 1 - moved), whole, back)
        entering[..., : 2 * w] = to_gates
        rows, out = (x.transpose(0, 1).flatten(1, 2) for x in (memories[:-1], inner))
        # Seed by seed: a product or a sum over a stack takes another order for one seed than for several.
        by_weight = torch.cat([a.transpose(1, 2) @ b for a, b in zip(rows.split(1), out.split(1), strict=True)])
        by_bias = torch.cat([one.sum(1, keepdim=True) for one in out.split(1)])
        return entering.permute(1, 2, 0, 3).contiguous(), h, by_weight, by_bias, None
