"""Draws a generated clip: a filmstrip, an animation, and its keypoints."""

from dataclasses import dataclass
from textwrap import wrap

import matplotlib
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from PIL import Image, ImageDraw

from rsjax.tools.studies.report.depth_view import SCALE, depth_range, depth_scale, depth_to_colors
from rsjax.tools.studies.report.lettering import font
from rsjax.tools.studies.report.video import resize

_BACKGROUND = (24, 26, 30)  # dark, which suits both light and dark pages
_TEXT = (222, 225, 230)
_FAINT = (120, 126, 136)
_GAP = 6
_TRAILS = matplotlib.colormaps["plasma"]

_CELL_ANIMATION = 192  # approximate side of a frame in pixels
_CELL_FILMSTRIP = 128
_LABEL_LETTERS = 18  # that fit beside a filmstrip
_FILMSTRIP_COLUMNS = 8
_CELL_KEYPOINTS = 448


@dataclass(frozen=True)
class ClipFigure:
    """A test clip and the frames generated from its prompt; a field that is None has no row.

    Attributes:
        title: the caption.
        truth: the recorded frames, 0–255.
        prediction: frames generated from the prompt and the clip's own actions.
        reconstruction: the truth, encoded and decoded by the tokenizer: an upper bound on any prediction's quality.
        other_actions: frames generated from the same prompt and another clip's actions.
        true_depth: metres, or relative; 0 or NaN where there is none.
        predicted_depth: the model's, in the same unit.
        depth_unit: "metres" or "relative".
        tracks: keypoints, x and y in 0–1 as in :class:`rsjax.clip.Clip`.
        visible: as in :class:`rsjax.clip.Clip`.
        selected: indices of the top-K tracks by motion.
        prompt_frames: number of recorded frames that generation starts from.
        label: a short name for lists of clips.

    Raises:
        ValueError: the shape of an array does not fit the truth's.
    """

    title: str
    truth: UInt8[np.ndarray, "T H W 3"]
    prediction: UInt8[np.ndarray, "T H W 3"] | None
    reconstruction: UInt8[np.ndarray, "T H W 3"] | None = None
    other_actions: UInt8[np.ndarray, "T H W 3"] | None = None
    true_depth: Float32[np.ndarray, "T H W"] | None = None
    predicted_depth: Float32[np.ndarray, "T H W"] | None = None
    tracks: Float32[np.ndarray, "N0 T 2"] | None = None
    visible: Bool[np.ndarray, "N0 T"] | None = None
    selected: Int[np.ndarray, " K"] | None = None
    prompt_frames: int = 1
    depth_unit: str = "metres"
    label: str = ""

    def __post_init__(self) -> None:
        shape = self.truth.shape
        for name in ("prediction", "reconstruction", "other_actions", "true_depth", "predicted_depth"):
            value = getattr(self, name)
            expected = shape[:3] if "depth" in name else shape
            if value is not None and value.shape != expected:
                raise ValueError(f"{name} of clip {self.title!r} has shape {value.shape}; it must be {expected}")
        if self.tracks is not None and (self.visible is None or self.tracks.shape[:2] != self.visible.shape):
            raise ValueError(f"visible of clip {self.title!r} must have its tracks' shape {self.tracks.shape[:2]}")

    def depth_range(self) -> tuple[float, float]:
        """Returns the depths of the first and last colour, from the true depth if it is known."""
        depth = self.true_depth if self.true_depth is not None else self.predicted_depth
        if depth is None:
            raise ValueError(f"clip {self.title!r} has no depth")
        return depth_range(depth)

    def has_depth(self) -> bool:
        """Returns whether rows of depth and their scale are drawn."""
        return self.true_depth is not None or self.predicted_depth is not None

    def rows(self) -> list[tuple[str, UInt8[np.ndarray, "T H W 3"]]]:
        """Returns the label (up to two lines) and the RGB frames of each row."""
        colors = [
            ("truth", self.truth),
            ("prediction", self.prediction),
            ("prediction with\nanother's actions", self.other_actions),
            ("tokenizer's\nreconstruction", self.reconstruction),
        ]
        rows = [(label, frames) for label, frames in colors if frames is not None]
        for label, depth in (("true depth", self.true_depth), ("predicted depth", self.predicted_depth)):
            if depth is not None:
                rows.append((label, depth_to_colors(depth, *self.depth_range())))
        return rows


