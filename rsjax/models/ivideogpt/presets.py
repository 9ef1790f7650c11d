"""The presets of iVideoGPT: the public sizes with their training, and a small one for 2 CPU cores."""

from dataclasses import replace

from rsjax.config.run import FULL_SIZE_EVAL, Config
from rsjax.config.sim import SimConfig
from rsjax.config.tokenizer import PerceptualConfig, TokenizerTrainConfig
from rsjax.config.train import AdamW, Muon, RuntimeConfig, TrainConfig
from rsjax.models.ivideogpt.config import ConditionalVQConfig, IVideoGPTConfig


def ivideogpt_64() -> Config:
    """Returns the public iVideoGPT for 64² pixels with one context frame, trained as for BAIR."""
    return _public("ivideogpt_64", 64, IVideoGPTConfig())


def ivideogpt_256() -> Config:
    """Returns the public iVideoGPT for 256² pixels, with two context frames."""
    autoencoder = ConditionalVQConfig(context_frames=2, widths=(128, 256, 256, 512, 768), attention_size=32)
    return _public("ivideogpt_256", 256, IVideoGPTConfig(autoencoder=autoencoder))


def _public(name: str, size: int, model: IVideoGPTConfig) -> Config:
    # LPIPS needs the path of its weights, --tokenizer-train.perceptual.lpips.
    constant = AdamW(learning_rate=5e-4, warmup_steps=500, schedule="steps", betas=(0.9, 0.999))
    cosine = AdamW(
        warmup_steps=5000, betas=(0.9, 0.999), weight_decay=0.01, final_share=0.0, grad_clip=0.0, learning_rate=1e-4
    )
    return Config(
        name=name,
        prompt_frames=model.autoencoder.context_frames,
        sim=SimConfig(image_size=size),
        tokenizer_train=TokenizerTrainConfig(
            steps=100_000,  # the public 200,000 include the discriminator's steps
            batch_size=64,
            frames_per_clip=8,
            depth_share=0.0,
            optimizer=constant,
            perceptual=PerceptualConfig(),
            commitment_weight=1.0,
        ),
        model=replace(model, compute_dtype="bfloat16", remat="blocks"),
        train=TrainConfig(steps=100_000, batch_size=64, optimizer=cosine),
        runtime=RuntimeConfig(log_every=100, checkpoint_every=1000, eval_every=5000),
        eval=FULL_SIZE_EVAL,
    )


def ivideogpt_tiny(tiny: Config) -> Config:
    """Returns iVideoGPT on the clips of the preset ``tiny``, trained for about as long."""
    return replace(
        tiny,
        name="ivideogpt_tiny",
        tokenizer_train=replace(
            tiny.tokenizer_train,
            steps=1100,
            batch_size=4,
            frames_per_clip=8,
            depth_share=0.0,
            optimizer=AdamW(learning_rate=1e-3, final_share=0.02),
            # Pixels are 0 … 1 here and -1 … 1 in tiny's tokenizer, and context and later frames are added up.
            l1_weight=0.2,
            l2_weight=8.0,
            commitment_weight=0.05,
        ),
        model=IVideoGPTConfig(
            autoencoder=ConditionalVQConfig(
                patch_size=2,
                widths=(32, 64),
                res_blocks=1,
                norm_groups=8,
                latent=32,
                codes=512,
                dropout=0.0,
                codebook_scale=1.0,
                compute_dtype="bfloat16",
            ),
            width=192,
            blocks=6,
            heads=6,
            mlp_width=768,
            positions=511,  # a clip of 16 frames: sampling uses only positions that were trained
            integrate_actions=True,
            dropout=0.0,
            compute_dtype="bfloat16",
            unroll=6,
        ),
        train=replace(
            tiny.train,
            steps=700,
            batch_size=8,
            accumulate=1,
            optimizer=Muon(learning_rate=3e-3, final_share=0.02),
        ),
    )
