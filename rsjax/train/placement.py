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
        devices: 0: the step is jitted, on one device. Else it is pmapped over as many: states have a leading axis over
            devices, and the batch is cut into as many parts.
    """

    devices: int

    @classmethod
    def create(cls, loop: LoopConfig) -> "Placement":
        """The placement that ``loop.placement`` asks for on this host.

        Raises:
            ConfigError: the batch cannot be cut evenly.
        """
        if loop.placement == "jit":
            return cls(0)
        local = jax.local_device_count()
        if loop.placement == "pmap" and loop.batch_size % local:
            raise ConfigError(
                f"batch_size {loop.batch_size} does not divide over {local} devices; make it a multiple, or set "
                f"placement to auto, which uses as many devices as divide it"
            )
        devices = max(n for n in range(1, local + 1) if loop.batch_size % n == 0)
        return cls(devices if devices > 1 or loop.placement == "pmap" else 0)

    def compile(self, objective: Objective, loop: LoopConfig) -> Any:
        """``step(state, batch) -> (state, metrics)``; the given state is donated."""
        step = partial(train_step, objective, loop)
        if self.devices:
            devices = jax.local_devices()[: self.devices]
            return jax.pmap(partial(step, axis_name=AXIS), axis_name=AXIS, donate_argnums=0, devices=devices)
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
