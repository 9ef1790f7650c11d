"""LPIPS of frames (Zhang et al. 2018, version 0.1) with AlexNet and VGG16; RoboScape does not say which one it uses.

The weights are files in ``eval.weights`` that ``python -m experiments.convert lpips`` makes; without its file, a metric
is unavailable.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, UInt8

from rsjax.clip import Array
from rsjax.config import EvalConfig
from rsjax.evaluation.registry import PerClip, PerFrame, Scene, Unavailable, metric
from rsjax.tokenizers.lpips import load_lpips, lpips, min_size

FILES = {"alexnet": "lpips_alex.safetensors", "vgg16": "lpips_vgg.safetensors"}  # in the directory eval.weights
_PAIRS = 8  # pairs of frames at a time, to limit memory: VGG's first layers hold 64 channels of full size


def alex_frames(scene: Scene) -> PerFrame:
    """Scores every predicted frame with AlexNet."""
    return _frames(scene, "alexnet")


def vgg_frames(scene: Scene) -> PerFrame:
    """Scores every predicted frame with VGG16."""
    return _frames(scene, "vgg16")


@metric("lpips_alex", "LPIPS, AlexNet", better="lower", decimals=4, per_frame=alex_frames)
def alex_score(scene: Scene) -> PerClip:
    """Returns the mean over each clip's predicted frames, with AlexNet."""
    return scene.shared(alex_frames).mean(-1)


@metric("lpips_vgg", "LPIPS, VGG", better="lower", decimals=4, per_frame=vgg_frames)
def vgg_score(scene: Scene) -> PerClip:
    """Returns the mean over each clip's predicted frames, with VGG16."""
    return scene.shared(vgg_frames).mean(-1)


def check_lpips(settings: EvalConfig) -> None:
    """Checks the files of both networks, as far as they are there.

    Raises:
        LpipsError: a file is damaged or of the other network.
    """
    for net, name in FILES.items():
        path = settings.weights_file(name)
        if path:
            load_lpips(path, net)


def _frames(scene: Scene, net: str) -> PerFrame:
    path = scene.settings.weights_file(FILES[net])
    if not path:
        made = f"python -m experiments.convert lpips IN DIR/{FILES[net]}"
        raise Unavailable(f"no {FILES[net]} in eval.weights: {made}, then --eval.weights DIR")
    params = load_lpips(path, net)
    side = min(scene.truth.rgb.shape[2:4])
    if side < min_size(params):
        raise Unavailable(f"frames of {side} pixels; LPIPS with {net} needs {min_size(params)}")
    pairs = zip(scene.truth.rgb, scene.prediction.rgb, strict=True)
    return np.stack([distances(params, *pair) for pair in pairs])[:, scene.prompt_frames :]


@jax.jit
def distances(
    params: dict[str, Any], truth: UInt8[Array, "T H W 3"], prediction: UInt8[Array, "T H W 3"]
) -> Float[Array, " T"]:
    """Returns the LPIPS of each frame, in float32 on every device; values 0–255."""

    def distance(pair: tuple[Array, Array]) -> Array:
        return lpips(params, *(frame.astype(np.float32) / 127.5 - 1 for frame in pair))

    with jax.default_matmul_precision("highest"):
        return jax.lax.map(distance, (truth, prediction), batch_size=_PAIRS)
