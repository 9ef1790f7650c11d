"""LPIPS of frames (Zhang et al. 2018, version 0.1) with AlexNet and VGG16; RoboScape does not say which one it uses.

The weights are files in ``eval.weights`` that ``rsjax convert lpips`` makes; without its file, a metric
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


def advice(settings: EvalConfig) -> str:
    """Returns a line on how to get LPIPS; "" if a file is there, or ``eval.weights`` is empty."""
    if not settings.weights or any(settings.weights_file(name) for name in FILES.values()):
        return ""
    return f"no LPIPS, as {settings.weights} has no weights: {how_to_get('alexnet')} gets them (64 MB; docs/convert.md)"


def how_to_get(net: str) -> str:
    """Returns the command that makes a network's file in the default directory."""
    word = FILES[net].removeprefix("lpips_").removesuffix(".safetensors")
    return f"rsjax convert lpips --net {word}"


def _frames(scene: Scene, net: str) -> PerFrame:
    path = scene.settings.weights_file(FILES[net])
    if not path:
        raise Unavailable(f"no {FILES[net]} in eval.weights: {how_to_get(net)}")
    params = load_lpips(path, net)
    side = min(scene.truth.rgb.shape[2:4])
    if side < min_size(params):
        raise Unavailable(f"frames of {side} pixels; LPIPS with {net} needs {min_size(params)}")
    truth = scene.truth.rgb[:, scene.prompt_frames :]
    prediction = scene.prediction.rgb[:, scene.prompt_frames :]
    scores = distances(params, truth.reshape(-1, *truth.shape[2:]), prediction.reshape(-1, *truth.shape[2:]))
    return scores.reshape(truth.shape[:2])


def distances(
    params: dict[str, Any], truth: UInt8[Array, "N H W 3"], prediction: UInt8[Array, "N H W 3"]
) -> Float[np.ndarray, " N"]:
    """Returns the LPIPS of each pair of frames, in float32 on every device; values 0–255."""
    scores = []
    # A loop in Python, since convolutions in one of JAX take ten times as long on a CPU.
    for start in range(0, len(truth), _PAIRS):
        rows = np.minimum(np.arange(start, start + _PAIRS), len(truth) - 1)  # repeats the last pair to a full batch
        scores.append(distances_of_batch(params, truth[rows], prediction[rows]))
    return np.concatenate(scores)[: len(truth)]


@jax.jit
def distances_of_batch(
    params: dict[str, Any], truth: UInt8[Array, "N H W 3"], prediction: UInt8[Array, "N H W 3"]
) -> Float[Array, " N"]:
    """Returns the LPIPS of each pair of frames, all computed at once."""
    with jax.default_matmul_precision("highest"):
        return lpips(params, *(frames.astype(np.float32) / 127.5 - 1 for frames in (truth, prediction)))
