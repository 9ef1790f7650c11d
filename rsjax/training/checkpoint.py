"""Checkpoints: the whole state with the place in the data, and the finished weights that later stages read."""

import errno
import logging
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from rsjax.errors import UserError, first_line
from rsjax.files import FileError, disk_guard
from rsjax.progress import note
from rsjax.training.checkpoint_manifest import find_fault, read_metric, write_manifest
from rsjax.training.distributed import agree, is_lead, on_lead
from rsjax.training.retention import retention

# Orbax tells of every step of every save, and of each error at length in each of its threads; a user has the progress
# line, and the error arrives as an exception too.
logging.getLogger("absl").setLevel(logging.CRITICAL)

UNFINISHED = ".orbax-checkpoint-tmp"  # what orbax adds to the name of a checkpoint that is being written


class CheckpointError(UserError):
    """A checkpoint that cannot be used. The message names it and the cure."""


class Checkpoints:
    """The checkpoints of one training run: state, optimizer and place in the data, saved together.

    A checkpoint is written in the background and appears under its step's name only when it is whole. Of several
    processes, all make the same calls. What an earlier run left unfinished is removed.

    Args:
        directory: holds one directory a checkpoint; made if it is not there. All processes see the same one.
        keep_last: the newest checkpoints are kept, this many …
        keep_every: … and every one at a multiple of this many steps (0: none for that) …
        keep_best: … and the one with the lowest metric.
        read_only: nothing is cleaned up or moved, so that another process may be writing here.
    """

    def __init__(
        self,
        directory: Path,
        keep_last: int = 2,
        keep_every: int = 0,
        keep_best: bool = False,
        read_only: bool = False,
    ) -> None:
        self.directory, self._read_only = directory.absolute(), read_only
        self._keep = (keep_last, keep_every, keep_best)
        with disk_guard(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
            self._manager = self._open()

    def steps(self) -> list[int]:
        """The steps of all checkpoints, from the oldest to the newest, which may still be being written."""
        return list(self._manager.all_steps())

    def latest(self) -> int | None:
        """The step of the newest checkpoint."""
        return self._manager.latest_step()

    def save(self, step: int, state: Any, data: dict[str, Any], metric: float | None = None) -> None:
        """Begins to save a state under its step; training may go on with it, and donate it, at once.

        Where there is a checkpoint of that step, it stays as it is.

        Args:
            state: arrays on the host, on one device or on a mesh. Of what is not on a mesh of all processes, the first
                process's is saved.
            data: the loader's state, JSON-ready and alike in all processes.
            metric: what ``keep_best`` goes by, the lower the better; None (or not finite): this one is never the best.

        Raises:
            FileError: the disk is full or refuses, for this checkpoint or the one before.
        """
        self.wait()
        if step in self.steps():
            return
        if metric is not None and math.isfinite(metric):
            self._metrics[step] = float(metric)
        self._writing = step
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(_writable(state)), data=ocp.args.JsonSave(data))
        with self._written():
            _need_room(self.directory, state)
            self._manager.save(step, args=arguments, force=True)  # force: whatever its own schedule is

    def restore(self, template: Any) -> tuple[Any, dict[str, Any]]:
        """The state and the loader's state of the newest checkpoint whose files are as they were written.

        Damaged ones are passed over: a line says so, and they are moved out of the way, to ``bad-<step>``.

        Args:
            template: a state of the same structure, or its ``jax.ShapeDtypeStruct``s. Arrays come back with the
                template's shardings, whatever those were that they were saved with; without, on the first device.

        Raises:
            CheckpointError: there is no checkpoint, all are damaged, or it is of another architecture.
            FileError: a damaged one cannot be moved, or the last save failed.
        """
        self.wait()
        step, faults = self._newest_whole()
        if step is None:
            told = "; ".join(f"{step}: {fault}" for step, fault in faults) or "there is none"
            raise CheckpointError(
                f"{self.directory}: no checkpoint can be read ({told}); restore them from a copy, or start again with "
                f"--no-resume"
            )
        arguments = ocp.args.Composite(state=ocp.args.StandardRestore(_shapes(template)), data=ocp.args.JsonRestore())
        try:
            _check_shapes(self.directory / str(step) / "state", template)
            restored = self._manager.restore(step, args=arguments)
        except Exception as error:  # orbax reports what does not fit as many types
            raise _misfit(self.directory / str(step), error) from error
        if faults and not self._read_only:
            self._set_aside(faults, step)
        return restored["state"], restored["data"]

    def wait(self) -> None:
        """Waits until what was saved is on disk.

        Raises:
            FileError: it could not be written; the checkpoints before it are as they were.
        """
        with self._written():
            self._manager.wait_until_finished()

    def close(self) -> None:
        """Waits for what is under way and gives everything back. Raises what :meth:`wait` raises."""
        try:
            self.wait()
        finally:
            self._manager.close()

    def _open(self) -> ocp.CheckpointManager:
        keep_last, keep_every, keep_best = self._keep
        self._metrics = {
            int(path.name): metric
            for path in self.directory.iterdir()
            if path.name.isdigit() and (metric := read_metric(path)) is not None
        }
        options = ocp.CheckpointManagerOptions(
            preservation_policy=retention(keep_last, keep_every, self._metrics if keep_best else None),
            cleanup_tmp_directories=not self._read_only,
            lightweight_initialize=True,  # else a damaged checkpoint keeps the others from being found
            # Directories are made before save returns: their making in the background is waited for by signals between
            # orbax's threads, for minutes where one gets lost.
            async_options=ocp.AsyncOptions(
                post_finalization_callback=self._write_manifest, create_directories_asynchronously=False
            ),
        )
        return ocp.CheckpointManager(self.directory, options=options)

    def _write_manifest(self) -> None:
        # Called by orbax in its thread, when all is written and only the renaming is left to do.
        (unfinished,) = self.directory.glob(f"{self._writing}{UNFINISHED}*")
        write_manifest(unfinished, self._metrics.get(self._writing))

    @contextmanager
    def _written(self) -> Iterator[None]:
        """Reports what went wrong in orbax's threads, and leaves no part of a checkpoint on a disk that is full."""
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

    def _newest_whole(self) -> tuple[int | None, list[tuple[int, str]]]:
        """The newest step whose files are whole, and what is wrong with those of newer ones."""
        found, faults = None, []
        for step in reversed(self.steps()) if is_lead() else ():
            fault = find_fault(self.directory / str(step))
            if fault is None:
                found = step
                break
            faults.append((step, fault))
        return agree((found, faults), "checkpoints")

    def _set_aside(self, faults: list[tuple[int, str]], instead: int) -> None:
        def move() -> None:
            for step, fault in faults:
                aside = self.directory / f"bad-{step}"
                shutil.rmtree(aside, ignore_errors=True)
                os.replace(self.directory / str(step), aside)
                note(f"checkpoint {step} is damaged ({fault}): going on from that of step {instead}; kept as {aside}")

        with disk_guard(self.directory):
            on_lead("moving a damaged checkpoint", move)
            self._manager.close()
            self._manager = self._open()


