"""Finds the files of weights in what a hub publishes: one file, several with an index, or a directory of these.

A directory has the layout that ``from_pretrained`` reads: the weights of one network with ``config.json`` beside them,
or a folder for each network.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rsjax.files import read_json
from rsjax.tools.convert.directory import Part
from rsjax.tools.convert.files import HOLDERS, PICKLED, SAFE, ConvertError, TensorFile, read_tensors

INDEX = ".index.json"  # end of the name of the file that says which file has which tensor
STEMS = ("diffusion_pytorch_model", "model", "pytorch_model")  # of diffusers and transformers
_SHARD = re.compile(r"(.*)-(\d{5})-of-(\d{5})(\.\w+)")


def weights_file(source: Path) -> Path:
    """Returns the file of a network's weights, or the index of its files; ``source`` may be its directory.

    Raises:
        ConvertError: the directory has no weights or those of several networks, or was made by this project.
    """
    if not source.is_dir():
        return source
    if any((source / part / "weights").exists() for part in ("tokenizer", "world_model")):
        raise ConvertError(f"{source}: holds networks of this project; add --export to export one")
    for suffix in (SAFE, SAFE + INDEX, ".bin", ".bin" + INDEX):
        named = [source / f"{stem}{suffix}" for stem in STEMS if (source / f"{stem}{suffix}").is_file()]
        if named:
            return _only(source, named)
    kinds = (SAFE, *PICKLED)
    candidates = sorted(path for path in source.iterdir() if path.suffix in kinds and path.is_file())
    if not candidates:
        raise ConvertError(
            f"{source}: is a directory without weights, such as {STEMS[1]}{SAFE} or {STEMS[1]}{SAFE}{INDEX}; name a "
            f"file, or the directory of one network"
        )
    return _only(source, candidates)


def weights_files(source: Path, folders: Mapping[Part, str], part: Part | None) -> list[Path]:
    """Returns :func:`weights_file` of each network that a source holds.

    Args:
        folders: the folders in which a whole pipeline keeps its networks.
        part: the only one to take from a whole pipeline; None takes all.

    Raises:
        ConvertError: as there; or ``part`` is not in the source.
    """
    there = {name: source / folder for name, folder in folders.items() if (source / folder / "config.json").is_file()}
    if not there:
        return [weights_file(source)]
    if part is not None and part not in there:
        raise ConvertError(f"{source}: has no {folders[part]}, which holds the {part}; it has {', '.join(there)}")
    return [weights_file(folder) for name, folder in there.items() if part in (None, name)]


def read_network(source: Path, holders: Sequence[str] = HOLDERS) -> TensorFile:
    """Returns the content of a file, or of all files of a network if it is an index or one of several.

    Raises:
        ConvertError: as :func:`read_tensors`; or the files lack tensors of the index, or hold others.
    """
    if source.name.endswith(INDEX):
        index = read_json(source, cure="put the published one beside the weights").get("weight_map")
        files = index.values() if isinstance(index, dict) else ()
        if not files or not all(isinstance(file, str) and Path(file).name == file for file in files):
            raise ConvertError(f"{source}: has no weight_map from tensors to files beside it; restore it")
        merged = _merged([source.with_name(name) for name in sorted(set(index.values()))], holders)
        known = {merged.names[own]: own for own in merged.tensors}
        if differing := sorted(index.keys() ^ known.keys()):
            raise ConvertError(
                f"{source}: {differing[0]} is {'in' if differing[0] in known else 'not in'} the files beside it, and "
                f"{'not ' if differing[0] in known else ''}in the index; download them again"
            )
        return merged
    if match := _SHARD.fullmatch(source.name):
        last = match[3]
        names = [f"{match[1]}-{number:05d}-of-{last}{match[4]}" for number in range(1, int(last) + 1)]
        return _merged([source.with_name(name) for name in names], holders)
    return read_tensors(source, holders)


def _merged(paths: Sequence[Path], holders: Sequence[str]) -> TensorFile:
    files = [read_tensors(path, holders) for path in paths]
    tensors = {name: x for file in files for name, x in file.tensors.items()}
    names = {name: known for file in files for name, known in file.names.items()}
    return TensorFile(tensors, {}, names, {}, "")


def _only(source: Path, candidates: Sequence[Path]) -> Path:
    if len(candidates) > 1:
        raise ConvertError(f"{source}: holds {' and '.join(path.name for path in candidates)}; name one of them")
    return candidates[0]
