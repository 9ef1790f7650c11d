"""The two kinds of directory that hold a model's weights, and how to read them alike.

A **run directory**, which ``rsjax train`` makes, has ``config.json`` and the folders ``tokenizer/weights`` and
``world_model/weights``. A **saved model** is small and complete, to be copied, published and loaded anywhere:

- ``config.json``: the configuration, as in a run, with one more section, ``saved``: the normalization of actions and
  depth, the type of the weights, and the SHA-256 of each file of tensors;
- ``model.safetensors``: the parameters of both networks, named ``tokenizer/…`` and ``world_model/…``;
- ``README.md``: the model card;
- ``clips``, if there are any: a store of a few clips to begin with.
"""

import hashlib
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

import jax
import numpy as np
import safetensors.numpy

from rsjax import __version__
from rsjax.errors import UserError, first_line
from rsjax.files import disk_guard, placeholder, read_json, regular, replace_directory, write_file, write_json
from rsjax.training.checkpoint import load_weights

Part: TypeAlias = Literal["tokenizer", "world_model"]
Dtype: TypeAlias = Literal["float32", "float16"]
Tree = TypeVar("Tree")  # a tree of arrays, or of their shapes

SETTINGS = "config.json"
TENSORS = "model.safetensors"
CARD = "README.md"
CLIPS = "clips"
SECTION = "saved"
AGAIN = "copy it again from where it came from"
PRETRAINED = Path(__file__).parent / "pretrained"
SHIPPED = ("tiny", "multitask")


class ModelFileError(UserError):
    """A saved model is damaged, or cannot be written. The message names the file and the cure."""


def locate(name: Path | str) -> Path:
    """Returns the directory of a model: the path itself or, for a name such as "tiny", the model in the package.

    A directory of that name in the working directory comes first.
    """
    path = Path(name)
    if str(name) not in SHIPPED or path.exists():
        return path
    return PRETRAINED / path


def output_directory(model: Path, name: str) -> Path:
    """Returns where files that were made with a model go by default: beside it, or in runs/ if it is the package's."""
    if model.parent == PRETRAINED:
        return Path("runs") / model.name / name
    return model / name


def is_saved(directory: Path) -> bool:
    """Returns whether a directory is a saved model, and not a run's."""
    return (directory / TENSORS).exists()


def read_settings(directory: Path, cure: str) -> dict[str, Any]:
    """Reads ``config.json`` without the section of a saved model. Arguments and errors as of ``read_json``."""
    settings = read_json(directory / SETTINGS, cure=cure)
    settings.pop(SECTION, None)
    return settings


def has_weights(directory: Path, part: Part) -> bool:
    """Returns whether a directory has the weights of a network, or is a saved model, which may have them."""
    return is_saved(directory) or (directory / part / "weights").exists()


def load_part(directory: Path, part: Part, like: Tree) -> Tree:
    """Reads the parameters of a network.

    Args:
        like: parameters of the same structure, or their shapes. Weights in half precision become float32 again.

    Raises:
        UserError: the parameters are missing or damaged, or have another architecture.
    """
    if not is_saved(directory):
        return load_weights(directory / part / "weights", like)
    path = directory / TENSORS
    check_digests(directory)
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    wanted = {_name(part, keys): leaf for keys, leaf in leaves}
    try:
        tensors = safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, OSError) as error:
        raise ModelFileError(f"{path}: cannot be read ({first_line(error)}); {AGAIN}") from error
    saved = {name: x for name, x in tensors.items() if name.startswith(f"{part}/")}
    for name in sorted(wanted.keys() | saved.keys()):
        shapes = [x.shape if (x := tree.get(name)) is not None else "none" for tree in (saved, wanted)]
        if shapes[0] != shapes[1]:
            raise ModelFileError(f"{path}: {name} is {shapes[0]}, the configuration needs {shapes[1]}; {AGAIN}")
    arrays = [saved[name].astype(x.dtype) for name, x in wanted.items()]
    # On a device by name, as orbax restores weights: programs for weights that may be anywhere would be others.
    return jax.device_put(jax.tree_util.tree_unflatten(structure, arrays), jax.local_devices()[0])


