"""Genie, or RoboScape's RGB branch, in plain eager PyTorch (architecture: 1xgpt's STMaskGIT), with its tokenizer.

Like the public code it uses ``scaled_dot_product_attention``, ``nn.LayerNorm`` and exact GELU, without compilation and
without a cache in sampling. Parameter names are those of the public checkpoints. It needs torch, an optional
dependency, so import this module only where it is used.

Axes: B clips, T frames, S cells, C width, n vocabularies of V codes, A action inputs.
"""

import math
from collections import OrderedDict

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.pytorch.magvit2 import MagvitDecoderTorch, MagvitEncoderTorch
from benchmarks.pytorch.measure import TorchWork
from rsjax.config import Config, TokenModelConfig
from rsjax.models.roboscape.architecture import Architecture


class Attention(nn.Module):
    """Multi-head attention over the second axis of (N, L, C)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width, bias=False)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        n, length, width = x.shape
        q, k, v = self.qkv(x).reshape(n, length, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(q, k, v, is_causal=causal)
        return self.proj(out.transpose(1, 2).reshape(n, length, width))


class STBlock(nn.Module):
    """x += Spatial(norm1 x); x += Temporal(x), without a norm; x += MLP(norm2 x)."""

    def __init__(self, config: Architecture) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(config.width)
        self.norm2 = nn.LayerNorm(config.width)
        self.spatial_attn = Attention(config.width, config.heads)
        self.temporal_attn = Attention(config.width, config.heads)
        hidden = config.public.mlp_ratio * config.width
        layers = {"fc1": nn.Linear(config.width, hidden), "gelu": nn.GELU(), "fc2": nn.Linear(hidden, config.width)}
        self.mlp = nn.Sequential(OrderedDict(layers))

    def forward(self, x: Tensor) -> Tensor:
        b, t, s, c = x.shape
        x = x + self.spatial_attn(self.norm1(x).reshape(b * t, s, c), causal=False).reshape(b, t, s, c)
        columns = x.transpose(1, 2).reshape(b * s, t, c)
        x = (columns + self.temporal_attn(columns, causal=True)).reshape(b, s, t, c).transpose(1, 2)
        return x + self.mlp(self.norm2(x))


class GenieTorch(nn.Module):
    """Maps tokens (B, T, S) and actions (B, T, A) to logits (B, T, S, n, V); the public Genie reads no actions.

    Args:
        config: passes :func:`benchmarks.pytorch.baselines.check_genie`.
    """

    def __init__(self, config: Architecture) -> None:
        super().__init__()
        self.config = config
        self.pos_embed_TSC = nn.Parameter(torch.zeros(1, config.frames, config.grid**2, config.width))
        self.factored_embeds = nn.ModuleList(
            nn.Embedding(config.vocabulary_size, config.width) for _ in range(config.vocabularies)
        )
        self.mask_token_embed = nn.Parameter(torch.zeros(1, config.width))
        if config.action_inputs:
            first = nn.Linear(config.action_inputs, config.width)
            more = [nn.GELU(), nn.Linear(config.width, config.width)] if config.action_encoder == "mlp" else []
            self.action_encoder = nn.Sequential(first, *more)
        self.layers = nn.ModuleList(STBlock(config) for _ in range(config.blocks))
        self.out_x_proj = nn.Linear(config.width, config.vocabularies * config.vocabulary_size)

    def forward(self, tokens: Tensor, mask: Tensor, actions: Tensor | None = None) -> Tensor:
        parts = sub_tokens(tokens, self.config)
        embedded = torch.stack([embed(part) for embed, part in zip(self.factored_embeds, parts, strict=True)]).sum(0)
        x = torch.where(mask[..., None], self.mask_token_embed, embedded) + self.pos_embed_TSC[:, : tokens.shape[1]]
        if self.config.action_inputs:
            x = x + self.action_encoder(actions)[:, :, None]
        for layer in self.layers:
            x = layer(x)
        return self.out_x_proj(x).reshape(*tokens.shape, self.config.vocabularies, self.config.vocabulary_size)


def sub_tokens(tokens: Tensor, config: Architecture) -> list[Tensor]:
    """Splits tokens into sub-tokens, little-endian, one per vocabulary."""
    bits = config.code_bits // config.vocabularies
    return [(tokens >> (k * bits)) & (2**bits - 1) for k in range(config.vocabularies)]


def masked_loss(model: GenieTorch, tokens: Tensor, mask: Tensor, actions: Tensor | None = None) -> Tensor:
    """Returns the mean over masked cells of the sum of the vocabularies' cross-entropies, in nats."""
    logits = model(tokens, mask, actions).float()
    targets = torch.stack(sub_tokens(tokens, model.config), dim=-1)
    cross_entropy = F.cross_entropy(logits.flatten(0, -2), targets.flatten(), reduction="none")
    return (cross_entropy.reshape(targets.shape).sum(-1) * mask).sum() / mask.sum()


@torch.no_grad()
def decode_frame(model: GenieTorch, tokens: Tensor, t: int, steps: int, actions: Tensor | None = None) -> Tensor:
    """Returns tokens with frame ``t`` decoded by MaskGIT with random unmasking; each step passes over all frames."""
    hidden = torch.ones_like(tokens[:, t], dtype=torch.bool)
    bits = model.config.code_bits // model.config.vocabularies
    tokens = tokens.clone()
    for step in range(steps):
        mask = torch.zeros_like(tokens, dtype=torch.bool)
        mask[:, t] = hidden
        codes = model(tokens, mask, actions)[:, t].argmax(-1)
        drawn = (codes << (bits * torch.arange(codes.shape[-1], device=codes.device))).sum(-1)
        tokens[:, t] = torch.where(hidden, drawn, tokens[:, t])
        left = 0 if step + 1 == steps else math.ceil(math.cos((step + 1) / steps * math.pi / 2) * hidden.shape[-1])
        order = torch.where(hidden, torch.rand(hidden.shape, device=tokens.device), torch.inf)
        hidden = order.argsort(-1).argsort(-1) < left
    return tokens


def create(config: Config, batch: int, horizon: int, device: str) -> TorchWork:
    """Returns the work to time; sampling decodes one frame, and each of its steps passes over the whole window."""
    arch = Architecture.create(config)
    model = config.model
    assert isinstance(model, TokenModelConfig)
    network = GenieTorch(arch).to(device)
    encoder = MagvitEncoderTorch(config.tokenizer).to(device)
    decoder = MagvitDecoderTorch(config.tokenizer).to(device)
    frames = config.clips.frames
    window = min(horizon, arch.frames)
    tokens = torch.randint(0, 2**arch.code_bits, (batch, max(frames, window), arch.grid**2), device=device)
    actions = torch.randn(*tokens.shape[:2], max(1, arch.action_inputs), device=device)
    mask = torch.rand(tokens[:, :frames].shape, device=device) < 0.5
    images = torch.randn(batch * frames, 3, config.clips.image_size, config.clips.image_size, device=device)
    codes = torch.randn(batch * frames, arch.code_bits, arch.grid, arch.grid, device=device).sign()
    return TorchWork(
        trained=(network,),
        frozen=(encoder, decoder),
        loss=lambda: masked_loss(network, tokens[:, :frames], mask, actions[:, :frames]),
        sample=lambda: decode_frame(network, tokens[:, :window], window - 1, model.sample.steps, actions[:, :window]),
        sampled=1,
        encode=lambda: encoder(images) > 0,
        decode=lambda: decoder(codes).clamp(-1, 1),
        frames=batch * frames,
    )
