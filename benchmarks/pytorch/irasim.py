"""IRASim in plain eager PyTorch, with the samplers and SDXL's autoencoder of ``diffusers``; both are optional packages.

Parameter names are those of the public checkpoints.

Axes: B clips, T frames, S tokens of a frame, D width, C channels, h×w cells.
"""

from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, DDIMScheduler, PNDMScheduler
from torch import Tensor, nn

from benchmarks.pytorch.magvit2 import MagvitDecoderTorch, MagvitEncoderTorch
from benchmarks.pytorch.measure import TorchWork
from rsjax.config import Config
from rsjax.models.diffusion.layers import TIME_CHANNELS, grid_positions, positions
from rsjax.models.diffusion.schedule import alphas
from rsjax.models.irasim.config import IRASimConfig, KLConfig
from rsjax.models.irasim.dit import Architecture, architecture


class Attention(nn.Module):
    """Multi-head attention over the second axis of (N, L, D)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        n, length, width = x.shape
        q, k, v = self.qkv(x).reshape(n, length, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(n, length, width))


class Mlp(nn.Module):
    """Linear → GELU → linear, or without GELU."""

    def __init__(self, inputs: int, hidden: int, width: int, gelu: bool = True) -> None:
        super().__init__()
        self.fc1 = nn.Linear(inputs, hidden)
        self.fc2 = nn.Linear(hidden, width)
        self.gelu = gelu

    def forward(self, x: Tensor) -> Tensor:
        x = self.fc1(x)
        return self.fc2(F.gelu(x, approximate="tanh") if self.gelu else x)


class DiTBlockTorch(nn.Module):
    """Attention, then an MLP, each with adaptive LayerNorm and gate, on (N, L, D) under a condition (N, D)."""

    def __init__(self, config: Architecture) -> None:
        super().__init__()
        width = config.width
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=1e-6, elementwise_affine=False) for _ in range(2))
        self.attn = Attention(width, config.heads)
        self.mlp = Mlp(width, config.mlp_ratio * width, width)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        parts = self.adaLN_modulation(condition)[:, None].chunk(6, dim=-1)
        x = x + parts[2] * self.attn(modulate(self.norm1(x), parts[0], parts[1]))
        return x + parts[5] * self.mlp(modulate(self.norm2(x), parts[3], parts[4]))


class Final(nn.Module):
    """Adaptive LayerNorm and the output layer."""

    def __init__(self, config: Architecture) -> None:
        super().__init__()
        self.norm_final = nn.LayerNorm(config.width, eps=1e-6, elementwise_affine=False)
        self.linear = nn.Linear(config.width, config.patch_size**2 * config.inputs)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(config.width, 2 * config.width))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        shift, scale = self.adaLN_modulation(condition)[:, None].chunk(2, dim=-1)
        return self.linear(modulate(self.norm_final(x), shift, scale))


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return x * (1 + scale) + shift


class IRASimTorch(nn.Module):
    """Maps noisy latents (B, T, C, h, w), steps (B,) and actions (B, T - 1, A) to the noise."""

    def __init__(self, config: Architecture) -> None:
        super().__init__()
        self.config = config
        width = config.width
        video = config.conditioning == "video"
        patch = (config.patch_size, config.patch_size)
        self.x_embedder = nn.ModuleDict({"proj": nn.Conv2d(config.inputs, width, patch, patch)})
        self.t_embedder = nn.ModuleDict(
            {"mlp": nn.Sequential(nn.Linear(TIME_CHANNELS, width), nn.SiLU(), nn.Linear(width, width))}
        )
        inputs = config.action_inputs * (config.frames - 1 if video else 1)
        self.embed_state = Mlp(inputs, config.mlp_ratio * width, width, config.action_activation == "gelu")
        self.mask_emb_fn = nn.Embedding(1, width)
        self.blocks = nn.ModuleList(DiTBlockTorch(config) for _ in range(config.blocks))
        self.final_layer = Final(config)
        fixed = {"pos_embed": grid_positions(*config.grid, width), "temp_embed": positions(config.frames, width)}
        for name, x in fixed.items():
            self.register_buffer(name, torch.from_numpy(x)[None])

    def forward(self, latents: Tensor, t: Tensor, actions: Tensor) -> Tensor:
        cfg = self.config
        clips, frames = latents.shape[:2]
        x = self.x_embedder["proj"](latents.flatten(0, 1)).flatten(2).transpose(1, 2) + self.pos_embed
        cells = x.shape[1]
        half = TIME_CHANNELS // 2
        angles = t[:, None].float() * 10_000.0 ** (-torch.arange(half, device=t.device) / half)
        time = self.t_embedder["mlp"](torch.cat([angles.cos(), angles.sin()], 1))
        video = cfg.conditioning == "video"
        acted = self.embed_state(actions.reshape(clips, 1, -1) if video else actions)
        if not video:
            acted = torch.cat([self.mask_emb_fn.weight.expand(clips, 1, -1).to(acted.dtype), acted], 1)
        acted = (time[:, None] + acted).expand(clips, frames, -1)
        plain = acted if video else time[:, None].expand(clips, frames, -1)
        for i, block in enumerate(self.blocks):
            if i % 2 == 0:
                x = block(x, acted.flatten(0, 1))
                continue
            x = x.reshape(clips, frames, cells, -1).transpose(1, 2)
            x = (x + self.temp_embed[:, :frames, None].transpose(1, 2)) if i == 1 else x
            x = block(x.flatten(0, 1), plain[:, 0].repeat_interleave(cells, 0))
            x = x.reshape(clips, cells, frames, -1).transpose(1, 2).flatten(0, 1)
        x = self.final_layer(x, plain.flatten(0, 1))
        p = cfg.patch_size
        rows, columns = cfg.grid
        x = x.reshape(clips, frames, rows, columns, p, p, cfg.inputs).permute(0, 1, 6, 2, 4, 3, 5)
        return x.reshape(clips, frames, cfg.inputs, rows * p, columns * p)


def autoencoder(config: KLConfig) -> tuple[nn.Module, Any, Any]:
    """Returns the autoencoder, and its functions that map images (N, 3, H, W) to latents and back."""
    if config.network == "magvit2":
        halves = nn.ModuleList(
            [
                MagvitEncoderTorch(config.convolutions),
                MagvitDecoderTorch(replace(config.convolutions, code_bits=config.latent_channels, vocabularies=1)),
            ]
        )
        return halves, lambda x: halves[0](x).chunk(2, dim=1)[0], halves[1]
    levels = len(config.widths)
    vae = AutoencoderKL(
        block_out_channels=config.widths,
        down_block_types=["DownEncoderBlock2D"] * levels,
        up_block_types=["UpDecoderBlock2D"] * levels,
        layers_per_block=config.res_blocks,
        norm_num_groups=config.norm_groups,
        latent_channels=config.latent_channels,
    )
    return vae, lambda x: vae.encode(x).latent_dist.mean, lambda z: vae.decode(z).sample


def create(config: Config, batch: int, horizon: int, device: str) -> TorchWork:
    """Returns the work to time; sampling goes from pixels to pixels, in chunks as long as a clip.

    With depth, the latents of its pictures are further channels of the frames', as in ours; encoding and decoding are
    timed on pictures of either kind, and the terms of RGB and depth weigh the same.
    """
    model = config.model
    clips = config.clips
    arch = architecture(config)
    kinds = 1 + arch.depth  # of pictures, each with latents of its own
    assert isinstance(model, IRASimConfig)
    network = IRASimTorch(arch).to(device)
    vae, encode, decode = autoencoder(model.autoencoder)
    vae.to(device)
    left = torch.tensor(alphas(model.noise), dtype=torch.float32, device=device)[:, None, None, None, None]
    latents = torch.randn(batch, arch.frames, arch.inputs, arch.rows, arch.columns, device=device)
    actions = torch.randn(batch, arch.frames - 1, arch.action_inputs, device=device)
    images = torch.randn(batch * clips.frames, 3, clips.image_size, clips.image_size, device=device)

    def loss() -> Tensor:
        t = torch.randint(0, model.noise.steps, (batch,), device=device)
        noise = torch.randn_like(latents)
        noisy = left[t].sqrt() * latents + (1 - left[t]).sqrt() * noise
        noisy[:, :1] = latents[:, :1]
        return (network(noisy, t, actions) - noise)[:, 1:].float().square().mean()

    def chunk(known: Tensor) -> Tensor:
        scheduler = make_scheduler(model)
        x = torch.randn_like(latents)
        x[:, :1] = known
        for t in scheduler.timesteps:
            made = network(x, torch.full((batch,), int(t), device=device), actions).float()
            x = scheduler.step(made, t, x).prev_sample
            x[:, :1] = known
        return x

    def sample() -> Tensor:
        made = torch.cat([encode(images[:batch])] * kinds, 1)[:, None].float()
        while made.shape[1] < horizon:
            made = torch.cat([made, chunk(made[:, -1:])[:, 1:]], 1)
        return [decode(each.flatten(0, 1)) for each in made[:, :horizon].chunk(kinds, dim=2)]

    return TorchWork(
        trained=(network,),
        frozen=(vae,),
        loss=loss,
        sample=sample,
        sampled=horizon - 1,
        encode=lambda: encode(images),
        decode=lambda: decode(latents[:, :, : arch.channels].flatten(0, 1)[: len(images)]),
        frames=len(images),
    )


def make_scheduler(model: IRASimConfig) -> Any:
    """Returns the sampler of ``diffusers`` with the model's settings, at its first step."""
    noise = model.noise
    sample = model.sample
    kind, more = (PNDMScheduler, {}) if sample.sampler == "pndm" else (DDIMScheduler, {"clip_sample": False})
    scheduler = kind(
        num_train_timesteps=noise.steps,
        beta_start=noise.beta_start,
        beta_end=noise.beta_end,
        beta_schedule=noise.betas,
        timestep_spacing=sample.spacing,
        set_alpha_to_one=sample.end_clean,
        **more,
    )
    scheduler.set_timesteps(sample.steps)
    return scheduler
