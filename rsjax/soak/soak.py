"""The soak: rounds until the time is over. Each ends in a comparison; what was found so far always stands on disk."""

import dataclasses
import fcntl
import json
import os
import platform
import random
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from rsjax.files import disk_guard, write_atomically
from rsjax.progress import duration
from rsjax.soak.bad_record import try_bad_record
from rsjax.soak.disk import can_mount, unmount_below
from rsjax.soak.disturb import FULL_DISK, SHARES, deck
from rsjax.soak.rounds import Round, run_round
from rsjax.soak.runs import Plan, SoakError, differences, make_reference, prepare
from rsjax.soak.table import markdown

RESULT = "soak.json"


def soak(plan: Plan, command: str, say: Callable[[str], None]) -> dict[str, Any]:
    """Disturbs runs for ``plan.minutes``, compares each with the reference, and says what was found.

    The run that is under way when the time is over is left to finish; one that fails or differs ends the soak. A soak
    that ended before its time goes on after its last whole round; one that had its time does nothing more.

    Args:
        command: how to repeat it, for the page.
        say: shows a line.

    Returns:
        What ``soak.json`` holds.

    Raises:
        SoakError: the place is in use or holds another soak, or a run that nothing disturbed failed.
        StoreError: the disk is full, really.
    """
    jax.config.update("jax_platforms", "cpu")  # only to read arrays: accelerators belong to the runs
    with disk_guard(plan.out), _alone(plan.out):
        unmount_below(plan.out)
        result = _load(plan, command)
        make_reference(plan, say)
        kinds = SHARES
        if not can_mount(plan.out):
            kinds = {kind: share for kind, share in SHARES.items() if kind != FULL_DISK}
            result["notes"] = ["No full disks: mounting a small one needs root and Linux."]
        sound = True
        while sound and (left := 60 * plan.minutes - sum(one["seconds"] for one in result["rounds"])) > 0:
            result["rounds"].append(_round(plan, len(result["rounds"]) + 1, kinds, left, say))
            sound = not result["rounds"][-1]["problem"] and not result["rounds"][-1]["differences"]
            _save(plan.out, result)
        if sound and result["bad_record"] is None and "world_model" in plan.stages:
            result["bad_record"] = try_bad_record(plan, say).told()
            _save(plan.out, result)
    return result


def _round(plan: Plan, number: int, kinds: dict[str, int], left: float, say: Callable[[str], None]) -> dict[str, Any]:
    """A round and its comparison, as JSON; the run is kept where it failed or differs."""
    place, rng = plan.out / "round", random.Random(f"{plan.seed} {number}")
    shutil.rmtree(place, ignore_errors=True)
    target = prepare(plan, place)
    say(f"round {number}")
    until = time.monotonic() + left
    done = run_round(target, deck(rng, kinds), rng, until, partial(_say_left, say, until))
    found = [] if done.problem else differences(plan, place)
    say(f"round {number}: " + (done.problem or "; ".join(found) or "bit-identical to the reference"))
    if done.problem or found:
        kept = plan.out / f"failed-{number}"
        shutil.rmtree(kept, ignore_errors=True)
        place.rename(kept)
    shutil.rmtree(place, ignore_errors=True)
    return _told(number, done, found, target.step_seconds)


def _say_left(say: Callable[[str], None], until: float, line: str) -> None:
    left = until - time.monotonic()
    say(f"[{duration(left)} left] {line}" if left > 0 else f"[time is over] {line}")


def _told(number: int, done: Round, found: list[str], step_seconds: float) -> dict[str, Any]:
    """A round as JSON."""
    events = [
        dataclasses.asdict(event.blow)
        | {"stage": event.folder.name, "step": event.step, "survived": event.survived}
        | {"repeated": event.repeated or 0, "lost": round(event.lost(step_seconds), 3)}
        for event in done.events
    ]
    return {
        "number": number,
        "starts": done.starts,
        "seconds": round(done.seconds, 1),
        "problem": done.problem,
        "differences": found,
        "events": events,
    }


def _load(plan: Plan, command: str) -> dict[str, Any]:
    """What an earlier start found, or the beginning of it all."""
    of: dict[str, Any] = {"arguments": list(plan.arguments), "stages": list(plan.stages), "seed": plan.seed}
    path = plan.out / RESULT
    if not path.exists():
        if plan.out.joinpath("reference").exists():
            _check_begun(plan, of)
        write_atomically(plan.out / "begun.json", json.dumps(of).encode())
        return {"of": of, "made_with": _made_with(), "notes": [], "rounds": [], "bad_record": None, "command": command}
    _check_begun(plan, of)
    return json.loads(path.read_text()) | {"command": command}


def _check_begun(plan: Plan, of: dict[str, Any]) -> None:
    try:
        begun = json.loads((plan.out / "begun.json").read_text())
    except (OSError, ValueError):
        begun = {}
    names = [name for name, value in of.items() if begun.get(name) != value]
    if names:
        told = "; ".join(f"{name} {begun.get(name)} there, {of[name]} here" for name in names)
        raise SoakError(f"{plan.out}: holds another soak ({told}); choose another --out, or delete it")


def _save(out: Path, result: dict[str, Any]) -> None:
    write_atomically(out / RESULT, json.dumps(result, indent=1).encode())
    write_atomically(out / "soak.md", markdown(result).encode())


def _made_with() -> str:
    return (
        f"Python {platform.python_version()}, jax {version('jax')}, orbax-checkpoint {version('orbax-checkpoint')} "
        f"on {platform.system()}, {os.cpu_count()} CPU cores"
    )


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    out.mkdir(parents=True, exist_ok=True)
    with (out / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SoakError(f"{out}: another soak works here; wait for it, or choose another --out") from error
        yield
