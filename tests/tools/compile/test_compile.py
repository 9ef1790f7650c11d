"""Compiles for accelerators that are not here; skipped without the compilers (make accelerators-test)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("jax_cuda13_plugin", reason="needs the compilers: make accelerators-test")

ROOT = Path(__file__).parents[3]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs a module with none of the tests' flags for XLA."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")
    }
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_no_program_has_become_more_expensive() -> None:
    done = run("scripts.compiled")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("line", "devices"),
    [
        ("roboscape_agibot --target a100x2 --model.blocks 1 --train.batch-size 4", 2),
        # Collectives are fused with kernels, so that jax cannot read the program back.
        ("debug --target v5p-8 --train.batch-size 8 --runtime.sharding mesh --runtime.fsdp 4", 4),
    ],
)
def test_the_figures_of_a_step_are_written_and_shown(tmp_path: Path, line: str, devices: int) -> None:
    out = tmp_path / "numbers.json"
    dump = tmp_path / "program.txt"
    done = run("experiments.compile", *line.split(), "--json", str(out), "--dump", str(dump))
    assert done.returncode == 0, done.stderr
    numbers = json.loads(out.read_text())
    assert numbers["devices"] == devices and numbers["fits"] and not numbers["warnings"]
    assert sum(each["bytes"] for each in numbers["collectives"].values()) > numbers["state_bytes"] / 4
    assert 0 < numbers["roofline_mfu"] < 1
    assert numbers["clips_per_s"] == pytest.approx(2 * devices / (numbers["roofline_s"] + numbers["exposed_s"]))
    assert "not a measurement" in done.stdout and "ENTRY" in dump.read_text()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("debug --target h100x8 --train.batch-size 12 --runtime.sharding mesh", ["12 does not divide over 8 devices"]),
        (
            "roboscape_s --model.blocks 2 --train.batch-size 512 --target rtx4090",
            ["roboscape_s: training step on 512 clips needs", "--train.batch-size"],
        ),
    ],
)
def test_what_cannot_run_is_one_line(line: str, words: list[str]) -> None:
    done = run("experiments.compile", *line.split())
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ") and all(word in last for word in words)
