"""Reads and writes tensor files as dictionaries of numpy arrays, without executing anything from them."""

import importlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import safetensors
import safetensors.numpy

from rsjax.config import ConfigError, from_dict
from rsjax.errors import UserError, first_line
from rsjax.files import parse_json, placeholder, read_json, write_file, write_json

Tensors = dict[str, np.ndarray]
T = TypeVar("T")

SAFE = ".safetensors"
REPLACES = "; it replaces the one that was there"
PICKLED = (".ckpt", ".pt", ".pth", ".bin")  # PyTorch's own formats, which contain a pickle
SETTINGS = "config.json"  # published beside a file of weights
HOLDERS = ("state_dict", "model_state_dict", "model")  # keys under which training scripts save a network's tensors
# The prefixes that DistributedDataParallel and torch.compile add to names.
_WRAPPED = re.compile(r"^module\.|(?<![^.])_orig_mod\.")
# Types that training scripts save beside tensors. Each is replaced by a placeholder, so that none of their code runs.
_HARMLESS = (
    "argparse.Namespace",
    "typing.Any",
    *(f"pathlib{module}.{kind}Path" for module in ("", "._local") for kind in ("", "Posix", "Windows")),
    *(f"pathlib{module}.Pure{kind}Path" for module in ("", "._local") for kind in ("", "Posix", "Windows")),
    "numpy.dtype",
    "numpy.ndarray",
    *(f"numpy.{core}.multiarray.{name}" for core in ("core", "_core") for name in ("scalar", "_reconstruct")),
    *(f"numpy.dtypes.{name}DType" for name in ("Bool", "Int32", "Int64", "Float16", "Float32", "Float64")),
    *(f"omegaconf.{name}" for name in ("dictconfig.DictConfig", "listconfig.ListConfig", "nodes.AnyNode")),
    *(f"omegaconf.base.{name}" for name in ("ContainerMetadata", "Metadata")),
    # Types that OmegaConf's metadata name; plain dicts and lists have their own pickle opcodes and are read as such.
    *(f"builtins.{name}" for name in ("dict", "int", "list")),
)


class ConvertError(UserError):
    """A file cannot be converted. The message names it and the cure."""


class TensorFile(NamedTuple):
    """The content of a file of tensors.

    Attributes:
        tensors: by name, without what DistributedDataParallel (``module.``) and torch.compile (``_orig_mod.``) add.
        metadata: the metadata of a safetensors file; empty for PyTorch's formats.
        names: each tensor's name in the file, by its name in ``tensors``.
        others: how many more tensors the file has, by the key that holds them; empty for a safetensors file.
        key: the key that holds the tensors; empty if none does.
    """

    tensors: Tensors
    metadata: dict[str, str]
    names: dict[str, str]
    others: dict[str, int]
    key: str


def read_tensors(path: Path, holders: Sequence[str] = HOLDERS) -> TensorFile:
    """Reads the tensors of a file.

    Args:
        path: a ``.safetensors`` file or one of PyTorch's, in which a key of ``holders`` may hold the network.
        holders: keys under which to look for the network's tensors, in this order.

    Raises:
        ConvertError: the file does not exist, is of another kind, is damaged, or contains objects that could run code;
            numpy lacks a tensor's type; or PyTorch is needed and not installed.
    """
    if not path.is_file():
        what = "is a pipe or device; name a file"
        if path.is_dir():
            what = "is a directory; name a file in it"
        elif not path.exists():
            what = "no such file"
        raise ConvertError(f"{path}: {what}")
    if instead := placeholder(path):
        raise ConvertError(f"{path}: {instead}")
    read: Tensors = {}
    metadata: dict[str, str] = {}
    others: dict[str, int] = {}
    key = ""
    if path.suffix == SAFE:
        try:
            with safetensors.safe_open(path, "np") as file:
                for name in file.keys():  # noqa: SIM118 - it is not a dict
                    try:
                        read[name] = file.get_tensor(name)
                    except (AttributeError, TypeError) as error:  # numpy has no such type
                        raise _unreadable(path, name, file.get_slice(name).get_dtype()) from error
                metadata = file.metadata() or {}
        except (safetensors.SafetensorError, OSError) as error:
            raise ConvertError(f"{path}: not a safetensors file, or damaged ({first_line(error)})") from error
    elif path.suffix in PICKLED:
        read, others, key = _read_torch(path, holders)
    else:
        raise ConvertError(f"{path}: unknown kind of file; pass one that ends in {SAFE} or {', '.join(PICKLED)}")
    names: dict[str, str] = {}
    for name in read:
        own = _WRAPPED.sub("", name)
        if own in names:
            raise ConvertError(f"{path}: {own} occurs twice, as {names[own]} and as {name}; keep one of them")
        names[own] = name
    return TensorFile({own: read[name] for own, name in names.items()}, metadata, names, others, key)


