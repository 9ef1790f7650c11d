"""Where a train step runs: on one device, on many that each hold the whole state, or on a mesh that shares it out.

A state is an ordinary tree of arrays under all three, so a checkpoint does not know which one wrote it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, SingleDeviceSharding
from jax.sharding import PartitionSpec as P

from rsjax.config import ConfigError, LoopConfig, require
from rsjax.training.objectives import Objective
from rsjax.training.sharding import DATA, FSDP, SMALL, cut_elements, shardings, table
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import Metrics, train_step

AXIS = "devices"  # of pmap

Kind = Literal["jit", "pmap", "mesh"]
Step = Callable[[TrainState, Any], tuple[TrainState, Metrics]]


def choose(loop: LoopConfig, local: int, processes: int) -> tuple[Kind, int]:
    """Which placement ``loop`` asks for, and on how many devices.

    Args:
        local: devices of each process.
        processes: how many there are.

    Raises:
        ConfigError: the batch or the devices cannot be divided as asked.
    """
    if loop.placement == "auto" and processes == 1:
        devices = max(n for n in range(1, local + 1) if loop.batch_size % (n * loop.accumulate) == 0)
        return ("pmap", devices) if devices > 1 else ("jit", 1)
    if loop.placement == "jit":
        require(processes == 1, f"placement jit is one device's, and {processes} processes train; set it to mesh")
        return "jit", 1
    devices = local * processes
    if loop.batch_size % (devices * loop.accumulate):
        parts = f" in accumulate = {loop.accumulate} parts" if loop.accumulate > 1 else ""
        other = ", or set placement to auto, which uses as many devices as divide it" if processes == 1 else ""
        raise ConfigError(
            f"batch_size {loop.batch_size} does not divide over {devices} devices{parts}; make it a multiple{other}"
        )
    require(devices % loop.fsdp == 0, f"fsdp {loop.fsdp} does not divide {devices} devices; make it one that does")
    return "pmap" if loop.placement == "pmap" else "mesh", devices


@dataclass(frozen=True)
class Placement:
    """How states and batches lie on the devices, and the compiled step that takes them.

    Attributes:
        kind: jit: one device. pmap: each device has the whole state and a part of the batch. mesh: likewise, but of
            ``fsdp`` devices each has a part of the state too, as :mod:`rsjax.training.sharding` says.
        mesh: the devices, as data × fsdp; under pmap on one axis.
    """

    kind: Kind
    mesh: Mesh

    @classmethod
    def create(cls, loop: LoopConfig) -> "Placement":
        """The placement that ``loop`` asks for, on the devices of all processes.

        Raises:
            ConfigError: the batch or the devices cannot be divided as asked.
        """
        kind, devices = choose(loop, jax.local_device_count(), jax.process_count())
        if kind == "mesh":
            sizes = (devices // loop.fsdp, loop.fsdp)
            return cls(kind, jax.make_mesh(sizes, (DATA, FSDP), axis_types=(AxisType.Auto,) * 2))
        # A process's devices stand together, as pmap wants them.
        ordered = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
        return cls(kind, Mesh(np.array(ordered[:devices]), (AXIS,)))

    def init(self, objective: Objective, loop: LoopConfig, start: Callable[[Any], Any] | None = None) -> TrainState:
        """:func:`rsjax.training.state.create_state`, made where it is to lie.

        Args:
            start: fresh parameters to those that training begins with.

        Raises:
            ConfigError: no array can be cut as ``loop.fsdp`` asks.
        """
        places = self._shardings(_shapes(objective, loop))
        given = None
        if start is not None:
            fresh = jax.jit(lambda: objective.init(jax.random.key(loop.seed)), out_shardings=places.params)()
            given = _place(start(fresh), places.params)

        def make(given: Any, extra: Any) -> TrainState:
            # What comes from disk is an argument: inside, it would be a constant of the compiled program.
            state = create_state(objective, loop, None if given is None else lambda _: given)
            return state.replace(extra=extra)  # type: ignore[attr-defined]

        extra = _place(objective.init_extra(), places.extra)
        return jax.jit(make, out_shardings=places, donate_argnums=(0, 1))(given, extra)

    def template(self, objective: Objective, loop: LoopConfig) -> TrainState:
        """The state's shapes, dtypes and shardings: what :meth:`portable` gives, to restore a checkpoint into."""
        shapes = _shapes(objective, loop)
        return jax.tree.map(
            lambda x, place: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), shapes, self._shardings(shapes)
        )

    def compile(self, objective: Objective, loop: LoopConfig) -> Any:
        """``step(state, batch) -> (state, metrics)``; the given state is donated."""
        step = partial(train_step, objective, loop)
        if self.kind == "jit":
            return jax.jit(step, donate_argnums=0)
        if self.kind == "pmap":
            return jax.pmap(
                partial(step, axis_name=AXIS),
                AXIS,
                in_axes=(None, 0),
                out_axes=None,
                donate_argnums=0,
                devices=list(self.mesh.devices.flat),
            )
        places, whole = self._shardings(_shapes(objective, loop)), NamedSharding(self.mesh, P())
        return jax.jit(step, donate_argnums=0, in_shardings=(places, self._rows), out_shardings=(places, whole))

    def put_batch(self, batch: Any) -> Any:
        """This process's part of the global batch onto its devices, cut along the first axis."""
        if self.kind == "jit":
            return jax.device_put(batch, SingleDeviceSharding(self.mesh.devices.flat[0]))
        if self.kind == "pmap":
            local = self.mesh.local_mesh
            cut = jax.tree.map(lambda x: np.reshape(x, (local.size, -1, *np.shape(x)[1:])), batch)
            return jax.device_put(cut, NamedSharding(local, P(AXIS)))
        return jax.tree.map(lambda x: jax.make_array_from_process_local_data(self._rows, np.asarray(x)), batch)

    @property
    def shares(self) -> bool:
        """Whether several devices share one state."""
        return self.kind == "mesh" and self.mesh.shape[FSDP] > 1

    def scalars(self, metrics: Metrics) -> dict[str, float]:
        """A step's metrics as numbers; waits for the step."""
        return {name: float(value) for name, value in jax.device_get(metrics).items()}

    def portable(self, state: TrainState) -> TrainState:
        """The state as arrays that all processes share, for a checkpoint. No copy: stepping on takes it along."""
        if self.kind == "jit" or jax.process_count() == 1:
            return state
        return jax.tree.map(self._shared, state)

    def adopt(self, state: TrainState) -> TrainState:
        """A state of another placement, or of numpy arrays, in this one. Not a copy where it lies as it should."""
        return _place(state, self._shardings(state))

    def gather(self, tree: Any) -> Any:
        """A state or a part of one as a copy on this process's first device, which it has to fit on."""
        first, whole = SingleDeviceSharding(jax.local_devices()[0]), NamedSharding(self.mesh, P())

        def one(x: jax.Array) -> jax.Array:
            return jax.device_put(x.addressable_data(0) if x.is_fully_replicated else x, first, may_alias=False)

        if not all(x.is_fully_replicated or x.is_fully_addressable for x in jax.tree.leaves(tree)):
            tree = jax.jit(lambda tree: tree, out_shardings=whole)(tree)  # other processes have parts
        return jax.tree.map(one, tree)

    @property
    def _rows(self) -> NamedSharding:
        return NamedSharding(self.mesh, P((DATA, FSDP)))

    def _shared(self, x: jax.Array) -> jax.Array:
        if not x.is_fully_addressable:
            return x
        return multihost_utils.host_local_array_to_global_array(x, self.mesh, P())

    def _shardings(self, tree: Any) -> Any:
        if self.kind == "mesh":
            rows, parts = table(tree, self.mesh.shape[FSDP]), self.mesh.shape[FSDP]
            large = any(np.prod(row.shape) >= SMALL for row in rows)
            require(
                parts == 1 or not large or cut_elements(rows) > 0,
                f"fsdp {parts} divides no axis of this model's arrays; choose one that divides its width",
            )
            return shardings(tree, self.mesh)
        one = SingleDeviceSharding(self.mesh.devices.flat[0])
        place = one if self.kind == "jit" else NamedSharding(self.mesh, P())
        return jax.tree.map(lambda _: place, tree)


def _shapes(objective: Objective, loop: LoopConfig) -> Any:
    return jax.eval_shape(partial(create_state, objective, loop))


def _place(tree: Any, places: Any) -> Any:
    """Arrays of the host or of any devices where they are to lie."""

    def put(x: Any, place: jax.sharding.Sharding) -> jax.Array:
        if place.is_fully_addressable or (isinstance(x, jax.Array) and not x.is_fully_addressable):
            return jax.device_put(x, place)
        # Every process has the same array, so each takes its own part: device_put would send it around to compare.
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, place, lambda index: host[index])

    return jax.tree.map(put, tree, places)
