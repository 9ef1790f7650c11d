"""Checkpoints: the whole training state with its position in the data, and the final weights that later stages read.

Sizes and checksums of their files are kept in them, so that damage is found before anything is read.
"""

import errno
import json
import logging
import math
import os
import resource
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import PyTree
from orbax.checkpoint import checkpoint_managers as ocm

from rsjax.errors import UserError, first_line
from rsjax.files import FileError, disk_guard, parse_json, placeholder, regular, replace_directory
from rsjax.progress import note
from rsjax.training.distributed import agree, is_lead, on_lead

# Orbax logs every step of every save, and each error at length in each of its threads. Users see the progress line,
# and the error is raised as well.
logging.getLogger("absl").setLevel(logging.CRITICAL)

CHECKSUMS = "checksums.json"  # written before a checkpoint gets its name, so one without it is damaged
CHUNK_BYTES = 2**22
MOST_FILE = 2**31  # bytes after which orbax begins another file
UNFINISHED = ".orbax-checkpoint-tmp"  # what orbax adds to the name of a checkpoint while it writes it

Tree = TypeVar("Tree")  # a tree of arrays, or of their shapes


class CheckpointError(UserError):
    """A checkpoint cannot be used. The message names it and the cure."""


class Checkpoints:
    """The checkpoints of one training run: parameters, optimizer and position in the data, saved together.

    A checkpoint is written in the background and appears under its step's name when it is complete. All processes make
    the same calls. Opening the directory removes what an earlier run left unfinished.

    Args:
        directory: has one folder for each checkpoint; created if missing. All processes see the same one.
        keep_last: keep this many of the newest checkpoints …
        keep_every: … and those whose step is a multiple of this (0: none) …
        keep_best: … and the one with the lowest metric.
        read_only: remove and move nothing, because another process may be writing here.
    """

    def __init__(
        self,
        directory: Path,
        keep_last: int = 2,
        keep_every: int = 0,
        keep_best: bool = False,
        read_only: bool = False,
    ) -> None:
        self.directory = directory.absolute()
        self._read_only = read_only
        self._keep = (keep_last, keep_every, keep_best)
        with disk_guard(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
            self._manager = self._open()

    def steps(self) -> list[int]:
        """Returns the steps of all checkpoints in ascending order; the last may still be being written."""
        return list(self._manager.all_steps())

    def latest(self) -> int | None:
        """Returns the step of the newest checkpoint."""
        return self._manager.latest_step()

    def save(self, step: int, state: PyTree, data: dict[str, Any], metric: float | None = None) -> None:
        """Starts to save a state; training may continue, and donate the state, at once.

        An existing checkpoint of that step stays as it is.

        Args:
            state: arrays on the host, on one device or on a mesh. Arrays that are not on a mesh of all processes are
                saved by the first process.
            data: the loader's state, JSON-ready and equal in all processes.
            metric: the value that ``keep_best`` compares, lower is better; a checkpoint without a finite one is never
                the best.

        Raises:
            FileError: this checkpoint, or the one before, cannot be written; for example, the disk is full.
        """
        self.wait()
        if step in self.steps():
            return
        if metric is not None and math.isfinite(metric):
            self._metrics[step] = float(metric)
        self._writing = step
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(_writable(state)), data=ocp.args.JsonSave(data))
        with self._writes():
            _need_space(self.directory, state)
            self._manager.save(step, args=arguments, force=True)  # force: orbax has a schedule of its own

    def best(self) -> int | None:
        """Returns the step of the checkpoint with the lowest metric, the first of equals; None without a metric."""
        kept = [step for step in self.steps() if step in self._metrics]
        return min(kept, key=lambda step: (self._metrics[step], step), default=None)

    def restore(self, template: Tree, chosen: int | None = None) -> tuple[Tree, dict[str, Any]]:
        """Returns the state and the loader's state of the newest checkpoint whose files are intact.

        Damaged ones are skipped with a note, and moved to ``bad-<step>``.

        Args:
            template: a state of the same structure, or its ``jax.ShapeDtypeStruct``s. Arrays get the template's
                shardings, whatever shardings they were saved with; without any, they go to the first device.
            chosen: the step of the checkpoint to read instead of the newest one.

        Raises:
            CheckpointError: there is no checkpoint, all are damaged, or it has another architecture.
            FileError: a damaged one cannot be moved, or the last save failed.
        """
        self.wait()
        step, faults = self._newest_intact(chosen)
        if step is None:
            reason = "; ".join(f"{step}: {fault}" for step, fault in faults) or "there is none"
            raise CheckpointError(
                f"{self.directory}: no checkpoint can be read ({reason}); restore them from a copy, or start again "
                f"with --no-resume"
            )
        arguments = ocp.args.Composite(state=ocp.args.StandardRestore(_shapes(template)), data=ocp.args.JsonRestore())
        try:
            _check_shapes(self.directory / str(step) / "state", template)
            restored = self._manager.restore(step, args=arguments)
        except Exception as error:  # orbax reports a mismatch as errors of many types
            raise _misfit(self.directory / str(step), error) from error
        if faults and not self._read_only:
            self._set_aside(faults, step)
        return restored["state"], restored["data"]

    def wait(self) -> None:
        """Waits until the last save is on disk.

        Raises:
            FileError: the save could not be written; the checkpoints before it are unchanged.
        """
        with self._writes():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Waits for the last save and releases all resources. Raises what :meth:`wait` raises."""
        try:
            self.wait()
        finally:
            self._manager.close()

    def _open(self) -> ocp.CheckpointManager:
        keep_last, keep_every, keep_best = self._keep
        steps = [path for path in self.directory.iterdir() if path.name.isascii() and path.name.isdigit()]
        self._metrics = {int(path.name): metric for path in steps if (metric := read_metric(path)) is not None}

        def finish() -> None:
            # Orbax calls this in its thread, when everything is written and only the rename remains.
            (unfinished,) = self.directory.glob(f"{self._writing}{UNFINISHED}*")
            write_checksums(unfinished, self._metrics.get(self._writing))

        options = ocp.CheckpointManagerOptions(
            preservation_policy=retention(keep_last, keep_every, self._metrics if keep_best else None),
            cleanup_tmp_directories=not self._read_only,
            lightweight_initialize=True,  # otherwise one damaged checkpoint makes all of them unreadable
            # Directories are created before save returns: in the background, orbax's threads signal their creation to
            # each other, and wait for minutes when a signal is lost.
            async_options=ocp.AsyncOptions(post_finalization_callback=finish, create_directories_asynchronously=False),
        )
        return ocp.CheckpointManager(self.directory, options=options)

    @contextmanager
    def _writes(self) -> Iterator[None]:
        """Turns errors of orbax's threads into a :class:`FileError`, and removes what they left of a checkpoint."""
        try:
            with disk_guard(self.directory):
                yield
        except (FileError, RuntimeError, ValueError) as error:
            if is_lead():
                for path in self.directory.glob(f"*{UNFINISHED}*"):
                    shutil.rmtree(path, ignore_errors=True)
            if isinstance(error, FileError):
                raise
            raise FileError(f"{self.directory}: cannot write a checkpoint ({first_line(error)})") from error

    def _newest_intact(self, chosen: int | None) -> tuple[int | None, list[tuple[int, str]]]:
        """Returns the newest step whose files are intact, or the chosen one, and the faults of newer ones."""
        faults: list[tuple[int, str]] = []
        steps = [step for step in self.steps() if chosen in (None, step)]
        for step in reversed(steps) if is_lead() else ():
            fault = find_fault(self.directory / str(step))
            if fault is None:
                return agree((step, faults), "checkpoints")
            faults.append((step, fault))
        return agree((None, faults), "checkpoints")

    def _set_aside(self, faults: list[tuple[int, str]], instead: int) -> None:
        def move() -> None:
            for step, fault in faults:
                aside = self.directory / f"bad-{step}"
                shutil.rmtree(aside, ignore_errors=True)
                os.replace(self.directory / str(step), aside)
                note(f"checkpoint {step} is damaged ({fault}): resuming from that of step {instead}; kept as {aside}")

        with disk_guard(self.directory):
            on_lead("moving a damaged checkpoint", move)
            self._manager.close()
            self._manager = self._open()


