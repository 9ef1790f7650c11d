"""CogVideoX from ``diffusers``, its public implementation, with the settings and shapes of this project's networks.

Axes: B clips, T frames, F latent frames, C channels, h×w cells.
"""

from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKLCogVideoX, CogVideoXDDIMScheduler, CogVideoXTransformer3DModel
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from torch import Tensor, nn

from benchmarks.pytorch.measure import TorchWork
from rsjax.config import Config
from rsjax.models.cogvideox.config import COMPRESSION, CausalVAEConfig, CogVideoXConfig, padded_frames
from rsjax.models.cogvideox.transformer import Architecture
from rsjax.models.diffusion.schedule import alphas


def autoencoder(config: CausalVAEConfig) -> tuple[nn.Module, Any, Any]:
    """Returns the autoencoder, and its functions that map frames (B, 3, T, H, W) to latents and back."""
    levels = len(config.widths)
    patch = config.patch_size
    vae = AutoencoderKLCogVideoX(
        in_channels=3 * patch**2,
        out_channels=3 * patch**2,
        block_out_channels=config.widths,
        down_block_types=("CogVideoXDownBlock3D",) * levels,
        up_block_types=("CogVideoXUpBlock3D",) * levels,
        layers_per_block=config.res_blocks,
        latent_channels=config.latent_channels,
        norm_num_groups=config.norm_groups,
    )

    def by_frame(x: Tensor, function: Any) -> Tensor:
        return function(x.transpose(1, 2), patch).transpose(1, 2)

    def encode(frames: Tensor) -> Tensor:
        return vae.encode(by_frame(frames, F.pixel_unshuffle)).latent_dist.mean

    return vae, encode, lambda latents: by_frame(vae.decode(latents).sample, F.pixel_shuffle)


def transformer(arch: Architecture) -> tuple[nn.Module, Any]:
    """Returns the transformer and its rotary positions (None for other positions)."""
    cfg = arch.model
    network = CogVideoXTransformer3DModel(
        num_attention_heads=cfg.heads,
        attention_head_dim=cfg.width // cfg.heads,
        in_channels=arch.channels * (1 + (cfg.image == "channels")),
        out_channels=arch.channels,
        time_embed_dim=cfg.time_width,
        text_embed_dim=cfg.text.width,
        num_layers=cfg.blocks,
        sample_width=arch.columns,
        sample_height=arch.rows,
        sample_frames=COMPRESSION * (arch.frames - 1) + 1,
        patch_size=cfg.patch_size,
        max_text_seq_length=cfg.text.tokens,
        spatial_interpolation_scale=cfg.position_scale,
        use_rotary_positional_embeddings=cfg.positions == "rotary",
        use_learned_positional_embeddings=False,
    )
    if cfg.positions != "rotary":
        return network, None
    grid = arch.grid
    return network, get_3d_rotary_pos_embed(cfg.width // cfg.heads, ((0, 0), grid), grid, arch.frames)


def create(config: Config, batch: int, horizon: int, device: str) -> TorchWork:
    """Returns the work to time; sampling goes from pixels to pixels, in chunks as long as a clip."""
    model = config.model
    clips = config.clips
    assert isinstance(model, CogVideoXConfig)
    arch = Architecture.create(model, clips)
    network, rotary = transformer(arch)
    network.to(device)
    vae, encode, decode = autoencoder(model.autoencoder)
    vae.to(device)
    channels = model.image == "channels"
    guidance = model.sample.guidance
    left = torch.tensor(alphas(model.noise), dtype=torch.float32, device=device)[:, None, None, None, None]
    latents = torch.randn(batch, arch.frames, arch.channels, arch.rows, arch.columns, device=device)
    text = torch.randn(batch, model.text.tokens, model.text.width, device=device)
    frames = torch.randn(batch, 3, padded_frames(clips.frames), clips.image_size, clips.image_size, device=device)

    def velocity(x: Tensor, t: Tensor, image: Tensor, text: Tensor) -> Tensor:
        given = torch.cat([image[:, None], torch.zeros_like(x[:, 1:])], 1)
        x = torch.cat([x, given], 2) if channels else torch.cat([image[:, None], x[:, 1:]], 1)
        return network(x, text, t, image_rotary_emb=rotary, return_dict=False)[0].float()

    def loss() -> Tensor:
        t = torch.randint(0, model.noise.steps, (batch,), device=device)
        noise = torch.randn_like(latents)
        signal = left[t].sqrt()
        spread = (1 - left[t]).sqrt()
        made = velocity(signal * latents + spread * noise, t, latents[:, 0], text)
        return (made - (signal * noise - spread * latents)).square().mean()

    def chunk(image: Tensor) -> Tensor:
        scheduler = make_scheduler(model)
        x = torch.randn_like(latents)
        for step in scheduler.timesteps:
            t = torch.full((batch,), int(step), device=device)
            if guidance == 1:
                made = velocity(x, t, image, text)
            else:
                x2, t2, image2 = (torch.cat([y, y]) for y in (x, t, image))
                texts = torch.cat([torch.zeros_like(text), text])
                without, given = velocity(x2, t2, image2, texts).chunk(2)
                made = without + guidance * (given - without)
            x = scheduler.step(made, step, x).prev_sample
        return x

    def sample() -> Tensor:
        made = frames[:, :, :1]
        while made.shape[2] < horizon:
            image = encode(made[:, :, -1:])[:, :, 0].float()
            video = decode(chunk(image).transpose(1, 2)).float()
            made = torch.cat([made, video[:, :, 1 : clips.frames]], 2)
        return made[:, :, :horizon]

    return TorchWork(
        trained=(network,),
        frozen=(vae,),
        loss=loss,
        sample=sample,
        sampled=horizon - 1,
        encode=lambda: encode(frames),
        decode=lambda: decode(latents.transpose(1, 2)),
        frames=batch * clips.frames,
    )


def make_scheduler(model: CogVideoXConfig) -> Any:
    """Returns the sampler of ``diffusers`` with the model's settings, at its first step."""
    noise = model.noise
    sample = model.sample
    scheduler = CogVideoXDDIMScheduler(
        num_train_timesteps=noise.steps,
        beta_start=noise.beta_start,
        beta_end=noise.beta_end,
        beta_schedule=noise.betas,
        prediction_type="v_prediction",
        rescale_betas_zero_snr=noise.zero_terminal,
        snr_shift_scale=noise.snr_shift,
        timestep_spacing=sample.spacing,
        set_alpha_to_one=sample.end_clean,
        clip_sample=False,
    )
    scheduler.set_timesteps(sample.steps)
    return scheduler
