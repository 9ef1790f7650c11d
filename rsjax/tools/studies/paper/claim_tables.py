"""Shows the outcome of a claim: its texts and numbers, its tables, and its figure, for reports and for documents."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from rsjax.evaluation.registry import Metric, metrics
from rsjax.evaluation.statistics import Estimate, Verdict
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.paper.arm_scores import BASELINES, CEILING, ArmScores
from rsjax.tools.studies.paper.judge import Judged, Outcome
from rsjax.tools.studies.report.score_charts import PLACE_SCENES
from rsjax.tools.studies.tables import ABSENT, CellText, Marked, Table, mean_text, number_text, p_text

LEGEND = (
    "Differences are of means (or medians) over clips and seeds. The interval is the wider of two: the one from "
    "resampling seeds and clips, and that of a t-test over the seeds (Welch's, or a paired one if each seed has its "
    "own clips). p is the test's, adjusted by Holm's method for the comparisons of the claim. A comparison holds, "
    "or does not hold, if the interval and p < 0.05 agree. It is equal within the margin that it names if the 90 % "
    "interval lies within it and both one-sided tests, adjusted likewise, have p < 0.05. Otherwise it cannot be "
    "told. A claim holds if all its comparisons that were measured do; it does not hold if any does not, or if "
    "sides are equal and nothing is open. With one seed there is no verdict."
)
EQUAL = {
    "steps": "equal steps of the world model",
    "seconds": "equal estimated seconds of training, autoencoders included",
    "flops": "equal operations of training, autoencoders included",
}
MISSING = "not measured"
COSTS = ["trained parameters", "steps", "TFLOP", "minutes"]


def claim_content(outcome: Outcome) -> dict[str, Any]:
    """Returns a claim's part of the report, JSON-ready, with texts as the pages show them."""
    claim = outcome.claim
    columns = _columns(outcome)
    return {
        "name": claim.name,
        "title": claim.title,
        "statement": claim.statement,
        "place": claim.place,
        "notes": claim.notes,
        "caption": caption(outcome),
        "verdict": verdict_words(outcome.verdict),
        "counts": outcome.counts,
        "header": [column.heading for column in columns],
        "beside": ["PSNR of the reconstruction"] * bool(columns) + list(claim.beside),
        "published_header": [column.heading for column in _published_columns(outcome)],
        "arms": [_arm(arm, outcome, columns) for arm in outcome.arms],
        "baselines": _baselines(outcome, columns),
        "published": any(arm.published for arm in claim.arms),
        "comparisons": [_comparison(each) for each in outcome.judged],
        "missing": [
            f"{result.name}: {result.state} ({result.reason})"
            for arm in outcome.arms
            for result in arm.results
            if result.state != "finished"
        ],
    }


def caption(outcome: Outcome) -> str:
    """Says what the compared trainings have in common, and what differs between the seeds of an arm."""
    own_clips = any(len(set(arm.clips)) > 1 for arm in outcome.arms)
    vary = "the training of the world model alone"
    if own_clips:
        vary = "clips, tokenizer and world model"
    seeds = sorted({len(arm.seeds) for arm in outcome.arms})
    if seeds == [1]:
        return f"Compared at {EQUAL[outcome.claim.equal]}; one seed."
    counts = " to ".join(map(str, dict.fromkeys([seeds[0], seeds[-1]])))
    return f"Compared at {EQUAL[outcome.claim.equal]}; {counts} seeds, which vary {vary}."


def verdict_words(verdict: Verdict, margin: float = 0.0, unit: str = "") -> str:
    """Returns a verdict as the tables say it: "equal" with its margin."""
    if verdict == "equal" and margin:
        return f"equal within {margin:g} {unit}".rstrip()
    return verdict


def marked(verdict: str, remark: str = "") -> Marked:
    """Returns a verdict as the cell of a table."""
    marks: dict[str, Literal["met", "missed"]] = {"holds": "met", "does not hold": "missed"}
    return Marked(verdict, marks.get(verdict, ""), remark)


def claim_tables(claim: Mapping[str, Any]) -> dict[str, Table]:
    """Makes a claim's tables: its arms with both baselines, the comparisons, and the paper's numbers, if it has any.

    Args:
        claim: its :func:`claim_content`.
    """
    arms = []
    for arm in claim["arms"]:
        costs = [arm[name] or "" for name in ("parameters", "steps", "tflop", "minutes")]
        arms.append([arm["name"], arm["seeds"], *arm["scores"], *arm["beside"], *map(str, costs)])
    for baseline in claim["baselines"]:
        blank = [""] * (len(claim["beside"]) + len(COSTS))
        arms.append([Marked(text, "note") for text in (baseline["name"], "", *baseline["scores"], *blank)])
    tables = {"arms": Table(["", "seeds", *claim["header"], *claim["beside"], *COSTS], arms)}

    comparisons: list[list[CellText]] = []
    for each in claim["comparisons"]:
        metric = ", ".join(filter(None, (each["metric"], each["where"])))
        row = [each["what"], metric, each["sides"] or "", each["difference"], each["interval"], each["p"] or ""]
        row += [each["published"] or "", ", ".join(map(str, each["seeds"])), str(each["clips"])]
        comparisons.append([*row, marked(each["verdict"], each["reason"])])
    head = ["compared", "by", "scores", "difference", "95 % interval", "p by Holm", "the paper's"]
    tables["comparisons"] = Table([*head, "seeds", "clips", "verdict"], comparisons)
    if claim["published"]:
        published = [[arm["name"], *arm["published"]] for arm in claim["arms"]]
        tables["published"] = Table(["", *claim["published_header"]], published)
    return tables


