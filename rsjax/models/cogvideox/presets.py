"""The presets of CogVideoX: the public sizes with their fine-tuning, and a small one for 2 CPU cores."""

from dataclasses import replace

from rsjax.config.run import FULL_SIZE_EVAL, Config
from rsjax.config.sim import SimConfig
from rsjax.config.tokenizer import TokenizerTrainConfig
from rsjax.config.train import AdamW, RuntimeConfig, TrainConfig
from rsjax.models.cogvideox.config import CausalVAEConfig, CogVideoXConfig, GuidedDenoiseConfig, TextConfig


def cogvideox_2b() -> Config:
    """Returns the public 2B, whose first latent frame is the image's: it has no channels for an image."""
    model = CogVideoXConfig(width=1920, blocks=30, heads=30, image="first_latent", positions="sincos")
    return _cogvideox("cogvideox_2b", replace(model, noise=replace(model.noise, snr_shift=3.0)))


def cogvideox_5b_i2v() -> Config:
    """Returns the public 5B-I2V without its learned positions, which are for 480×720 pixels."""
    return _cogvideox("cogvideox_5b_i2v", CogVideoXConfig())


def _cogvideox(name: str, model: CogVideoXConfig) -> Config:
    """Returns a preset with the public fine-tuner's settings; the autoencoder keeps its public weights."""
    return Config(
        name=name,
        sim=SimConfig(image_size=256),
        tokenizer_train=TokenizerTrainConfig(steps=0, start_from="cogvideox", frames_per_clip=16),
        model=replace(
            model,
            autoencoder=CausalVAEConfig(),
            text=TextConfig(file="text.safetensors", dropout=0.0),
            compute_dtype="bfloat16",
            remat="blocks",
        ),
        train=TrainConfig(
            steps=10_000,
            batch_size=16,
            start_from="cogvideox",
            optimizer=AdamW(learning_rate=2e-5, warmup_steps=100, schedule="steps", weight_decay=1e-4),
        ),
        runtime=RuntimeConfig(log_every=10, checkpoint_every=500, eval_every=1000),
        eval=FULL_SIZE_EVAL,
    )


def cogvideox_tiny(base: Config) -> Config:
    """Returns CogVideoX and its own autoencoder on the clips of the preset ``tiny``, trained for about as long."""
    return replace(
        base,
        name="cogvideox_tiny",
        tokenizer_train=replace(
            base.tokenizer_train,
            steps=800,
            batch_size=2,
            frames_per_clip=16,
            depth_share=0.0,
            optimizer=AdamW(learning_rate=3e-3, final_share=0.02),
        ),
        model=CogVideoXConfig(
            autoencoder=CausalVAEConfig(
                patch_size=2, widths=(32, 64, 64), res_blocks=1, norm_groups=8, compute_dtype="bfloat16"
            ),
            # There is one task, so one text: guidance by the text has no effect.
            text=TextConfig(tokens=8, width=64, dropout=0.0),
            width=192,
            blocks=8,
            heads=6,
            patch_size=1,
            time_width=128,
            compute_dtype="bfloat16",
            unroll=8,
            sample=GuidedDenoiseConfig(steps=20, guidance=1.0),
        ),
        train=replace(
            base.train,
            steps=1200,
            batch_size=8,
            accumulate=1,
            optimizer=AdamW(learning_rate=1e-3, final_share=0.02),
        ),
        runtime=replace(base.runtime, checkpoint_every=300, eval_every=600),
    )
