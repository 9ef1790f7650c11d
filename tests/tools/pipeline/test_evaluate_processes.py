"""One evaluation on several devices and by several processes."""

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rsjax.config import to_dict
from rsjax.data.normalization import Normalization
from rsjax.files import write_json
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.training.checkpoint import save_weights
from tests.tools.pipeline import toy
from tests.tools.pipeline.conftest import printed_by
from tests.training.test_sharding import ROOT, virtual

OPTIONS = ("--overwrite", "--horizon", "5", "--clips", "5", "--action-draws", "1")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of random parameters on a store of clips."""
    base = tmp_path_factory.mktemp("evaluated by several")
    store = toy.store(base / "clips")
    run = Run(on_store(toy.config(), base / "clips"), base / "run", base)
    for stage in ("tokenizer", "world_model", "tokens"):
        (run.directory / stage).mkdir(parents=True)
    save_weights(run.output("tokenizer"), toy.tokenizer_params())
    save_weights(run.output("world_model"), toy.world_model_params(run.config))
    Normalization.create(store).save(run.directory / "tokens")
    write_json(run.directory / "config.json", to_dict(run.config))
    return run


def evaluated_by_several(run: Run, processes: int, devices: int) -> str:
    """What ``experiments.evaluate`` prints, started as so many processes with so many devices each."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    command = [sys.executable, "-m", "experiments.evaluate", str(run.directory), *OPTIONS]
    group = ["--coordinator", address, "--processes", str(processes), "--process-id"]
    pipe: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    started = [
        subprocess.Popen([*command, *group, str(number)], cwd=ROOT, env=virtual(devices), **pipe)
        for number in range(processes)
    ]
    try:
        outputs = [process.communicate(timeout=600) for process in started]
    finally:
        for process in started:
            process.kill()  # where one failed, the other would wait for it
    assert not any(process.returncode for process in started), outputs
    return "".join(out for out, _ in outputs)


def result(printed: str) -> dict[str, Any]:
    """What was written where the command says."""
    lines = [line for line in printed.splitlines() if line.startswith("result: ")]
    assert len(lines) == 1, "the lead process alone says where the result is"
    made: dict[str, Any] = json.loads(Path(lines[0].removeprefix("result: ")).read_text())
    return made


def test_two_processes_with_two_devices_each_score_what_one_scores(run: Run) -> None:
    alone = result(printed_by("experiments.evaluate", run.directory, *OPTIONS))
    together = result(evaluated_by_several(run, 2, 2))
    numbers = {name: value for name, value in alone["metrics"].items() if value is not None}
    assert len(numbers) > 20
    assert {name: together["metrics"][name] for name in numbers} == pytest.approx(numbers, rel=1e-4, abs=1e-4)
    assert together["clips"] == alone["clips"]
