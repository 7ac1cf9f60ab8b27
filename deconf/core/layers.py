"""Layers of S seeds side by side: linear maps and MLPs.

S seeds train in one program: every parameter and every tensor has a leading axis of S. Seeds share nothing, so that a
seed's numbers are the same, bit for bit, whatever runs beside it. Exceptions are sigmoid, softplus and sinh, of binary
observations and labels of heavy tails, on tensors whose size is no multiple of 32: torch computes what is left over,
which is of the last seed, by other code, whose last bits may differ.
"""

import ctypes
import platform
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from deconfounded.deconf.core.data import Draws

relu_backward = torch.ops.aten.threshold_backward.grad_input
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of mallopt(3)
SMALL, NARROW = 16**3, 16  # multiplications, rows or columns: below which MKL's sums depend on what else is in a stack


def prepare_torch() -> None:
    """Set one thread, since networks are small; and keep freed memory.

    C's library gives freed memory back to the system, and to ask for it again takes longer than to use it.
    """
    torch.set_num_threads(1)
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for option, size in ((M_MMAP_THRESHOLD, 2**25), (M_TRIM_THRESHOLD, 2**30), (M_TOP_PAD, 2**26)):
            libc.mallopt(option, size)


prepare_torch()


def stack_differs(rows: Tensor, weight: Tensor) -> bool:
    """Whether the product of stacked rows [S, R, I] and weights [S, I, O] may have other bits than a seed's alone."""
    seeds, count, _ = rows.shape
    if seeds == 1:
        return False
    _, inputs, outputs = weight.shape
    return min(count, outputs) < NARROW or inputs == 1 or count * inputs * outputs <= SMALL


def add_product(out: Tensor, rows: Tensor, weight: Tensor) -> Tensor:
    """Add rows [S, R, I] weight [S, I, O] to out [S, R, O], with the same bits for a seed however many are stacked."""
    if stack_differs(rows, weight):
        for operands in zip(out.split(1), rows.split(1), weight.split(1), strict=True):
            operands[0].baddbmm_(*operands[1:])
        return out
    return out.baddbmm_(rows, weight)


def affine(bias: Tensor, rows: Tensor, weight: Tensor) -> Tensor:
    """bias [S, 1 or R, O] + rows [S, R, I] weight [S, I, O], with the same bits for a seed however many are stacked."""
    if stack_differs(rows, weight):
        return torch.cat([*map(torch.baddbmm, bias.split(1), rows.split(1), weight.split(1))])
    return torch.baddbmm(bias, rows, weight)


class Linear(nn.Module):
    """S linear maps side by side: [S, ..., I] -> [S, ..., O]."""

    def __init__(self, inputs: int, outputs: int, draws: Draws) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter((2 * draws.uniform(inputs, outputs) - 1) * bound)
        self.bias = nn.Parameter((2 * draws.uniform(1, outputs) - 1) * bound)

    def forward(self, x: Tensor) -> Tensor:
        out = affine(self.bias, x.reshape(len(x), -1, x.shape[-1]), self.weight)
        return out.reshape(*x.shape[:-1], out.shape[-1])


def by_seed(a: Tensor, b: Tensor, product: Callable[..., Tensor] = torch.bmm) -> Tensor:
    """a [S, ..., N, K] b [S, ..., K, M], seed by seed: products of a stack have another order of sums than of one seed.

    Without a gradient. product: of one seed; torch.bmm is for three axes, and torch.matmul has other bits there.
    """
    if a.shape[0] == 1:
        return product(a, b)
    out = a.new_empty(*a.shape[:-1], b.shape[-1])
    for operands in zip(a.split(1), b.split(1), out.split(1), strict=True):
        product(*operands[:2], out=operands[2])
    return out


def parameter_gradients(rows: Tensor, grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients [S, I, O] of a weight and [S, 1, O] of a bias; rows [S, R, I] went in, grad [S, R, O] comes back."""
    bias = [row.sum(1, keepdim=True) for row in grad.split(1)]
    return by_seed(rows.transpose(1, 2), grad), bias[0] if len(bias) == 1 else torch.cat(bias)


def activations(rows: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows [S, R, I], and what each of three linear maps makes of them, with ReLU between.

    parameters: the weight and the bias of each map in turn.
    """
    weight, bias, weight_2, bias_2, weight_3, bias_3 = parameters
    hidden = affine(bias, rows, weight).relu_()
    hidden_2 = affine(bias_2, hidden, weight_2).relu_()
    return rows, hidden, hidden_2, affine(bias_3, hidden_2, weight_3)


class MlpFunction(torch.autograd.Function):
    """Rows [S, R, I] through three linear maps with ReLU between: one node of the graph, which writes in place."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, *parameters: Tensor) -> Tensor:
        *inputs, out = activations(rows, *parameters)
        ctx.save_for_backward(*inputs, *parameters[::2])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        half, grad, by_parameter = len(saved) // 2, grads[0].contiguous(), list[Tensor]()
        for i in range(half - 1, -1, -1):
            by_parameter[:0] = parameter_gradients(saved[i], grad)
            if i or ctx.needs_input_grad[0]:
                grad = by_seed(grad, saved[half + i].transpose(1, 2))
            if i:
                relu_backward(grad, saved[i], 0, grad_input=grad)
        return grad if ctx.needs_input_grad[0] else None, *by_parameter


class Mlp(nn.Sequential):
    """An MLP with two hidden layers and ReLU: [S, ..., I] -> [S, ..., O]."""

    def __init__(self, inputs: int, width: int, outputs: int, draws: Draws) -> None:
        first, second = Linear(inputs, width, draws), Linear(width, width, draws)
        super().__init__(first, nn.ReLU(), second, nn.ReLU(), Linear(width, outputs, draws))

    def forward(self, x: Tensor) -> Tensor:
        layers = self._modules.values()  # `parameters()` takes several times as long
        parameters = [each for layer in layers if layer for each in layer._parameters.values() if each is not None]
        rows = x if x.dim() == 3 else x.reshape(len(x), -1, x.shape[-1])
        # A node of the graph costs an agent's step a tenth of its time, for a gradient that nobody asks for.
        out = MlpFunction.apply(rows, *parameters) if torch.is_grad_enabled() else activations(rows, *parameters)[-1]
        return out if rows is x else out.reshape(*x.shape[:-1], out.shape[-1])
