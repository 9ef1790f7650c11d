"""Rules for splitting arrays over a mesh's ``fsdp`` axis.

Rules match an array's path, such as ``params/blocks/rgb/fc1/kernel``. The paths of optimizer moments and averaged
parameters end with their parameter's path, so they are split in the same way.
"""

import re
from dataclasses import dataclass
from math import prod

import jax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jax.tree_util import KeyPath
from jaxtyping import PyTree

DATA, FSDP = "data", "fsdp"
SMALL = 2**14  # arrays of fewer elements stay whole, since gathering them costs more than their memory


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
    Rule(r"(^|/)(embedding|pos_embed)$", (-1,)),  # width, so that a look-up reads its part of every row
    Rule(r"(^|/)kernel$", (-1, -2)),  # heads and convolutions: output channels, else input channels
)


@dataclass(frozen=True)
class Row:
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


def table(tree: PyTree, parts: int) -> list[Row]:
    """Returns every array of a tree of arrays or shapes, with its partition into ``parts``."""
    paths = ((_path(keys), leaf) for keys, leaf in jax.tree.leaves_with_path(tree))
    return [Row(path, leaf.shape, spec_of(path, leaf.shape, parts)) for path, leaf in paths]


def shown(rows: list[Row]) -> str:
    """Formats the table: path, shape with the split axis in brackets, and the share of all elements that is split."""
    lines = [f"{row.path:<72} {_shape(row)}" for row in rows]
    total = sum(prod(row.shape) for row in rows)
    return "\n".join([*lines, f"{total:,} elements, {cut_elements(rows) / total:.1%} of them cut"])


def cut_elements(rows: list[Row]) -> int:
    """Returns the number of elements in arrays that are split."""
    return sum(prod(row.shape) for row in rows if row.spec != P())


def shardings(tree: PyTree, mesh: Mesh) -> PyTree:
    """Returns a tree of :class:`NamedSharding` by the rules for the mesh's ``fsdp`` axis."""
    parts = mesh.shape[FSDP]
    return jax.tree.map_with_path(lambda keys, leaf: NamedSharding(mesh, spec_of(_path(keys), leaf.shape, parts)), tree)


def _path(keys: KeyPath) -> str:
    return jax.tree_util.keystr(keys, simple=True, separator="/")


def _shape(row: Row) -> str:
    cut = len(row.spec) - 1  # a spec ends with the split axis
    return f"({', '.join(f'[{size}]' if axis == cut else str(size) for axis, size in enumerate(row.shape))})"
