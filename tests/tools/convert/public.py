"""A second implementation of the public checkpoints: names, shapes and computation of their authors' code.

Plain numpy in torch's layout (NCHW, OIHW, (out, in)), float64, without the project's tables or models.
"""

import math
from collections.abc import Sequence

import numpy as np

Tensors = dict[str, np.ndarray]
Shapes = dict[str, tuple[int, ...]]


def random_tensors(shapes: Shapes, seed: int = 0) -> Tensors:
    """Returns tensors without zeros or ones, which could hide errors; smaller values for more inputs."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(scale=0.5 / math.sqrt(max(1, math.prod(shape[1:]) / 4)), size=shape).astype(np.float32)
        for name, shape in shapes.items()
    }


# The tokenizer.


def tokenizer_shapes(ch: int, mult: Sequence[int], res: int, bits: int, adaptive: bool) -> Shapes:
    shapes: Shapes = {}

    def block(name: str, ins: int, outs: int) -> None:
        shapes.update({f"{name}.norm1.weight": (ins,), f"{name}.norm1.bias": (ins,)})
        shapes[f"{name}.conv1.weight"] = (outs, ins, 3, 3)
        shapes.update({f"{name}.norm2.weight": (outs,), f"{name}.norm2.bias": (outs,)})
        shapes[f"{name}.conv2.weight"] = (outs, outs, 3, 3)
        if ins != outs:
            shapes[f"{name}.nin_shortcut.weight"] = (outs, ins, 1, 1)

    def conv(name: str, ins: int, outs: int, side: int) -> None:
        shapes.update({f"{name}.weight": (outs, ins, side, side), f"{name}.bias": (outs,)})

    shapes["encoder.conv_in.weight"] = (ch, 3, 3, 3)
    width = ch
    for level, m in enumerate(mult):
        for i in range(res):
            block(f"encoder.down.{level}.block.{i}", width, ch * m)
            width = ch * m
        if level < len(mult) - 1:
            conv(f"encoder.down.{level}.downsample", width, width, 3)
    for i in range(res):
        block(f"encoder.mid_block.{i}", width, width)
    shapes.update({"encoder.norm_out.weight": (width,), "encoder.norm_out.bias": (width,)})
    conv("encoder.conv_out", width, bits, 1)
    conv("decoder.conv_in", bits, width, 3)
    for i in range(res):
        block(f"decoder.mid_block.{i}", width, width)
    for level in reversed(range(len(mult))):
        if adaptive:
            for name in ("gamma", "beta"):
                shapes[f"decoder.adaptive.{level}.{name}.weight"] = (width, bits)
                shapes[f"decoder.adaptive.{level}.{name}.bias"] = (width,)
        for i in range(res):
            block(f"decoder.up.{level}.block.{i}", width, ch * mult[level])
            width = ch * mult[level]
        if level:
            conv(f"decoder.up.{level}.upsample.conv1", width, 4 * width, 3)
    shapes.update({"decoder.norm_out.weight": (width,), "decoder.norm_out.bias": (width,)})
    conv("decoder.conv_out", width, 3, 3)
    return shapes


def conv2d(x: np.ndarray, weight: np.ndarray, bias: np.ndarray | None = None, stride: int = 1) -> np.ndarray:
    """Cross-correlation; 3×3 kernels pad one pixel of zeros on all sides."""
    side = weight.shape[-1]
    x = np.pad(x, ((0, 0), (0, 0), (side // 2, side // 2), (side // 2, side // 2)))
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(2, 3))[:, :, ::stride, ::stride]
    out = np.einsum("bihwyx,oiyx->bohw", windows, weight, optimize=True)
    return out if bias is None else out + bias[:, None, None]


def group_norm(x: np.ndarray, groups: int = 32) -> np.ndarray:
    grouped = x.reshape(len(x), groups, -1)
    mean = grouped.mean(-1, keepdims=True)
    var = grouped.var(-1, keepdims=True)
    return ((grouped - mean) / np.sqrt(var + 1e-6)).reshape(x.shape)


class TokenizerNet:
    """The published tokenizer's encoder and decoder, on (B, 3, H, W) in [-1, 1]."""

    def __init__(self, tensors: Tensors, levels: int, res: int) -> None:
        self.t = {name: x.astype(np.float64) for name, x in tensors.items()}
        self.levels = levels
        self.res = res

    def conv(self, name: str, x: np.ndarray, stride: int = 1) -> np.ndarray:
        return conv2d(x, self.t[f"{name}.weight"], self.t.get(f"{name}.bias"), stride)

    def norm_swish(self, name: str, x: np.ndarray) -> np.ndarray:
        x = group_norm(x) * self.t[f"{name}.weight"][:, None, None] + self.t[f"{name}.bias"][:, None, None]
        return x / (1 + np.exp(-x))

    def blocks(self, name: str, x: np.ndarray) -> np.ndarray:
        for i in range(self.res):
            h = self.conv(f"{name}.{i}.conv1", self.norm_swish(f"{name}.{i}.norm1", x))
            h = self.conv(f"{name}.{i}.conv2", self.norm_swish(f"{name}.{i}.norm2", h))
            if f"{name}.{i}.nin_shortcut.weight" in self.t:
                x = self.conv(f"{name}.{i}.nin_shortcut", x)
            x = x + h
        return x

    def encode(self, images: np.ndarray) -> np.ndarray:
        x = self.conv("encoder.conv_in", images)
        for level in range(self.levels):
            x = self.blocks(f"encoder.down.{level}.block", x)
            if level < self.levels - 1:
                x = self.conv(f"encoder.down.{level}.downsample", x, stride=2)
        return self.conv("encoder.conv_out", self.norm_swish("encoder.norm_out", self.blocks("encoder.mid_block", x)))

    def decode(self, codes: np.ndarray) -> np.ndarray:
        x = self.blocks("decoder.mid_block", self.conv("decoder.conv_in", codes))
        for level in reversed(range(self.levels)):
            if f"decoder.adaptive.{level}.gamma.weight" in self.t:
                x = self.adapt(f"decoder.adaptive.{level}", x, codes)
            x = self.blocks(f"decoder.up.{level}.block", x)
            if level:
                x = shuffle(self.conv(f"decoder.up.{level}.upsample.conv1", x))
        return self.conv("decoder.conv_out", self.norm_swish("decoder.norm_out", x))

    def adapt(self, name: str, x: np.ndarray, codes: np.ndarray) -> np.ndarray:
        flat = codes.reshape(*codes.shape[:2], -1)
        unbiased = ((flat - flat.mean(-1, keepdims=True)) ** 2).sum(-1) / (flat.shape[-1] - 1)
        scale = np.sqrt(unbiased + 1e-6) @ self.t[f"{name}.gamma.weight"].T + self.t[f"{name}.gamma.bias"]
        shift = flat.mean(-1) @ self.t[f"{name}.beta.weight"].T + self.t[f"{name}.beta.bias"]
        return scale[:, :, None, None] * group_norm(x) + shift[:, :, None, None]


