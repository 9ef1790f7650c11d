"""Encodes and decodes numpy images with a trained tokenizer: RGB frames and depth maps."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias, TypeVar, cast

import jax
import numpy as np
from jax.sharding import Mesh
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.config import TokenizerConfig
from rsjax.data.depth_color import color_to_depth, depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.devices import divide, map_rows, mesh_of, on_cpu
from rsjax.layers.platform import by_platform
from rsjax.tokenizers.magvit2 import run_tokenizer
from rsjax.trainable import Params

Tokens = dict[str, Int[np.ndarray, "B T h w"]]
Grids: TypeAlias = Int[np.ndarray, "*B h w"] | Float32[np.ndarray, "*B h w D"]  # tokens, or codes of D bits

T = TypeVar("T")

PIXELS = 128 * 64**2  # of a pass
CPU_PIXELS = 16 * 64**2  # a CPU keeps the features of so few pixels in its cache


@dataclass(frozen=True)
class Codec:
    """A trained tokenizer that takes and returns numpy arrays."""

    config: TokenizerConfig
    params: Params
    normalization: Normalization

    def encode(self, video: Video) -> Tokens:
        """Returns a video's tokens; "depth" only if a clip has depth, with zeros for clips without.

        "second" are the tokens of the second view, if there is one.
        """
        tokens = {"rgb": self.encode_rgb(video.rgb)}
        if video.second is not None:
            tokens["second"] = self.encode_rgb(video.second)
        has_depth = video.has_depth
        if video.depth is not None and has_depth.any():
            grid = self.encode_depth(video.depth[has_depth])
            tokens["depth"] = np.zeros((len(video), *grid.shape[1:]), grid.dtype)
            tokens["depth"][has_depth] = grid
        return tokens

    def decode(self, tokens: Mapping[str, Grids], has_depth: Bool[np.ndarray, " B"]) -> Video:
        """Decodes tokens or codes to a video, with depth for the clips that have it and NaN for the others."""
        rgb = self.decode_rgb(tokens["rgb"])
        second = None
        if "second" in tokens:
            second = self.decode_rgb(tokens["second"])
        if "depth" not in tokens or not has_depth.any():
            return Video(rgb, second=second)
        metres = np.full(rgb.shape[:-1], np.nan, np.float32)
        metres[has_depth] = self.decode_depth(np.asarray(tokens["depth"])[has_depth])
        return Video(rgb, metres, second=second)

    def encode_rgb(self, frames: UInt8[np.ndarray, "*B H W 3"]) -> Int[np.ndarray, "*B h w"]:
        """Encodes frames 0–255."""
        return self._chunked("encode", frames)

    def encode_depth(self, depth: Float[np.ndarray, "*B H W"]) -> Int[np.ndarray, "*B h w"]:
        """Encodes the colour maps of depth in metres.

        Raises:
            UserError: no clip of the data has depth.
        """
        return self._chunked("encode", self._colors(depth))

    def depth_pictures(
        self, depth: Float[np.ndarray, "B T H W"]
    ) -> tuple[UInt8[np.ndarray, "B T H W 3"], UInt8[np.ndarray, "B T H W 3"]]:
        """Returns the colour maps of depth in metres, and these encoded and decoded."""
        return self._colors(depth), self.decode_rgb(self.encode_depth(depth))

    def decode_rgb(self, tokens: Grids) -> UInt8[np.ndarray, "*B H W 3"]:
        """Decodes tokens or codes to frames 0–255."""
        return np.round(self._chunked("decode", np.asarray(tokens))).astype(np.uint8)

    def decode_depth(self, tokens: Grids) -> Float32[np.ndarray, "*B H W"]:
        """Decodes tokens or codes of depth colour maps to metres.

        Raises:
            UserError: no clip of the data has depth.
        """
        near, far = self.normalization.require_depth_range()
        colors = self._chunked("decode", np.asarray(tokens))
        return color_to_depth(colors, near, far, self.config.depth_scale)

    def _colors(self, depth: Float[np.ndarray, "*B H W"]) -> UInt8[np.ndarray, "*B H W 3"]:
        near_far = self.normalization.require_depth_range()
        known = np.nan_to_num(depth, nan=0.0)  # NaN and 0 both say that it is unknown
        return depth_to_color(known, *near_far, self.config.depth_scale).astype(np.uint8)

    def _chunked(self, method: Literal["encode", "decode"], images: np.ndarray) -> np.ndarray:
        axes = 3  # of pixels, or of codes
        if method == "decode" and images.dtype != np.float32:
            axes = 2  # of tokens
        side = images.shape[1 - axes]
        if method == "decode":
            side *= self.config.downsampling
        most = images_per_pass(side)
        one_program = passes_at_once() > 1  # for any number of images, of which it computes those there are

        def apply(chunk: np.ndarray) -> ArrayLike:
            if one_program:
                rows = np.zeros((most, *chunk.shape[1:]), chunk.dtype)
                rows[: len(chunk)] = chunk
                return _run(self.config, method, None, self.params, rows, np.int32(len(chunk)))[: len(chunk)]
            x = divide(chunk, self.params)
            return _run(self.config, method, mesh_of(x), self.params, x)

        return in_chunks(apply, images, axes, most, pad=not one_program)


def images_per_pass(side: int) -> int:
    """Returns how many images of ``side`` × ``side`` pixels one pass takes, over all devices."""
    pixels = PIXELS
    if on_cpu():
        pixels = CPU_PIXELS * jax.local_device_count()
    return max(1, pixels // side**2)


def in_chunks(
    apply: Callable[[np.ndarray], ArrayLike], items: np.ndarray, item_axes: int, most: int, pad: bool = True
) -> np.ndarray:
    """Applies a function to all items, in passes of at most ``most`` items.

    Args:
        apply: the function; its result for an item must not depend on the other items.
        items: with any leading axes before the ``item_axes`` of an item.
        pad: whether the last pass gets as many items as the others, by repeats, so that it needs no other program.
    """
    lead = items.shape[:-item_axes]
    item = items.shape[-item_axes:]
    flat = items.reshape(-1, *item)
    whole = 2 ** (len(flat) - 1).bit_length()  # powers of 2, so that few programs are compiled
    size = max(1, min(most, whole // passes_at_once()))

    def run(start: int) -> np.ndarray:
        chunk = flat[start : start + size]
        if not pad:
            return np.asarray(apply(chunk))
        padded = np.concatenate([chunk, np.repeat(chunk[-1:], size - len(chunk), axis=0)])
        return np.asarray(apply(padded))[: len(chunk)]

    joined = np.concatenate(each_pass(run, range(0, len(flat), size)))
    return joined.reshape(*lead, *joined.shape[1:])


def each_pass(run: Callable[[int], T], starts: range) -> list[T]:
    """Returns the results of passes that start at these items, :func:`passes_at_once` of which run at the same time."""
    with ThreadPoolExecutor(passes_at_once()) as threads:
        return list(threads.map(run, starts))


def passes_at_once() -> int:
    """Returns 2 if a CPU is the only device, since a pass leaves a second core half idle; otherwise 1.

    Passes on several devices must keep their order.
    """
    if on_cpu() and jax.device_count() == 1:
        return 2
    return 1


@partial(jax.jit, static_argnums=(0, 1, 2))
def _run(
    config: TokenizerConfig,
    method: str,
    mesh: Mesh | None,
    params: Params,
    x: ArrayLike,
    count: Int[np.ndarray, ""] | None = None,
) -> jax.Array:
    """Encodes or decodes images: on a CPU one by one, so that an image's features stay in the processor's cache.

    Args:
        count: of a CPU's images, the others are left out; None: all.
    """

    def run(params: Params, images: ArrayLike) -> jax.Array:
        return cast(jax.Array, run_tokenizer(config, params, images, method))

    def one_by_one(params: Params, images: ArrayLike) -> jax.Array:
        return map_rows(lambda params, image: run(params, image[None])[0], params, images, mesh, count)

    out: jax.Array = by_platform(one_by_one, run, params, x)
    return out
