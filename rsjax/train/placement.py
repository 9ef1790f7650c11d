"""Where a train step runs: jitted on one device, or pmapped over the local ones."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from rsjax.config import ConfigError, LoopConfig
from rsjax.train.objectives import Objective
from rsjax.train.state import TrainState
from rsjax.train.step import Metrics, train_step

AXIS = "devices"


@dataclass(frozen=True)
class Placement:
    """How states and batches lie on the devices, and the compiled step that takes them.

    Attributes:
        devices: 1: the step is jitted. More: it is pmapped, states have a leading axis over devices, and the batch is
            cut into as many parts.
    """

    devices: int

    @classmethod
    def create(cls, loop: LoopConfig) -> "Placement":
        """The placement that ``loop.placement`` asks for on this host.

        Raises:
            ConfigError: the batch cannot be cut evenly.
        """
        local = jax.local_device_count()
        devices = local if loop.placement == "pmap" or (loop.placement == "auto" and local > 1) else 0
        if devices and loop.batch_size % devices:
            raise ConfigError(
                f"batch_size {loop.batch_size} does not divide over {devices} devices; make it a multiple, or set "
                f"placement to jit"
            )
        return cls(devices)

    def compile(self, objective: Objective, loop: LoopConfig) -> Any:
        """``step(state, batch) -> (state, metrics)``; the given state is donated."""
        step = partial(train_step, objective, loop)
        if self.devices:
            return jax.pmap(partial(step, axis_name=AXIS), axis_name=AXIS, donate_argnums=0)
        return jax.jit(step, donate_argnums=0)

    def put_state(self, state: TrainState) -> TrainState:
        """A host or single-device state onto the devices."""
        if not self.devices:
            return jax.device_put(state)
        return jax.tree.map(lambda x: jax.numpy.stack([x] * self.devices), state)

    def put_batch(self, batch: Any) -> Any:
        """A host batch onto the devices, cut along its first axis."""
        if not self.devices:
            return jax.device_put(batch)
        return jax.tree.map(lambda x: np.reshape(x, (self.devices, -1, *np.shape(x)[1:])), batch)

    def first(self, values: TrainState | Metrics) -> Any:
        """One device's copy of what is the same on all."""
        return jax.tree.map(lambda x: x[0], values) if self.devices else values
