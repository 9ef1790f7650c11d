"""LPIPS, the learned perceptual distance of images (Zhang et al. 2018, version 0.1), with AlexNet or VGG16.

Its weights are not part of this project. They are read from one safetensors file, which
``rsjax convert lpips`` makes from the public weights:

    backbone.{i}.weight, .bias   torchvision's ``features.{i}``: (out, in, kernel, kernel), (out,)
    head.{k}.weight              of tap k: (1, channels, 1, 1)
    metadata                     {"net": "alexnet" | "vgg16", "sha256": digest of tensors and metadata}
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open

from rsjax.errors import UserError
from rsjax.files import is_intact, placeholder


class LpipsError(UserError):
    """LPIPS weights that are missing, damaged or of another network."""


class _Conv(NamedTuple):
    """One convolution with its ReLU, with torchvision's number and shape."""

    number: int
    channels: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pool: int = 0  # side of the max pooling before it, of stride 2; 0: none
    tap: bool = False  # whether its output is compared


NETS: dict[str, tuple[_Conv, ...]] = {
    "alexnet": (
        _Conv(0, 64, kernel=11, stride=4, padding=2, tap=True),
        _Conv(3, 192, kernel=5, padding=2, pool=3, tap=True),
        _Conv(6, 384, pool=3, tap=True),
        _Conv(8, 256, tap=True),
        _Conv(10, 256, tap=True),
    ),
    "vgg16": (
        _Conv(0, 64),
        _Conv(2, 64, tap=True),
        _Conv(5, 128, pool=2),
        _Conv(7, 128, tap=True),
        _Conv(10, 256, pool=2),
        _Conv(12, 256),
        _Conv(14, 256, tap=True),
        _Conv(17, 512, pool=2),
        _Conv(19, 512),
        _Conv(21, 512, tap=True),
        _Conv(24, 512, pool=2),
        _Conv(26, 512),
        _Conv(28, 512, tap=True),
    ),
}

# Smallest image side in pixels, which gives one position in the last tap.
MIN_SIZES: dict[str, int] = {"alexnet": 31, "vgg16": 16}

_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)


def lpips(params: dict[str, Any], one: Float[Array, "*B H W 3"], other: Float[Array, "*B H W 3"]) -> Float[Array, "*B"]:
    """Returns the distance of each pair of images; 0 for equal images.

    Args:
        params: from :func:`load_lpips`; the layers' numbers identify the network, and layers may have any width.
        one: values in [-1, 1]; both sides at least :func:`min_size` pixels, or else the distance is NaN.
        other: the same shape.
    """
    batch = one.shape[:-3]
    pair = jnp.stack([one, other]).astype(jnp.float32)
    taps = _features(params["backbone"], pair.reshape(-1, *one.shape[-3:]))
    distance = jnp.float32(0)
    for k, features in enumerate(taps):
        first, second = jnp.split(_unit(features), 2)
        weight = params["head"][str(k)]["weight"][0, :, 0, 0]
        distance += jnp.mean(jnp.square(first - second) @ weight, axis=(1, 2))
    return distance.reshape(batch)


def load_lpips(path: str | Path, wanted_net: str = "") -> dict[str, Any]:
    """Loads the weights of a file as a nested dict, such as ``["backbone"]["0"]["weight"]``.

    Args:
        wanted_net: the network whose weights the file must contain; any if empty.

    Raises:
        LpipsError: the file is missing or damaged, or a tensor is missing, unexpected or of another shape.
    """
    if not Path(path).is_file():
        raise LpipsError(f"{path}: no such LPIPS weights; make them with rsjax convert lpips")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - it is not a dict
    except SafetensorError as error:
        instead = placeholder(Path(path)) or f"not a safetensors file, or damaged ({error}); make it again"
        raise LpipsError(f"{path}: {instead}") from error
    if not is_intact(tensors, metadata):
        raise LpipsError(f"{path}: damaged (its digest is wrong); make it again with rsjax convert lpips")
    net = metadata.get("net")
    if net not in NETS:
        raise LpipsError(f"{path}: its metadata name the net {net!r}, not one of {', '.join(NETS)}; make it again")
    if wanted_net not in ("", net):
        raise LpipsError(f"{path}: these LPIPS weights are of {net}, not of {wanted_net}; name the other file")
    wanted = lpips_shapes(net)
    for name in sorted(wanted.keys() | tensors.keys()):
        shape: Any = "missing"
        if name in tensors:
            shape = tensors[name].shape
        if shape != wanted.get(name, "none"):
            raise LpipsError(f"{path}: {name} is {shape}, {net} needs {wanted.get(name, 'none')}; make it again")
    nested: dict[str, Any] = {"backbone": {}, "head": {}}
    for name, tensor in tensors.items():
        part, index, kind = name.split(".")
        nested[part].setdefault(index, {})[kind] = tensor.astype(np.float32)
    return nested


def min_size(params: dict[str, Any]) -> int:
    """Returns the smallest image side in pixels."""
    return MIN_SIZES[_net(params["backbone"])]


def lpips_shapes(net: str) -> dict[str, tuple[int, ...]]:
    """Returns the shape of every tensor of a file by name."""
    shapes: dict[str, tuple[int, ...]] = {}
    width = 3
    taps = 0
    for conv in NETS[net]:
        shapes[f"backbone.{conv.number}.weight"] = (conv.channels, width, conv.kernel, conv.kernel)
        shapes[f"backbone.{conv.number}.bias"] = (conv.channels,)
        if conv.tap:
            shapes[f"head.{taps}.weight"] = (1, conv.channels, 1, 1)
            taps += 1
        width = conv.channels
    return shapes


def _net(backbone: dict[str, Any]) -> str:
    return next(net for net, convs in NETS.items() if {str(conv.number) for conv in convs} == backbone.keys())


def _features(backbone: dict[str, Any], images: Float[Array, "B H W 3"]) -> list[Float[Array, "B h w C"]]:
    """Returns the tapped outputs, from the first to the last."""
    x = (images - _SHIFT) / _SCALE
    taps = []
    for conv in NETS[_net(backbone)]:
        if conv.pool:
            x = jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, conv.pool, conv.pool, 1), (1, 2, 2, 1), "VALID")
        layer = backbone[str(conv.number)]
        x = jax.lax.conv_general_dilated(
            x,
            layer["weight"],
            (conv.stride, conv.stride),
            [(conv.padding, conv.padding)] * 2,
            dimension_numbers=("NHWC", "OIHW", "NHWC"),
        )
        x = jax.nn.relu(x + layer["bias"])
        if conv.tap:
            taps.append(x)
    return taps


def _unit(features: Float[Array, "B h w C"]) -> Float[Array, "B h w C"]:
    """Normalises each position's features to length 1."""
    square = jnp.sum(jnp.square(features), axis=-1, keepdims=True)
    # The root's gradient is taken as 0 where all features are 0; the public code gets NaN there.
    length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return features / (length + 1e-10)