def save_directory(
    directory: Path,
    settings: dict[str, Any],
    saved: dict[str, Any],
    parts: Mapping[Part, Any],
    dtype: Dtype,
    card: str,
) -> None:
    """Writes a saved model. An older one there is replaced, with all its files, when the new one is complete.

    Args:
        settings: the configuration, JSON-ready.
        saved: entries for the section ``saved``, JSON-ready, besides those that this function adds.
        parts: the parameters of each network.
        dtype: what floating-point parameters are stored as. ``float16`` halves the files; its rounding changes a
            generated frame by less than the eye can see, which ``rsjax save`` measures.
        card: the text of ``README.md``.

    Raises:
        ModelFileError: the directory holds something else, or a parameter is too large for ``float16``.
        FileError: the disk is full or cannot be written to.
    """
    if directory.exists() and not is_saved(directory) and any(directory.iterdir()):
        raise ModelFileError(f"{directory}: holds something else than a saved model; choose another place")
    leaves = {part: jax.tree_util.tree_flatten_with_path(params)[0] for part, params in parts.items()}
    named = [(_name(part, keys), x) for part, flat in leaves.items() for keys, x in flat]
    tensors: dict[str, np.ndarray] = {}
    for name, leaf in named:
        x = np.asarray(leaf)
        if x.dtype.kind == "f":
            with np.errstate(over="ignore"):
                x = x.astype(dtype)
            if not np.isfinite(x).all():
                raise ModelFileError(f"{name} has values that {dtype} cannot hold; save it as float32")
        # safetensors writes memory as it lies; ascontiguousarray makes a vector of a scalar
        tensors[name] = np.ascontiguousarray(x).reshape(x.shape)
    new = directory.absolute().with_name(f"{directory.name}.new")
    with disk_guard(directory):
        shutil.rmtree(new, ignore_errors=True)
        write_file(new / TENSORS, safetensors.numpy.save(tensors, {"format": "rsjax"}))
        write_file(new / CARD, card.encode(errors="replace"))
        section = {"rsjax": __version__, "dtype": dtype, "files": digests(new, [TENSORS])} | saved
        write_json(new / SETTINGS, settings | {SECTION: section})
        replace_directory(new, directory.absolute())


def saved_section(directory: Path) -> dict[str, Any]:
    """Returns the section ``saved`` of a saved model's ``config.json``.

    Raises:
        UserError: it is missing or damaged.
    """
    section = read_json(directory / SETTINGS, cure=AGAIN).get(SECTION)
    if not isinstance(section, dict) or not isinstance(section.get("files"), dict):
        raise ModelFileError(f"{directory / SETTINGS}: has no section {SECTION!r} with digests of files; {AGAIN}")
    return section


def digests(directory: Path, names: Iterable[str]) -> dict[str, str]:
    """Returns the SHA-256 of files of a directory.

    Raises:
        ModelFileError: a file cannot be read.
    """
    by_name = {}
    for name in names:
        path = directory / name
        try:
            with regular(path).open("rb") as file:
                by_name[name] = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise ModelFileError(f"{path}: cannot be read ({error.strerror}); {AGAIN}") from error
    return by_name


def check_digests(directory: Path) -> None:
    """Compares the files of tensors with the digests in ``config.json``.

    Raises:
        UserError: a file is missing or damaged; the message names it.
    """
    recorded = saved_section(directory)["files"]
    for name, digest in digests(directory, {TENSORS, *recorded}).items():
        if recorded.get(name) != digest:
            path = directory / name
            instead = placeholder(path) or f"damaged: its SHA-256 is not the one that {SETTINGS} records; {AGAIN}"
            raise ModelFileError(f"{path}: {instead}")


def _name(part: Part, keys: tuple[Any, ...]) -> str:
    return "/".join([part, *(str(getattr(key, "key", getattr(key, "idx", key))) for key in keys)])
