"""Tables between public tensor names and flax parameters, and the two ways through them.

A table is data: one :class:`Entry` per public tensor. Reading uses every tensor exactly once and fills every parameter
exactly once; whatever does not fit is named, all of it in one error.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.convert.files import ConvertError, Tensors

Layout = Literal["same", "linear", "conv", "lead"]
Shape = tuple[int, ...]

# (torch → flax, flax → torch)
LAYOUTS: dict[Layout, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
    "same": (lambda x: x, lambda x: x),
    "linear": (lambda x: x.T, lambda x: x.T),  # (out, in) ↔ (in, out)
    "conv": (lambda x: x.transpose(2, 3, 1, 0), lambda x: x.transpose(3, 2, 0, 1)),  # OIHW ↔ HWIO
    "lead": (lambda x: x[0], lambda x: x[None]),  # torch keeps a leading axis of one
}
NAMED = 8  # misfits of each kind that an error names; the others are counted


@dataclass(frozen=True)
class Entry:
    """One public tensor and the parameter, or the part of one, that it is."""

    key: str  # public name, dotted
    path: str  # flax path, parts joined by /
    layout: Layout = "same"
    layer: int | None = None  # place along the leading axis of a parameter that is stacked over blocks


Table = tuple[Entry, ...]


def weight_and_bias(key: str, path: str, layout: Layout, layer: int | None = None) -> Table:
    """A linear layer or convolution that has a bias."""
    return (Entry(f"{key}.weight", f"{path}/kernel", layout, layer), Entry(f"{key}.bias", f"{path}/bias", layer=layer))


def norm(key: str, path: str, layer: int | None = None) -> Table:
    """A normalisation with scale and shift."""
    return (Entry(f"{key}.weight", f"{path}/scale", layer=layer), Entry(f"{key}.bias", f"{path}/bias", layer=layer))


def public_shapes(table: Table, shapes: Any) -> dict[str, Shape]:
    """The shape of every public tensor.

    Args:
        shapes: the parameters, or their ``jax.eval_shape``.

    Raises:
        ConvertError: the network has parameters that the table does not know, or the other way round.
    """
    flat = flatten_dict(shapes, sep="/")
    _check_complete(table, {path: leaf.shape for path, leaf in flat.items()})
    found: dict[str, Shape] = {}
    for entry in table:
        own = flat[entry.path].shape if entry.layer is None else flat[entry.path].shape[1:]
        found[entry.key] = LAYOUTS[entry.layout][1](np.broadcast_to(np.float32(0), own)).shape
    return found


def to_params(source: object, tensors: Tensors, table: Table, shapes: Any) -> dict[str, Any]:
    """Public tensors to float32 parameters.

    Args:
        source: where the tensors are from, for the error.
        tensors: exactly those of the table, any floating type.
        shapes: ``jax.eval_shape`` of the parameters.

    Raises:
        ConvertError: a tensor is missing, left over or of another shape; all are named.
    """
    expected = public_shapes(table, shapes)
    check(source, {key: x.shape for key, x in tensors.items()}, expected)
    flat = {path: np.empty(leaf.shape, np.float32) for path, leaf in flatten_dict(shapes, sep="/").items()}
    for entry in table:
        value = LAYOUTS[entry.layout][0](tensors[entry.key])
        flat[entry.path][... if entry.layer is None else entry.layer] = value
    return unflatten_dict(flat, sep="/")


def to_tensors(params: Any, table: Table) -> Tensors:
    """Parameters to public tensors; the inverse of :func:`to_params`.

    Raises:
        ConvertError: the network has parameters for which there is no public name.
    """
    public_shapes(table, params)
    flat = flatten_dict(params, sep="/")
    return {
        e.key: LAYOUTS[e.layout][1](np.asarray(flat[e.path] if e.layer is None else flat[e.path][e.layer]))
        for e in table
    }


def check(source: object, found: dict[str, Shape], expected: dict[str, Shape]) -> None:
    """Compares names and shapes.

    Raises:
        ConvertError: they differ; every kind of misfit is named.
    """
    reshaped = [key for key in found.keys() & expected.keys() if found[key] != expected[key]]
    misfits: dict[str, Collection[str]] = {
        "missing": expected.keys() - found.keys(),
        "left over": found.keys() - expected.keys(),
        "misshapen": [f"{key} is {found[key]}, not {expected[key]}" for key in reshaped],
    }
    told = [f"{kind}: {_some(names)}" for kind, names in misfits.items() if names]
    if told:
        raise ConvertError(f"{source}: its tensors do not fit the network that they seem to be of; {'; '.join(told)}")


def _check_complete(table: Table, shapes: dict[str, Shape]) -> None:
    stacked = {entry.path for entry in table if entry.layer is not None}
    slots = [(p, i) for p, s in shapes.items() for i in (range(s[0]) if p in stacked else (None,))]
    known = [(entry.path, entry.layer) for entry in table]
    if sorted(slots, key=repr) != sorted(known, key=repr):
        names = {path for path, _ in set(slots) ^ set(known)}
        raise ConvertError(f"the public format has no name for these parts of the network: {_some(names)}")


def _some(names: Iterable[str]) -> str:
    listed = sorted(names)
    more = f" and {len(listed) - NAMED} more" if len(listed) > NAMED else ""
    return ", ".join(listed[:NAMED]) + more
