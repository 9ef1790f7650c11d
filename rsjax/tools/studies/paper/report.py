"""Writes the report on all claims: ``report.md``, ``report.html``, ``report.json`` and a figure for each claim."""

import base64
import math
import os
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import UInt8

from rsjax.config import Config
from rsjax.errors import UserError
from rsjax.evaluation.registry import Metric, metrics
from rsjax.evaluation.results import read_frames
from rsjax.evaluation.statistics import Estimate
from rsjax.files import disk_guard, write_file, write_json
from rsjax.progress import duration
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.ablation.table import Row
from rsjax.tools.studies.compare.page import ComparedClip
from rsjax.tools.studies.paper import budget
from rsjax.tools.studies.paper.judge import CEILING, Judged, Outcome, Trained
from rsjax.tools.studies.paper.plan import Plan
from rsjax.tools.studies.report.figures import filmstrip
from rsjax.tools.studies.report.page import template_environment
from rsjax.tools.studies.report.score_charts import SCENES
from rsjax.tools.studies.report.video import webp, webp_uri
from rsjax.tools.studies.results import RunResult
from rsjax.tools.studies.tables import ABSENT, CellText, Marked, Table, as_html, as_markdown, mean_text

LEGEND = (
    "Differences are paired by clip: mean (or median) over clips and seeds, with the 95 % interval from resampling "
    "both. A verdict takes the wider of this interval and Welch's t over the seeds; p is Welch's. A claim holds if all "
    "its comparisons do, and does not hold if any does not; otherwise the budget is too small to tell. With one seed "
    "there is no verdict."
)


def write_report(out: Path, plan: Plan, outcomes: Sequence[Outcome], command: str) -> Path:
    """Writes the report's files into a directory, and returns the path of the HTML page.

    Raises:
        FileError: the disk is full.
    """
    content = {
        "command": command,
        **_summary(plan, outcomes),
        "legend": LEGEND,
        "claims": [_claim(each) for each in outcomes],
    }
    tables = [_tables(claim) for claim in content["claims"]]
    overview = _overview(content["claims"])
    environment = template_environment("rsjax.tools.studies.paper")
    environment.autoescape = lambda name: bool(name) and "html" in str(name)
    with disk_guard(out):
        figures: dict[str, str] = {}
        strips: dict[str, str] = {}
        for outcome in outcomes:
            picture = _figure(outcome)
            if picture is not None:
                figures[outcome.claim.name] = base64.b64encode(picture).decode()
                write_file(out / "figures" / f"{outcome.claim.name}.png", picture)
            strip = _strip(outcome)
            if strip is not None:
                strips[outcome.claim.name] = webp_uri(strip)
                write_file(out / "figures" / f"{outcome.claim.name}-clip.webp", webp(strip))
        write_json(out / "report.json", content)
        for name, render in (("report.md", as_markdown), ("report.html", as_html)):
            template = environment.get_template(f"{name}.j2")
            text = template.render(
                **content,
                overview=render(overview),
                tables=[{key: render(table) for key, table in each.items()} for each in tables],
                figures=figures,
                strips=strips,
            )
            write_file(out / name, text.encode())
    return out / "report.html"


