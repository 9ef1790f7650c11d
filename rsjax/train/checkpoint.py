"""Checkpoints: the whole state with the place in the data, and the finished weights that later stages read."""

import errno
import logging
import shutil
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from rsjax.data.store import disk_guard
from rsjax.errors import UserError
from rsjax.train.state import TrainState

# Orbax tells of every step of every save, and of each error at length in each of its threads; a user has the progress
# line, and the error arrives as an exception too.
logging.getLogger("absl").setLevel(logging.CRITICAL)


class CheckpointError(UserError):
    """A checkpoint that cannot be used. The message names it and the cure."""


class Checkpoints:
    """The checkpoints of one training run: state, optimizer and place in the data, saved together.

    A save appears under its step's name only when it is whole.
    """

    def __init__(self, directory: Path, keep: int = 2) -> None:
        self.directory = directory.absolute()
        with disk_guard(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(self.directory, options=options)

    def latest(self) -> int | None:
        """The step of the newest checkpoint."""
        return self._manager.latest_step()

    def save(self, state: TrainState, data: dict[str, Any]) -> None:
        """Saves the state under its step, with the loader's state.

        Raises:
            StoreError: the disk is full.
        """
        arguments = ocp.args.Composite(state=ocp.args.StandardSave(state), data=ocp.args.JsonSave(data))
        with disk_guard(self.directory):
            _need_room(self.directory, state)
            self._manager.save(int(state.step), args=arguments)

    def restore(self, like: TrainState) -> tuple[TrainState, dict[str, Any]]:
        """The newest checkpoint's state and loader state.

        Args:
            like: a state of the same structure.

        Raises:
            CheckpointError: the checkpoint is of another architecture, or damaged.
        """
        step = self.latest()
        arguments = ocp.args.Composite(state=ocp.args.StandardRestore(_shapes(like)), data=ocp.args.JsonRestore())
        try:
            _check_shapes(self.directory / str(step) / "state", like)
            restored = self._manager.restore(step, args=arguments)
        except Exception as error:  # orbax reports damage as many types
            raise _misfit(self.directory / str(step), error) from error
        return restored["state"], restored["data"]

    def close(self) -> None:
        """Waits for what is under way."""
        self._manager.close()


def save_weights(path: Path, weights: Any) -> None:
    """Writes parameters alone; they appear whole or not at all."""
    with disk_guard(path), ocp.StandardCheckpointer() as checkpointer:
        _need_room(path.parent, weights)
        checkpointer.save(path.absolute(), weights, force=True)


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
        with ocp.StandardCheckpointer() as checkpointer:
            return checkpointer.restore(path.absolute(), _shapes(like))
    except Exception as error:  # as above
        raise _misfit(path, error) from error


def _need_room(folder: Path, tree: Any) -> None:
    # On a full disk TensorStore prints tracebacks from callbacks that outlive orbax: so it is looked up first.
    if shutil.disk_usage(folder).free < sum(x.nbytes for x in jax.tree.leaves(tree)):
        raise OSError(errno.ENOSPC, "No space left on device")


def _shapes(tree: Any) -> Any:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), tree)


def _check_shapes(path: Path, like: Any) -> None:
    # Looked up before anything is read: when a read does not fit, TensorStore prints tracebacks as on a full disk.
    with ocp.StandardCheckpointer() as checkpointer:
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
    first_line = str(reason).strip().partition("\n")[0][:200]
    return CheckpointError(
        f"{path}: does not fit this configuration or is damaged ({first_line}); use the configuration it was made "
        f"with, or another run directory, or delete it"
    )
