"""Checkpoints: the whole state with the place in the data, and the finished weights that later stages read."""

import logging
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from rsjax.data.store import disk_guard
from rsjax.errors import UserError
from rsjax.train.state import TrainState

# Orbax tells of every step of every save; a user has the progress line.
logging.getLogger("absl").setLevel(logging.WARNING)


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
            restored = self._manager.restore(step, args=arguments)
        except Exception as error:  # orbax reports misfits and damage as many types
            raise _misfit(self.directory / str(step), error) from error
        _check_shapes(self.directory / str(step), like, restored["state"])
        return restored["state"], restored["data"]

    def close(self) -> None:
        """Waits for what is under way."""
        self._manager.close()


def save_weights(path: Path, weights: Any) -> None:
    """Writes parameters alone; they appear whole or not at all."""
    with disk_guard(path), ocp.StandardCheckpointer() as checkpointer:
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
        with ocp.StandardCheckpointer() as checkpointer:
            weights = checkpointer.restore(path.absolute(), _shapes(like))
    except Exception as error:  # as above
        raise _misfit(path, error) from error
    _check_shapes(path, like, weights)
    return weights


def _shapes(tree: Any) -> Any:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), tree)


def _check_shapes(path: Path, like: Any, restored: Any) -> None:
    for (where, wanted), found in zip(jax.tree.leaves_with_path(like), jax.tree.leaves(restored), strict=True):
        if wanted.shape != found.shape:
            raise _misfit(
                path, f"{jax.tree_util.keystr(where)} is {found.shape}, the configuration needs {wanted.shape}"
            )


def _misfit(path: Path, reason: object) -> CheckpointError:
    first_line = str(reason).strip().partition("\n")[0][:200]
    return CheckpointError(
        f"{path}: does not fit this configuration or is damaged ({first_line}); use the configuration it was made "
        f"with, or another run directory, or delete it"
    )