def claim_figure(outcome: Outcome, source: str = "") -> bytes | None:
    """Draws the arms' scores with every seed, where any was measured; returns None before any arm has a score.

    Args:
        source: what the picture is made of, for its metadata.
    """
    columns = [column for column in _columns(outcome) if any(column.name in arm.spreads for arm in outcome.arms)]
    names = {column.name for column in columns}
    shown = [arm for arm in outcome.arms if names & set(arm.spreads)]
    if not shown:
        return None
    return draw(shown, columns, f"{outcome.claim.place}: {outcome.claim.title}", source)


def _columns(outcome: Outcome) -> list[Metric]:
    """Returns the metrics of the arms' own evaluations that a claim compares or shows."""
    compared = [each.metric for each in outcome.claim.comparisons if not each.measurement]
    return _known([*compared, *outcome.claim.shown])


def _published_columns(outcome: Outcome) -> list[Metric]:
    return _known([each.metric for each in outcome.claim.comparisons])


def _known(names: Sequence[str]) -> list[Metric]:
    known = metrics()
    return [known[name] for name in dict.fromkeys(names) if name in known]


def _arm(arm: ArmScores, outcome: Outcome, columns: Sequence[Metric]) -> dict[str, Any]:
    published = outcome.claim.arm(arm.name).published
    spreads = arm.spreads
    means = {name: spread.mean for name, spread in spreads.items()}
    beside = [CEILING] * bool(columns) + list(outcome.claim.beside)
    return {
        "name": arm.name,
        "absent": arm.absent,
        "seeds": f"{len(arm.seeds)} of {arm.planned}",
        "failed": sum(result.state == "failed" for result in arm.results),
        "scores": [mean_text(spreads.get(c.name), c.decimals, len(arm.seeds)) for c in columns],
        "published": [number_text(published.get(c.name), f".{c.decimals}f") for c in _published_columns(outcome)],
        "values": {name: spread._asdict() for name, spread in spreads.items()},
        "beside": [number_text(means.get(name), ".3g") for name in beside],
        "steps": arm.steps,
        "parameters": arm.parameters,
        "tflop": arm.tflop,
        "minutes": arm.minutes,
        "runs": [str(result.run.directory) for result in arm.results],
    }


def _baselines(outcome: Outcome, columns: Sequence[Metric]) -> list[dict[str, Any]]:
    """Returns the scores of first frame repeated, reconstruction and true frames, from the first arm that has any."""
    first = next((arm for arm in outcome.arms if arm.seeds), None)
    if first is None:
        return []
    of = {"_tokenizer": f" of {first.name}"}
    means = {name: spread.mean for name, spread in first.spreads.items()}
    rows = []
    for suffix in BASELINES:
        names = [f"{column.name}{suffix}" for column in columns]
        if any(name in means for name in names):
            texts = [
                number_text(means.get(name), f".{column.decimals}f")
                for name, column in zip(names, columns, strict=True)
            ]
            rows.append({"name": PLACE_SCENES[suffix] + of.get(suffix, ""), "scores": texts})
    return rows


def _comparison(judged: Judged) -> dict[str, Any]:
    compared = judged.comparison
    metric = judged.metric
    digits = metric.decimals
    own = compared.score or compared.metric
    other = compared.than_score or compared.metric
    sides = (compared.better, compared.than)
    if compared.better == compared.than:
        sides = (own, other)
    verdict = MISSING
    if judged.difference is not None:
        verdict = verdict_words(judged.verdict, compared.equal_margin, metric.unit)
    interval = ABSENT
    difference = judged.difference
    if difference is not None and difference.low is not None and difference.high is not None:
        interval = f"{difference.low:+.{digits}f} … {difference.high:+.{digits}f}"
    numbers = _numbers(judged)
    return {
        "what": f"{sides[0]} − {sides[1]}",
        "metric": metric.heading,
        "where": compared.measurement,
        "margin": compared.margin,
        "sides": None if judged.sides is None else " / ".join(f"{side:.{digits}f}" for side in judged.sides),
        "difference": number_text(numbers["difference"], f"+.{digits}f"),
        "interval": interval,
        "p": None if judged.p is None else p_text(judged.p),
        "published": None if judged.published is None else f"{judged.published:+.{digits}f}",
        "seeds": list(judged.seeds),
        "clips": judged.clips,
        "verdict": verdict,
        "reason": judged.reason,
        "values": numbers,
    }


def _numbers(judged: Judged) -> dict[str, Any]:
    """Returns the unrounded numbers of a comparison; the texts of the report are rounded."""
    numbers: dict[str, Any] = dict.fromkeys(("sides", "difference", "test_low", "test_high", "p_alone"))
    if judged.sides is not None:
        numbers["sides"] = list(map(float, judged.sides))
    if judged.difference is not None:
        numbers["difference"] = judged.difference.value
    if judged.test is not None:
        numbers["test_low"] = judged.test.difference.low
        numbers["test_high"] = judged.test.difference.high
        numbers["p_alone"] = judged.test.p_of(judged.shift)
    nothing = Estimate(math.nan, None, None)
    decides = judged.difference or nothing
    resampled = judged.resampled or nothing
    inner = judged.inner or nothing
    return numbers | {
        "low": decides.low,
        "high": decides.high,
        "resampled_low": resampled.low,
        "resampled_high": resampled.high,
        "low_90": inner.low,
        "high_90": inner.high,
        "p": judged.p,
        "equal_margin": judged.comparison.equal_margin,
        "equal_p": judged.equal_p,
        "published": judged.published,
    }
