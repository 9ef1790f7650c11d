"""Writes a comparison as one self-contained HTML page: tables, curves over frames, film strips of the same clips."""

import textwrap
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from rsjax.errors import UserError
from rsjax.evaluation.metrics import contact
from rsjax.evaluation.registry import Metric
from rsjax.evaluation.results import Curves, read_frames
from rsjax.evaluation.shown import extremes
from rsjax.files import write_file
from rsjax.progress import note
from rsjax.tools.studies.compare.table import Comparison, difference_table, legend, score_table
from rsjax.tools.studies.report.curves import INK, Chart, charts_svg
from rsjax.tools.studies.report.figures import ClipFigure, filmstrip
from rsjax.tools.studies.report.page import template_environment
from rsjax.tools.studies.report.video import webp_uri
from rsjax.tools.studies.tables import Footnotes, as_html

LABEL = 18  # letters per line in a film strip's labels
COLORS = ("#3b7dd8", "#d9480f", "#3f9a63", "#8f5bd1", "#b8860b", "#c2417c", "#1b8a9c", "#6b7280")


@dataclass(frozen=True)
class ComparedClip(ClipFigure):
    """A clip with frames for each entry.

    Attributes:
        others: label and frames of each row below the truth.
    """

    others: tuple[tuple[str, UInt8[np.ndarray, "T H W 3"]], ...] = ()

    def rows(self) -> list[tuple[str, UInt8[np.ndarray, "T H W 3"]]]:
        """Returns the truth and the rows of all entries."""
        return [("truth", self.truth), *self.others]


def write_page(path: Path, comparison: Comparison, command: str) -> None:
    """Writes the page atomically.

    Args:
        command: the command that repeats the comparison.
    """
    notes = Footnotes()
    shown = strips(comparison)
    charts = [_chart(comparison, metric) for metric in comparison.metrics if _lines(comparison, metric)]
    if charts and all(contact.AXIS in result.curves for group in comparison.groups for result in group.results):

        def draw_offsets(axes: Axes) -> None:
            of_simulator = comparison.groups[0].results[0].curves
            offsets = np.array(of_simulator[contact.AXIS], float)
            truth = np.array(of_simulator[contact.SIMULATOR], float)
            axes.plot(offsets, truth, ":", color=INK, linewidth=1.3, label="simulator")
            axes.legend(fontsize=8, frameon=False)
            for number, group in enumerate(comparison.groups):
                shares = [np.array(result.curves[contact.MODEL], float) for result in group.results]
                axes.plot(offsets, np.mean(shares, axis=0), color=COLORS[number % len(COLORS)], linewidth=1.3)
            axes.set_ylim(-0.02, 1.02)
            axes.set_title("share of grasps that succeed", fontsize=9, loc="left")
            axes.set_xlabel("offset of the fingers from the cube, cm", fontsize=8)

        charts.append(draw_offsets)
    curves = charts_svg(charts, "scores frame by frame", legend=True, height=2.3) if charts else ""
    html = (
        template_environment("rsjax.tools.studies.compare")
        .get_template("compare.html.j2")
        .render(
            title=comparison.title,
            reference=comparison.reference.name,
            origin=comparison.protocol.get("origin", ""),
            scores=as_html(score_table(comparison, notes)),
            differences=as_html(difference_table(comparison)),
            legend=legend(comparison),
            notes=notes.texts,
            curves=Markup(curves),
            strips=[(clip.title, webp_uri(filmstrip(clip))) for clip in shown],
            command=command,
        )
    )
    write_file(path, html.encode())


