"""The shortest possible soak of the real command."""

import json
from pathlib import Path

from tests.tools.pipeline.conftest import Commands


def test_a_soak_of_the_main_job_passes_and_lists_what_was_survived(
    debug: Path, tmp_path: Path, command: Commands
) -> None:
    out = tmp_path / "soak"
    done = command("benchmarks.soak", "debug", "--reference", debug, "--out", out, "--minutes", 0.1)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads((out / "soak.json").read_text())
    assert "1 of 1 runs ended bit-identical" in done.stdout
    assert result["rounds"][0]["events"]
    assert result["rounds"][0]["starts"] == len(result["rounds"][0]["events"]) + 1
    assert result["bad_record"]["passed"]
    assert "| all | " in (out / "soak.md").read_text()


def test_a_reference_of_another_configuration_is_refused(debug: Path, tmp_path: Path, command: Commands) -> None:
    places = ("--reference", debug, "--out", tmp_path / "soak")
    line = command.refused("benchmarks.soak", "debug", *places, "--model.loss.gamma", 4.0)
    assert f"{debug}: holds no finished world_model of this configuration" in line