def filmstrip(clip: ClipFigure) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a sheet with a row per kind of frame and up to eight frames, evenly spaced from the first to the last.

    Cell (row i, column j) starts at pixel :func:`filmstrip_cell`.
    """
    times = np.unique(np.linspace(0, len(clip.truth) - 1, _FILMSTRIP_COLUMNS).round().astype(int))
    rows = clip.rows()
    scale = _scale(clip, _CELL_FILMSTRIP)
    height, width = (side * scale for side in clip.truth.shape[1:3])
    top, left = filmstrip_cell(clip, len(rows), len(times))
    sheet, draw = _sheet(left, top + (SCALE + _GAP if clip.has_depth() else 0))
    for j, t in enumerate(times):
        y, x = filmstrip_cell(clip, 0, j)
        name = f"frame {t + 1}" + (", prompt" if t < clip.prompt_frames else "")
        draw.text((x + width // 2, y - 6), name, fill=_FAINT, font=font(13), anchor="ms")
    for i, (label, frames) in enumerate(rows):
        y, x = filmstrip_cell(clip, i, 0)
        lines = [line for part in label.splitlines() for line in wrap(part, _LABEL_LETTERS)]
        draw.text((x - 10, y + height // 2), "\n".join(lines), fill=_TEXT, font=font(14), anchor="rm", align="right")
        for j, frame in enumerate(resize(frames[times], scale)):
            y, x = filmstrip_cell(clip, i, j)
            sheet.paste(Image.fromarray(frame), (x, y))
    if clip.has_depth():
        first = filmstrip_cell(clip, 0, 0)[1]
        draw.text((first - 10, top + _GAP + 6), "depth", fill=_TEXT, font=font(14), anchor="rm")
        sheet.paste(Image.fromarray(_depth_scale(clip, left - _GAP - first)), (first, top + _GAP))
    return np.asarray(sheet)


def filmstrip_cell(clip: ClipFigure, row: int, column: int) -> tuple[int, int]:
    """Returns the top and left pixel of a frame in a filmstrip."""
    height, width = (side * _scale(clip, _CELL_FILMSTRIP) + _GAP for side in clip.truth.shape[1:3])
    return 30 + row * height, 156 + column * width


def animation(clip: ClipFigure) -> UInt8[np.ndarray, "T h w 3"]:
    """Draws each frame of every row side by side, under the row's label and above a progress bar."""
    rows = clip.rows()
    scale = _scale(clip, _CELL_ANIMATION)
    height, width = (side * scale for side in clip.truth.shape[1:3])
    top = 46
    bottom = 30
    cells = [resize(frames, scale) for _, frames in rows]
    low = SCALE + _GAP if clip.has_depth() else 0
    empty, draw = _sheet(_GAP + len(rows) * (width + _GAP), top + height + low + bottom)
    for i, (label, _) in enumerate(rows):
        x = _GAP + i * (width + _GAP)
        draw.text((x + width // 2, top // 2), label, fill=_TEXT, font=font(14), anchor="mm", align="center")
    if clip.has_depth():
        shown = [i for i, (label, _) in enumerate(rows) if label.endswith("depth")]
        x, end = (_GAP + i * (width + _GAP) for i in (shown[0], shown[-1] + 1))
        empty.paste(Image.fromarray(_depth_scale(clip, end - _GAP - x)), (x, top + height + _GAP))
    count = len(clip.truth)
    sheets = []
    for t in range(count):
        sheet = empty.copy()
        for i, frames in enumerate(cells):
            sheet.paste(Image.fromarray(frames[t]), (_GAP + i * (width + _GAP), top))
        draw = ImageDraw.Draw(sheet)
        y = top + height + low + bottom // 2
        name = f"frame {t + 1} of {count}" + (", prompt" if t < clip.prompt_frames else "")
        draw.text((_GAP, y), name, fill=_FAINT, font=font(13), anchor="lm")
        start = 170
        end = sheet.width - _GAP
        draw.line((start, y, end, y), fill=(60, 64, 70), width=3)
        draw.line((start, y, start + (end - start) * (t + 1) // count, y), fill=_TEXT, width=3)
        sheets.append(np.asarray(sheet))
    return np.stack(sheets)


def keypoints(clip: ClipFigure) -> UInt8[np.ndarray, "h w 3"]:
    """Draws the first frame with a dot where each track starts, and the trails of the selected tracks.

    Colour encodes how far a point moves over the steps in which it is visible in both frames, from blue for the
    selected point that moves least to orange for the one that moves most. Trails cover only these steps.

    Raises:
        ValueError: the clip has no tracks.
    """
    if clip.tracks is None or clip.visible is None:
        raise ValueError(f"clip {clip.title!r} has no tracks")
    over = 2  # draw at twice the size, then reduce it, for smooth lines
    image = Image.fromarray(resize(clip.truth[:1], over * _scale(clip, _CELL_KEYPOINTS))[0])
    draw = ImageDraw.Draw(image)
    points = clip.tracks * np.array(image.size)
    steps = clip.visible[:, 1:] & clip.visible[:, :-1]
    motion = (np.linalg.norm(np.diff(clip.tracks, axis=1), axis=-1) * steps).sum(1)
    selected = np.arange(len(points)) if clip.selected is None else np.asarray(clip.selected)
    for x, y in points[np.setdiff1d(np.arange(len(points)), selected), 0]:
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=(235, 235, 235), outline=(90, 90, 90))
    selected = selected[np.argsort(motion[selected], kind="stable")]
    least, most = motion[selected[[0, -1]]] if len(selected) else (0.0, 0.0)
    for n in selected:
        shade = (motion[n] - least) / max(most - least, 1e-9)
        color = tuple(int(255 * c) for c in _TRAILS(0.78 * shade)[:3])  # above 0.78 the yellow is too pale to see
        for t in np.flatnonzero(steps[n]):
            draw.line((*points[n, t], *points[n, t + 1]), fill=color, width=4)
        x, y = points[n, 0]
        draw.ellipse((x - 8, y - 8, x + 8, y + 8), fill=color, outline=(20, 20, 20), width=2)
    return np.asarray(image.reduce(over))


def _scale(clip: ClipFigure, target: int) -> int:
    return max(1, round(target / clip.truth.shape[1]))


def _depth_scale(clip: ClipFigure, width: int) -> UInt8[np.ndarray, "h w 3"]:
    return depth_scale(*clip.depth_range(), width, clip.depth_unit, _BACKGROUND)


def _sheet(width: int, height: int) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    sheet = Image.new("RGB", (width, height), _BACKGROUND)
    return sheet, ImageDraw.Draw(sheet)
