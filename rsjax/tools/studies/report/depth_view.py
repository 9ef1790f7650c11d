"""Colours depth in the same way for reports, sheets and videos, and draws the scale of the colours.

The tokenizer uses other colours, those of :mod:`rsjax.data.depth_color`.
"""

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from rsjax.tools.studies.report.lettering import font

SCALE = 30  # pixels of a scale's height
_COLORS = np.round(matplotlib.colormaps["turbo"](np.linspace(1, 0, 256))[:, :3] * 255).astype(np.uint8)
_BAR = 8
_TICK_APART = 90  # pixels


def depth_range(*depths: Float[np.ndarray, "..."]) -> tuple[float, float]:
    """Returns the depths of the first and last colour: the 1st and 99th percentile of the known depths.

    Raises:
        ValueError: no depth is known.
    """
    known = np.concatenate([depth[np.isfinite(depth) & (depth > 0)] for depth in depths])
    if not known.size:
        raise ValueError("depth is 0 or NaN everywhere")
    near, far = np.percentile(known, [1, 99])
    return float(near), float(max(far, near * 1.001))


def depth_to_colors(depth: Float[np.ndarray, "..."], near: float, far: float) -> UInt8[np.ndarray, "... 3"]:
    """Colours depth with the turbo map: red at ``near`` and closer, violet at ``far`` and farther.

    Colour is linear in 1/depth, which resolves close depths best. Pixels without depth (0 or NaN) are black.

    Raises:
        ValueError: 0 < ``near`` < ``far`` does not hold.
    """
    if not 0 < near < far:
        raise ValueError(f"depth colours need 0 < near < far, not near = {near} m and far = {far} m")
    known = np.isfinite(depth) & (depth > 0)
    share = (1 / near - 1 / np.clip(np.where(known, depth, far), near, far)) / (1 / near - 1 / far)
    return np.where(known[..., None], _COLORS[np.round(share * 255).astype(np.uint8)], np.uint8(0))


def depth_scale(
    near: float, far: float, width: int, unit: str, background: tuple[int, int, int]
) -> UInt8[np.ndarray, "30 width 3"]:
    """Draws the colours from ``near`` to ``far``, with numbers for depth below them.

    Args:
        unit: "metres" or "relative" (see :mod:`rsjax.tools.ingest.annotators.depth`).
    """
    strip = Image.new("RGB", (width, SCALE), background)
    depths = 1 / np.linspace(1 / near, 1 / far, width)
    strip.paste(Image.fromarray(np.repeat(depth_to_colors(depths, near, far)[None], _BAR, axis=0)), (0, 2))
    draw = ImageDraw.Draw(strip)
    ticks = np.linspace(0, width - 1, max(2, width // _TICK_APART + 1)).round().astype(int)
    texts = [f"{depths[x]:.3g}" for x in ticks]
    if unit == "metres":
        texts = [f"{text} m" for text in texts]
    else:
        texts[-1] += " (no unit)"
    anchors = ["lt", *["mt"] * (len(ticks) - 2), "rt"]
    for x, text, anchor in zip(ticks, texts, anchors, strict=True):
        draw.text((int(x), _BAR + 7), text, fill=(222, 225, 230), font=font(11), anchor=anchor)
    return np.asarray(strip)
