"""A family of world models in less than 40 lines: how strongly the mean action brightens the last given frame."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from rsjax.clip import Video
from rsjax.config import Config, ModelConfig, register_family
from rsjax.models.base import WorldModel, implements


@register_family("toy")
@dataclass(frozen=True)
class ToyConfig(ModelConfig):
    error_weight: float = 1.0
    start: float = 0.0


@implements(ToyConfig)
@dataclass(frozen=True)
class Toy(WorldModel):
    config: Config

    def init(self, key):
        return {"gain": jnp.float32(self.config.model.start)}

    def loss_terms(self, params, batch, key, context):
        change = jnp.diff(batch["brightness"], axis=1) - params["gain"] * batch["action"][:, 1:]
        weight = jnp.broadcast_to(batch["weight"][:, None], change.shape)
        return {"error": (jnp.sum(weight * change**2), jnp.sum(weight))}

    def transform(self, normalization):
        return lambda clip, rng: {"brightness": clip["rgb"].mean((1, 2, 3)) / 255, "action": clip["actions"].mean(-1)}

    def generate(self, params, assets, prompt, actions, *, index=None, depth=True):
        change = 255 * np.cumsum(params["gain"] * actions[:, 1:].mean(-1), axis=1)[..., None, None, None]
        later = np.clip(prompt.rgb[:, -1:] + change, 0, 255).astype(np.uint8)
        return Video(np.concatenate([prompt.rgb[:, -1:], later], axis=1))