def save_weights(path: Path, weights: PyTree) -> None:
    """Writes only parameters; existing ones are replaced when the new ones are complete.

    If there are several processes, only one calls this. Arrays on a mesh of all processes must be gathered first.

    Raises:
        FileError: the disk is full.
    """
    new = path.absolute().with_name(f"{path.name}.new")  # orbax would delete the old ones first
    with disk_guard(path):
        _need_space(path.parent, weights)
        with _checkpointer() as checkpointer:
            checkpointer.save(new, _writable(weights), force=True)
        write_checksums(new, None, "**/*")
        replace_directory(new, path.absolute())


def load_weights(path: Path, like: Tree) -> Tree:
    """Reads parameters that :func:`save_weights` wrote.

    Args:
        like: parameters of the same structure, or their shapes.

    Raises:
        CheckpointError: the parameters are missing or damaged, or have another architecture.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: no such weights; train first (rsjax train)")
    if fault := find_fault(path):
        raise _pointer(path) or CheckpointError(
            f"{path}: is damaged ({fault}); restore it from a copy, or delete it and make it again: a training makes "
            f"it from its last checkpoint"
        )
    try:
        _check_shapes(path, like)
        with _checkpointer() as checkpointer:
            return checkpointer.restore(path.absolute(), _shapes(like))
    except Exception as error:  # as above
        raise _misfit(path, error) from error


def _need_space(folder: Path, tree: PyTree) -> None:
    # Checked before: on a full disk TensorStore prints tracebacks from callbacks that outlive orbax.
    size = sum(x.nbytes for x in jax.tree.leaves(tree))
    if shutil.disk_usage(folder).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    most, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if most != resource.RLIM_INFINITY and most < min(size, MOST_FILE):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))


def _checkpointer() -> ocp.StandardCheckpointer:
    """Returns a checkpointer that waits for no other process."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process{me}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _writable(tree: PyTree) -> PyTree:
    # With several processes, orbax refuses arrays on a device of one of them; host arrays are written by the first.
    if jax.process_count() == 1:
        return tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) and x.is_fully_addressable else x, tree)


