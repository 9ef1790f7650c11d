"""Runs the train step on one device, on many with replicated states, or on a mesh with a sharded state.

A state is an ordinary tree of arrays in all three cases, so checkpoints do not depend on the sharding.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from math import prod
from typing import Any, Literal, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, SingleDeviceSharding
from jax.sharding import PartitionSpec as P
from jax.tree_util import KeyPath
from jax.typing import ArrayLike
from jaxtyping import PyTree

from rsjax.config import ConfigError, LoopConfig, require
from rsjax.layers.partition import FSDP
from rsjax.trainable import Extra, Params, Trainable
from rsjax.training.state import TrainState, create_state, fresh_params
from rsjax.training.step import Metrics

Tree = TypeVar("Tree")  # a tree of arrays

AXIS = "devices"  # of pmap
DATA = "data"  # axes of the mesh
SMALL = 2**14  # arrays of fewer elements stay whole, since gathering them costs more than their memory

KEPT = 8  # programs of the last trainings in a process

Kind = Literal["jit", "pmap", "mesh"]
Step = Callable[[TrainState, PyTree], tuple[TrainState, Metrics]]
TrainStep = Callable[..., tuple[TrainState, Metrics]]  # (model, loop, state, batch, axis_name) -> (state, metrics)


def choose(loop: LoopConfig, local: int, processes: int) -> tuple[Kind, int]:
    """Returns the kind of sharding that ``loop`` requires, and its number of devices.

    Args:
        local: devices per process.
        processes: number of processes.

    Raises:
        ConfigError: the batch or the devices cannot be divided as required.
    """
    if loop.sharding == "auto" and processes == 1:
        devices = max(n for n in range(1, local + 1) if loop.batch_size % (n * loop.accumulate) == 0)
        return ("pmap", devices) if devices > 1 else ("jit", 1)
    if loop.sharding == "jit":
        require(processes == 1, f"sharding is jit, for one device, but {processes} processes train; set it to mesh")
        return "jit", 1
    devices = local * processes
    if loop.batch_size % (devices * loop.accumulate):
        parts = f" in accumulate = {loop.accumulate} parts" if loop.accumulate > 1 else ""
        other = ", or set sharding to auto, which uses as many devices as divide it" if processes == 1 else ""
        raise ConfigError(
            f"batch_size {loop.batch_size} does not divide over {devices} devices{parts}; make it a multiple{other}"
        )
    require(devices % loop.fsdp == 0, f"fsdp {loop.fsdp} does not divide {devices} devices; make it one that does")
    return "pmap" if loop.sharding == "pmap" else "mesh", devices


@dataclass(frozen=True)
class Sharding:
    """The layout of states and batches on devices, and the compiled step for it.

    Attributes:
        kind: jit: one device. pmap: each device has the whole state and a part of the batch. mesh: the same, but each
            group of ``fsdp`` devices shares one state, split by :data:`RULES`.
        mesh: the devices, as data × fsdp; on one axis for jit and pmap.
    """

    kind: Kind
    mesh: Mesh

    @classmethod
    def create(cls, loop: LoopConfig, devices: Sequence[Any] = ()) -> "Sharding":
        """Returns the sharding that ``loop`` requires, on the devices of all processes.

        Args:
            devices: those to use; for absent ones, programs can be lowered and compiled, but not run.

        Raises:
            ConfigError: the batch or the devices cannot be divided as required.
        """
        devices = devices or jax.devices()
        processes = len({device.process_index for device in devices})
        kind, count = choose(loop, len(devices) // processes, processes)
        if kind == "mesh":
            sizes = (count // loop.fsdp, loop.fsdp)
            return cls(kind, jax.make_mesh(sizes, (DATA, FSDP), axis_types=(AxisType.Auto,) * 2, devices=devices))
        # pmap requires the devices of a process to be adjacent.
        ordered = sorted(devices, key=lambda device: (device.process_index, device.id))
        return cls(kind, Mesh(np.array(ordered[:count]), (AXIS,)))

    def init(
        self, model: Trainable[Any], loop: LoopConfig, start: Callable[[Params], Params] | None = None
    ) -> TrainState:
        """Returns :func:`rsjax.training.state.create_state`'s state, created with this sharding.

        Args:
            start: makes the initial parameters from the shapes of fresh ones. A shape that it returns stands for the
                fresh parameter.

        Raises:
            ConfigError: no array can be split into ``loop.fsdp`` parts.
        """
        shapes = _shapes(model, loop)
        places = self._shardings(shapes)
        initial = None
        if start is not None:
            initial = _completed(start(shapes.params), places.params, model, loop)
        return self._make(model, loop)(initial, _place(model.init_extra(), places.extra))

    @lru_cache(maxsize=KEPT)  # noqa: B019 - a sharding is a value
    def _make(self, model: Trainable[Any], loop: LoopConfig) -> Callable[[Params | None, Extra], TrainState]:
        """Returns the compiled function from initial parameters (None: fresh ones) and ``extra`` to a state."""

        def make(initial: Params | None, extra: Extra) -> TrainState:
            # Arrays from disk are arguments, so that they do not become constants of the compiled program.
            state = create_state(model, loop, initial)
            return state.replace(extra=extra)  # type: ignore[attr-defined]

        return jax.jit(make, out_shardings=self._shardings(_shapes(model, loop)), donate_argnums=(0, 1))

    def template(self, model: Trainable[Any], loop: LoopConfig) -> TrainState:
        """Returns shapes, dtypes and shardings of :meth:`portable`'s state, to restore a checkpoint."""
        shapes = _shapes(model, loop)
        return jax.tree.map(
            lambda x, place: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), shapes, self._shardings(shapes)
        )

    @lru_cache(maxsize=KEPT)  # noqa: B019 - a sharding is a value
    def compile(self, train_step: TrainStep, model: Trainable[Any], loop: LoopConfig) -> Step:
        """Returns the compiled ``step(state, batch) -> (state, metrics)``, which donates its state.

        A training that goes on in the same process, or another one with the same settings, compiles nothing again.

        Args:
            train_step: :func:`rsjax.training.step.train_step`.
        """
        step = partial(train_step, model, loop, axis_name=AXIS if self.kind == "pmap" else None)
        if self.kind == "jit":
            return jax.jit(step, donate_argnums=0)
        if self.kind == "pmap":
            return jax.pmap(
                step,
                AXIS,
                in_axes=(None, 0),
                out_axes=None,
                donate_argnums=0,
                devices=list(self.mesh.devices.flat),
            )
        places = self._shardings(_shapes(model, loop))
        whole = NamedSharding(self.mesh, P())

        def in_mesh(state: TrainState, batch: PyTree) -> tuple[TrainState, Metrics]:
            with jax.sharding.use_abstract_mesh(self.mesh.abstract_mesh):
                return step(state, batch)

        return jax.jit(in_mesh, donate_argnums=0, in_shardings=(places, self._rows), out_shardings=(places, whole))

    def put_batch(self, batch: PyTree) -> PyTree:
        """Puts this process's part of the global batch on its devices, split along the first axis."""
        if self.kind == "jit":
            return jax.device_put(batch, SingleDeviceSharding(self.mesh.devices.flat[0]))
        if self.kind == "pmap":
            local = self.mesh.local_mesh
            split = jax.tree.map(lambda x: np.reshape(x, (local.size, -1, *np.shape(x)[1:])), batch)
            return jax.device_put(split, NamedSharding(local, P(AXIS)))
        return jax.tree.map(lambda x: jax.make_array_from_process_local_data(self._rows, np.asarray(x)), batch)

    def batch_template(self, batch: PyTree) -> PyTree:
        """Returns shapes, dtypes and shardings of :meth:`put_batch`'s batch, from those of the global batch."""
        if self.kind == "jit":
            one = SingleDeviceSharding(self.mesh.devices.flat[0])
            return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=one), batch)
        if self.kind == "mesh":
            return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=self._rows), batch)
        parts = self.mesh.size
        each = NamedSharding(self.mesh, P(AXIS))

        def split(x: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((parts, x.shape[0] // parts, *x.shape[1:]), x.dtype, sharding=each)

        return jax.tree.map(split, batch)

    @property
    def shares(self) -> bool:
        """Whether several devices share one state."""
        return self.kind == "mesh" and self.mesh.shape[FSDP] > 1

    def portable(self, state: TrainState) -> TrainState:
        """Returns the state as global arrays of all processes, for a checkpoint. The next step donates them."""
        if self.kind == "jit" or jax.process_count() == 1:
            return state

        def as_global(x: jax.Array) -> jax.Array:
            if not x.is_fully_addressable:
                return x
            return multihost_utils.host_local_array_to_global_array(x, self.mesh, P())

        return jax.tree.map(as_global, state)

    def adopt(self, state: TrainState) -> TrainState:
        """Returns a state of numpy arrays or another sharding in this sharding, without a copy if it has this one."""
        return _place(state, self._shardings(state))

    def gather(self, tree: Tree) -> Tree:
        """Returns a copy of a state, or of a part of one, on this process's first device, which it must fit on."""
        first = SingleDeviceSharding(jax.local_devices()[0])
        whole = NamedSharding(self.mesh, P())

        def one(x: jax.Array) -> jax.Array:
            return jax.device_put(x.addressable_data(0) if x.is_fully_replicated else x, first, may_alias=False)

        if not all(x.is_fully_replicated or x.is_fully_addressable for x in jax.tree.leaves(tree)):
            tree = jax.jit(lambda tree: tree, out_shardings=whole)(tree)  # other processes have parts
        return jax.tree.map(one, tree)

    @property
    def _rows(self) -> NamedSharding:
        return NamedSharding(self.mesh, P((DATA, FSDP)))

    def _shardings(self, tree: PyTree) -> PyTree:
        if self.kind == "mesh":
            rows = partitioned_arrays(tree, self.mesh.shape[FSDP])
            parts = self.mesh.shape[FSDP]
            large = any(np.prod(row.shape) >= SMALL for row in rows)
            require(
                parts == 1 or not large or cut_elements(rows) > 0,
                f"fsdp {parts} divides no axis of this model's arrays; choose one that divides its width",
            )
            return shardings(tree, self.mesh)
        one = SingleDeviceSharding(self.mesh.devices.flat[0])
        place = one if self.kind == "jit" else NamedSharding(self.mesh, P())
        return jax.tree.map(lambda _: place, tree)


@lru_cache(maxsize=KEPT)
def _shapes(model: Trainable[Any], loop: LoopConfig) -> TrainState:
    return jax.eval_shape(lambda: create_state(model, loop))


def _completed(started: Params, places: PyTree, model: Trainable[Any], loop: LoopConfig) -> Params:
    """Puts fresh parameters in place of shapes, and all into the shardings ``places``.

    Only these are drawn, since a program that draws all parameters takes seconds to compile.
    """
    is_fresh = [isinstance(x, jax.ShapeDtypeStruct) for x in jax.tree.leaves(started)]

    def draw() -> list[jax.Array]:
        leaves = jax.tree.leaves(fresh_params(model, loop))
        return [x for x, fresh in zip(leaves, is_fresh, strict=True) if fresh]

    drawn: Iterator[jax.Array] = iter(())
    if any(is_fresh):
        where = [place for place, fresh in zip(jax.tree.leaves(places), is_fresh, strict=True) if fresh]
        drawn = iter(jax.jit(draw, out_shardings=where)())
    completed = jax.tree.map(lambda x: next(drawn) if isinstance(x, jax.ShapeDtypeStruct) else x, started)
    return _place(completed, places)


def _place(tree: Tree, places: PyTree) -> Tree:
    """Puts arrays of the host or of any devices into the shardings ``places``."""

    def put(x: ArrayLike, place: jax.sharding.Sharding) -> jax.Array:
        if place.is_fully_addressable or (isinstance(x, jax.Array) and not x.is_fully_addressable):
            return jax.device_put(x, place)
        # All processes have the same array, so each takes its own part; device_put would also compare them.
        host = np.asarray(x)
        return jax.make_array_from_callback(host.shape, place, lambda index: host[index])

    return jax.tree.map(put, tree, places)


# Which arrays are split over the mesh's ``fsdp`` axis. Rules match an array's path, such as
# ``params/blocks/rgb/fc1/kernel``. The paths of optimizer moments and averaged parameters end with their parameter's
# path, so they are split in the same way.


@dataclass(frozen=True)
class Rule:
    """Arrays whose path matches ``pattern`` are split along the first of ``axes`` whose size is divisible."""

    pattern: str
    axes: tuple[int, ...]


# The first matching rule applies. Arrays without one are split along their largest axis whose size is divisible.
RULES = (
    Rule(r"^extra/", ()),  # LPIPS's weights and LeCAM's averages stay whole
    # Blocks are stacked on axis 0, which a scan iterates over; split there, each iteration would read from one device.
    Rule(r"(^|/)blocks/.*/kernel$", (2, 1)),  # (blocks, in, out)
    Rule(r"(^|/)blocks/.*/(bias|scale)$", (1,)),
    Rule(r"(^|/)(embedding|(depth_)?pos_embed)$", (-1,)),  # width, so that a look-up reads its part of every row
    Rule(r"(^|/)kernel$", (-1, -2)),  # heads and convolutions: output channels, else input channels
)


@dataclass(frozen=True)
class PartitionedArray:
    """One array of a state with its partition."""

    path: str
    shape: tuple[int, ...]
    spec: P


def spec_of(path: str, shape: tuple[int, ...], parts: int) -> P:
    """Returns how the array at ``path`` is split into ``parts``; ``P()`` if it stays whole."""
    if parts == 1 or prod(shape) < SMALL:
        return P()
    for rule in RULES:
        if re.search(rule.pattern, path):
            axes = [axis % len(shape) for axis in rule.axes if -len(shape) <= axis < len(shape)]
            break
    else:
        axes = sorted(range(len(shape)), key=lambda axis: -shape[axis])
    for axis in axes:
        if shape[axis] % parts == 0:
            return P(*[None] * axis, FSDP)
    return P()


def partitioned_arrays(tree: PyTree, parts: int) -> list[PartitionedArray]:
    """Returns every array of a tree of arrays or shapes, with its partition into ``parts``."""
    paths = ((_path(keys), leaf) for keys, leaf in jax.tree.leaves_with_path(tree))
    return [PartitionedArray(path, leaf.shape, spec_of(path, leaf.shape, parts)) for path, leaf in paths]


def shown(rows: list[PartitionedArray]) -> str:
    """Formats the table: path, shape with the split axis in brackets, and the share of all elements that is split."""
    lines = []
    for row in rows:
        cut = len(row.spec) - 1  # a spec ends with the split axis
        sizes = ", ".join(f"[{size}]" if axis == cut else str(size) for axis, size in enumerate(row.shape))
        lines.append(f"{row.path:<72} ({sizes})")
    total = sum(prod(row.shape) for row in rows)
    return "\n".join([*lines, f"{total:,} elements, {cut_elements(rows) / total:.1%} of them cut"])


def cut_elements(rows: list[PartitionedArray]) -> int:
    """Returns the number of elements in arrays that are split."""
    return sum(prod(row.shape) for row in rows if row.spec != P())


def shardings(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns a tree of :class:`NamedSharding` by the rules for the mesh's ``fsdp`` axis."""
    parts = mesh.shape[FSDP]
    return jax.tree.map_with_path(lambda keys, leaf: NamedSharding(mesh, spec_of(_path(keys), leaf.shape, parts)), tree)


def _path(keys: KeyPath) -> str:
    return jax.tree_util.keystr(keys, simple=True, separator="/")