def described(settings: Any) -> str:
    """Returns the fields of a model's settings, without nested ones: those belong to other networks."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    return ", ".join(f"{name} {value}" for name, value in values.items() if not is_dataclass(value))


def left_aside(*groups: Mapping[str, int]) -> list[str]:
    """Returns a line for each group of a file's tensors that are not converted, or one that says there are none."""
    counts = [(name, n) for group in groups for name, n in sorted(group.items()) if n]
    lines = [f"left aside: {n} tensor{'s' * (n > 1)} of {name}" for name, n in counts]
    return lines or ["left aside: no tensors"]


def write_safetensors(path: Path, tensors: Tensors, metadata: dict[str, str]) -> None:
    """Writes a safetensors file atomically. Errors as in :func:`rsjax.files.write_file`."""
    # safetensors writes memory as it lies and ignores strides.
    contiguous = {name: np.ascontiguousarray(x) for name, x in tensors.items()}
    write_file(path, safetensors.numpy.save(contiguous, metadata))


def check_file(out: Path) -> str:
    """Checks the name of the file to write; returns a note for the message if the file replaces another one."""
    if out.suffix != SAFE:
        raise ConvertError(f"{out}: the output is a {SAFE} file; name OUT accordingly")
    return REPLACES * out.exists()


def write_published(out: Path, tensors: Tensors, settings: dict[str, Any]) -> None:
    """Writes a file of tensors with its settings beside it, as the public checkpoints come.

    Raises:
        ConvertError: other settings are there already.
        FileError: the files cannot be written.
    """
    beside = out.parent / SETTINGS
    cure = "write to an empty directory"
    if beside.exists() and read_json(beside, cure=cure) != settings:
        raise ConvertError(f"{beside}: exists with other settings; {cure}")
    write_safetensors(out, tensors, {})
    write_json(beside, settings)


def exported_config(kind: type[T], source: Path, metadata: dict[str, str], key: str) -> T | None:
    """Returns the configuration that this project wrote into a file's metadata; None if another program made the file.

    Raises:
        ConvertError: it is damaged.
    """
    if key not in metadata:
        return None
    try:
        return from_dict(kind, parse_json(metadata[key]))
    except (ValueError, TypeError, ConfigError) as error:
        raise ConvertError(f"{source}: its metadata {key} are of another version or damaged ({error})") from error


