"""Settings of diffusion models: the forward process and the sampler."""

import math
from dataclasses import dataclass
from typing import Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import fitting_sizes, require, require_range


@dataclass(frozen=True)
class NoiseConfig:
    """The forward process: how latents turn into noise, and which quantity the network predicts."""

    steps: int = 1000  # of the forward process; sampling visits some of them
    beta_start: float = 1e-4  # variance that the first step adds
    beta_end: float = 0.02  # variance that the last step adds
    betas: Literal["linear", "scaled_linear"] = "linear"  # scaled_linear: their roots grow linearly
    prediction: Literal["noise", "velocity"] = "noise"  # velocity: a mixture of noise and latents
    snr_shift: float = 1.0  # s in ᾱ ← ᾱ / (s + (1 - s)·ᾱ): the ratio of signal to noise is divided by it
    zero_terminal: bool = False  # √ᾱ is rescaled to be 0 after the last step, where sampling then begins

    def __post_init__(self) -> None:
        require_range(self, "model.noise", 2, math.inf, "steps")
        require(
            0 < self.beta_start <= self.beta_end < 1,
            f"model.noise.beta_start is {self.beta_start} and beta_end {self.beta_end}; they grow, above 0 and below 1",
        )
        require(self.snr_shift > 0, f"model.noise.snr_shift is {self.snr_shift}; it must be above 0")
        require(
            not self.zero_terminal or self.prediction == "velocity",
            "model.noise.zero_terminal is on, where noise alone says nothing of the clip; set model.noise.prediction "
            "to velocity",
        )


@dataclass(frozen=True)
class DenoiseConfig:
    """Settings of the sampler. Names and definitions are those of the package ``diffusers``."""

    # ddim: one network call a step. pndm: begins with Runge-Kutta steps, so it takes steps + 9 calls.
    sampler: Literal["pndm", "ddim"] = "pndm"
    steps: int = 50  # fewer are faster and coarser
    # Which steps of the forward process are visited: from 0 to the last (linspace), multiples of one number from 0 on
    # (leading), or an evenly spaced series that ends with the last one (trailing).
    spacing: Literal["linspace", "leading", "trailing"] = "linspace"
    # ᾱ after the last step is 1; False: that of the first step of the forward process. The public IRASim has False.
    end_clean: bool = False
    seed: int = 0  # of the noise; another one gives other videos of the same clips

    def __post_init__(self) -> None:
        least = 4 if self.sampler == "pndm" else 1
        require(
            self.steps >= least,
            f"model.sample.steps is {self.steps}; the sampler {self.sampler} takes at least {least}",
        )

    def check(self, noise: NoiseConfig) -> None:
        """Raises :class:`rsjax.config.ConfigError` if the forward process has fewer steps than the sampler visits."""
        require(
            self.steps <= noise.steps,
            f"model.sample.steps is {self.steps} of model.noise.steps {noise.steps}; take at most as many",
        )


def check_grid(clips: ClipShape, downsampling: int, patch_size: int) -> int:
    """Returns the pixels of a token along each side.

    Args:
        downsampling: the autoencoder's.

    Raises:
        ConfigError: these tokens do not divide the clips' images.
    """
    token = downsampling * patch_size
    require(
        clips.image_size % token == 0,
        f"images have {clips.image_size} pixels a side, which the {token} pixels of a token (the autoencoder's "
        f"{downsampling} × model.patch_size {patch_size}) do not divide; take clips of "
        f"{fitting_sizes(clips.image_size, token)} pixels, or change model.patch_size",
    )
    return token
