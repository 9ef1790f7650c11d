"""Records the configuration, code, packages, machine and data of every start of a run in ``run.json``."""

import hashlib
import importlib.metadata
import os
import platform
import socket
import subprocess
from contextlib import suppress
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

import rsjax
from rsjax.config import Config, TrainConfig, to_dict
from rsjax.config.config_fields import config_fields
from rsjax.data.store import MANIFEST
from rsjax.devices import device_name
from rsjax.files import FileError, parse_json, read_json, regular, write_json
from rsjax.tools.pipeline.run import Run

NAME = "run.json"
BY_SEED = ("seed", "start_from")  # settings of a training loop that differ between the seeds of one kind of run
DECIDE = ("code", "packages", "data")  # entries that may change results under the same configuration


def read_starts(directory: Path) -> list[dict[str, Any]]:
    """Reads every start of a run, oldest first.

    Returns:
        Dicts of ``time`` (ISO 8601, UTC), ``command``, ``config`` (resolved), ``keys`` (of the stages), ``code``,
        ``packages``, ``machine`` and ``data``. Empty if the run was never started.

    Raises:
        FileError: the file is damaged.
    """
    path = directory / NAME
    starts = read_json(path, list) if path.exists() else []
    for number, start in enumerate(starts):
        if not isinstance(start, dict) or not all(isinstance(start.get(name, {}), dict) for name in DECIDE):
            raise FileError(f"{path}: entry {number} is not a start of this run; restore the file, or delete it")
    return starts


def record_start(run: Run, command: str) -> list[str]:
    """Appends this start to ``run.json``. The lead process calls it once, after device setup, in an existing directory.

    Args:
        command: the command that started the run.

    Returns:
        The entries of ``DECIDE`` that changed since the last start; added data and packages do not count.

    Raises:
        FileError: the file is damaged, or the disk is full.
    """
    now: dict[str, Any] = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "config": to_dict(run.config),
        "keys": run.keys(),
        "code": code_version(Path(rsjax.__file__).resolve().parents[1]),
        "packages": packages(),
        "machine": machine(),
        "data": data_fingerprints(run),
    }
    starts = read_starts(run.directory)
    write_json(run.directory / NAME, [*starts, now])
    before = starts[-1] if starts else {}
    changed = []
    for name in DECIDE:
        for key, old in before.get(name, {}).items():
            new = now[name].get(key)
            if isinstance(old, dict) and isinstance(new, dict):
                old = old | {"path": ""}  # the data may have moved
                new = new | {"path": ""}
            if old != new:
                changed.append(name)
                break
    return changed


def record_data(run: Run) -> None:
    """Adds the data that the run has made since its last start to that start's entry."""
    starts = read_starts(run.directory)
    if starts:
        write_json(run.directory / NAME, [*starts[:-1], starts[-1] | {"data": data_fingerprints(run)}])


def data_fingerprints(run: Run) -> dict[str, Any]:
    """Returns path, content key, manifest hash and split sizes of every existing data set.

    The manifest lists all files with their sizes and numbers of records, so its hash changes when these do.
    """
    stores = {"clips": run.clips, "tokens": run.output("tokens")}
    loops = (run.config.tokenizer_train, run.config.train)
    stores |= {
        p.store: Path(p.store) for loop in loops for stage in loop.curriculum for p in stage.components if p.store
    }
    return {name: data_fingerprint(path) for name, path in stores.items() if (path / MANIFEST).is_file()}


def data_fingerprint(path: Path) -> dict[str, Any]:
    """Returns path, content key, manifest hash and split sizes of a store; fewer entries if it is damaged."""
    known: dict[str, Any] = {"path": str(path.absolute())}
    # The stage that reads the store reports the damage.
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        raw = regular(path / MANIFEST).read_bytes()
        known["manifest_sha256"] = hashlib.sha256(raw).hexdigest()
        manifest = parse_json(raw)
        files = {name: split["files"] for name, split in manifest["splits"].items()}
        splits = {name: {of: sum(file[of] for file in files[name]) for of in ("count", "bytes")} for name in files}
        known |= {"key": manifest.get("key"), "splits": splits}
    return known


def code_version(root: Path) -> dict[str, Any]:
    """Returns version, git revision, whether the checkout at ``root`` has changes, and the hash of ``git diff HEAD``.

    Without a checkout, everything but the version is null. The diff does not include new files.
    """
    code: dict[str, Any] = {"version": rsjax.__version__, "revision": None, "dirty": None, "diff_sha256": None}
    # rsjax may be installed inside another project's checkout.
    if _git(root, "rev-parse", "--show-toplevel") != str(root.resolve()):
        return code
    status = _git(root, "status", "--porcelain")
    diff = _git(root, "diff", "HEAD")
    return code | {
        "revision": _git(root, "rev-parse", "HEAD"),
        "dirty": None if status is None else bool(status),
        "diff_sha256": hashlib.sha256(diff.encode()).hexdigest() if diff else None,
    }


def _git(root: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, errors="replace", timeout=30
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def packages() -> dict[str, str]:
    """Returns the versions of the installed packages; without those that a broken installation left nameless."""
    found = [each.metadata for each in importlib.metadata.distributions()]  # read once, since this takes a second
    return dict(sorted((each["Name"], each["Version"]) for each in found if each["Name"]))


def training_settings(config: Config) -> dict[str, Any]:
    """Returns the settings, other than seeds, that determine the weights: of the training loops and the tokenizer."""
    parts = {each.name: getattr(config, each.name) for each in fields(config)}
    trained: dict[str, Any] = {name: part for name, part in parts.items() if isinstance(part, TrainConfig)}
    if config.model.uses_tokenizer:
        trained["tokenizer"] = config.tokenizer
    settings = {}
    for name, part in trained.items():
        skipped = {field for field, about in config_fields(part).items() if about.runtime or field in BY_SEED}
        settings[name] = {field: value for field, value in to_dict(part).items() if field not in skipped}
    return settings


def machine() -> dict[str, Any]:
    """Returns host, system, Python and devices."""
    devices = jax.local_devices()
    return {
        "host": socket.gethostname(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "cpu_cores": os.cpu_count(),
        "device_kind": device_name(),
        "platform": devices[0].platform,
        "local_devices": len(devices),
        "devices": jax.device_count(),
        "processes": jax.process_count(),
        "environment": {k: v for k, v in sorted(os.environ.items()) if k.startswith(("JAX_", "XLA_"))},
    }