def _shapes(tree: PyTree) -> PyTree:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=getattr(x, "sharding", None) or device), tree
    )


def _check_shapes(path: Path, like: PyTree) -> None:
    # Checked before reading: at a mismatch TensorStore prints tracebacks, as on a full disk.
    with _checkpointer() as checkpointer:
        saved = _flat_shapes(checkpointer.metadata(path.absolute()).item_metadata.tree)
    wanted = _flat_shapes(like)
    for name in sorted(wanted.keys() | saved.keys()):
        if wanted.get(name) != saved.get(name):
            raise ValueError(
                f"{name} is {saved.get(name, 'missing')}, the configuration needs {wanted.get(name, 'none')}"
            )


def _flat_shapes(tree: PyTree) -> dict[str, tuple[int, ...]]:
    leaves = ocp.tree.to_flat_dict(ocp.tree.serialize_tree(tree, keep_empty_nodes=True))
    return {".".join(map(str, path)): tuple(leaf.shape) for path, leaf in leaves.items() if hasattr(leaf, "shape")}


def _pointer(path: Path) -> CheckpointError | None:
    """Returns the error for the first file of a folder in whose place something else stands, such as a pointer."""
    for file in sorted(path.rglob("*")):
        if instead := placeholder(file):
            return CheckpointError(f"{file}: {instead}")
    return None


