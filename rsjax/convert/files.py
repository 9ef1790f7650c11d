"""Reads and writes tensor files as dictionaries of numpy arrays, without executing anything from them."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from rsjax.errors import UserError, first_line
from rsjax.files import placeholder, write_file

Tensors = dict[str, np.ndarray]

SAFE = ".safetensors"
PICKLED = (".ckpt", ".pt", ".pth", ".bin")  # PyTorch's own; a pickle inside


class ConvertError(UserError):
    """A file cannot be converted. The message names it and the cure."""


def read_tensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    """Returns the tensors of a file by name, and its metadata (always empty for PyTorch's files).

    Args:
        path: a ``.safetensors`` file, or one of PyTorch's; of the latter, the ``state_dict`` if it has one.

    Raises:
        ConvertError: the file does not exist, is of another kind, is damaged, or holds more than tensors; or PyTorch
            is not installed.
    """
    if not path.is_file():
        raise ConvertError(f"{path}: no such file")
    if instead := placeholder(path):
        raise ConvertError(f"{path}: {instead}")
    if path.suffix == SAFE:
        return _read_safetensors(path)
    if path.suffix in PICKLED:
        return _read_torch(path), {}
    raise ConvertError(f"{path}: unknown kind of file; pass one that ends in {SAFE} or {', '.join(PICKLED)}")


def write_safetensors(path: Path, tensors: Tensors, metadata: dict[str, str]) -> None:
    """Writes a safetensors file atomically. Errors as in :func:`rsjax.files.write_file`."""
    # safetensors writes memory in its order, ignoring strides.
    contiguous = {name: np.ascontiguousarray(x) for name, x in tensors.items()}
    write_file(path, safetensors.numpy.save(contiguous, metadata))


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
            f"{path}: reading {path.suffix} files needs PyTorch; install it (pip install 'rsjax[torch]'), or pass the "
            f"same weights as a {SAFE} file"
        ) from None
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many types for damage and for content that it refuses
        raise ConvertError(
            f"{path}: refused: it is damaged, or holds more than tensors, which could run any code when loaded "
            f"({first_line(error)}); pass the same weights as a {SAFE} file"
        ) from error
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(x, torch.Tensor) for x in state.values()):
        raise ConvertError(f"{path}: holds no tensors by name, and no state_dict with them")
    # numpy has no bfloat16; float32 represents each of its numbers.
    values = {name: x.detach() for name, x in state.items()}  # parameters that require a gradient refuse numpy()
    return {name: (x.float() if x.dtype == torch.bfloat16 else x).numpy() for name, x in values.items()}
