"""The report's player: the data of each clip that its scripts show, and the scripts themselves.

The modules in ``player/`` are plain JavaScript. The page of :mod:`rsjax.tools.play` loads some of them as they are. The
report has to open directly from a disk, so it contains them as one script.
"""

import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from rsjax.evaluation.metrics.psnr import psnr
from rsjax.tools.studies.report.depth_view import depth_to_colors
from rsjax.tools.studies.report.figures import ClipFigure
from rsjax.tools.studies.report.video import sprite_uri

SCRIPTS = ("dom.js", "transport.js", "chart.js", "gallery.js")  # each module comes after those that it imports
STYLES = ("controls.css", "gallery.css")
# The order of the rows: a wide page shows three side by side, a narrow page two, each depth below its picture.
_WIDE = ("truth", "prediction", "tokenizer's reconstruction", "true depth", "predicted depth")
_NARROW = ("truth", "prediction", "true depth", "predicted depth", "tokenizer's reconstruction")
_COLORS = 12  # colours in the scale of depth


def player_script() -> str:
    """Returns the player's modules as one script without imports."""
    texts = [(files("rsjax.tools.studies.report") / "player" / name).read_text() for name in SCRIPTS]
    return re.sub(r"^import .*;\n|^export (?=\w)", "", "\n".join(texts), flags=re.MULTILINE)


def player_style() -> str:
    """Returns the style sheets of the player as one."""
    return "".join((files("rsjax.tools.studies.report") / "player" / name).read_text() for name in STYLES)


def player_clip(clip: ClipFigure) -> dict[str, Any]:
    """Returns the data that ``gallery.js`` needs for a clip: videos as pictures of tiles, and each frame's PSNR.

    A prompt frame has no PSNR (None).
    """
    rows = {label.replace("\n", " "): frames for label, frames in clip.rows()}
    scores = []
    for name, frames in rows.items():
        if name != "truth" and not name.endswith("depth"):
            decibels = enumerate(np.asarray(psnr(clip.truth, frames)))
            values = [None if t < clip.prompt_frames else round(float(each), 2) for t, each in decibels]
            scores.append({"name": name, "values": values})
    depth: dict[str, Any] | None = None
    if clip.has_depth():
        near, far = clip.depth_range()
        colors = depth_to_colors(1 / np.linspace(1 / near, 1 / far, _COLORS), near, far)
        unit = " m" if clip.depth_unit == "metres" else ""
        depth = {
            "near": f"{near:.3g}{unit}",
            "far": f"{far:.3g}{unit or ' (no unit)'}",
            "colors": [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in colors],
        }
    return {
        "title": clip.title,
        "label": clip.label or clip.title,
        "frames": len(clip.truth),
        "prompt": clip.prompt_frames,
        "size": list(clip.truth.shape[1:3]),
        "rows": [
            {"label": name, "uri": sprite_uri(rows[name]), "narrow": _place(name, _NARROW)}
            for name in sorted(rows, key=lambda name: _place(name, _WIDE))
        ],
        "psnr": scores,
        "depth": depth,
    }


def _place(name: str, order: Sequence[str]) -> int:
    return order.index(name) if name in order else len(order)
