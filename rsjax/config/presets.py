"""The named experiments: complete configurations, one function each."""

from collections.abc import Callable
from dataclasses import replace

from rsjax.config import (
    Config,
    ConfigError,
    EvalConfig,
    LoopConfig,
    LossConfig,
    MaskConfig,
    ModelConfig,
    OptimizerConfig,
    SimConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
)
from rsjax.errors import did_you_mean


def debug() -> Config:
    """All six stages in about a minute on a CPU: the integration test. Its pictures are noise."""
    return Config(
        name="debug",
        sim=SimConfig(episodes=8, test_episodes=2, frames=6, tracks=64),
        tokenizer=TokenizerConfig(
            image_size=64,
            patch_size=4,
            channels=16,
            channel_multipliers=(1, 2),
            res_blocks=1,
            norm_groups=8,
            code_bits=8,
        ),
        tokenizer_train=TokenizerTrainConfig(steps=6, batch_size=2, log_every=2, checkpoint_every=3),
        model=ModelConfig(frames=6, grid=8, code_bits=8, width=32, blocks=2, heads=2),
        loss=LossConfig(num_keypoints=8),
        train=LoopConfig(steps=4, batch_size=2, log_every=2, checkpoint_every=2),
        eval=EvalConfig(clips=2, batch_size=2, action_draws=1, report_clips=2),
    )


def tiny() -> Config:
    """A robot arm that lifts a cube, in under 30 minutes on 2 CPU cores without a GPU."""
    return Config(
        name="tiny",
        sim=SimConfig(),
        # Six vocabularies of 8 codes: of the codes that a held-out clip needs, many never occur in 180 training clips,
        # but their parts do (20.4 dB on validation clips after 600 steps, against 20.0 with two of 512).
        tokenizer=TokenizerConfig(
            image_size=64,
            patch_size=2,
            channels=32,
            channel_multipliers=(1, 2, 4),
            res_blocks=1,
            norm_groups=8,
            vocabularies=6,
        ),
        # Small batches: in so few minutes the number of steps counts. The weights are chosen for PSNR; at the
        # reference's entropy weight (0.1) codes spread further, and reconstruction pays for it.
        tokenizer_train=TokenizerTrainConfig(
            steps=3400,
            batch_size=8,
            frames_per_clip=2,
            depth_share=0.2,
            optimizer=OptimizerConfig(learning_rate=3e-3, final_share=0.02),
            ema=0.998,
            l1=0.2,
            l2=4.0,
            entropy=0.01,
            commitment=0.1,
            placement="jit",
            checkpoint_every=500,
            eval_every=1700,
        ),
        model=ModelConfig(
            grid=8,
            vocabularies=6,
            width=128,
            blocks=4,
            unroll=4,
            heads=4,
            action_dim=56,
            integrate_actions=True,
            temporal_norm=True,
            final_norm=True,
            embed_std=0.5,
            position_std=0.5,
            compute_dtype="bfloat16",
        ),
        # In so few steps the corruption recipe costs more than it gives: 22.2 dB on validation clips without it (after
        # 1950 steps), 22.0 with its first step and half of its second (after 1800).
        mask=MaskConfig(random_token_rate=0.0, corruption_probability=0.0),
        train=LoopConfig(
            steps=2000,
            batch_size=4,
            optimizer=OptimizerConfig(kind="muon", learning_rate=2e-3, final_share=0.02),
            ema=0.995,
            checkpoint_every=500,
            eval_every=500,
        ),
    )


def roboscape_s() -> Config:
    """The paper's smallest model, which it calls 34M: one branch without actions, and there are two."""
    return _full_size("roboscape_s", ModelConfig())


def roboscape_m() -> Config:
    """The paper's middle model, which it calls 131M."""
    return _full_size("roboscape_m", ModelConfig(width=512))


def roboscape_l() -> Config:
    """The paper's largest model, which it calls 544M."""
    return _full_size("roboscape_l", ModelConfig(width=1024, heads=16))


def genie_35m() -> Config:
    """The public Genie (1xgpt's GENIE_35M): RGB alone, no actions. The paper's baseline of that name reads actions."""
    return _genie("genie_35m", ModelConfig())


def genie_138m() -> Config:
    """The public Genie's larger model (1xgpt's GENIE_138M)."""
    return _genie("genie_138m", ModelConfig(width=512))


def _full_size(name: str, model: ModelConfig) -> Config:
    """256² pixels, 16 frames of 16×16 tokens, 32 blocks. λ and γ are the paper's: the defaults.

    Heads are not in the paper: 8 as in the public code, 16 where that would make them wider than 64. Nor are optimizer
    and batch: AdamW and a linear decay as in the public code, and 5 epochs of 6.5 million clips, the paper's, at a
    batch of 256.
    """
    return Config(
        name=name,
        sim=SimConfig(image_size=256),
        tokenizer=TokenizerConfig(),
        # Open-MAGVIT2: Adam, 256 images a step, 270 epochs of ImageNet, a tenth of the rate after 200 and 250 of them.
        # LPIPS joins with the path of its weights, --tokenizer-train.lpips-weights.
        tokenizer_train=TokenizerTrainConfig(
            steps=1_350_000,
            batch_size=64,
            frames_per_clip=4,
            optimizer=OptimizerConfig(
                warmup_steps=0, schedule="steps", drop_at=(200 / 270, 250 / 270), beta1=0.5, beta2=0.9, grad_clip=0.0
            ),
            ema=0.999,
            flip=True,
            perceptual=1.0,
            adversarial=0.1,
            log_every=100,
            checkpoint_every=5000,
            eval_every=5000,
        ),
        model=replace(model, compute_dtype="bfloat16", remat="blocks"),
        train=LoopConfig(
            steps=127_000,
            batch_size=256,
            optimizer=OptimizerConfig(beta2=0.999, schedule="linear", final_share=0.0),
            log_every=100,
            checkpoint_every=1000,
            eval_every=5000,
        ),
    )


def _genie(name: str, model: ModelConfig) -> Config:
    # The public code prompts with half of the frames; --mask.prompt-frames 1 for the paper's comparison.
    return replace(
        _full_size(name, replace(model, depth=False, action_dim=0)),
        mask=MaskConfig(prompt_frames=8),
        loss=LossConfig(keypoints=False),
    )


def collect(*makers: Callable[[], Config]) -> dict[str, Config]:
    """The configurations of ``makers`` by name.

    Raises:
        ConfigError: two share a name.
    """
    presets: dict[str, Config] = {}
    for make in makers:
        config = make()
        if config.name in presets:
            raise ConfigError(f"two presets are named {config.name!r}; rename one of them in rsjax/config/presets.py")
        presets[config.name] = config
    return presets


PRESETS = collect(debug, tiny, roboscape_s, roboscape_m, roboscape_l, genie_35m, genie_138m)


def get(name: str) -> Config:
    """The preset called ``name``.

    Raises:
        ConfigError: there is none; the message names the nearest and lists them all.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}{did_you_mean(name, PRESETS)} (presets: {', '.join(PRESETS)})")
    return PRESETS[name]