class _Placeholder:
    """Stands for an object that is not a tensor; built in its place, whatever the file says."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __setstate__(self, state: object) -> None: ...


def _read_torch(path: Path, holders: Sequence[str]) -> tuple[Tensors, dict[str, int], str]:
    try:
        torch: Any = importlib.import_module("torch")
    except ImportError:
        raise ConvertError(
            f"{path}: reading {path.suffix} files needs PyTorch; install it (pip install 'rsjax[torch]'), or pass the "
            f"same weights as a {SAFE} file"
        ) from None
    content = _unpickled(path, torch)
    holding = (holder for holder in holders if isinstance(content, dict) and _tensors(content.get(holder), torch))
    key = next(holding, "")
    if key:
        state = content[key]
    else:
        state = content
    tensors = _tensors(state, torch)
    if not tensors:
        raise ConvertError(f"{path}: holds no tensors by name, also under none of the keys {', '.join(holders)}")
    others = {}
    for name, value in content.items():
        if value is state:
            read = len(tensors)
        else:
            read = state is content and name in tensors
        if more := _count(value, torch) - read:
            others[f"the file's key {name}"] = more
    arrays: Tensors = {}
    for name, tensor in tensors.items():
        try:
            x = tensor.detach()  # parameters that require a gradient refuse numpy()
            # numpy has no bfloat16; float32 represents each of its numbers.
            arrays[name] = (x.float() if x.dtype == torch.bfloat16 else x).numpy()
        except Exception as error:  # torch raises several types for tensors that are sparse, quantized or on no device
            raise _unreadable(path, name, str(tensor.dtype).removeprefix("torch.")) from error
    return arrays, others, key


def _unpickled(path: Path, torch: Any) -> Any:
    """Loads a PyTorch file with ``weights_only``: tensors, plain values, and placeholders for other objects."""

    def without_default(*_: object) -> dict[Any, Any]:  # stands for defaultdict; drops its factory without a call
        return {}

    stand_ins = [(_Placeholder, name) for name in _HARMLESS] + [(without_default, "collections.defaultdict")]
    try:
        with torch.serialization.safe_globals(stand_ins):
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for damage and for content that it refuses
        # torch's messages advise loading the file without this protection, so they are not shown.
        unknown = re.search(r"GLOBAL (\S+)", str(error))
        why = "it is damaged or no weights"
        if unknown:
            why = f"it holds {unknown[1]:.80}, which could run code when loaded"
        raise ConvertError(f"{path}: refused: {why}; pass the same weights as a {SAFE} file") from error


def _tensors(state: Any, torch: Any) -> dict[str, Any]:
    """Returns the tensors of a state dict; other values, such as counters, are left out."""
    if not isinstance(state, dict):
        return {}
    return {name: x for name, x in state.items() if isinstance(name, str) and isinstance(x, torch.Tensor)}


def _count(value: Any, torch: Any) -> int:
    """Returns the number of tensors in nested dicts and sequences."""
    if isinstance(value, dict):
        return sum(_count(x, torch) for x in value.values())
    if isinstance(value, list | tuple):
        return sum(_count(x, torch) for x in value)
    return int(isinstance(value, torch.Tensor))


def _unreadable(path: Path, name: str, dtype: str) -> ConvertError:
    return ConvertError(f"{path}: {name} is of type {dtype} or a form that cannot be read; save it as dense float32")


_KINDS = {bool: "true or false", int: "a whole number", float: "a number"}
S = TypeVar("S", bool, int, float)


def check_type(source: object, name: str, value: object, example: bool | int | float) -> None:
    """Raises :class:`ConvertError` unless a setting is null or of the example's type; integers count as floats, too."""
    is_integer_for_float = type(example) is float and type(value) is int
    if value is not None and type(value) is not type(example) and not is_integer_for_float:
        raise ConvertError(f"{source}: {name} is {json.dumps(value):.80}, not {_KINDS[type(example)]}")


def setting(source: object, settings: dict[str, Any], name: str, default: S) -> S:
    """Returns a setting from ``published_settings``, or its default if it is missing or null.

    Raises:
        ConvertError: it is not of its default's type, or a number that is not above 0.
    """
    value = settings.get(name)
    where = f"{source}: its config.json"
    check_type(where, name, value, default)
    if value is None:
        return default
    if type(value) is not bool and not 0 < value < math.inf:
        raise ConvertError(f"{where}: {name} is {json.dumps(value)}, not above 0")
    return value  # type: ignore[no-any-return]


def published_settings(weights: Path, *classes: str) -> dict[str, Any]:
    """Reads the settings beside a file of weights in diffusers' layout; returns an empty dict if there are none.

    Args:
        classes: names of the networks that the settings may describe.

    Raises:
        UserError: the file is damaged or describes another network.
    """
    path = weights.parent / SETTINGS
    if not path.exists():
        return {}
    cure = f"put the published one beside {weights.name}, or delete it"
    settings = read_json(path, cure=cure)
    named = settings.get("_class_name", "no network")
    if named not in classes:
        raise ConvertError(f"{path}: describes {named}, not {' or '.join(classes)}; {cure}")
    return settings