def _misfit(path: Path, error: Exception) -> CheckpointError:
    return _pointer(path) or CheckpointError(
        f"{path}: does not fit this configuration or is damaged ({first_line(error)}); use the configuration it was "
        f"made with, or another run directory, or delete it"
    )


def write_checksums(checkpoint: Path, metric: float | None, pattern: str = "*/**/*") -> None:
    """Reads the files of a finished checkpoint and writes their sizes and checksums, and the checkpoint's metric.

    Args:
        pattern: of the files. Those of a checkpoint are in folders: at the top are orbax's own notes, which it changes
            later and which no restore reads.

    Raises:
        OSError: a file cannot be read or written.
    """
    paths = sorted(path for path in checkpoint.glob(pattern) if path.is_file())
    files = {str(path.relative_to(checkpoint)): _size_and_checksum(path) for path in paths}
    content = {"metric": metric, "files": files}
    (checkpoint / CHECKSUMS).write_text(json.dumps(content | {"crc32": _checksum(content)}))


def read_metric(checkpoint: Path) -> float | None:
    """Returns the metric that a checkpoint was written with; None if it has none, or none that can be read."""
    try:
        return _read_checksums(checkpoint)["metric"]
    except (OSError, ValueError):
        return None


def find_fault(checkpoint: Path) -> str | None:
    """Returns a few words that name a checkpoint's first bad file and its fault, or None if all files are intact."""
    name = CHECKSUMS
    try:
        for name, written in _read_checksums(checkpoint)["files"].items():
            if _size_and_checksum(checkpoint / name) != written:
                return f"{name}: not what was written"
    except OSError as error:
        return f"{name}: {error.strerror}"
    except ValueError:
        return f"{name}: not what was written"
    return None


def _size_and_checksum(path: Path) -> list[int]:
    size = 0
    checksum = 0
    with regular(path).open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            size += len(chunk)
            checksum = zlib.crc32(chunk, checksum)
    return [size, checksum]


def _checksum(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())


def _read_checksums(checkpoint: Path) -> dict[str, Any]:
    """Reads the metric and the files' sizes and checksums.

    Raises:
        OSError: there is no such file.
        ValueError: the file is damaged.
    """
    path = checkpoint / CHECKSUMS
    content = parse_json(regular(path).read_bytes())
    if content.pop("crc32", None) != _checksum(content):
        raise ValueError(f"{path}: its checksum is wrong")
    return content


@dataclass
class Best(ocm.PreservationPolicy):
    """Keeps the checkpoint with the lowest metric, the first of equal ones; keeps none if none has a metric.

    Orbax's BestN reads the metrics from the checkpoints, where a damaged one stops it from opening the others.

    Attributes:
        metrics: by step.
    """

    metrics: Mapping[int, float]

    def should_preserve(
        self, checkpoints: Sequence[ocm.PolicyCheckpointInfo], *, context: ocm.PreservationContext
    ) -> list[bool]:
        judged = [(self.metrics[info.step], info.step) for info in checkpoints if info.step in self.metrics]
        _, best = min(judged, default=(None, None))
        return [info.step == best for info in checkpoints]


def retention(keep_last: int, keep_every: int, metrics: Mapping[int, float] | None) -> ocm.PreservationPolicy:
    """Returns the policy that keeps every checkpoint to which one of three rules applies.

    Args:
        keep_last: number of newest checkpoints to keep.
        keep_every: keep those whose step is a multiple of this; 0: no such rule.
        metrics: keep the one with the lowest of these, by step; None: no such rule.
    """
    policies: list[ocm.PreservationPolicy] = [ocm.LatestN(keep_last)]
    if keep_every:
        policies.append(ocm.EveryNSteps(keep_every))
    if metrics is not None:
        policies.append(Best(metrics))
    return ocm.AnyPreservationPolicy(policies)
