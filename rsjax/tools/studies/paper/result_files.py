"""Files of results: what a study measured for a claim, from which documents make their tables and figures.

``NAME.json`` has the claim, where and how it was measured, and its arms with the scores of every seed and clip. If it
would be larger than :data:`MOST_BYTES`, the clips' scores are in ``NAME.npz`` beside it.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.files import FileError, read_json, write_file
from rsjax.tools.pipeline.provenance import read_starts
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper.arm_scores import CLIP_DIGITS, ArmScores, ScoreRows, merge_arms, rounded
from rsjax.tools.studies.paper.claim import Arm, ArmComparison, Claim
from rsjax.tools.studies.paper.judge import Outcome, judge_claim

KIND = "measured"
MOST_BYTES = 300_000
OF_CLAIM = ("name", "title", "statement", "place", "notes", "shown", "beside")


def write_claim_result(path: Path, outcome: Outcome, about: Mapping[str, Any], most: int = MOST_BYTES) -> None:
    """Writes what was measured for a claim.

    Args:
        path: of the JSON file.
        about: the command and the sizes of the study, and its :func:`provenance`.
        most: the size from which the clips' scores are written beside it.

    Raises:
        FileError: the disk is full.
    """
    claim = outcome.claim
    content: dict[str, Any] = {"kind": KIND, **about}
    content["claim"] = {name: getattr(claim, name) for name in OF_CLAIM}
    content["claim"]["comparisons"] = [asdict(each) for each in claim.comparisons]
    content["arms"] = []
    for each in outcome.arms:
        values = {field.name: getattr(each, field.name) for field in fields(ArmScores) if field.name != "results"}
        values["scores"] = {}
        for source, by_name in each.scores.items():
            values["scores"][source] = {}
            for name, clips in by_name.items():
                rows = [[None if np.isnan(value) else value for value in row] for row in clips.rows]
                values["scores"][source][name] = {"rows": rows, "reason": clips.reason}
        of_claim = claim.arm(each.name)
        values |= {"equal": of_claim.equal, "published": dict(of_claim.published)}
        content["arms"].append(values)
    text = as_text(content)
    path.with_suffix(".npz").unlink(missing_ok=True)
    if len(text) > most:
        arrays: dict[str, Any] = {}
        for arm in content["arms"]:
            for source, scores in arm["scores"].items():
                for name, scored in scores.items():
                    for number, row in enumerate(scored["rows"]):
                        # As float32: the digits that are kept do not need more, and reading rounds to them again.
                        arrays[json.dumps([arm["name"], source, name, number])] = np.array(row, np.float32)
                    scored["rows"] = len(scored["rows"])
        buffer = BytesIO()
        np.savez_compressed(buffer, **arrays)
        write_file(path.with_suffix(".npz"), buffer.getvalue())
        text = as_text(content)
    write_file(path, text.encode())


def read_claim_result(path: Path) -> Outcome:
    """Reads a file of results, and judges the claim anew.

    Raises:
        FileError: the file is missing, damaged or of another version.
    """
    content = read_json(path)
    try:
        arms = content["arms"]
        claim = Claim(
            **content["claim"]
            | {
                "arms": tuple(Arm(arm["name"], equal=arm["equal"], published=arm["published"]) for arm in arms),
                "comparisons": tuple(ArmComparison(**each) for each in content["claim"]["comparisons"]),
                "notes": tuple(content["claim"]["notes"]),
                "shown": tuple(content["claim"]["shown"]),
            }
        )
        return judge_claim(claim, [_arm_scores(arm, path.with_suffix(".npz")) for arm in arms])
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path}: damaged or of another version ({error!r}); add it again from its study") from error


def merge_claim_result(path: Path, study: Path) -> None:
    """Adds the trainings of a study's file to a file of results of the same claim.

    A study may be divided among machines by its seeds. Where both files have a training with the same seed, the study's
    counts.

    Raises:
        FileError: a file is missing or damaged, or the two differ in what they compare, or in the preset or sizes of
            trainings.
    """
    ours = read_claim_result(path)
    theirs = read_claim_result(study)
    before = read_json(path)
    after = read_json(study)
    for what, one, other in (
        ("presets", before["preset"], after["preset"]),
        ("claims", before["claim"]["comparisons"], after["claim"]["comparisons"]),
        ("arms", [arm["name"] for arm in before["arms"]], [arm["name"] for arm in after["arms"]]),
        ("sizes of trainings", before["sizes"], after["sizes"]),
    ):
        if one != other:
            raise FileError(
                f"{study}: its {what} differ from those of {path}; add it without --merge or by another --name"
            )
    arms = [merge_arms(one, other) for one, other in zip(ours.arms, theirs.arms, strict=True)]
    for arm in arms:
        if 1 < len(set(arm.clips)) < len(arm.clips):
            raise FileError(
                f"{study}: its seeds share their clips and those of {path} do not, or the other way round (--vary); "
                f"add it without --merge or by another --name"
            )
    about = {name: after[name] for name in ("command", "preset", "budget", "sizes")}
    about |= {name: list(dict.fromkeys([*before[name], *after[name]])) for name in ("commits", "machines")}
    days = sorted(day for content in (before, after) for day in content["dates"].split(" to "))
    about["dates"] = " to ".join(dict.fromkeys([days[0], days[-1]]))
    write_claim_result(path, judge_claim(theirs.claim, arms), about)


def about_result(path: Path) -> str:
    """Returns where a file's numbers are from: commit, machine and date."""
    content = read_json(path)
    commits = [commit[:7] for commit in content["commits"]]
    parts = [f"commit {', '.join(commits)}" if commits else "", ", ".join(content["machines"]), content["dates"]]
    return "; ".join(part for part in parts if part)


