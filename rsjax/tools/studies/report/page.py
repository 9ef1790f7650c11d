"""Writes a run's HTML report: one self-contained page, whose only script plays the clips."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from rsjax.evaluation.coverage import UNSEEN
from rsjax.evaluation.metrics.failures import FLAGGED
from rsjax.evaluation.registry import Metric, metrics
from rsjax.evaluation.results import Curves
from rsjax.evaluation.statistics import bootstrap
from rsjax.evaluation.verdict import verdict
from rsjax.files import write_file
from rsjax.progress import duration
from rsjax.tools.studies.report.curves import curves_svg
from rsjax.tools.studies.report.figures import ClipFigure, filmstrip, keypoints
from rsjax.tools.studies.report.player import player_clip, player_script, player_style
from rsjax.tools.studies.report.score_charts import PLACE_SCENES, SCENES, frame_curves_svg, place_errors_svg, probes_svg
from rsjax.tools.studies.report.targets import judge
from rsjax.tools.studies.report.video import webp_uri
from rsjax.tools.studies.tables import ABSENT, CellText, Footnotes, Marked, Table, as_html

_FPS = 4  # the rate at which the player starts; one of its rates

Row = tuple[str, str]
Column = tuple[str, str, int]

# Rows are (suffix, label), columns are (metric, header, decimals); a column's {} stands for the row's suffix.
_SCORE_ROWS = tuple(SCENES.items())
_PLACE_ROWS = tuple(PLACE_SCENES.items())
_PLACE_ERRORS = ("cube_error_widths", "gripper_error_widths")
_PLACES = (*_PLACE_ERRORS, "lifted_accuracy")  # metrics in a table of their own
_CONTACTS = ("contact_false_success", "contact_false_failure", "contact_brier")
_DRIVES = ("drive_gripper_error_widths", "drive_psnr", "drive_worse_frames")
_APART = (*_PLACES, *_CONTACTS, "contact_judge_accuracy", *_DRIVES)  # metrics that the tables of scores leave out
_DEPTH_ROWS = (
    ("", "predicted depth, in metres"),
    ("_median_branch", "predicted depth, median scale"),
    ("_affine_disparity_branch", "predicted depth, scale and shift of 1/depth"),
    ("_l1_scale_branch", "predicted depth, L1 scale"),
    ("_median_estimator", "estimator, median scale"),
    ("_affine_disparity_estimator", "estimator, scale and shift of 1/depth"),
    ("_l1_scale_estimator", "estimator, L1 scale"),
    ("_exact_estimator", "estimator against exact depth, in metres"),
    ("_exact_estimator_tokenizer", "the same, of the tokenizer's reconstruction"),
    ("_exact_estimator_truth", "the same, of the true frames"),
)
_DEPTH_COLUMNS = (("depth_absrel{}", "AbsRel ↓", 4), ("depth_delta1{}", "δ₁ ↑", 3), ("depth_delta2{}", "δ₂ ↑", 3))
_COVERAGE_GROUPS = 4  # groups of clips by their distance from the training clips
_STATE_ROWS = (("", "while the model generates"),)
_CONTROL_ROWS = (("", "another clip's actions"), ("_uniform", "uniform random actions"))
_CONTROL_COLUMNS = (("delta_psnr{}_t4", "Δ₄, dB", 2),)


@dataclass(frozen=True)
class RunReport:
    """The contents of a page; the page leaves out the sections of empty fields.

    Attributes:
        preset: the run's preset.
        metrics: flat, as in metrics.json; ``name_low`` and ``name_high`` bound the 95 % interval of ``name``. The page
            lists all of them, and its tables show those of their columns.
        reasons: why a metric is absent, by name; the cells of absent metrics refer to them in footnotes.
        clips: test clips; the player at the top of the page opens with the first one.
        curves: scores at each predicted frame, as in curves.json.
        per_clip: the scores of single clips by name; only the errors of places are drawn.
        logs: scalar logs by name ("tokenizer", "world model"): dicts with "step" and numbers.
        config: nested settings, JSON-ready.
        versions: library → version.
        seconds: stage → duration.
        command: the command that reproduces the run.
        show_targets: judge the run by :data:`rsjax.tools.studies.report.targets.TARGETS`.
    """

    preset: str
    metrics: Mapping[str, float]
    reasons: Mapping[str, str] = field(default_factory=dict)
    clips: Sequence[ClipFigure] = ()
    curves: Curves = field(default_factory=dict)
    per_clip: Mapping[str, Sequence[float]] = field(default_factory=dict)
    logs: Mapping[str, Sequence[dict[str, Any]]] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    command: str = ""
    show_targets: bool = True


def write_report(path: Path, report: RunReport) -> None:
    """Writes the page atomically.

    Raises:
        ValueError: a log has no numbers.
        FileError: the disk is full or the directory is not writable.
    """
    environment = template_environment()
    environment.filters["duration"] = duration
    shown = [metric for metric in metrics().values() if metric.column]
    places = [metrics()[name] for name in _PLACES]
    contacts = [metrics()[name] for name in _CONTACTS]
    drives = [metrics()[name] for name in _DRIVES]
    scored = [metric for metric in shown if metric.name not in _APART]
    uncolumned = [metric for metric in metrics().values() if not (metric.column or metric.name in _APART)]
    further = [metric for metric in uncolumned if not metric.name.startswith(("depth_", "state_", "coverage"))]
    states = [metric for metric in uncolumned if metric.name.startswith("state_")]
    clips = [
        {
            "title": clip.title,
            "filmstrip": webp_uri(filmstrip(clip)),
            "keypoints": None if clip.tracks is None else webp_uri(keypoints(clip)),
            "depth_range": clip.depth_range() if clip.has_depth() else None,
            "metres": clip.depth_unit == "metres",
        }
        for clip in report.clips
    ]
    notes = Footnotes()
    html = environment.get_template("page.html.j2").render(
        report=report,
        verdict=verdict(report.metrics),
        gallery={"rate": _FPS, "clips": [player_clip(clip) for clip in report.clips]},
        player_script=Markup(player_script()),
        player_style=Markup(player_style()),
        clips=clips,
        scores=_table(report, "test clips", notes, _SCORE_ROWS, _columns(scored)),
        depths=_table(report, "depth of the prediction", notes, _DEPTH_ROWS, _DEPTH_COLUMNS),
        further=_table(report, "test clips", notes, _SCORE_ROWS, _columns(further)),
        coverage=_coverage(report),
        states=_table(report, "state heads", Footnotes(), _STATE_ROWS, _columns(states)),
        control=_table(report, "ΔPSNR under", notes, _CONTROL_ROWS, _CONTROL_COLUMNS),
        places=_table(report, "last frame", Footnotes(), _PLACE_ROWS, _columns(places)),
        place_errors=Markup(place_errors_svg(report.per_clip, places[: len(_PLACE_ERRORS)])),
        contacts=_table(report, "grasps", Footnotes(), _PLACE_ROWS, _columns(contacts)),
        drives=_table(report, "drives", Footnotes(), _PLACE_ROWS, _columns(drives)),
        probes=Markup(probes_svg(report.curves, drives)),
        frame_curves=Markup(frame_curves_svg(report.curves, [*scored, *further, *states])),
        notes=notes.texts,
        failures=_failures(report),
        targets=_targets(report),
        training={name: Markup(curves_svg(log, name)) for name, log in report.logs.items() if log},
        settings=_settings(report.config),
    )
    write_file(path, html.encode())


def template_environment(package: str = "rsjax.tools.studies.report") -> jinja2.Environment:
    """Returns the environment of a package's templates; they may include those of the report, such as its style."""
    loaders = [jinja2.PackageLoader(name, ".") for name in dict.fromkeys((package, "rsjax.tools.studies.report"))]
    return jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def _columns(shown: Iterable[Metric]) -> list[Column]:
    return [(f"{metric.name}{{}}", metric.heading, metric.decimals) for metric in shown]


