"""Files of results of single runs: the scores of trainings of one configuration, and the table that shows them.

A file of kind "run" has the scores of each run over its held-out clips, and those of each clip.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import require
from rsjax.errors import UserError
from rsjax.evaluation.registry import metrics
from rsjax.evaluation.statistics import score_interval
from rsjax.files import write_file
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper.arm_scores import CLIP_DIGITS, SEED_DIGITS, rounded
from rsjax.tools.studies.paper.result_files import as_text, provenance
from rsjax.tools.studies.results import read_metrics, read_per_clip, spread
from rsjax.tools.studies.tables import Table, mean_text

KIND = "run"
COLUMNS = (
    "psnr",
    "psnr_motion",
    "delta_psnr",
    "ssim",
    "lpips_alex",
    "depth_absrel",
    "cube_error_widths",
    "gripper_error_widths",
)
HEADLINE = ("psnr", "psnr_motion", "delta_psnr", "depth_absrel")  # the columns of the README's table
LIFTED = "lifted_accuracy"
PROBES = (
    "contact_false_success",
    "contact_false_failure",
    "contact_brier",
    "drive_gripper_error_widths",
    "drive_psnr",
)
OF_A_SEED = ("seed", "store", "key", "start_from")
ROWS = {
    "": "prediction",
    "_repeat_first": "first frame repeated",
    "_tokenizer": "tokenizer's reconstruction",
    "_truth": "true frames",
}


def write_runs(path: Path, runs: Sequence[Run]) -> None:
    """Writes the scores of finished runs that differ in nothing but their seeds and the split of their recordings.

    Raises:
        UserError: a run is not finished, or two differ in more.
    """
    names = [f"{name}{suffix}" for name in (*COLUMNS, LIFTED, *PROBES) for suffix in ROWS]
    scores = []
    for run in runs:
        measured = read_metrics(run)
        if measured is None:
            raise UserError(f"{run.directory}: not a finished run; finish it with rsjax train")
        require(
            _without_seeds(asdict(run.config)) == _without_seeds(asdict(runs[0].config)),
            f"{run.directory} has another configuration than {runs[0].directory}; give runs that differ in their seeds",
        )
        per_clip = read_per_clip(run)
        clips = {name: [rounded(x, CLIP_DIGITS) for x in per_clip[name]] for name in names if name in per_clip}
        numbers = {name: rounded(measured[name], SEED_DIGITS) for name in names if name in measured}
        scores.append({"seed": run.config.train.seed, "metrics": numbers, "clips": clips})
    about = {"kind": KIND, "preset": runs[0].config.name}
    write_file(path, as_text(about | provenance(runs) | {"runs": scores}).encode())


def _without_seeds(value: Any) -> Any:
    """Returns a configuration, or a part of one, without its seeds and what names its directories."""
    if isinstance(value, dict):
        return {name: _without_seeds(part) for name, part in value.items() if name not in OF_A_SEED}
    return value


def run_tables(content: Mapping[str, Any]) -> dict[str, Table]:
    """Returns the tables of a file: "scores", "headline" (a few of their columns) and, with probes, "contacts".

    Their rows are the prediction and what it is compared with, as means over the runs. The share of clips in which
    "lifted" is read correctly has Wilson's interval over the clips; runs on the same clips do not make it narrower.
    """
    measured = {name for run in content["runs"] for name in run["metrics"]}
    tables = {
        "scores": _table(content, [name for name in COLUMNS if name in measured], LIFTED in measured),
        "headline": _table(content, [name for name in HEADLINE if name in measured], lifted=False),
    }
    if probes := [name for name in PROBES if name in measured]:
        tables["contacts"] = _table(content, probes, lifted=False)
    return tables


def _table(content: Mapping[str, Any], shown: Sequence[str], lifted: bool) -> Table:
    known = metrics()
    runs = content["runs"]
    head = ["", *(known[name].heading for name in shown)]
    if lifted:
        head.append('"lifted" read correctly, 95 % interval')
    rows = []
    for suffix, label in ROWS.items():
        cells = [label]
        for name in shown:
            values = [run["metrics"][f"{name}{suffix}"] for run in runs if f"{name}{suffix}" in run["metrics"]]
            cells.append(mean_text(spread(values), known[name].decimals) if values else "")
        if lifted:
            right = np.array([x for run in runs for x in run["clips"].get(f"{LIFTED}{suffix}", ())])
            text = ""
            if right.size:
                of_clips = {tuple(run["clips"]["psnr_repeat_first"]) for run in runs}  # alike in runs on the same clips
                share = score_interval(float(right.mean()), right.size * len(of_clips) / len(runs))
                text = f"{share.value:.0%} ({share.low:.0%} … {share.high:.0%})".replace("%", " %")
            cells.append(text)
        if any(cells[1:]):
            rows.append(cells)
    return Table(head, rows)


def about_runs(content: Mapping[str, Any]) -> str:
    """Returns how many runs and clips a file's table is of, and where they are from."""
    runs = content["runs"]
    clips = " and ".join(str(len(run["clips"]["psnr"])) for run in runs)
    seeds = ", ".join(str(run["seed"]) for run in runs)
    commits = ", ".join(commit[:7] for commit in content["commits"])
    return (
        f"Preset `{content['preset']}`, {len(runs)} run{'s' * (len(runs) > 1)} (seed {seeds}), {clips} held-out clips; "
        f"commit {commits}; {', '.join(content['machines'])}; {content['dates']}."
    )
