"""A causal transformer with rotary positions (Su et al., 2021), over whole trials or a token at a time."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deconfounded.deconf.core.data import Draws
from deconfounded.deconf.core.layers import Linear
from deconfounded.envs.support.errors import InputError


def normed(x: Tensor) -> Tensor:
    """Layer normalisation without parameters, since a linear layer follows."""
    return torch.layer_norm(x, x.shape[-1:])


def rotation(position: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Rotary positions: cosines, and sines with a sign, [..., D] of angles that grow with position [...].

    Dot products of rotated vectors depend on relative positions; wavelengths are 6 to some thousand steps.
    """
    half = width // 2
    angle = position[..., None].float() * 1000.0 ** -(torch.arange(half, device=position.device) / half)
    cos, sin = angle.cos(), angle.sin()
    return torch.cat([cos, cos], -1), torch.cat([-sin, sin], -1)


def rotated(x: Tensor, by: tuple[Tensor, Tensor]) -> Tensor:
    """Pairs of the D of x [..., D], of its first and its second half, rotated by angles of these cosines and sines."""
    cos, sin = by
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)


def check_heads(width: int, heads: int) -> None:
    """Raises InputError for a width that cannot be divided between heads whose numbers are rotated in pairs."""
    if width % (2 * heads):
        raise InputError(f"a transformer of {heads} heads had width {width}; it must be a multiple of {2 * heads}")


class Cache:
    """A ring buffer of keys and values [2, N H, D, window] of each layer's latest tokens, for N trials of one seed.

    A trial's next token is written to the same place, until `advance` says that it stays. Each seed has its own cache,
    since the order of sums depends on how far it is filled.
    """

    def __init__(self, layers: int, n: int, heads: int, window: int, width: int, device: torch.device) -> None:
        self.kept = [torch.zeros(2, n * heads, width, window, device=device) for _ in range(layers)]
        self.heads, self.window = heads, window
        self.count = torch.zeros(n, dtype=torch.int64, device=device)  # of tokens that stay
        self.turns = self._turns(window)
        self._place()

    def _turns(self, length: int) -> Tensor:
        """Cosines and sines [length, 2, 3, D] by position, for queries, which are scaled, keys, and values: 1 and 0."""
        width = self.kept[0].shape[-2]
        cos, sin = rotation(torch.arange(length, device=self.count.device), width)
        scale = width**-0.5
        both = torch.stack([scale * cos, cos, torch.ones_like(cos), scale * sin, sin, torch.zeros_like(sin)], 1)
        return both.unflatten(1, (2, 3))

    def advance(self, mask: Tensor) -> None:
        """Keep the next token of each trial where mask [N] is 1."""
        self.count += mask.long()
        self._place()

    def clear(self) -> None:
        """Keep no token."""
        self.count.zero_()
        self._place()

    def _place(self) -> None:
        """Find where the next tokens are written, and to what they attend."""
        low, high = (int(count) for count in self.count.aminmax())
        if high >= len(self.turns):
            self.turns = self._turns(2 * high)
        self.filled = min(high + 1, self.window)
        self.slot: int | Tensor = high % self.window
        self.later: Tensor | None = None
        if low == high:  # all trials have as many steps
            cos, sin = self.turns[high, :, :, None].unbind()
        else:
            count = self.count.repeat_interleave(self.heads)
            cos, sin = self.turns[count].permute(1, 2, 0, 3).unbind()
            self.slot = (count % self.window)[:, None, None].expand(*self.kept[0].shape[:3], 1)
            self.later = (torch.arange(self.filled, device=count.device) > count[:, None])[:, None]
        self.turn = cos, sin

    def write(self, layer: int, qkv: Tensor) -> Tensor:
        """Write the key and value of each trial's next token [N, 3, H, D]; its query [N H, 1, D], scaled."""
        turned = rotated(qkv.transpose(0, 1).flatten(1, 2), self.turn)
        if isinstance(self.slot, int):
            self.kept[layer].select(-1, self.slot).copy_(turned[1:])
        else:
            self.kept[layer].scatter_(-1, self.slot, turned[1:, ..., None])
        return turned[0, :, None]

    def attend(self, layer: int, query: Tensor) -> Tensor:
        """What a query [N H, 1, D], scaled, reads from its trial's tokens, the next one among them: [N H, D, 1].

        On a CPU, torch's own attention, made for many queries at once, takes up to ten times as long.
        """
        keys, values = self.kept[layer].narrow(-1, 0, self.filled).unbind()
        alike = torch.bmm(query, keys)
        if self.later is not None:
            alike.masked_fill_(self.later, -torch.inf)
        return torch.bmm(values, alike.softmax(-1).mT)


