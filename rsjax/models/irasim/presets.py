"""The presets of IRASim: the public sizes with their training, and small ones for 2 CPU cores."""

from dataclasses import replace

from rsjax.config.run import FULL_SIZE_EVAL, Config
from rsjax.config.sim import SimConfig
from rsjax.config.tokenizer import TokenizerTrainConfig
from rsjax.config.train import AdamW, RuntimeConfig, TrainConfig
from rsjax.models.diffusion.config import DenoiseConfig
from rsjax.models.irasim.config import IRASimConfig, KLConfig


def irasim_s() -> Config:
    """Returns the smallest of IRASim's public sizes."""
    return _irasim("irasim_s", width=384, blocks=12, heads=6)


def irasim_b() -> Config:
    """Returns the second of IRASim's public sizes."""
    return _irasim("irasim_b", width=768, blocks=12, heads=12)


def irasim_l() -> Config:
    """Returns the third of IRASim's public sizes."""
    return _irasim("irasim_l", width=1024, blocks=24, heads=16)


def irasim_xl() -> Config:
    """Returns IRASim's published model."""
    return _irasim("irasim_xl", width=1152, blocks=28, heads=16)


def _irasim(name: str, width: int, blocks: int, heads: int) -> Config:
    """Returns a preset with the public code's settings on the latents of SDXL's autoencoder, which stays frozen.

    The public batch is 1 clip a GPU, accumulated twice, on an unknown number of GPUs; 16 is our choice.
    """
    public = AdamW(warmup_steps=0, schedule="steps", betas=(0.9, 0.999), grad_clip=0.1)
    return Config(
        name=name,
        sim=SimConfig(image_size=256),
        tokenizer_train=TokenizerTrainConfig(steps=0, start_from="sdxl_vae"),
        model=IRASimConfig(width=width, blocks=blocks, heads=heads, compute_dtype="bfloat16", remat="blocks"),
        train=TrainConfig(
            steps=300_000,
            batch_size=16,
            optimizer=public,
            ema=0.9999,
        ),
        runtime=RuntimeConfig(log_every=100, checkpoint_every=1000, eval_every=10_000),
        eval=FULL_SIZE_EVAL,
    )


def irasim_tiny(base: Config) -> Config:
    """Returns IRASim and its own autoencoder on the clips of the preset ``tiny``, trained for about as long."""
    return replace(
        base,
        name="irasim_tiny",
        tokenizer_train=replace(
            base.tokenizer_train,
            steps=2000,
            depth_share=0.0,
            optimizer=AdamW(learning_rate=3e-3, final_share=0.02),
        ),
        model=IRASimConfig(
            # The convolutions of tiny's tokenizer.
            autoencoder=KLConfig(
                network="magvit2",
                latent_channels=16,
                channels=64,
                channel_multipliers=(1, 2),
                res_blocks=1,
                norm_groups=8,
                patch_size=4,
                local_codes=True,
                compute_dtype="bfloat16",
            ),
            integrate_actions=True,
            width=128,
            blocks=8,
            heads=4,
            patch_size=1,
            compute_dtype="bfloat16",
            unroll=4,
            sample=DenoiseConfig("ddim", steps=20),
        ),
        train=replace(
            base.train,
            steps=2400,
            accumulate=1,
            optimizer=AdamW(learning_rate=1e-3, final_share=0.02),
            ema=0.998,
        ),
        runtime=replace(base.runtime, eval_every=1200),
    )


def irasim_rgbd_tiny(base: Config) -> Config:
    """Returns ``irasim_tiny`` with depth as further channels of its latents, as geometry-aware world models have it.

    The autoencoder learns from depth maps as often as the tokenizer of ``tiny`` does.
    """
    rgb = irasim_tiny(base)
    assert isinstance(rgb.model, IRASimConfig)
    return replace(
        rgb,
        name="irasim_rgbd_tiny",
        tokenizer_train=replace(rgb.tokenizer_train, depth_share=base.tokenizer_train.depth_share),
        model=replace(rgb.model, autoencoder=replace(rgb.model.autoencoder, depth="inverse")),
    )
