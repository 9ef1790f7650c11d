"""Tables that map public tensor names to flax parameters, and the conversion in both directions.

A table has one :class:`Entry` per public tensor. Reading uses every tensor exactly once and fills every parameter
exactly once; one error names everything that does not fit.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jax import dtypes

from rsjax.tools.convert.files import ConvertError, Tensors
from rsjax.trainable import Params

Layout = Literal["same", "linear", "conv", "lead", "conv3d", "linear3d"]
Shape = tuple[int, ...]
Names = Mapping[str, str]  # a tensor's name in this project → its name in its file

SAME_NAMES: Names = MappingProxyType({})

# (torch → flax, flax → torch)
LAYOUTS: dict[Layout, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
    "same": (lambda x: x, lambda x: x),
    "linear": (lambda x: x.T, lambda x: x.T),  # (out, in) ↔ (in, out)
    "conv": (lambda x: x.transpose(2, 3, 1, 0), lambda x: x.transpose(3, 2, 0, 1)),  # OIHW ↔ HWIO
    "lead": (lambda x: x[0], lambda x: x[None]),  # torch keeps a leading axis of one
    "conv3d": (lambda x: x.transpose(2, 3, 4, 1, 0), lambda x: x.transpose(4, 3, 0, 1, 2)),  # OITHW ↔ THWIO
    "linear3d": (lambda x: x[..., 0, 0, 0].T, lambda x: x.T[..., None, None, None]),  # a 1×1×1 convolution
}
NAMED = 8  # names of each kind that an error lists; the others are only counted
_DIFFUSERS_PARTS = (
    (r"(down|up)_(\d+)_block_(\d+)", r"\1_blocks.\2.resnets.\3"),
    (r"(down|up)_(\d+)_(down|up)sample", r"\1_blocks.\2.\3samplers.0"),
    (r"mid_block_(\d)", r"mid_block.resnets.\1"),
    (r"mid_attention", "mid_block.attentions.0"),
    (r"to_out", "to_out.0"),
    (r"\bnorm_out", "conv_norm_out"),
    (r"\b(kernel|scale)$", "weight"),
)


@dataclass(frozen=True)
class Entry:
    """A public tensor and the parameter, or the slice of a stacked parameter, that holds it."""

    key: str  # public name, dotted
    path: str  # flax path, joined by /
    layout: Layout = "same"
    layer: int | None = None  # index along the leading axis of a parameter that is stacked over blocks


Table = tuple[Entry, ...]


def weight_and_bias(key: str, path: str, layout: Layout, layer: int | None = None) -> Table:
    """Returns the entries of a linear layer or convolution with a bias."""
    return (Entry(f"{key}.weight", f"{path}/kernel", layout, layer), Entry(f"{key}.bias", f"{path}/bias", layer=layer))


def norm(key: str, path: str, layer: int | None = None) -> Table:
    """Returns the entries of a normalisation with scale and shift."""
    return (Entry(f"{key}.weight", f"{path}/scale", layer=layer), Entry(f"{key}.bias", f"{path}/bias", layer=layer))


def public_shapes(table: Table, shapes: Any) -> dict[str, Shape]:
    """Returns the shape of every public tensor.

    Args:
        shapes: the parameters, or their shapes from ``jax.eval_shape``.

    Raises:
        ConvertError: the network and the table do not have the same parameters.
    """
    flat = flatten_dict(shapes, sep="/")
    stacked = {entry.path for entry in table if entry.layer is not None}
    slots = [(path, i) for path, x in flat.items() for i in (range(x.shape[0]) if path in stacked else (None,))]
    known = [(entry.path, entry.layer) for entry in table]
    if sorted(slots, key=repr) != sorted(known, key=repr):
        names = {path for path, _ in set(slots) ^ set(known)}
        raise ConvertError(f"the public format has no name for these parts of the network: {_some(names)}")
    public: dict[str, Shape] = {}
    for entry in table:
        if entry.layer is None:
            own = flat[entry.path].shape
        else:
            own = flat[entry.path].shape[1:]
        public[entry.key] = LAYOUTS[entry.layout][1](np.broadcast_to(np.float32(0), own)).shape
    return public


def to_params(source: object, tensors: Tensors, table: Table, shapes: Any, names: Names = SAME_NAMES) -> dict[str, Any]:
    """Converts public tensors to float32 parameters.

    Args:
        source: the file of the tensors, for error messages.
        tensors: exactly those of the table, of any floating type.
        shapes: ``jax.eval_shape`` of the parameters.
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: as :func:`check`.
    """
    check(source, tensors, public_shapes(table, shapes), names)
    flat = {path: np.empty(leaf.shape, np.float32) for path, leaf in flatten_dict(shapes, sep="/").items()}
    for entry in table:
        value = LAYOUTS[entry.layout][0](tensors[entry.key])
        flat[entry.path][... if entry.layer is None else entry.layer] = value
    return unflatten_dict(flat, sep="/")


def to_tensors(params: Any, table: Table) -> Tensors:
    """Converts parameters to public tensors; the inverse of :func:`to_params`.

    Raises:
        ConvertError: the public format has no name for a parameter of the network.
    """
    public_shapes(table, params)
    flat = flatten_dict(params, sep="/")
    return {
        e.key: LAYOUTS[e.layout][1](np.asarray(flat[e.path] if e.layer is None else flat[e.path][e.layer]))
        for e in table
    }


def shape_of(source: object, tensors: Tensors, key: str, axes: int, names: Names = SAME_NAMES) -> Shape:
    """Returns the shape of a tensor from which a network is inferred.

    Raises:
        ConvertError: there is no such tensor, or it has the wrong number of axes, or no values.
    """
    name = names.get(key, key)
    if key not in tensors:
        raise ConvertError(f"{source}: {name} is missing")
    shape = tensors[key].shape
    if len(shape) != axes or not all(shape):
        raise ConvertError(f"{source}: {name} is of shape {shape}; it has {axes} axes, and values")
    return shape


def check(source: object, tensors: Tensors, expected: dict[str, Shape], names: Names = SAME_NAMES) -> None:
    """Compares names and shapes of tensors, and checks that their values are finite floats.

    Args:
        names: the tensors' names in the file, where they differ, for error messages.

    Raises:
        ConvertError: tensors are missing, unexpected, of the wrong shape or type, or not finite in float32; one message
            reports them all.
    """
    both = {key: (names.get(key, key), tensors[key], shape) for key, shape in expected.items() if key in tensors}
    floats = [(n, x) for n, x, _ in both.values() if _is_float(x)]
    with np.errstate(over="ignore"):
        not_finite = [n for n, x in floats if not np.isfinite(x.astype(np.float32)).all()]
    misfits: dict[str, Collection[str]] = {
        "missing": [names.get(key, key) for key in expected.keys() - tensors.keys()],
        "unexpected": [names.get(key, key) for key in tensors.keys() - expected.keys()],
        "of another shape": [f"{n} is {x.shape}, not {shape}" for n, x, shape in both.values() if x.shape != shape],
        "not floats": [f"{n} is {x.dtype}" for n, x, _ in both.values() if not _is_float(x)],
        "with NaN or infinite values": not_finite,
    }
    listed = "; ".join(f"{kind}: {_some(which)}" for kind, which in misfits.items() if which)
    if listed:
        raise ConvertError(f"{source}: its tensors do not fit the network inferred from them; {listed}")


def _is_float(x: np.ndarray) -> bool:
    return bool(dtypes.issubdtype(x.dtype, np.floating))  # bfloat16 included


def _some(names: Iterable[str]) -> str:
    listed = sorted(names)
    if len(listed) > NAMED:
        return f"{', '.join(listed[:NAMED])} and {len(listed) - NAMED} more"
    return ", ".join(listed)


def vae_table(shapes: Params, more: Sequence[tuple[str, str]] = ()) -> Table:
    """Returns an entry for each parameter of :mod:`rsjax.tokenizers.vae_blocks`, under ``diffusers``' names.

    Args:
        shapes: the parameters' shapes.
        more: further (regular expression for a part of a dotted path, its replacement), which are applied first.
    """
    return renamed_table(shapes, (*more, *_DIFFUSERS_PARTS), {2: "linear", 4: "conv"})


def renamed_table(shapes: Params, parts: Sequence[tuple[str, str]], layouts: Mapping[int, Layout]) -> Table:
    """Returns an entry for each parameter, whose public name is its dotted path after all replacements.

    Args:
        shapes: the parameters' shapes.
        parts: pairs of a regular expression for a part of a dotted path and its replacement, applied in order.
        layouts: the layout of kernels by their number of axes.
    """
    entries = []
    for path, x in flatten_dict(shapes, sep="/").items():
        key = path.replace("/", ".")
        for own, public in parts:
            key = re.sub(own, public, key)
        entries.append(Entry(key, path, layouts[x.ndim] if path.endswith("kernel") else "same"))
    return tuple(entries)
