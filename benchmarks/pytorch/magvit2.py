"""MAGVIT-2's encoder and decoder in plain eager PyTorch, with the public parameter names.

It needs torch, an optional dependency, so import this module only where it is used.

Axes: N images, C channels, h×w cells.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rsjax.config import TokenizerConfig


class CellNorm(nn.GroupNorm):
    """GroupNorm that normalises each cell by itself."""

    def forward(self, x: Tensor) -> Tensor:
        n, c, h, w = x.shape
        return super().forward(x.permute(0, 2, 3, 1).reshape(-1, c)).reshape(n, h, w, c).permute(0, 3, 1, 2)


def _norm(config: TokenizerConfig, width: int, local: bool) -> nn.GroupNorm:
    return (CellNorm if local else nn.GroupNorm)(config.norm_groups, width, eps=1e-6)


class MagvitResBlockTorch(nn.Module):
    """GroupNorm → SiLU → convolution, twice, plus the input; with ``local`` no cell sees another."""

    def __init__(self, config: TokenizerConfig, width_in: int, width: int, local: bool = False) -> None:
        super().__init__()
        side = 1 if local else 3
        self.norm1 = _norm(config, width_in, local)
        self.norm2 = _norm(config, width, local)
        self.conv1 = nn.Conv2d(width_in, width, side, padding=side // 2, bias=False)
        self.conv2 = nn.Conv2d(width, width, side, padding=side // 2, bias=False)
        if width_in != width:
            self.nin_shortcut = nn.Conv2d(width_in, width, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv2(F.silu(self.norm2(self.conv1(F.silu(self.norm1(x))))))
        return (self.nin_shortcut(x) if hasattr(self, "nin_shortcut") else x) + h


def _blocks(config: TokenizerConfig, width_in: int, width: int, local: bool = False) -> nn.ModuleList:
    return nn.ModuleList(
        MagvitResBlockTorch(config, width if i else width_in, width, local) for i in range(config.res_blocks)
    )


class MagvitEncoderTorch(nn.Module):
    """Maps images (N, 3, H, W) to latents (N, C, h, w)."""

    def __init__(self, config: TokenizerConfig) -> None:
        super().__init__()
        local = config.local_codes
        width = config.channels
        self.patch = config.patch_size
        side = 1 if local else 3
        self.conv_in = nn.Conv2d(3 * config.patch_size**2, width, side, padding=side // 2, bias=False)
        levels = []
        for i, multiplier in enumerate(config.channel_multipliers):
            level = nn.ModuleDict({"block": _blocks(config, width, config.channels * multiplier, local)})
            width = config.channels * multiplier
            if i < len(config.channel_multipliers) - 1:
                shape = (2, 2, 0) if local else (3, 2, 1)
                level["downsample"] = nn.Conv2d(width, width, shape[0], shape[1], shape[2])
            levels.append(level)
        self.down = nn.ModuleList(levels)
        self.mid_block = _blocks(config, width, width, local)
        self.norm_out = _norm(config, width, local)
        self.conv_out = nn.Conv2d(width, config.code_bits, 1)

    def forward(self, images: Tensor) -> Tensor:
        x = self.conv_in(to_channels(images, self.patch))
        for level in self.down:
            for layer in [*level["block"], *([level["downsample"]] if "downsample" in level else [])]:
                x = layer(x)
        for block in self.mid_block:
            x = block(x)
        return self.conv_out(F.silu(self.norm_out(x)))


class Adaptive(nn.Module):
    """GroupNorm whose scale and shift are linear in the codes' deviations and means over the cells."""

    def __init__(self, config: TokenizerConfig, width: int) -> None:
        super().__init__()
        self.groups = config.norm_groups
        self.gamma = nn.Linear(config.code_bits, width)
        self.beta = nn.Linear(config.code_bits, width)

    def forward(self, x: Tensor, codes: Tensor) -> Tensor:
        scale = self.gamma((codes.var((2, 3)) + 1e-6).sqrt())[..., None, None]
        return scale * F.group_norm(x, self.groups, eps=1e-6) + self.beta(codes.mean((2, 3)))[..., None, None]


class MagvitDecoderTorch(nn.Module):
    """Maps codes or latents (N, C, h, w) to images (N, 3, H, W), not clipped."""

    def __init__(self, config: TokenizerConfig) -> None:
        super().__init__()
        self.patch = config.patch_size
        width = config.channels * config.channel_multipliers[-1]
        self.conv_in = nn.Conv2d(config.code_bits, width, 3, padding=1)
        self.mid_block = _blocks(config, width, width)
        levels = []
        norms = []
        for i, multiplier in reversed(list(enumerate(config.channel_multipliers))):
            norms.append(Adaptive(config, width))
            level = nn.ModuleDict({"block": _blocks(config, width, config.channels * multiplier)})
            width = config.channels * multiplier
            if i > 0:
                level["upsample"] = nn.ModuleDict({"conv1": nn.Conv2d(width, 4 * width, 3, padding=1)})
            levels.append(level)
        self.up = nn.ModuleList(levels[::-1])  # counted from the last level on, as in the public code
        self.adaptive = nn.ModuleList(norms[::-1] if config.adaptive_norm else [])
        self.norm_out = _norm(config, width, False)
        self.conv_out = nn.Conv2d(width, 3 * config.patch_size**2, 3, padding=1)

    def forward(self, codes: Tensor) -> Tensor:
        x = self.conv_in(codes)
        for block in self.mid_block:
            x = block(x)
        for i in reversed(range(len(self.up))):
            x = self.adaptive[i](x, codes) if self.adaptive else x
            for block in self.up[i]["block"]:
                x = block(x)
            x = to_pixels(self.up[i]["upsample"]["conv1"](x), 2) if i else x
        return to_pixels(self.conv_out(F.silu(self.norm_out(x))), self.patch)


def to_channels(x: Tensor, p: int) -> Tensor:
    """Moves p×p pixels into channels, ordered (p, p, C); PyTorch's own function orders them (C, p, p)."""
    n, c, h, w = x.shape
    return x.reshape(n, c, h // p, p, w // p, p).permute(0, 3, 5, 1, 2, 4).reshape(n, -1, h // p, w // p)


def to_pixels(x: Tensor, p: int) -> Tensor:
    """Inverts :func:`to_channels`, and keeps the memory format."""
    n, c, h, w = x.shape
    out = x.reshape(n, p, p, c // p**2, h, w).permute(0, 3, 4, 1, 5, 2).reshape(n, c // p**2, h * p, w * p)
    last = x.is_contiguous(memory_format=torch.channels_last)
    return out.contiguous(memory_format=torch.channels_last) if last else out
