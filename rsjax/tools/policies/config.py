"""Settings of the Diffusion Policy, and its sizes."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from rsjax.config.fields import ConfigError, require, require_range, runtime
from rsjax.config.train import AdamW, LoopConfig
from rsjax.errors import did_you_mean

# Diffusion Policy on robomimic's images: AdamW with betas (.95, .999), warm-up 500, cosine to 0, batch 64.
PUBLIC_OPTIMIZER = AdamW(
    learning_rate=1e-4,
    warmup_steps=500,
    schedule="cosine",
    final_share=0.0,
    betas=(0.95, 0.999),
    weight_decay=1e-6,
    grad_clip=0.0,
)


@dataclass(frozen=True)
class PolicyConfig:
    """A Diffusion Policy with a 1-D U-Net; the defaults are the public hyper-parameters for Lift from images.

    An action of a clip leads from one frame to the next and may consist of several controls, such as four of 50 ms; the
    policy plans in controls.
    """

    observations: int = 2  # frames that the policy sees, the newest last
    horizon: int = 16  # controls that the policy plans
    execute: int = 8  # controls of a plan that are executed before the next one
    crop: float = 76 / 84  # side of the crop, as a share of the picture's: random in training, the middle otherwise
    noise_steps: int = 100  # of the diffusion
    sample_steps: int = runtime(100)  # of sampling, a divisor of noise_steps
    channels: tuple[int, ...] = (256, 512, 1024)  # of the U-Net's levels
    kernel: int = 5  # controls that a convolution of the U-Net spans
    groups: int = 8  # of the U-Net's group normalisation
    step_embedding: int = 128  # numbers that tell the U-Net the noise's step
    vision: tuple[int, ...] = (64, 128, 256, 512)  # channels of the ResNet's stages
    vision_blocks: int = 2  # of each stage
    pool: bool = True  # whether the ResNet's stem halves the picture a second time
    keypoints: int = 32  # of the spatial softmax
    features: int = 64  # of each frame
    # Length, batch and optimizer of its training.
    train: LoopConfig = LoopConfig(
        steps=100_000, batch_size=64, optimizer=PUBLIC_OPTIMIZER, ema=0.9999, checkpoint_every=1000, log_every=100
    )

    def __post_init__(self) -> None:
        require_range(self, "policy", 1, math.inf, "observations", "horizon", "execute", "keypoints", "features")
        halvings = 2 ** (len(self.channels) - 1)
        require(
            self.horizon % halvings == 0,
            f"policy.horizon is {self.horizon}; a U-Net of {len(self.channels)} levels takes multiples of {halvings}",
        )
        require(
            self.execute <= self.horizon,
            f"policy.execute is {self.execute}, more than the {self.horizon} controls that are planned",
        )
        require(
            0 < self.crop <= 1, f"policy.crop is {self.crop}; it is a share of the picture's side, above 0, up to 1"
        )
        for name in ("channels", "vision"):
            bad = [width for width in getattr(self, name) if width % self.groups]
            require(not bad, f"policy.{name} has {bad}; channels are multiples of policy.groups = {self.groups}")
        require(
            0 < self.sample_steps <= self.noise_steps and self.noise_steps % self.sample_steps == 0,
            f"policy.sample_steps is {self.sample_steps}; it divides policy.noise_steps = {self.noise_steps}",
        )

    def fitted(self, controls: int) -> "PolicyConfig":
        """Returns the same settings, with plans and their executed part rounded up to whole frames of ``controls``."""
        size = math.lcm(controls, 2 ** (len(self.channels) - 1))
        horizon = -(-self.horizon // size) * size
        execute = -(-self.execute // controls) * controls
        return replace(self, horizon=horizon, execute=execute)


def public() -> PolicyConfig:
    """Returns the public sizes and hyper-parameters, for a GPU."""
    return PolicyConfig()


def tiny() -> PolicyConfig:
    """Returns a size that trains in about 15 minutes on 2 CPU cores with pictures of 64²."""
    return PolicyConfig(
        channels=(64, 128, 256),
        step_embedding=64,
        vision=(16, 32, 64),
        vision_blocks=1,
        pool=False,
        sample_steps=20,
        train=LoopConfig(
            steps=3000,
            batch_size=64,
            optimizer=replace(PUBLIC_OPTIMIZER, learning_rate=1e-3, warmup_steps=100),
            ema=0.995,
            checkpoint_every=500,
            log_every=50,
            sharding="jit",
        ),
    )


def toy() -> PolicyConfig:
    """Returns a size for tests, which trains in seconds."""
    return PolicyConfig(
        horizon=8,
        execute=4,
        channels=(8,),
        groups=4,
        step_embedding=8,
        vision=(4, 8),
        vision_blocks=1,
        pool=False,
        keypoints=4,
        features=8,
        noise_steps=4,
        sample_steps=2,
        train=replace(tiny().train, steps=4, batch_size=4, checkpoint_every=2, log_every=2),
    )


POLICIES: dict[str, Callable[[], PolicyConfig]] = {"public": public, "tiny": tiny, "toy": toy}


def policy_preset(name: str) -> PolicyConfig:
    """Returns a named size.

    Raises:
        ConfigError: no size has this name.
    """
    if name not in POLICIES:
        raise ConfigError(f"no policy size {name!r}{did_you_mean(name, POLICIES)}; there are {', '.join(POLICIES)}")
    return POLICIES[name]()
