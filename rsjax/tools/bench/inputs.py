"""Makes random inputs from shapes, since speed does not depend on the contents of clips.

Axes: B clips, T frames, H×W token cells, A action dimensions.
"""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from rsjax.clip import Video
from rsjax.config import Config
from rsjax.data.loader import Arrays
from rsjax.data.normalization import Normalization
from rsjax.models.base import Assets, WorldModel, create_autoencoder, with_random_files
from rsjax.models.roboscape.architecture import Architecture


def normalization(config: Config) -> Normalization:
    """Returns the identity normalization."""
    width = config.clips.action_dim
    return Normalization((0.0,) * width, (1.0,) * width, (0.1, 1.0))


def assets(config: Config) -> Assets:
    """Returns the identity normalization and, if the model uses one, a fresh autoencoder."""
    if not config.model.uses_tokenizer:
        return Assets(normalization(config), None)
    autoencoder = create_autoencoder(config)
    params = jax.jit(lambda key: autoencoder.tokenizer_params(autoencoder.init(key)))(jax.random.key(0))
    return Assets(normalization(config), params)


@contextmanager
def random_files(config: Config) -> Iterator[Config]:
    """Yields the configuration with temporary random files in place of those that the model reads."""
    with tempfile.TemporaryDirectory() as folder:
        yield with_random_files(config, Path(folder))


def video(config: Config, size: int, frames: int) -> Video:
    """Returns random RGB frames, (size, frames, H, W, 3)."""
    side = config.clips.image_size
    return Video(np.random.default_rng(0).integers(0, 256, (size, frames, side, side, 3), np.uint8))


def prompt_video(config: Config, size: int, frames: int) -> Video:
    """Returns random frames with depth if the model learns from it."""
    rgb = video(config, size, frames).rgb
    if not config.model.uses_depth:
        return Video(rgb)
    near, far = normalization(config).require_depth_range()
    return Video(rgb, np.random.default_rng(1).uniform(near, far, rgb.shape[:-1]).astype(np.float32))


def arrays(model: WorldModel[Any], config: Config, size: int) -> Arrays:
    """Returns the stacked arrays of ``size`` random records."""
    rng = np.random.default_rng(0)
    transform = model.transform(normalization(config))
    rows = [transform(model.example(rng), rng) for _ in range(size)]
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def batch(model: WorldModel[Any], config: Config, size: int) -> Any:
    """Returns a training batch of ``size`` clips, on the device."""
    return jax.device_put(model.batch(arrays(model, config, size)))


def batch_shapes(model: WorldModel[Any], config: Config) -> Any:
    """Returns the shapes of a training batch of one clip."""
    one = model.batch(arrays(model, config, 1))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), one)


def prompt(arch: Architecture, size: int, frames: int) -> dict[str, Int[Array, "B T H W"]]:
    """Returns random tokens of ``frames`` prompt frames for each modality."""
    keys = jax.random.split(jax.random.key(0), len(arch.modalities))
    shape = (size, frames, arch.grid, arch.grid)
    drawn = (jax.random.randint(key, shape, 0, 2**arch.code_bits, "int32") for key in keys)
    return dict(zip(arch.modalities, drawn, strict=True))


def actions(arch: Architecture, size: int, frames: int) -> Float[Array, "B T A"]:
    """Returns random normalised actions."""
    return jax.random.normal(jax.random.key(1), (size, frames, arch.action_inputs))