def _table(
    report: RunReport, corner: str, notes: Footnotes, rows: Sequence[Row], columns: Sequence[Column]
) -> Markup | None:
    """Returns a table of the rows and columns that have a metric or a reason; None without any metric.

    A cell has a score with its interval as the remark, or the footnote that says why the score is absent.
    """
    if not any(key.format(suffix) in report.metrics for key, _, _ in columns for suffix, _ in rows):
        return None
    known = {*report.metrics, *report.reasons}
    columns = [column for column in columns if any(column[0].format(suffix) in known for suffix, _ in rows)]
    rows = [row for row in rows if any(key.format(row[0]) in known for key, _, _ in columns)]
    lines: list[list[CellText]] = []
    for suffix, label in rows:
        cells: list[CellText] = [label]
        for key, _, digits in columns:
            name = key.format(suffix)
            value = report.metrics.get(name)
            low = report.metrics.get(f"{name}_low")
            high = report.metrics.get(f"{name}_high")
            if value is None:
                cells.append(Marked(notes.absent(report.reasons.get(name) or report.reasons.get(key.format("")))))
            elif low is None or high is None:
                cells.append(Marked(f"{value:.{digits}f}"))
            else:
                cells.append(Marked(f"{value:.{digits}f}", remark=f"{low:.{digits}f} – {high:.{digits}f}"))
        lines.append(cells)
    return as_html(Table([corner, *(header for _, header, _ in columns)], lines, first_bold=True))


