"""What made a run: configuration, code, packages, machines and data, kept in its directory for every start.

``run.json`` holds a list of starts. The first names everything, the later ones their time and what differs from the
start before: so a run that was resumed a hundred times stays readable, and shows when its code or its machines changed.
"""

import dataclasses
import hashlib
import importlib.metadata
import json
import os
import platform
import socket
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

import rsjax
from rsjax.config import Config, to_dict
from rsjax.data.store import MANIFEST
from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.pipeline.run import Run
from rsjax.progress import note

NAME = "run.json"
DECIDE = ("code", "packages", "data")  # a change of these may change results though the configuration is the same


class ProvenanceError(UserError):
    """A ``run.json`` that cannot be read; the next start of the run moves it aside."""


def read_starts(directory: Path) -> list[dict[str, Any]]:
    """Every start of a run, oldest first, each complete.

    Returns:
        Dicts of ``time`` (ISO 8601, UTC), ``command``, ``config`` (resolved), ``keys`` (of the stages), ``seeds``,
        ``code``, ``packages``, ``machine`` and ``data``. Empty where the run was never started.

    Raises:
        ProvenanceError: the file is damaged.
    """
    starts: list[dict[str, Any]] = []
    for differing in _read(directory / NAME):
        starts.append((starts[-1] if starts else {}) | differing)
    return starts


def record_start(run: Run, command: str) -> list[str]:
    """Appends this start; called once by the lead process, when the devices are known and the directory is there.

    A damaged file is moved aside.

    Args:
        command: how the run was started.

    Returns:
        Which of ``DECIDE`` are not what they were at the last start.

    Raises:
        StoreError: the disk is full.
    """
    try:
        before = (read_starts(run.directory) or [{}])[-1]
    except ProvenanceError as error:
        path = run.directory / NAME
        note(f"{error}; it is now {path.name}.damaged, and a new one is begun")
        os.replace(path, path.with_name(f"{path.name}.damaged"))
        before = {}
    now: dict[str, Any] = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "config": to_dict(run.config),
        "keys": run.keys(),
        "seeds": _seeds(run.config),
        "code": code_version(Path(rsjax.__file__).resolve().parents[1]),
        "packages": {d.metadata["Name"]: d.version for d in sorted(importlib.metadata.distributions(), key=_name)},
        "machine": _machine(),
        "data": data_fingerprints(run),
    }
    differing = {name: value for name, value in now.items() if name == "time" or before.get(name) != value}
    _write(run.directory, [*_read(run.directory / NAME), differing])
    # What was not there yet is no change: data that are made later, a package that nothing used.
    return [name for name in DECIDE if any(_other(v, now[name].get(k)) for k, v in before.get(name, {}).items())]


def _other(before: Any, now: Any) -> bool:
    """Whether two entries differ in more than the place where the data lie."""
    if isinstance(before, dict) and isinstance(now, dict):
        return before | {"path": ""} != now | {"path": ""}
    return before != now


def record_data(run: Run) -> None:
    """Completes the last start by the data that it has made since."""
    starts, data = read_starts(run.directory), data_fingerprints(run)
    if starts and starts[-1]["data"] != data:
        differing = _read(run.directory / NAME)
        _write(run.directory, [*differing[:-1], differing[-1] | {"data": data}])


def data_fingerprints(run: Run) -> dict[str, Any]:
    """What identifies each data set of a run that is there: its place, content key, splits, and its manifest's hash.

    The manifest names all files with their sizes and numbers of records.
    """
    stores = {"clips": run.clips, "tokens": run.output("tokens")}
    loops = (run.config.tokenizer_train, run.config.train)
    stores |= {p.store: Path(p.store) for loop in loops for stage in loop.stages for p in stage.parts if p.store}
    return {name: _fingerprint(path) for name, path in stores.items() if (path / MANIFEST).exists()}


def code_version(root: Path) -> dict[str, Any]:
    """The revision of the checkout at ``root``, whether it differs from what is committed, and a hash of how.

    All null where there is no checkout; the hash is of ``git diff HEAD``, which does not see new files.
    """
    found: dict[str, Any] = {"version": rsjax.__version__, "revision": None, "dirty": None, "diff_sha256": None}
    # An environment inside somebody else's checkout is not that checkout's code.
    if _git(root, "rev-parse", "--show-toplevel") != str(root.resolve()):
        return found
    status, diff = _git(root, "status", "--porcelain"), _git(root, "diff", "HEAD")
    return found | {
        "revision": _git(root, "rev-parse", "HEAD"),
        "dirty": None if status is None else bool(status),
        "diff_sha256": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
    }


def _git(root: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _machine() -> dict[str, Any]:
    devices = jax.local_devices()
    return {
        "host": socket.gethostname(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "cpu_cores": os.cpu_count(),
        "device_kind": devices[0].device_kind,
        "platform": devices[0].platform,
        "local_devices": len(devices),
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        "environment": {k: v for k, v in sorted(os.environ.items()) if k.startswith(("JAX_", "XLA_"))},
    }


def _seeds(config: Config) -> dict[str, int]:
    sections = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {f"{name}.seed": section.seed for name, section in sections.items() if hasattr(section, "seed")}


def _fingerprint(path: Path) -> dict[str, Any]:
    raw = (path / MANIFEST).read_bytes()
    found: dict[str, Any] = {"path": str(path.absolute()), "manifest_sha256": hashlib.sha256(raw).hexdigest()}
    try:
        manifest = json.loads(raw)
        splits = {
            name: {of: sum(file[of] for file in split["files"]) for of in ("count", "bytes")}
            for name, split in manifest["splits"].items()
        }
    except (ValueError, KeyError, TypeError):  # a damaged one is told by the stage that reads it
        return found
    return found | {"key": manifest.get("key"), "splits": splits}


def _name(distribution: importlib.metadata.Distribution) -> str:
    return distribution.metadata["Name"].lower()


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        return json.loads(path.read_text())["starts"] if path.exists() else []
    except (ValueError, KeyError, TypeError) as error:
        raise ProvenanceError(f"{path}: damaged ({error})") from error


def _write(directory: Path, starts: list[dict[str, Any]]) -> None:
    with disk_guard(directory):
        write_atomically(directory / NAME, json.dumps({"starts": starts}, indent=1).encode())
