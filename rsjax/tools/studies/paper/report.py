"""Writes the report on all claims: ``report.md``, ``report.html``, ``report.json`` and a figure for each claim."""

import base64
import os
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.devices import device_name
from rsjax.errors import UserError
from rsjax.evaluation.results import read_frames
from rsjax.files import disk_guard, write_file, write_json
from rsjax.progress import duration
from rsjax.tools.studies.compare.page import ComparedClip
from rsjax.tools.studies.paper.claim_tables import LEGEND, claim_content, claim_figure, claim_tables, marked
from rsjax.tools.studies.paper.judge import Outcome
from rsjax.tools.studies.paper.plan import Plan
from rsjax.tools.studies.paper.result_files import provenance, write_claim_result
from rsjax.tools.studies.report.figures import filmstrip
from rsjax.tools.studies.report.page import template_environment
from rsjax.tools.studies.report.video import webp, webp_uri
from rsjax.tools.studies.tables import Table, as_html, as_markdown

RESULTS = "results"  # folder of the claims' files of results


def write_report(out: Path, plan: Plan, outcomes: Sequence[Outcome], command: str) -> Path:
    """Writes the report's files into a directory, and returns the path of the HTML page.

    Raises:
        FileError: the disk is full.
    """
    content = {
        "command": command,
        **_summary(plan, outcomes),
        "legend": LEGEND,
        "claims": [claim_content(each) for each in outcomes],
    }
    tables = [claim_tables(claim) for claim in content["claims"]]
    rows = []
    for claim in content["claims"]:
        counts = list(claim["counts"].values())
        missing = len(claim["comparisons"]) - sum(counts)
        rows.append([claim["title"], claim["place"], marked(claim["verdict"]), *map(str, counts), str(missing)])
    head = ["claim", "place", "verdict", "comparisons: hold", "do not", "are equal", "cannot tell", "not measured"]
    overview = Table(head, rows)
    environment = template_environment("rsjax.tools.studies.paper")
    environment.autoescape = lambda name: bool(name) and "html" in str(name)
    with disk_guard(out):
        figures: dict[str, str] = {}
        strips: dict[str, str] = {}
        for outcome in outcomes:
            picture = claim_figure(outcome)
            if picture is not None:
                figures[outcome.claim.name] = base64.b64encode(picture).decode()
                write_file(out / "figures" / f"{outcome.claim.name}.png", picture)
            strip = _strip(outcome)
            if strip is not None:
                strips[outcome.claim.name] = webp_uri(strip)
                write_file(out / "figures" / f"{outcome.claim.name}-clip.webp", webp(strip))
        write_json(out / "report.json", content)
        about = {name: content[name] for name in ("command", "preset", "budget", "sizes")}
        for outcome in outcomes:
            runs = [result.run for arm in outcome.arms for result in arm.finished]
            if runs:
                write_claim_result(out / RESULTS / f"{outcome.claim.name}.json", outcome, about | provenance(runs))
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
        "made": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {device_name()}, {os.cpu_count()} cores",
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
