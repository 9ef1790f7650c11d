"""iVideoGPT's tokenizer in plain eager PyTorch, a reference for results and speed, with the public parameter names.

It needs torch, an optional dependency, so import this module only where it is used.

Axes: B clips, c context frames, F later frames, N images, C channels, h×w cells.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rsjax.models.ivideogpt.config import ConditionalVQConfig


class Resnet(nn.Module):
    """GroupNorm → SiLU → convolution, twice, plus the input."""

    def __init__(self, width_in: int, width: int, groups: int) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, width_in, eps=1e-6)
        self.norm2 = nn.GroupNorm(groups, width, eps=1e-6)
        self.conv1 = nn.Conv2d(width_in, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        if width_in != width:
            self.conv_shortcut = nn.Conv2d(width_in, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv2(F.silu(self.norm2(self.conv1(F.silu(self.norm1(x))))))
        return (self.conv_shortcut(x) if hasattr(self, "conv_shortcut") else x) + h


class Resample(nn.Module):
    """Halves the size (padded at the bottom and right), or doubles it by repeating cells."""

    def __init__(self, width: int, up: bool) -> None:
        super().__init__()
        self.up = up
        self.conv = nn.Conv2d(width, width, 3, padding=1) if up else nn.Conv2d(width, width, 3, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(F.interpolate(x, scale_factor=2.0) if self.up else F.pad(x, (0, 1, 0, 1)))


class Level(nn.Module):
    """Residual blocks, followed by a change of size in all levels but the last."""

    def __init__(self, width_in: int, width: int, blocks: int, groups: int, up: bool, last: bool) -> None:
        super().__init__()
        self.resnets = nn.ModuleList(Resnet(width if i else width_in, width, groups) for i in range(blocks))
        self.name = "upsamplers" if up else "downsamplers"
        if not last:
            self.add_module(self.name, nn.ModuleList([Resample(width, up)]))

    def forward(self, x: Tensor) -> Tensor:
        for block in [*self.resnets, *getattr(self, self.name, [])]:
            x = block(x)
        return x


class SelfAttention(nn.Module):
    """Attention with one head over all cells of an image, plus the input."""

    def __init__(self, width: int, groups: int) -> None:
        super().__init__()
        self.group_norm = nn.GroupNorm(groups, width, eps=1e-6)
        self.to_q, self.to_k, self.to_v = (nn.Linear(width, width) for _ in range(3))
        self.to_out = nn.ModuleList([nn.Linear(width, width)])

    def forward(self, x: Tensor) -> Tensor:
        cells = self.group_norm(x).flatten(2).transpose(1, 2)
        out = F.scaled_dot_product_attention(self.to_q(cells), self.to_k(cells), self.to_v(cells))
        return x + self.to_out[0](out).transpose(1, 2).reshape(x.shape)


class Middle(nn.Module):
    """Two residual blocks, in the conditional pair with attention between them."""

    def __init__(self, width: int, groups: int, attention: bool) -> None:
        super().__init__()
        self.resnets = nn.ModuleList(Resnet(width, width, groups) for _ in range(2))
        self.attentions = nn.ModuleList([SelfAttention(width, groups)] if attention else [])

    def forward(self, x: Tensor) -> Tensor:
        for block in [self.resnets[0], *self.attentions, self.resnets[1]]:
            x = block(x)
        return x


class CrossAttention(nn.Module):
    """Attention of each later frame (N, C, h, w) to the context frames (N, C, c·h, w) at the same level."""

    def __init__(self, width: int, size: int, config: ConditionalVQConfig) -> None:
        super().__init__()
        self.q_pos_emb = nn.Parameter(torch.zeros(size**2, width))
        self.kv_pos_emb = nn.Parameter(torch.zeros(config.context_frames * size**2, width))
        self.q_norm = nn.GroupNorm(config.norm_groups, width)
        self.kv_norm = nn.GroupNorm(config.norm_groups, width)
        self.att = nn.MultiheadAttention(width, config.heads, config.dropout, batch_first=True)

    def forward(self, z: Tensor, context: Tensor) -> Tensor:
        q = self.q_norm(z).flatten(2).transpose(1, 2) + self.q_pos_emb
        kv = self.kv_norm(context).flatten(2).transpose(1, 2) + self.kv_pos_emb
        out, _ = self.att(q, kv, kv)
        return F.silu(z + F.dropout(out, self.att.dropout, self.training).transpose(1, 2).reshape(z.shape))


class Half(nn.Module):
    """An encoder or a decoder.

    With ``size``, the number of cells per side of its input, it is the conditional one of later frames.
    """

    def __init__(self, config: ConditionalVQConfig, up: bool, size: int | None) -> None:
        super().__init__()
        self.up = up
        self.limit = config.attention_size if size else 0
        widths = config.widths[::-1] if up else config.widths
        pixels = 3 * config.patch_size**2
        self.conv_in = nn.Conv2d(config.latent if up else pixels, widths[0], 3, padding=1)
        levels = []
        cross = [CrossAttention(widths[0], size, config)] if up and size else []
        width_in = widths[0]
        for i, width in enumerate(widths):
            last = i == len(widths) - 1
            levels.append(Level(width_in, width, config.res_blocks + up, config.norm_groups, up, last))
            width_in = width
            if size and not last:
                size = size * 2 if up else size // 2
            if size and size <= config.attention_size:
                cross.append(CrossAttention(width, size, config))
        self.add_module("up_blocks" if up else "down_blocks", nn.ModuleList(levels))
        self.mid_block = Middle(config.widths[-1], config.norm_groups, size is not None)
        self.cross_att_blocks = nn.ModuleList(cross)
        self.conv_norm_out = nn.GroupNorm(config.norm_groups, widths[-1], eps=1e-6)
        self.conv_out = nn.Conv2d(widths[-1], pixels if up else config.latent, 3, padding=1)

    def forward(self, x: Tensor, context: list[Tensor] | None = None) -> tuple[Tensor, list[Tensor]]:
        """Returns the output and the features after each stage; ``context`` holds such features of another half."""
        cross = iter(self.cross_att_blocks)
        stages = [self.mid_block] * self.up
        stages = [*stages, *getattr(self, "up_blocks" if self.up else "down_blocks")]
        x = self.conv_in(x)
        features = [x]
        for number, stage in enumerate(stages, 1):
            x = stage(x)
            if context is not None and x.shape[-1] <= self.limit:
                x = next(cross)(x, context[number])
            features.append(x)
        x = x if self.up else self.mid_block(x)
        return self.conv_out(F.silu(self.conv_norm_out(x))), features


class Codebook(nn.Module):
    """A codebook that maps each vector to its nearest entry."""

    def __init__(self, config: ConditionalVQConfig) -> None:
        super().__init__()
        self.embedding = nn.Embedding(config.codes, config.latent)
        nn.init.uniform_(self.embedding.weight, -1 / config.codes, 1 / config.codes)

    def nearest(self, z: Tensor) -> Tensor:
        """Returns the indices (…) of the entries nearest to vectors (…, C)."""
        return torch.cdist(z.reshape(-1, z.shape[-1]).float(), self.embedding.weight).argmin(1).reshape(z.shape[:-1])


class ConditionalVQTorch(nn.Module):
    """Maps frames (B, c + F, 3, H, W) in [0, 1] to tokens (B, c, g²) and (B, F, n), and back."""

    def __init__(self, config: ConditionalVQConfig, image_size: int) -> None:
        super().__init__()
        self.config = config
        patches = config.latent * config.future_patch**2
        self.encoder = Half(config, False, None)
        self.decoder = Half(config, True, None)
        self.cond_encoder = Half(config, False, image_size // config.patch_size)
        self.cond_decoder = Half(config, True, config.grid(image_size))
        self.quant_conv, self.post_quant_conv = (nn.Conv2d(config.latent, config.latent, 1) for _ in range(2))
        self.quant_linear = nn.Linear(patches, config.latent)
        self.post_quant_linear = nn.Linear(config.latent, patches)
        self.quantize = Codebook(config)
        self.dynamics_quantize = Codebook(config)

    def latents(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the latents that the codebooks quantise, (B, c, g², C) and (B, F, n, C)."""
        cfg = self.config
        clips, count = frames.shape[:2]
        later = count - cfg.context_frames
        unshuffled = [self._to_channels(x.flatten(0, 1)) for x in frames.split([cfg.context_frames, later], 1)]
        h, features = self.encoder(unshuffled[0])
        d, _ = self.cond_encoder(unshuffled[1], self._stacked(features, clips, later))
        p = cfg.future_patch
        grid = d.shape[-1]
        d = d.reshape(len(d), cfg.latent, grid // p, p, grid // p, p).permute(0, 2, 4, 3, 5, 1)
        d = self.quant_linear(d.reshape(clips, later, (grid // p) ** 2, -1))
        h = self.quant_conv(h).flatten(2).transpose(1, 2)
        return h.reshape(clips, cfg.context_frames, grid**2, cfg.latent), d

    def tokenize(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the tokens of context frames and of later frames."""
        context, later = self.latents(frames)
        return self.quantize.nearest(context), self.dynamics_quantize.nearest(later)

    def detokenize(self, context: Tensor, later: Tensor) -> Tensor:
        """Decodes tokens to frames in about [0, 1]."""
        return self.images(self.quantize.embedding(context), self.dynamics_quantize.embedding(later))

    def images(self, context: Tensor, later: Tensor) -> Tensor:
        """Decodes quantised latents, laid out as :meth:`latents` returns them."""
        cfg = self.config
        clips, count = later.shape[:2]
        grid = int(context.shape[2] ** 0.5)
        p = cfg.future_patch
        h = context.flatten(0, 1).transpose(1, 2).reshape(-1, cfg.latent, grid, grid)
        first, features = self.decoder(self.post_quant_conv(h))
        d = self.post_quant_linear(later).reshape(-1, grid // p, grid // p, p, p, cfg.latent)
        d = d.permute(0, 5, 1, 3, 2, 4).reshape(-1, cfg.latent, grid, grid)
        made, _ = self.cond_decoder(d, self._stacked(features, clips, count))
        frames = [self._to_pixels(x) for x in (first, made)]
        return torch.cat([x.reshape(clips, -1, *x.shape[1:]) for x in frames], 1)

    def _stacked(self, features: list[Tensor], clips: int, later: int) -> list[Tensor]:
        """Stacks context frames along the height and repeats them for each later frame, as the public code does."""
        out = []
        for x in features:
            x = x.reshape(clips, -1, *x.shape[1:]).transpose(1, 2).flatten(2, 3)
            out.append(x.repeat_interleave(later, 0))
        return out

    def _to_channels(self, x: Tensor) -> Tensor:
        p = self.config.patch_size  # channels are ordered (p, p, 3); PyTorch's own function orders them (3, p, p)
        n, c, h, w = x.shape
        return x.reshape(n, c, h // p, p, w // p, p).permute(0, 3, 5, 1, 2, 4).reshape(n, -1, h // p, w // p)

    def _to_pixels(self, x: Tensor) -> Tensor:
        p = self.config.patch_size
        n, _, h, w = x.shape
        return x.reshape(n, p, p, 3, h, w).permute(0, 3, 4, 1, 5, 2).reshape(n, 3, h * p, w * p)


def public_tensors(model: nn.Module) -> dict[str, Any]:
    """Returns the parameters under their public names, as numpy arrays."""
    return {name: x.detach().numpy() for name, x in model.state_dict().items()}
