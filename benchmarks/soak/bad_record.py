"""An unreadable record: training continues without it, and still resumes exactly.

The damage changes the data, so such runs are compared with each other instead of with the reference.
"""

import json
import math
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.soak.compare import compare_stages, json_lines
from benchmarks.soak.faults import KILL_TRAINING, copy_tree, damage_record
from benchmarks.soak.rounds import Stage, Target, run_round, run_without_faults
from benchmarks.soak.runs import Soak, step_seconds
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import open_store

LEAST_STEPS = 60  # a shorter run of some milliseconds a step mostly ends before it is killed


def try_bad_record(soak: Soak, show: Callable[[str], None]) -> dict[str, Any]:
    """Damages a record in a copy of the reference's tokens, and trains on it twice: left alone, and killed once.

    Both runs have enough steps to read every record once.

    Returns:
        As JSON: the number of the damaged ``record`` in the training split, the numbers that training ``quarantined``,
        the ``differences`` between the two runs, the ``problem`` by which the killed one failed for good (empty if it
        did not), and whether all of it ``passed``.

    Raises:
        SoakError: the run that was left alone failed.
    """
    rng = random.Random(f"{soak.options.seed} record")
    place = soak.out / "bad-record"
    shutil.rmtree(place, ignore_errors=True)
    for stage in soak.all_stages[: soak.all_stages.index("world_model")]:
        copy_tree(soak.reference / stage, place / "whole" / stage)
    record = damage_record(place / "whole" / "tokens" / "store", rng)
    copy_tree(place / "whole", place / "untouched")
    show(f"record {record} of the training split is damaged: two short runs without it")
    whole = _target(soak, place / "whole", 0.0)
    run_without_faults(whole)
    # A run of some milliseconds a step can end before the kill: then again, with the kill nearer to the first step.
    for steps in (3, 1, 0, 0, 0):
        shutil.rmtree(place / "killed", ignore_errors=True)
        copy_tree(place / "untouched", place / "killed")
        killed = _target(soak, place / "killed", steps * step_seconds(whole.trained[0]))
        done = run_round(killed, [KILL_TRAINING], rng, show=show)
        if done.events or done.problem:
            break
    problem = done.problem or ("" if done.events else "the run ended before it could be killed")
    differences = compare_stages(killed.trained[0], whole.trained[0])
    quarantined = sorted(json.loads(line)["record"] for line in json_lines(killed.trained[0], QUARANTINE))
    passed = quarantined == [record] and not differences and not problem
    if passed:
        shutil.rmtree(place)
    return {
        "record": record,
        "quarantined": quarantined,
        "differences": differences,
        "problem": problem,
        "passed": passed,
    }


def _target(soak: Soak, run: Path, interval: float) -> Target:
    records = len(open_store(run / "tokens" / "store").source("train"))
    steps = max(LEAST_STEPS, math.ceil(records / soak.config.train.batch_size) + 1)
    few = () if soak.config.train.curriculum else ("--train.steps", str(steps))
    every = ("--runtime.log-every", "1", "--runtime.checkpoint-every", str(max(1, steps // 4)))
    command = soak.command(run, soak.options.data_dir, *few, *every)
    return Target(command, (Stage(run / "world_model"),), run.with_name(f"{run.name}.log"), interval)