def _coverage(report: RunReport) -> Markup | None:
    """Returns a table of PSNR by distance from the training clips, in groups of equal size; None without distances."""
    known = report.per_clip
    if not {"coverage", "coverage_percentile", "psnr"} <= known.keys():
        return None
    far, percentile, psnr = (np.array(known[name]) for name in ("coverage", "coverage_percentile", "psnr"))
    groups = np.array_split(np.argsort(far, kind="stable"), min(_COVERAGE_GROUPS, len(far)))
    rows: list[list[CellText]] = []
    for rows_of in groups:
        score = bootstrap(psnr[rows_of])
        remark = "" if score.low is None else f"{score.low:.2f} – {score.high:.2f}"
        unseen = int((percentile[rows_of] > 100 * UNSEEN).sum())
        span = f"{far[rows_of].min():.2f} – {far[rows_of].max():.2f}"
        rows.append([span, str(len(rows_of)), str(unseen), Marked(f"{score.value:.2f}", remark=remark)])
    header = ("distance, in the median training clip's", "clips", "not seen in training", "PSNR, dB ↑")
    return as_html(Table(header, rows))


def _failures(report: RunReport) -> Markup | None:
    """Returns the table of how many clips show a failure mode, by kind of video; None without scores."""
    rows: list[list[CellText]] = []
    for name, bound in FLAGGED.items():
        scored = [report.per_clip.get(f"{name}{suffix}", ()) for suffix in SCENES]
        counts = [f"{sum(x > bound for x in values)} of {len(values)}" if values else ABSENT for values in scored]
        if any(scored):
            rows.append([f"{metrics()[name].title}, share above {bound:g}", *counts])
    if not rows:
        return None
    return as_html(Table(["clips with", *SCENES.values()], rows))


def _targets(report: RunReport) -> Markup | None:
    """Returns the table of the targets whose metrics were measured; None if there are none, or they do not apply."""
    if not report.show_targets:
        return None
    rows: list[list[CellText]] = []
    for target, measured, margin in judge(report.metrics):
        bound = f"≤ {target.bound:g} {target.unit}"
        if target.at_least:
            bound = f"≥ {target.bound:g} {target.unit}"
        if margin >= 0:
            outcome = Marked("met", "met")
        else:
            outcome = Marked(f"missed by {-margin:.2f}", "missed")
        rows.append([target.name, bound, f"{measured:.2f} {target.unit}", outcome])
    if not rows:
        return None
    return as_html(Table(["on test episodes", "target", "measured", ""], rows))


def _settings(config: Mapping[str, Any], name: str = "run") -> dict[str, list[tuple[str, Any]]]:
    """Returns section → (field, value); a nested mapping becomes a section, named by its path."""
    fields = [(key, value) for key, value in config.items() if not isinstance(value, Mapping)]
    sections = {}
    if fields:
        sections[name] = fields
    for key, value in config.items():
        if isinstance(value, Mapping):
            sections |= _settings(value, key if name == "run" else f"{name}.{key}")
    return sections