def claim_result_key(path: Path) -> str:
    """Returns a hash of a file of results and of the scores beside it."""
    digest = hashlib.sha256(path.read_bytes())
    beside = path.with_suffix(".npz")
    if beside.exists():
        digest.update(beside.read_bytes())
    return digest.hexdigest()[:16]


def provenance(runs: Sequence[Run]) -> dict[str, Any]:
    """Returns the commits, machines and dates of the starts of some runs."""
    starts = [start for run in runs for start in read_starts(run.directory)]
    known = [start["code"] for start in starts if start["code"]["revision"]]  # None outside a checkout
    commits = [f"{code['revision']}{' with changes' * bool(code['dirty'])}" for code in known]
    machines = [f"{s['machine']['cpu_cores']} cores, {s['machine']['device_kind']}" for s in starts]
    days = sorted({start["time"][:10] for start in starts})
    return {
        "commits": list(dict.fromkeys(commits)),
        "machines": list(dict.fromkeys(machines)),
        "dates": " to ".join(dict.fromkeys([*days[:1], *days[-1:]])),
    }


def _arm_scores(content: Mapping[str, Any], beside: Path) -> ArmScores:
    """Returns an arm from its JSON, and from the file beside it."""
    names = {field.name for field in fields(ArmScores)} - {"results"}
    scores: dict[str, dict[str, ScoreRows]] = {}
    for source, by_name in content["scores"].items():
        scores[source] = {}
        for name, scored in by_name.items():
            rows = scored["rows"]
            if isinstance(rows, int):
                with np.load(beside) as arrays:
                    keys = [json.dumps([content["name"], source, name, number]) for number in range(rows)]
                    rows = [[rounded(float(value), CLIP_DIGITS) for value in arrays[key]] for key in keys]
            numbers = tuple(tuple(np.nan if value is None else float(value) for value in row) for row in rows)
            scores[source][name] = ScoreRows(numbers, scored["reason"])
    values = {name: content[name] for name in names} | {"scores": scores}
    return ArmScores(**values | {name: tuple(values[name]) for name in ("seeds", "trainings", "clips")})


def as_text(content: Mapping[str, Any]) -> str:
    """Returns JSON with a line for each entry of the outer two levels of objects, so that differences can be read."""
    lines = []
    for key, value in content.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            inner = ",\n  ".join(json.dumps(each, ensure_ascii=False) for each in value)
            lines.append(f' "{key}": [\n  {inner}\n ]')
        else:
            lines.append(f' "{key}": {json.dumps(value, ensure_ascii=False)}')
    return "{\n" + ",\n".join(lines) + "\n}\n"
