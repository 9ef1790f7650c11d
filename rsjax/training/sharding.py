"""Rules that say which axis of which array is cut over a mesh's ``fsdp`` axis, and what they give for a state.

An array is known by its path, such as ``params/blocks/rgb/fc1/kernel``. Optimizer moments and averaged parameters have
their parameter's path as the end of their own, so they are cut as it is.
"""

import re
from dataclasses import dataclass
from math import prod
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

DATA, FSDP = "data", "fsdp"
SMALL = 2**14  # elements; smaller arrays stay whole: gathering them costs more time than they take memory


@dataclass(frozen=True)
class Rule:
    """Arrays whose path has a match of ``pattern`` are cut along the first of ``axes`` that divides."""

    pattern: str
    axes: tuple[int, ...]


# The first rule that matches decides. Arrays that none matches are cut along their largest axis that divides.
RULES = (
    Rule(r"^extra/", ()),  # LPIPS's weights and averages: read whole, never trained
    # Blocks are stacked on axis 0, which a scan walks along: cut there, each turn would read from one device.
    Rule(r"(^|/)blocks/.*/kernel$", (2, 1)),  # (blocks, in, out)
    Rule(r"(^|/)blocks/.*/(bias|scale)$", (1,)),
    Rule(r"(^|/)(embedding|pos_embed)$", (-1,)),  # width: a look-up reads its part of every row
    Rule(r"(^|/)kernel$", (-1, -2)),  # heads and convolutions: output channels, else input channels
)


@dataclass(frozen=True)
class Row:
    """One array of a state: where it is, and how it lies."""

    path: str
    shape: tuple[int, ...]
    spec: P


def spec_of(path: str, shape: tuple[int, ...], parts: int) -> P:
    """How the array at ``path`` is cut into ``parts``; ``P()`` where it stays whole."""
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


def table(tree: Any, parts: int) -> list[Row]:
    """Every array of a tree of arrays or their shapes, with its cut into ``parts``."""
    paths = ((_path(keys), leaf) for keys, leaf in jax.tree.leaves_with_path(tree))
    return [Row(path, leaf.shape, spec_of(path, leaf.shape, parts)) for path, leaf in paths]


def shown(rows: list[Row]) -> str:
    """The table as text: path, shape with the cut axis in brackets, and the share of all elements that is cut."""
    lines = [f"{row.path:<72} {_shape(row)}" for row in rows]
    total = sum(prod(row.shape) for row in rows)
    return "\n".join([*lines, f"{total:,} elements, {cut_elements(rows) / total:.1%} of them cut"])


def cut_elements(rows: list[Row]) -> int:
    """How many elements lie in arrays that are cut."""
    return sum(prod(row.shape) for row in rows if row.spec != P())


def shardings(tree: Any, mesh: Mesh) -> Any:
    """The same tree of :class:`NamedSharding`, as the rules say for the mesh's ``fsdp`` axis."""
    parts = mesh.shape[FSDP]
    return jax.tree.map_with_path(lambda keys, leaf: NamedSharding(mesh, spec_of(_path(keys), leaf.shape, parts)), tree)


def _path(keys: Any) -> str:
    return jax.tree_util.keystr(keys, simple=True, separator="/")


def _shape(row: Row) -> str:
    cut = len(row.spec) - 1  # a spec ends with the axis that is cut
    return f"({', '.join(f'[{size}]' if axis == cut else str(size) for axis, size in enumerate(row.shape))})"
