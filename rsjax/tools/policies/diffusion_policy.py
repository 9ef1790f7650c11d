"""The Diffusion Policy (Chi et al. 2023): its loss, its plans and its training samples.

Axes: B samples, O observed frames, S×S pixels, H controls of a plan, D numbers of a control, T frames of a clip, k
controls between two frames, A = k·D numbers of a clip's action.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Key, UInt8

from rsjax.config import ConfigError
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.ddpm import add_noise, cosine_schedule, sample
from rsjax.tools.policies.unet1d import PolicyNet
from rsjax.trainable import Params, StepContext, Term, Trainable


@dataclass(frozen=True)
class DiffusionPolicy(Trainable[Any]):
    """The policy's network with its loss.

    Attributes:
        config: the policy's settings.
        image_size: S, the side of the frames.
        controls: k, the number of controls between two frames.
        width: D, the numbers of a control.
    """

    config: PolicyConfig
    image_size: int
    controls: int
    width: int

    def __post_init__(self) -> None:
        for name in ("horizon", "execute"):
            value = getattr(self.config, name)
            if value % self.controls:
                raise ConfigError(
                    f"policy.{name} is {value}; it is a multiple of the {self.controls} controls of a frame"
                )

    @property
    def net(self) -> PolicyNet:
        """The network, without parameters."""
        return PolicyNet(self.config)

    @property
    def cropped(self) -> int:
        """The side in pixels of the crop that the network sees."""
        return round(self.config.crop * self.image_size)

    @property
    def loss_weights(self) -> dict[str, float]:
        return {"noise": 1.0}

    def init(self, key: Key[Array, ""]) -> Params:
        controls = jnp.zeros((1, self.config.horizon, self.width))
        frames = jnp.zeros((1, self.config.observations, self.cropped, self.cropped, 3))
        return self.net.init(key, controls, jnp.zeros(1, jnp.int32), frames)["params"]

    def batch(self, arrays: Arrays) -> Arrays:
        """Returns the arrays that :meth:`loss_terms` reads."""
        return {name: arrays[name] for name in ("frames", "controls", "index")}

    def loss_terms(
        self, params: Params, batch: dict[str, Array], key: Key[Array, ""], context: StepContext
    ) -> dict[str, Term]:
        """Returns the squared error of the predicted noise, at a noise step drawn for each sample.

        Args:
            batch: ``frames`` uint8 (B, O, S', S', 3), cropped, ``controls`` (B, H, D) in [-1, 1], ``index`` (B,).
        """
        clean = batch["controls"]
        keys = jax.vmap(lambda number: jax.random.split(jax.random.fold_in(key, number)))(batch["index"])
        noise = jax.vmap(lambda each: jax.random.normal(each, clean.shape[1:]))(keys[:, 0])
        step = jax.vmap(lambda each: jax.random.randint(each, (), 0, self.config.noise_steps))(keys[:, 1])
        noisy = add_noise(clean, noise, step, cosine_schedule(self.config.noise_steps))
        predicted: Any = self.net.apply({"params": params}, noisy, step, scaled(batch["frames"]))
        return {"noise": (jnp.sum(jnp.square(predicted - noise)), jnp.float32(noise.size))}

    def plan(self, params: Params, frames: UInt8[Array, "B O S S 3"], key: Key[Array, ""]) -> Float[Array, "B H D"]:
        """Returns the controls that follow the frames, scaled so that the demonstrations' range is [-1, 1]."""
        edge = (self.image_size - self.cropped) // 2
        middle = frames[:, :, edge : edge + self.cropped, edge : edge + self.cropped]
        variables = {"params": params}
        features = self.net.apply(variables, scaled(middle), method="see")

        def predict(x: Array, step: Array) -> Array:
            return self.net.apply(variables, x, step, features, method="denoise")  # type: ignore[return-value]

        shape = (len(frames), self.config.horizon, self.width)
        return sample(predict, key, shape, cosine_schedule(self.config.noise_steps), self.config.sample_steps)


def scaled(frames: UInt8[Array, "*B"]) -> Float[Array, "*B"]:
    """Returns pixels scaled to [-1, 1]."""
    return frames.astype(jnp.float32) / 127.5 - 1


@dataclass(frozen=True)
class Range:
    """The range of each number of a control, which the policy sees as -1 to 1 (Diffusion Policy's normalisation)."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, controls: Float[np.ndarray, "N D"]) -> "Range":
        return cls(tuple(controls.min(0).tolist()), tuple(controls.max(0).tolist()))

    def scale(self, controls: Float[np.ndarray, "*B D"]) -> Float32[np.ndarray, "*B D"]:
        """Returns controls scaled to [-1, 1]; 0 for numbers that never vary."""
        low, span = self._ends()
        return np.where(span > 0, 2 * (controls - low) / np.where(span > 0, span, 1) - 1, 0).astype(np.float32)

    def unscale(self, plan: Float[np.ndarray, "*B D"]) -> Float32[np.ndarray, "*B D"]:
        """Inverts :meth:`scale`."""
        low, span = self._ends()
        return (low + (np.clip(plan, -1, 1) + 1) / 2 * span).astype(np.float32)

    def _ends(self) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, " D"]]:
        low = np.array(self.low)
        return low, np.array(self.high) - low


@dataclass(frozen=True)
class Windows:
    """Draws a training sample from a demonstration: a random frame with those before it, and the controls that follow.

    At the clip's ends, the first frame and the last control are repeated. This is a class of the module rather than a
    local function so that it can be pickled.
    """

    model: DiffusionPolicy
    range: Range

    def __call__(self, demo: Record, rng: np.random.Generator) -> Arrays:
        cfg = self.model.config
        model = self.model
        now = int(rng.integers(len(demo["rgb"]) - 1))
        observed = np.maximum(np.arange(now - cfg.observations + 1, now + 1), 0)
        top, left = rng.integers(model.image_size - model.cropped + 1, size=2)
        frames = demo["rgb"][observed, top : top + model.cropped, left : left + model.cropped]
        controls = demo["actions"][1:].reshape(-1, model.width)
        rows = np.minimum(now * model.controls + np.arange(cfg.horizon), len(controls) - 1)
        return {"frames": frames, "controls": self.range.scale(controls[rows])}