class Transformer(nn.Module):
    """Pre-norm blocks of causal attention and an MLP: tokens [S, B, T, I] -> features [S, B, T, W]."""

    def __init__(self, inputs: int, width: int, layers: int, heads: int, window: int, draws: Draws) -> None:
        super().__init__()
        self.width, self.heads, self.window, self.depth = width, heads, window, layers
        self.embed = Linear(inputs, width, draws)
        self.attend = nn.ModuleList(Linear(width, 3 * width, draws) for _ in range(layers))
        self.mix = nn.ModuleList(Linear(width, width, draws) for _ in range(layers))
        self.widen = nn.ModuleList(Linear(width, 4 * width, draws) for _ in range(layers))
        self.narrow = nn.ModuleList(Linear(4 * width, width, draws) for _ in range(layers))

    def forward(self, tokens: Tensor) -> Tensor:
        x = self.embed(tokens)
        turn = rotation(torch.arange(tokens.shape[2], device=tokens.device), self.width // self.heads)
        for i in range(self.depth):
            qkv = self.projected(i, x)
            query, key = rotated(qkv[:2], turn)
            mixed = F.scaled_dot_product_attention(query, key, qkv[2], is_causal=True)
            x = self.after_attention(i, x, mixed)
        return normed(x)

    def projected(self, layer: int, x: Tensor) -> Tensor:
        """Queries, keys and values [3, S B, H, T, D] of a layer, from its inputs [S, B, T, W]."""
        qkv = self.attend[layer](normed(x)).unflatten(-1, (3, self.heads, -1))
        return qkv.permute(3, 0, 1, 4, 2, 5).flatten(1, 2)

    def after_attention(self, layer: int, x: Tensor, mixed: Tensor) -> Tensor:
        """Outputs [S, B, T, W] of a layer, from its inputs [S, B, T, W] and what its heads attend to [S B, H, T, D]."""
        x = x + self.mix[layer](mixed.unflatten(0, x.shape[:2]).transpose(2, 3).flatten(3))
        return x + self.narrow[layer](F.gelu(self.widen[layer](normed(x))))

    def layers(self, seed: int) -> list[tuple[Tensor, Tensor]]:
        """Bias and weight of a seed's linear maps, in the order of `step`."""
        blocks = zip(self.attend, self.mix, self.widen, self.narrow, strict=True)
        maps: list[Any] = [self.embed, *(linear for block in blocks for linear in block)]
        return [(linear.bias[seed], linear.weight[seed]) for linear in maps]

    def write(self, token: Tensor, layers: list[tuple[Tensor, Tensor]], cache: Cache) -> tuple[Tensor, Tensor]:
        """Write each trial's next token [N, I] to the cache, with one seed's layers; the last layer's input and query.

        What that layer reads is left to `step`: a token that only later ones read does not need it.
        """
        x = torch.addmm(layers[0][0], token, layers[0][1])
        for i in range(self.depth):
            bias, weight = layers[1 + 4 * i]
            qkv = torch.addmm(bias, normed(x), weight).view(len(x), 3, self.heads, -1)
            query = cache.write(i, qkv)
            if i + 1 < self.depth:
                x = self._read(i, x, query, layers, cache)
        return x, query

    def _read(self, i: int, x: Tensor, query: Tensor, layers: list[tuple[Tensor, Tensor]], cache: Cache) -> Tensor:
        """Outputs [N, W] of a layer, from its inputs [N, W] and queries [N H, 1, D]."""
        mix, widen, narrow = layers[2 + 4 * i : 5 + 4 * i]
        x = torch.addmm(x, cache.attend(i, query).reshape(x.shape), mix[1]).add_(mix[0])
        return torch.addmm(x, F.gelu(torch.addmm(widen[0], normed(x), widen[1])), narrow[1]).add_(narrow[0])

    def step(self, token: Tensor, layers: list[tuple[Tensor, Tensor]], cache: Cache) -> Tensor:
        """Features [N, W] of each trial's next token [N, I], with one seed's layers; it is written to the cache."""
        x, query = self.write(token, layers, cache)
        return normed(self._read(self.depth - 1, x, query, layers, cache))
