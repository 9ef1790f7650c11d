"""Runs cases in this process: reads their names, one a line, and writes how each ended as a line of JSON.

``python -m benchmarks.hostile.worker MATERIAL``. Where a command has passed its checks and begins to train, generate,
simulate or serve, a stand-in ends it, so that thousands of commands take minutes.
"""

import json
import os
import shutil
import sys
import tempfile
import traceback
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from benchmarks.hostile.cases import Began, Ended, Place, verdict
from rsjax.runtime import HUGE_PAGES

# Functions at which work begins.
WORK = (
    "rsjax.training.loop:fit",
    "rsjax.tools.sim.collect:collect",
    "rsjax.tools.sim.collect:make_store",
    "rsjax.tools.export.demonstrations:TabletopSim",
    "rsjax.tools.finetune.recipe:measure_tokenizer",
    "rsjax.tools.policies.worlds.simulator_world:SimulatorWorld.lift",
    "rsjax.tools.policies.judges.trained_judge:train_judge",
    "rsjax.evaluation.evaluate:evaluate",
    "rsjax.models.roboscape.model:RoboScape.generate",
    "rsjax.models.roboscape.model:RoboScape.plan",
    "rsjax.tools.play.serve:prepare",
    "rsjax.tools.bench.run:measure_part",
    "rsjax.tools.ingest.ingest:ingest",
    "rsjax.tools.studies.paper.run:run_plan",
)


def main() -> None:
    """Runs cases until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print goes to the log
    os.environ["GLIBC_TUNABLES"] = HUGE_PAGES  # otherwise a command would restart the process
    os.environ["JAX_PLATFORMS"] = "cpu"
    warnings.simplefilter("ignore")
    stand_in()
    remembering = remember_weights()
    from benchmarks.hostile.table import all_cases

    table = {case.name: case for case in all_cases()}
    material = Path(sys.argv[1])
    os.chdir(material)
    for line in sys.stdin:
        case = table[json.loads(line)]
        remembering[0] = not case.name.startswith("files: ")
        scratch = Path(tempfile.mkdtemp(dir=material.parent, prefix="scratch-"))
        try:
            ended = case.act(Place(material, scratch))
        except Exception:  # of the case itself
            ended = Ended("broke", traceback.format_exc())
        shutil.rmtree(scratch, ignore_errors=True)
        print(
            json.dumps({"verdict": verdict(case, ended), "kind": ended.kind, "text": ended.text[-4000:]}),
            file=answers,
            flush=True,
        )


def stand_in() -> None:
    """Replaces the functions at which work begins, and those that would end or replace this process."""
    for name in WORK:
        module, _, path = name.partition(":")
        owner: Any = import_module(module)
        *classes, last = path.split(".")
        for each in classes:
            owner = getattr(owner, each)
        setattr(owner, last, _began(last))
    command: Any = import_module("rsjax.command")
    command.exit_now = _exit
    os.execve = _began("execve")  # type: ignore[assignment]


def remember_weights() -> list[bool]:
    """Lets commands read the same weights once only, while the list that is returned holds True."""
    load_run: Any = import_module("rsjax.models.load_run")
    read = load_run.load_part
    kept: dict[tuple[str, str], Any] = {}
    remembering = [True]

    def load_part(directory: Path, part: str, like: Any) -> Any:
        if not remembering[0]:
            return read(directory, part, like)
        place = (str(directory.absolute()), part)
        if place not in kept:
            kept[place] = read(directory, part, like)
        return kept[place]

    load_run.load_part = load_part
    return remembering


def _began(name: str) -> Any:
    def began(*_: Any, **__: Any) -> NoReturn:
        raise Began(name)

    return began


def _exit(status: int) -> NoReturn:
    raise SystemExit(status)


if __name__ == "__main__":
    main()
