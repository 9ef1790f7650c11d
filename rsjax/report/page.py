"""One HTML page per run: everything inside it, nothing loaded from elsewhere, no script."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from rsjax.report.curves import curves_svg
from rsjax.report.figures import ClipFigure, animation, filmstrip, keypoints
from rsjax.report.targets import judge
from rsjax.report.video import animation_uri, webp_uri, write_file

_HEADLINE_CLIPS = 2  # animations that stand above everything else
_FPS = 4.0

_ROWS = (("", "prediction"), ("_repeat_first", "first frame repeated"), ("_tokenizer", "tokenizer's reconstruction"))
_COLUMNS = (
    ("psnr", "PSNR, dB ↑", 2),
    ("ssim", "SSIM ↑", 3),
    ("depth_absrel", "depth AbsRel ↓", 4),
    ("depth_delta1", "depth δ₁ ↑", 3),
    ("depth_delta2", "depth δ₂ ↑", 3),
    ("delta_psnr", "ΔPSNR, another clip's actions, dB ↑", 2),
    ("delta_psnr_uniform", "ΔPSNR, uniform actions, dB ↑", 2),
)
_DELTA_ROWS = (("", "another clip's actions"), ("_uniform", "uniform random actions"))
_DELTA_COLUMNS = (("_t4", "Δ₄, dB", 2),)


@dataclass(frozen=True)
class Report:
    """What a page is made of. Whatever is empty or missing leaves its part of the page out.

    Attributes:
        preset: the run's preset.
        metrics: flat, as in metrics.json; ``name_low`` and ``name_high`` are the 95 % interval of ``name``. Numbers
            without a table of their own are listed under all numbers.
        clips: held-out clips; the first ones stand at the top.
        logs: scalar logs by name ("tokenizer", "world model"): dicts with "step" and numbers.
        config: nested settings, JSON-ready.
        versions: library → version.
        seconds: stage → how long it took.
        command: what to type to make the run again.
        show_targets: judge the run by :data:`rsjax.report.targets.TARGETS`.
    """

    preset: str
    metrics: Mapping[str, float]
    clips: Sequence[ClipFigure] = ()
    logs: Mapping[str, Sequence[dict[str, Any]]] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    command: str = ""
    show_targets: bool = True


def write_report(path: Path | str, report: Report) -> None:
    """Write the page; it appears only when it is whole.

    Raises:
        ValueError: a log without numbers.
        OSError: the disk is full or the folder cannot be written.
    """
    template = _environment().get_template("page.html.j2")
    html = template.render(
        report=report,
        headline=_HEADLINE_CLIPS,
        clips=[_clip_pictures(clip) for clip in report.clips],
        scores=_table(report.metrics, _ROWS, _COLUMNS, lambda row, column: column + row),
        control=_table(report.metrics, _DELTA_ROWS, _DELTA_COLUMNS, lambda row, column: f"delta_psnr{row}{column}"),
        verdicts=judge(report.metrics) if report.show_targets else [],
        curves={name: Markup(curves_svg(log, name)) for name, log in report.logs.items() if log},
        settings=_settings(report.config),
    )
    write_file(path, html.encode())


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rsjax.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["duration"] = _duration
    return environment


def _clip_pictures(clip: ClipFigure) -> dict[str, Any]:
    has_depth = clip.true_depth is not None or clip.predicted_depth is not None
    return {
        "title": clip.title,
        "animation": animation_uri(animation(clip), _FPS),
        "filmstrip": webp_uri(filmstrip(clip)),
        "keypoints": None if clip.tracks is None else webp_uri(keypoints(clip)),
        "depth_range": clip.depth_range() if has_depth else None,
    }


def _table(metrics: Mapping[str, float], rows: Any, columns: Any, key_of: Any) -> dict[str, Any] | None:
    """Header and cells (value, interval) of those rows and columns of which anything was measured."""
    columns = [c for c in columns if any(key_of(row, c[0]) in metrics for row, _ in rows)]
    rows = [r for r in rows if any(key_of(r[0], column) in metrics for column, _, _ in columns)]
    if not columns:
        return None
    cells = [[_cell(metrics, key_of(row, column), digits) for column, _, digits in columns] for row, _ in rows]
    return {
        "header": [header for _, header, _ in columns],
        "rows": [{"label": label, "cells": line} for (_, label), line in zip(rows, cells, strict=True)],
    }


def _cell(metrics: Mapping[str, float], key: str, digits: int) -> dict[str, str]:
    bounds = [metrics.get(f"{key}_{side}") for side in ("low", "high")]
    value = metrics.get(key)
    interval = "" if None in bounds else " – ".join(f"{bound:.{digits}f}" for bound in bounds)
    return {"value": "–" if value is None else f"{value:.{digits}f}", "interval": interval}


def _settings(config: Mapping[str, Any]) -> dict[str, list[tuple[str, Any]]]:
    """Section → (field, value): nested mappings become sections, the rest is gathered under "run"."""
    sections: dict[str, list[tuple[str, Any]]] = {}
    for name, value in config.items():
        if isinstance(value, Mapping):
            sections[name] = list(value.items())
        else:
            sections.setdefault("run", []).append((name, value))
    return sections


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(math.floor(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
