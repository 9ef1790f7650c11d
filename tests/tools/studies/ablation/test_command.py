"""A grid for real, through the command."""

import json
import shutil
from pathlib import Path

from rsjax.training.log import read_log
from tests.tools.pipeline.conftest import Commands


def test_a_cell_is_the_run_that_its_configuration_makes_alone(debug: Path, command: Commands, tmp_path: Path) -> None:
    """The cell whose values are the preset's own scores as the preset's run does; a tokenizer lies beside it."""
    out = tmp_path / "grid"
    shutil.copytree(debug / "tokenizer", out / "beside" / "tokenizer", symlinks=True)
    grid = "model.loss.keypoints=printed"
    told = command.here("experiments.ablation", "debug", "--grid", grid, "--seeds", 0, "--out", out)
    assert not list((out / "shared").glob("tokenizer*"))
    assert "| printed | 1/1 |" in " ".join(told.split())
    cell = out / f"{grid},seed=0"
    metrics = [json.loads((run / "metrics.json").read_text()) | {"seconds_total": 0} for run in (debug, cell)]
    assert metrics[0] == metrics[1]
    logs = [{name for row in read_log(run / "world_model") for name in row} for run in (debug, cell)]
    assert logs[0] == logs[1] >= {"keypoint", "attention"}
    table = json.loads((out / "table.json").read_text())
    assert [row["metrics"]["psnr"] for row in table["cells"]] == [metrics[1]["psnr"]]
    assert (cell / "report.html").exists()