def strips(comparison: Comparison) -> list[ComparedClip]:
    """Returns the clips of :func:`_chosen` with the frames of each group's first run."""
    try:
        kept = [read_frames(group.folders[0]) for group in comparison.groups]
    except UserError as error:
        note(f"no film strips: {error}")
        return []
    clips = comparison.groups[0].results[0].clips
    prompt = comparison.protocol["prompt_frames"]
    out = []
    for row, why in _chosen(comparison, reduce(np.intersect1d, [frames["rows"] for frames in kept])).items():
        here = []
        for frames in kept:
            place = int(np.flatnonzero(frames["rows"] == row)[0])
            here.append({name: videos[place] for name, videos in frames.items()})
        truth = here[0]["truth"]
        others = [(_label(g.name), frames["prediction"]) for g, frames in zip(comparison.groups, here, strict=True)]
        others.append(("first frame\nrepeated", np.repeat(truth[prompt - 1 : prompt], len(truth), axis=0)))
        reconstructions: list[tuple[str, np.ndarray]] = []  # each distinct one once
        for group, frames in zip(comparison.groups, here, strict=True):
            if "reconstruction" in frames:
                video = frames["reconstruction"]
                if not any(np.array_equal(video, other) for _, other in reconstructions):
                    reconstructions.append((_label(f"tokenizer, {group.name}"), video))
        if len(reconstructions) == 1:
            reconstructions = [("tokenizer's\nreconstruction", reconstructions[0][1])]
        others += reconstructions
        title = f"clip {clips[row]['number']}, {why}"
        out.append(ComparedClip(title, truth, None, prompt_frames=prompt, others=tuple(others)))
    return out


def _chosen(comparison: Comparison, rows: Int[np.ndarray, " n"]) -> dict[int, str]:
    """Returns the rows of the clips to show, and why: most and least motion, then the worst and the best.

    The baseline that repeats the first frame has the lowest PSNR where most moves. All clips are ranked by it, because
    every result keeps the frames of both ends. The worst and the best clips by the reference's own PSNR are chosen
    among the kept clips only.

    Args:
        rows: the rows of the clips whose frames every group has.
    """
    results = comparison.reference.group.results
    name = comparison.reference.name
    own = np.mean([each.per_clip["psnr"] for each in results], axis=0)
    still = np.array(results[0].per_clip["psnr_repeat_first"])
    every = np.arange(len(own))
    chosen: dict[int, str] = {}
    for scores, among, ends, of in (
        (still, every, ("moves most", "moves least"), "first frame repeated"),
        (own, rows, ("worst", "best"), name),
    ):
        clips = f"{'all' if len(among) == len(every) else 'the'} {len(among)}{'' if among is every else ' kept'} clips"
        for end, places in zip(ends, extremes(scores[among]), strict=True):
            for rank, row in enumerate(among[places].tolist(), 1):
                chosen.setdefault(row, f"{end} ({rank} of {clips}; {of}: {scores[row]:.2f} dB)")
    return chosen


def _label(name: str) -> str:
    return "\n".join(textwrap.wrap(name, LABEL, max_lines=2, placeholder="…"))


def _lines(comparison: Comparison, metric: Metric) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Returns frames and values of each entry that has this metric, with the entry's number."""
    lines = []
    for number, entry in enumerate(comparison.entries):
        curves: list[Curves] = [result.curves for result in entry.group.results]
        name = entry.score(metric)
        if all(name in each for each in curves):
            points = np.mean([np.array(each[name], float) for each in curves], axis=0)
            lines.append((number, np.array(curves[0][metric.axis], float), points))
    return lines


def _chart(comparison: Comparison, metric: Metric) -> Chart:
    """Draws a metric over the predicted frames; a line is the mean over an entry's seeds."""

    def draw(axes: Axes) -> None:
        for number, frames, points in _lines(comparison, metric):
            color = COLORS[number % len(COLORS)]  # an entry has one colour in all charts
            label = comparison.entries[number].name
            marker = "o" if len(frames) == 1 else None
            axes.plot(frames, points, color=color, marker=marker, linewidth=1.3, label=label)
        axes.set_title(metric.heading, fontsize=9, loc="left")
        axes.set_xlabel("frame", fontsize=8)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))

    return draw
