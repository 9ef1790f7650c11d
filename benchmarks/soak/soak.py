"""The soak: rounds until the time is up, each compared with the reference; results so far are always on disk."""

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
from importlib.metadata import version
from typing import Any

import jax

from benchmarks.soak.bad_record import try_bad_record
from benchmarks.soak.disk import can_mount, unmount_below
from benchmarks.soak.faults import FULL_DISK, SHARES, schedule
from benchmarks.soak.rounds import SoakError, run_round
from benchmarks.soak.runs import Soak, compare_with_reference, make_reference, prepare
from benchmarks.soak.table import failed, markdown
from rsjax.files import disk_guard, write_atomically
from rsjax.progress import duration


def run_soak(soak: Soak, command: str, show: Callable[[str], None]) -> dict[str, Any]:
    """Injects faults into runs for ``--minutes``, and compares each run with the reference.

    The run in progress when the time is up is left to finish; one that fails or differs ends the soak. A soak that
    ended before its time goes on after its last complete round; one that had its time does nothing more.

    Args:
        command: how to repeat it, for the page.
        show: prints a line.

    Returns:
        The content of ``soak.json``.

    Raises:
        SoakError: the directory is in use or holds another soak, or a run without faults failed.
        StoreError: the disk is really full.
    """
    jax.config.update("jax_platforms", "cpu")  # only to read arrays: accelerators belong to the runs
    with disk_guard(soak.out), _lock(soak):
        unmount_below(soak.out)
        result = _load(soak, command)
        _save(soak, result)
        make_reference(soak, show)
        kinds = SHARES
        if not can_mount(soak.out):
            kinds = {kind: share for kind, share in SHARES.items() if kind != FULL_DISK}
            result["notes"] = ["No full disks: mounting a small one needs root and Linux."]
        rounds = result["rounds"]
        seconds = 60 * soak.options.minutes
        while not any(map(failed, rounds)) and (left := seconds - sum(one["seconds"] for one in rounds)) > 0:
            rounds.append(_round(soak, len(rounds) + 1, kinds, left, show))
            _save(soak, result)
        if not any(map(failed, rounds)) and result["bad_record"] is None and "world_model" in soak.stages:
            result["bad_record"] = try_bad_record(soak, show)
            _save(soak, result)
    return result


def _round(
    soak: Soak, number: int, kinds: dict[str, int], seconds: float, show: Callable[[str], None]
) -> dict[str, Any]:
    """Runs a round and compares it; returns it as JSON. The run is kept if it fails or differs."""
    place = soak.out / "round"
    rng = random.Random(f"{soak.options.seed} {number}")
    shutil.rmtree(place, ignore_errors=True)
    target = prepare(soak, place)
    until = time.monotonic() + seconds

    def show_left(line: str) -> None:
        left = until - time.monotonic()
        show(f"[{duration(left)} left] {line}" if left > 0 else f"[time is up] {line}")

    show(f"round {number}")
    done = run_round(target, schedule(rng, kinds), rng, until, show_left)
    differences = [] if done.problem else compare_with_reference(soak, place)
    show(f"round {number}: " + (done.problem or "; ".join(differences) or "bit-identical to the reference"))
    if done.problem or differences:
        kept = soak.out / f"failed-{number}"
        shutil.rmtree(kept, ignore_errors=True)
        place.rename(kept)
    shutil.rmtree(place, ignore_errors=True)
    events = [
        dataclasses.asdict(event.fault)
        | {"stage": event.folder.name, "step": event.step, "survived": event.survived}
        | {"repeated": event.repeated or 0, "lost": round(event.lost(target.step_seconds), 3)}
        for event in done.events
    ]
    return {
        "number": number,
        "starts": done.starts,
        "seconds": round(done.seconds, 1),
        "problem": done.problem,
        "differences": differences,
        "events": events,
    }


def _load(soak: Soak, command: str) -> dict[str, Any]:
    """Returns the result of an earlier start of the same soak, or an empty one."""
    of = {"arguments": list(soak.arguments), "stages": list(soak.stages), "seed": soak.options.seed}
    path = soak.out / "soak.json"
    if not path.exists():
        made_with = (
            f"Python {platform.python_version()}, jax {version('jax')}, orbax-checkpoint {version('orbax-checkpoint')} "
            f"on {platform.system()}, {os.cpu_count()} CPU cores"
        )
        return {"of": of, "made_with": made_with, "notes": [], "rounds": [], "bad_record": None, "command": command}
    result = json.loads(path.read_text())
    if names := [name for name, value in of.items() if result["of"][name] != value]:
        values = "; ".join(f"{name} {result['of'][name]} there, {of[name]} here" for name in names)
        raise SoakError(f"{soak.out}: holds another soak ({values}); choose another --out, or delete it")
    return result | {"command": command}


def _save(soak: Soak, result: dict[str, Any]) -> None:
    write_atomically(soak.out / "soak.json", json.dumps(result, indent=1).encode())
    write_atomically(soak.out / "soak.md", markdown(result).encode())


@contextmanager
def _lock(soak: Soak) -> Iterator[None]:
    soak.out.mkdir(parents=True, exist_ok=True)
    with (soak.out / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SoakError(f"{soak.out}: another soak runs here; wait for it, or choose another --out") from error
        yield
