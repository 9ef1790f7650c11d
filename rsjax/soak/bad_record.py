"""A record of the data that cannot be read: training goes on without it, and still resumes exactly.

Damage changes the data, so such runs are held against each other and not against the reference.
"""

import json
import math
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import open_store
from rsjax.soak.compare import compare_stages, listed
from rsjax.soak.disturb import KILL_TRAINING, copy_tree, damage_record
from rsjax.soak.rounds import Stage, Target, run_round
from rsjax.soak.runs import Plan, run_through, step_seconds

GIVEN = ("collect", "tokenizer", "tokens")


@dataclass(frozen=True)
class Trial:
    """What became of it.

    Attributes:
        record: the damaged one's number in the training split.
        quarantined: the numbers of those that training put aside.
        differences: between a run that was killed on the way and one that was not.
        problem: how a run failed for good; empty where none did.
    """

    record: int
    quarantined: tuple[int, ...]
    differences: tuple[str, ...]
    problem: str

    @property
    def passed(self) -> bool:
        return self.quarantined == (self.record,) and not self.differences and not self.problem

    def told(self) -> dict[str, Any]:
        """All of it as JSON."""
        lists = {"quarantined": list(self.quarantined), "differences": list(self.differences)}
        return {"record": self.record, "problem": self.problem, "passed": self.passed, **lists}


def try_bad_record(plan: Plan, say: Callable[[str], None]) -> Trial:
    """Damages one record of a copy of the reference's tokens, and trains on it twice: left alone, and killed once.

    Both runs have as few steps as read every record once.

    Raises:
        SoakError: the run that was left alone failed.
    """
    rng, place = random.Random(f"{plan.seed} record"), plan.out / "bad-record"
    shutil.rmtree(place, ignore_errors=True)
    for stage in GIVEN:
        copy_tree(plan.reference / stage, place / "whole" / stage)
    record = damage_record(place / "whole" / "tokens" / "store", rng)
    copy_tree(place / "whole", place / "killed")
    say(f"record {record} of the training split is damaged: two short runs on what is left")
    whole, killed = (_target(plan, place / name) for name in ("whole", "killed"))
    run_through(whole)
    seconds = step_seconds(whole.trained[0])
    done = run_round(replace(killed, interval=3 * seconds), iter([KILL_TRAINING]), rng, math.inf, say)
    trial = Trial(
        record,
        tuple(sorted(json.loads(line)["record"] for line in listed(killed.trained[0], QUARANTINE))),
        tuple(compare_stages(killed.trained[0], whole.trained[0])),
        done.problem or ("" if done.events else "the run ended before it could be killed"),
    )
    if trial.passed:
        shutil.rmtree(place)
    return trial


def _target(plan: Plan, run: Path) -> Target:
    records = len(open_store(run / "tokens" / "store").source("train"))
    steps = math.ceil(records / plan.config.train.batch_size) + 1
    few = () if plan.config.train.stages else ("--train.steps", str(steps))
    every = ("--train.log-every", "1", "--train.checkpoint-every", str(max(1, steps // 4)))
    command = plan.command(run, plan.data, *few, *every)
    return Target(command, (Stage(run / "world_model"),), run.with_name(f"{run.name}.log"), 0.0, 0.0)