def shuffle(x: np.ndarray) -> np.ndarray:
    """Depth to space: channel (row, column, c) goes to that row and column of its 2×2 block."""
    b, c, h, w = x.shape
    out = np.empty((b, c // 4, 2 * h, 2 * w))
    for row in range(2):
        for column in range(2):
            start = (2 * row + column) * (c // 4)
            out[:, :, row::2, column::2] = x[:, start : start + c // 4]
    return out


# Genie.


def genie_shapes(layers: int, d: int, heads: int, frames: int, cells: int, codes: int, qk_norm: bool) -> Shapes:
    shapes: Shapes = {
        "pos_embed_TSC": (1, frames, cells, d),
        "token_embed.factored_embeds.0.weight": (codes, d),
        "token_embed.factored_embeds.1.weight": (codes, d),
        "token_embed.mask_token_embed": (1, d),
        "out_x_proj.weight": (2 * codes, d),
        "out_x_proj.bias": (2 * codes,),
    }
    for i in range(layers):
        own: Shapes = {"mlp.fc1.weight": (4 * d, d), "mlp.fc1.bias": (4 * d,)}
        own |= {"mlp.fc2.weight": (d, 4 * d), "mlp.fc2.bias": (d,)}
        for name in ("spatial_attn", "temporal_attn"):
            own |= {f"{name}.qkv.weight": (3 * d, d), f"{name}.proj.weight": (d, d), f"{name}.proj.bias": (d,)}
            if qk_norm:
                own |= {f"{name}.norm.weight": (d // heads,), f"{name}.norm.bias": (d // heads,)}
        if not qk_norm:
            own |= {f"norm{k}.{kind}": (d,) for k in (1, 2) for kind in ("weight", "bias")}
        shapes |= {f"decoder.layers.{i}.{name}": shape for name, shape in own.items()}
    return shapes


class GenieNet:
    """STMaskGIT's logits."""

    def __init__(self, tensors: Tensors, layers: int, heads: int, mup: bool = False) -> None:
        self.t = {name: x.astype(np.float64) for name, x in tensors.items()}
        self.layers = layers
        self.heads = heads
        self.mup = mup

    def linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self.t[f"{name}.weight"].T + self.t.get(f"{name}.bias", 0.0)

    def norm(self, name: str, x: np.ndarray) -> np.ndarray:
        """LayerNorm, or the identity if the checkpoint has none of that name."""
        if f"{name}.weight" not in self.t:
            return x
        centred = x - x.mean(-1, keepdims=True)
        scaled = centred / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return scaled * self.t[f"{name}.weight"] + self.t[f"{name}.bias"]

    def attention(self, name: str, x: np.ndarray, causal: bool) -> np.ndarray:
        """Over the last axis but one."""
        *_, n, d = x.shape
        size = d // self.heads
        qkv = np.moveaxis(self.linear(f"{name}.qkv", x).reshape(*x.shape[:-1], 3, self.heads, size), -3, 0)
        q = self.norm(f"{name}.norm", qkv[0])
        k = self.norm(f"{name}.norm", qkv[1])
        v = qkv[2]
        scores = np.einsum("...qhe,...khe->...hqk", q, k) * (8 / size if self.mup else size**-0.5)
        if causal:
            scores = np.where(np.tril(np.ones((n, n), bool)), scores, -np.inf)
        weights = np.exp(scores - scores.max(-1, keepdims=True))
        weights /= weights.sum(-1, keepdims=True)
        return self.linear(f"{name}.proj", np.einsum("...hqk,...khe->...qhe", weights, v).reshape(x.shape))

    def logits(self, tokens: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """(B, T, S) tokens, True where masked, to (B, T, S, vocabularies, codes)."""
        tables = [self.t[f"token_embed.factored_embeds.{k}.weight"] for k in range(2)]
        codes = len(tables[0])
        x = tables[0][tokens % codes] + tables[1][tokens // codes]
        x[mask] = self.t["token_embed.mask_token_embed"][0]
        x = x + self.t["pos_embed_TSC"][:, : tokens.shape[1]]
        for i in range(self.layers):
            layer = f"decoder.layers.{i}"
            x = x + self.attention(f"{layer}.spatial_attn", self.norm(f"{layer}.norm1", x), causal=False)
            over_time = x.swapaxes(1, 2)  # not normalised
            x = x + self.attention(f"{layer}.temporal_attn", over_time, causal=True).swapaxes(1, 2)
            hidden = self.linear(f"{layer}.mlp.fc1", self.norm(f"{layer}.norm2", x))
            hidden = 0.5 * hidden * (1 + np.vectorize(math.erf)(hidden / math.sqrt(2)))
            x = x + self.linear(f"{layer}.mlp.fc2", hidden)
        if self.mup:
            x = x / (x.shape[-1] / 256)
        return self.linear("out_x_proj", x).reshape(*x.shape[:-1], 2, codes)
