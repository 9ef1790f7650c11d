"""The named experiments: complete configurations, one function each."""

from collections.abc import Callable

from rsjax.config import (
    Config,
    ConfigError,
    EvalConfig,
    LoopConfig,
    LossConfig,
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
        tokenizer=TokenizerConfig(
            image_size=64, patch_size=2, channels=32, channel_multipliers=(1, 2, 4), res_blocks=1, norm_groups=8
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
        ),
        model=ModelConfig(
            grid=8,
            width=128,
            blocks=4,
            heads=4,
            action_dim=56,
            integrate_actions=True,
            temporal_norm=True,
            final_norm=True,
            embed_std=0.5,
            position_std=0.5,
            compute_dtype="bfloat16",
        ),
        train=LoopConfig(
            steps=1900,
            batch_size=4,
            optimizer=OptimizerConfig(kind="muon", learning_rate=2e-3, final_share=0.02),
            ema=0.995,
            checkpoint_every=400,
        ),
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
            raise ConfigError(f"two presets are named {config.name!r}; rename one of them in rsjax/presets.py")
        presets[config.name] = config
    return presets


PRESETS = collect(debug, tiny)


def get(name: str) -> Config:
    """The preset called ``name``.

    Raises:
        ConfigError: there is none; the message names the nearest and lists them all.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}{did_you_mean(name, PRESETS)} (presets: {', '.join(PRESETS)})")
    return PRESETS[name]
