"""The soak of the real command, as short as it can be."""

import json
from pathlib import Path

from tests.pipeline.conftest import Commands


def test_a_soak_of_the_main_job_passes_and_says_what_was_survived(
    debug: Path, tmp_path: Path, command: Commands
) -> None:
    out = tmp_path / "soak"
    done = command("experiments.soak", "debug", "--reference", debug, "--out", out, "--minutes", 0.1)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((out / "soak.json").read_text())
    assert "1 of 1 runs ended bit-identical" in done.stdout
    assert found["rounds"][0]["events"]
    assert found["rounds"][0]["starts"] == len(found["rounds"][0]["events"]) + 1
    assert found["bad_record"]["passed"]
    assert "| all | " in (out / "soak.md").read_text()


def test_a_reference_of_another_configuration_is_refused(debug: Path, tmp_path: Path, command: Commands) -> None:
    places = ("--reference", debug, "--out", tmp_path / "soak")
    line = command.refused("experiments.soak", "debug", *places, "--loss.gamma", 4.0)
    assert f"{debug}: holds no finished world_model of this configuration" in line
