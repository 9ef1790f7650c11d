"""A grid for real, through the command."""

import json
from pathlib import Path

from rsjax.training.log import read_log
from tests.tools.pipeline.conftest import Commands


def test_a_cell_is_the_run_that_its_configuration_makes_alone(debug: Path, command: Commands, tmp_path: Path) -> None:
    """The cell whose values are the preset's own scores as the preset's run does; the other one has no such terms."""
    out = tmp_path / "grid"
    done = command(
        "experiments.ablation", "debug", "--grid", "model.loss.use_keypoints=True,False", "--seeds", 0, "--out", out
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| True | 1/1 |" in " ".join(done.stdout.split())
    same, other = (out / f"model.loss.use_keypoints={on},seed=0" for on in (True, False))
    metrics = [json.loads((run / "metrics.json").read_text()) | {"seconds_total": 0} for run in (debug, same, other)]
    assert metrics[0] == metrics[1] != metrics[2]
    logs = [{name for row in read_log(run / "world_model") for name in row} for run in (debug, same, other)]
    assert logs[0] == logs[1] == logs[2] | {"keypoint", "attention"}
    table = json.loads((out / "table.json").read_text())
    assert [cell["metrics"]["psnr"] for cell in table["cells"]] == [metrics[1]["psnr"], metrics[2]["psnr"]]
    assert all((run / "report.html").exists() for run in (same, other))
