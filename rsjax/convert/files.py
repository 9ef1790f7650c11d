"""Tensor files as dictionaries of numpy arrays. Nothing that a file holds is ever executed."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from rsjax.errors import UserError, first_line
from rsjax.files import disk_guard, write_atomically

Tensors = dict[str, np.ndarray]

SAFE = ".safetensors"
PICKLED = (".ckpt", ".pt", ".pth", ".bin")  # PyTorch's own; a pickle inside


class ConvertError(UserError):
    """A file that cannot be converted. The message names it and the cure."""


def read_tensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    """The tensors of a file by name, and its metadata (none but in safetensors).

    Args:
        path: a ``.safetensors`` file, or one of PyTorch's, whose ``state_dict`` is taken where it has one.

    Raises:
        ConvertError: no such file, of another kind, damaged, or holding more than tensors; or PyTorch is needed.
    """
    if not path.is_file():
        raise ConvertError(f"{path}: no such file")
    if path.suffix == SAFE:
        return _read_safetensors(path)
    if path.suffix in PICKLED:
        return _read_torch(path), {}
    raise ConvertError(f"{path}: not a kind of file that is read; give one that ends in {SAFE} or {', '.join(PICKLED)}")


def write_safetensors(path: Path, tensors: Tensors, metadata: dict[str, str]) -> None:
    """Writes a safetensors file that appears whole or not at all.

    Raises:
        StoreError: the disk is full, or the place cannot be written.
    """
    # safetensors writes memory as it lies, whatever the strides.
    contiguous = {name: np.ascontiguousarray(x) for name, x in tensors.items()}
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, safetensors.numpy.save(contiguous, metadata))


def _read_safetensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    try:
        with safetensors.safe_open(path, "np") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise ConvertError(f"{path}: not a safetensors file, or damaged ({error})") from error


def _read_torch(path: Path) -> Tensors:
    try:
        torch: Any = importlib.import_module("torch")
    except ImportError:
        raise ConvertError(
            f"{path}: reading {path.suffix} files needs PyTorch; install it (pip install 'rsjax[torch]'), or give the "
            f"same weights as a {SAFE} file, which needs nothing"
        ) from None
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch reports damage, and what it refuses to run, as many types
        raise ConvertError(
            f"{path}: refused, it is damaged or holds more than tensors, and loading that could run any code "
            f"({first_line(error)}); give the same weights as a {SAFE} file"
        ) from error
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(x, torch.Tensor) for x in state.values()):
        raise ConvertError(f"{path}: neither holds tensors by name nor has a state_dict that does")
    # numpy has no bfloat16; float32 holds every one of its numbers.
    values = {name: x.detach() for name, x in state.items()}  # parameters that want a gradient refuse numpy()
    return {name: (x.float() if x.dtype == torch.bfloat16 else x).numpy() for name, x in values.items()}