def _summary(plan: Plan, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    base = plan.scale.base
    results = {result.name: result for outcome in outcomes for arm in outcome.arms for result in arm.results}
    runs = [result.run for result in results.values()]  # cells that share a stage have the same mark for it
    spent = {key: run.seconds(stage) for run in runs for stage, key in run.keys().items()}
    states = Counter(result.state for result in results.values())
    return {
        "made": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {jax.local_devices()[0].device_kind}, {os.cpu_count()} cores",
        "states": ", ".join(f"{count} {state}" for state, count in states.items()),
        "spent": duration(sum(spent.values())),
        "budget": duration(plan.scale.seconds),
        "preset": base.name,
        "sizes": {
            "episodes": base.sim.episodes,
            "test clips": base.eval.clips,
            "steps of the tokenizer": base.tokenizer_train.steps,
            "steps of the model": base.train.steps,
            "draws of random actions": base.eval.action_draws,
        },
        "left_out": [f"{task.cell}: {task.measurement}" if task.measurement else task.cell for task in plan.left_out],
    }


def _claim(outcome: Outcome) -> dict[str, Any]:
    """Returns a claim's part of the report, JSON-ready, with texts as the pages show them."""
    claim = outcome.claim
    columns = _columns(outcome)
    return {
        "name": claim.name,
        "title": claim.title,
        "statement": claim.statement,
        "place": claim.place,
        "notes": claim.notes,
        "verdict": outcome.verdict,
        "counts": outcome.counts,
        "header": [column.heading for column in columns],
        "beside": ["PSNR of the reconstruction"] * bool(columns) + list(claim.beside),
        "published_header": [column.heading for column in _published_columns(outcome)],
        "arms": [_arm(arm, outcome, columns) for arm in outcome.arms],
        "baselines": _baselines(outcome, columns),
        "published": any(arm.published for arm in claim.arms),
        "comparisons": [_comparison(each) for each in outcome.judged],
        "missing": [_missing(result) for arm in outcome.arms for result in arm.results if result.state != "finished"],
    }


def _marked(verdict: str, remark: str = "") -> Marked:
    marks: dict[str, Literal["met", "missed"]] = {"holds": "met", "does not hold": "missed"}
    return Marked(verdict, marks.get(verdict, ""), remark)


def _overview(claims: Sequence[dict[str, Any]]) -> Table:
    """Makes a row for each claim: its verdict, and how many of its comparisons have which."""
    rows = []
    for claim in claims:
        counts = list(claim["counts"].values())
        missing = len(claim["comparisons"]) - sum(counts)
        rows.append([claim["title"], claim["place"], _marked(claim["verdict"]), *map(str, counts), str(missing)])
    return Table(["claim", "place", "verdict", "comparisons: hold", "do not", "cannot tell", "not measured"], rows)


def _tables(claim: dict[str, Any]) -> dict[str, Table]:
    """Makes a claim's tables: its arms with both baselines, the comparisons, and the paper's numbers, if it has any."""
    arms = []
    for arm in claim["arms"]:
        costs = [arm[name] or "" for name in ("parameters", "steps", "tflop", "minutes")]
        arms.append([arm["name"], arm["seeds"], *arm["scores"], *arm["beside"], *map(str, costs)])
    for baseline in claim["baselines"]:
        blank = [""] * (len(claim["beside"]) + 4)
        arms.append([Marked(text, "note") for text in (baseline["name"], "", *baseline["scores"], *blank)])
    costs = ["trained parameters", "steps", "TFLOP", "minutes"]
    tables = {"arms": Table(["", "seeds", *claim["header"], *claim["beside"], *costs], arms)}

    comparisons: list[list[CellText]] = []
    for each in claim["comparisons"]:
        metric = f"{each['metric']}, {each['where']}" if each["where"] else each["metric"]
        row = [each["what"], metric, each["sides"] or "", each["difference"], each["interval"], each["p"] or ""]
        row += [each["published"] or "", ", ".join(map(str, each["seeds"])), str(each["clips"])]
        comparisons.append([*row, _marked(each["verdict"], each["reason"])])
    head = ["compared", "by", "scores", "difference", "95 % interval", "p", "the paper's", "seeds", "clips", "verdict"]
    tables["comparisons"] = Table(head, comparisons)
    if claim["published"]:
        published = [[arm["name"], *arm["published"]] for arm in claim["arms"]]
        tables["published"] = Table(["", *claim["published_header"]], published)
    return tables


def _columns(outcome: Outcome) -> list[Metric]:
    """Returns the metrics by which a claim compares the arms' own evaluations."""
    return _known([each.metric for each in outcome.claim.comparisons if not each.measurement])


def _published_columns(outcome: Outcome) -> list[Metric]:
    return _known([each.metric for each in outcome.claim.comparisons])


def _known(names: Sequence[str]) -> list[Metric]:
    known = metrics()
    return [known[name] for name in dict.fromkeys(names) if name in known]


def _arm(arm: Trained, outcome: Outcome, columns: Sequence[Metric]) -> dict[str, Any]:
    published = outcome.claim.arm(arm.name).published
    config = arm.cells[0].config if arm.cells else None
    seconds = [sum(_trained(result).values()) for result in arm.finished]
    flops = sum(budget.training_cost(config, "flops")) if config and arm.finished else None
    return {
        "name": arm.name,
        "absent": arm.absent,
        "seeds": f"{len(arm.finished)} of {len(arm.cells)}",
        "failed": sum(result.state == "failed" for result in arm.results),
        "scores": [_spread(arm, column) for column in columns],
        "published": [
            f"{published[c.name]:.{c.decimals}f}" if c.name in published else ABSENT
            for c in _published_columns(outcome)
        ],
        "values": {name: spread._asdict() for name, spread in arm.spreads.items()},
        "steps": config.train.steps if config and not config.train.curriculum else None,
        "beside": [_beside(arm, name) for name in [CEILING] * bool(columns) + list(outcome.claim.beside)],
        "parameters": _parameters(config) if config and arm.finished else None,
        "tflop": None if flops is None else round(flops / 1e12, 1),
        "minutes": round(sum(seconds) / len(seconds) / 60, 1) if seconds else None,
        "runs": [str(result.run.directory) for result in arm.results],
    }


def _beside(arm: Trained, name: str) -> str:
    return f"{arm.spreads[name].mean:.3g}" if name in arm.spreads else ABSENT


def _parameters(config: Config) -> str:
    """Returns the numbers of trained and, if any, of frozen parameters of model and autoencoder, in millions."""
    model, autoencoder = budget.parameters(config)
    trained = model + autoencoder * (config.tokenizer_train.steps > 0)
    frozen = model + autoencoder - trained
    return f"{trained / 1e6:.2f} M" + (f", {frozen / 1e6:.2f} M frozen" if frozen else "")


def _baselines(outcome: Outcome, columns: Sequence[Metric]) -> list[dict[str, Any]]:
    """Returns the scores of both baselines (first frame repeated, reconstruction) from the first arm that has any."""
    finished = [result for arm in outcome.arms for result in arm.finished][:1]
    of = next((f" of {arm.name}" for arm in outcome.arms if arm.finished), "")
    rows = []
    for suffix, name in (("_repeat_first", SCENES["_repeat_first"]), ("_tokenizer", SCENES["_tokenizer"] + of)):
        numbers = [result.metrics.get(f"{column.name}{suffix}") for result in finished for column in columns]
        if any(number is not None for number in numbers):
            texts = [ABSENT if n is None else f"{n:.{c.decimals}f}" for n, c in zip(numbers, columns, strict=True)]
            rows.append({"name": name, "scores": texts})
    return rows


def _trained(result: RunResult) -> dict[str, float]:
    return {stage: result.run.seconds(stage) for stage in ("tokenizer", "world_model")}


def _spread(arm: Trained, column: Metric) -> str:
    return mean_text(arm.spreads[column.name], column.decimals) if column.name in arm.spreads else ABSENT


def _comparison(judged: Judged) -> dict[str, Any]:
    compared = judged.comparison
    metric = judged.metric
    digits = metric.decimals
    own = compared.score or compared.metric
    other = compared.than_score or compared.metric
    sides = (compared.better, compared.than) if compared.better != compared.than else (own, other)
    return {
        "what": f"{sides[0]} − {sides[1]}",
        "metric": metric.heading,
        "where": compared.measurement,
        "margin": compared.margin,
        "sides": None if judged.sides is None else " / ".join(f"{side:.{digits}f}" for side in judged.sides),
        "difference": ABSENT if judged.difference is None else f"{judged.difference.value:+.{digits}f}",
        "interval": _interval(judged.difference, digits),
        "p": None if judged.test is None else f"{judged.test.p:.3f}",
        "published": None if judged.published is None else f"{judged.published:+.{digits}f}",
        "seeds": list(judged.seeds),
        "clips": judged.clips,
        "verdict": judged.verdict if judged.difference else "not measured",
        "reason": judged.reason,
        "values": _numbers(judged),
    }


def _numbers(judged: Judged) -> dict[str, Any]:
    """Returns the unrounded numbers of a comparison; the texts of the report are rounded."""
    interval = judged.difference or Estimate(math.nan, None, None)
    test = judged.test
    welch = test.difference if test else Estimate(math.nan, None, None)
    return {
        "sides": None if judged.sides is None else list(map(float, judged.sides)),
        "difference": interval.value if judged.difference else None,
        "low": interval.low,
        "high": interval.high,
        "welch_low": welch.low,
        "welch_high": welch.high,
        "p": test.p if test else None,
        "published": judged.published,
    }


def _interval(difference: Estimate | None, digits: int) -> str:
    if difference is None or difference.low is None or difference.high is None:
        return ABSENT
    return f"{difference.low:+.{digits}f} … {difference.high:+.{digits}f}"


def _missing(result: RunResult) -> str:
    return f"{result.name}: {result.state} ({result.reason})"


def _figure(outcome: Outcome) -> bytes | None:
    """Draws the arms' scores with every seed, where any was measured; returns None before any arm has a score."""
    columns = [column for column in _columns(outcome) if any(column.name in arm.spreads for arm in outcome.arms)]
    names = {column.name for column in columns}
    shown = [(arm, {name: value for name, value in arm.spreads.items() if name in names}) for arm in outcome.arms]
    rows = [Row({"": arm.name}, arm.finished, spreads) for arm, spreads in shown if spreads]
    return draw(rows, columns, f"{outcome.claim.place}: {outcome.claim.title}") if rows else None


def _strip(outcome: Outcome) -> UInt8[np.ndarray, "h w 3"] | None:
    """Draws one clip as the first seed of every arm predicts it: the clip that is the median by the first arm's error.

    It is chosen among the clips whose frames all arms kept. Returns None with fewer than two arms, if no frames of the
    same clip were kept, or for a claim about other clips or frames than those of the runs' evaluations.
    """
    if all(each.measurement for each in outcome.claim.comparisons):
        return None
    arms = [(arm.name, arm.finished[0]) for arm in outcome.arms if arm.finished]
    try:
        kept = [(name, read_frames(result.run.output("evaluation").parent)) for name, result in arms]
    except UserError:
        return None
    if len(kept) < 2:
        return None
    rows = reduce(np.intersect1d, [frames["rows"] for _, frames in kept])
    places = [np.searchsorted(frames["rows"], rows) for _, frames in kept]
    truths = [frames["truth"][place] for (_, frames), place in zip(kept, places, strict=True)]
    if not len(rows) or any(not np.array_equal(truths[0], truth) for truth in truths):
        return None
    predictions = [frames["prediction"][place] for (_, frames), place in zip(kept, places, strict=True)]
    error = np.square(predictions[0].astype(float) - truths[0]).mean((1, 2, 3, 4))
    middle = int(np.argsort(error)[len(error) // 2])
    others = tuple((name, frames[middle]) for (name, _), frames in zip(kept, predictions, strict=True))
    title = f"the clip in the middle by {arms[0][0]}'s PSNR, first seed of each"
    prompt = arms[0][1].run.config.prompt_frames
    return filmstrip(ComparedClip(title, truths[0][middle], None, prompt_frames=prompt, others=others))