def save_weights(path: Path, weights: Any) -> None:
    """Writes parameters alone; they appear whole or not at all.

    Called by one process, where there are several; what lies on a mesh of all of them has to be brought to it first.

    Raises:
        FileError: the disk is full.
    """
    with disk_guard(path), _checkpointer() as checkpointer:
        _need_room(path.parent, weights)
        checkpointer.save(path.absolute(), _writable(weights), force=True)


def load_weights(path: Path, like: Any) -> Any:
    """Reads parameters written by :func:`save_weights`.

    Args:
        like: parameters (or their shapes) of the same structure.

    Raises:
        CheckpointError: there are none, they are of another architecture, or they are damaged.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: no such weights; train first (python -m experiments.train)")
    try:
        _check_shapes(path, like)
        with _checkpointer() as checkpointer:
            return checkpointer.restore(path.absolute(), _shapes(like))
    except Exception as error:  # as above
        raise _misfit(path, error) from error


def _need_room(folder: Path, tree: Any) -> None:
    # On a full disk TensorStore prints tracebacks from callbacks that outlive orbax: so it is looked up first.
    if shutil.disk_usage(folder).free < sum(x.nbytes for x in jax.tree.leaves(tree)):
        raise OSError(errno.ENOSPC, "No space left on device")


def _checkpointer() -> ocp.StandardCheckpointer:
    """One that waits for no other process."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(
        primary_host=me, active_processes={me}, barrier_sync_key_prefix=f"process{me}"
    )
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _writable(tree: Any) -> Any:
    # Where there are several processes, orbax refuses device arrays of one of them; host arrays the first one writes.
    if jax.process_count() == 1:
        return tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) and x.is_fully_addressable else x, tree)


def _shapes(tree: Any) -> Any:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=getattr(x, "sharding", None) or device), tree
    )


def _check_shapes(path: Path, like: Any) -> None:
    # Looked up before anything is read: when a read does not fit, TensorStore prints tracebacks as on a full disk.
    with _checkpointer() as checkpointer:
        saved = _flat_shapes(checkpointer.metadata(path.absolute()).item_metadata.tree)
    wanted = _flat_shapes(like)
    for name in sorted(wanted.keys() | saved.keys()):
        if wanted.get(name) != saved.get(name):
            raise ValueError(
                f"{name} is {saved.get(name, 'missing')}, the configuration needs {wanted.get(name, 'none')}"
            )


def _flat_shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    leaves = ocp.tree.to_flat_dict(ocp.tree.serialize_tree(tree, keep_empty_nodes=True))
    return {".".join(map(str, path)): tuple(leaf.shape) for path, leaf in leaves.items() if hasattr(leaf, "shape")}


def _misfit(path: Path, reason: object) -> CheckpointError:
    return CheckpointError(
        f"{path}: does not fit this configuration or is damaged ({first_line(reason)}); use the configuration it was "
        f"made with, or another run directory, or delete it"
    )
