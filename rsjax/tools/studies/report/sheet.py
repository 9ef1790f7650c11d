"""Draws clips of a store as a sheet: one picture, or a page, whose captions a browser shows in any script.

Axes: T frames, H×W pixels, n pictures.
"""

import html
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from rsjax.data.store import Store
from rsjax.tools.studies.report.contents import clips_of
from rsjax.tools.studies.report.depth_view import depth_range, depth_scale, depth_to_colors
from rsjax.tools.studies.report.lettering import font
from rsjax.tools.studies.report.video import webp_uri

GAP = 4  # pixels between pictures
CAPTION = 18  # pixels high
BACKGROUND = 30
Captioned = tuple[str, UInt8[np.ndarray, "h w 3"]]


def sheet_rows(store: Store, clips: int = 12, frames: int = 8, side: int = 96) -> Iterator[Captioned]:
    """Yields, for some clips, a caption and ``frames`` of each clip's frames, with their depth and its scale below.

    The clips are spread evenly over the store. A caption names the clip's split, its number in the split and its task.

    Raises:
        StoreError: the store contains tokens, or no clip can be read.
    """
    for split, number, record in clips_of(store, clips, []):
        times = np.linspace(0, len(record["rgb"]) - 1, frames).round().astype(int)
        rows = [_row(record["rgb"][times], side)]
        if record.get("depth") is not None:
            near, far = depth_range(record["depth"])
            unit = record["provenance"].get("depth_unit") or "metres"
            rows.append(_row(depth_to_colors(record["depth"][times], near, far), side))
            rows.append(depth_scale(near, far, rows[0].shape[1], unit, (BACKGROUND,) * 3))
        yield f"{split} {number}: {' '.join(record['task'].split())}", np.concatenate(rows)


def sheet_picture(rows: Sequence[Captioned]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns one picture of all rows, each below its caption, which is cut off at the picture's width."""
    parts = []
    for text, row in rows:
        strip = Image.new("RGB", (row.shape[1], CAPTION), (BACKGROUND,) * 3)
        ImageDraw.Draw(strip).text((GAP, CAPTION - 5), text, fill=(230, 230, 230), font=font(12, text), anchor="ls")
        parts += [np.asarray(strip), row]
    return np.concatenate(parts)


def sheet_page(rows: Sequence[Captioned], title: str) -> str:
    """Returns all rows with their captions as one HTML page."""
    figures = "".join(
        f'<figure><figcaption dir="auto">{html.escape(text)}</figcaption><img src="{webp_uri(row)}" alt=""></figure>\n'
        for text, row in rows
    )
    color = f"background: rgb({BACKGROUND} {BACKGROUND} {BACKGROUND}); color: #dee1e6"
    head = f'<meta charset="utf-8">\n<title>{html.escape(title)}</title>\n'
    return f"<!doctype html>\n{head}<style>body {{{color}; font: 14px sans-serif}}</style>\n{figures}"


def _row(pictures: UInt8[np.ndarray, "n H W 3"], side: int) -> UInt8[np.ndarray, "h w 3"]:
    height = max(1, round(side * pictures.shape[1] / pictures.shape[2]))
    small = [cv2.resize(picture, (side, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    framed = [np.pad(one, ((0, GAP), (0, GAP), (0, 0)), constant_values=BACKGROUND) for one in small]
    return np.concatenate(framed, axis=1)
