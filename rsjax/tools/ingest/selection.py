"""A list of a data set's episodes to keep and to leave out, with reasons, and a source that follows the list."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rsjax.files import disk_guard, parse_json, regular, write_atomically
from rsjax.tools.ingest.episode import Episode, EpisodeError, EpisodeRef, EpisodeSource, SourceError, fingerprint

FORMAT = 1


def write_selection(
    path: Path, about: str, refs: tuple[tuple[str, str], ...], reasons: Mapping[str, list[str]]
) -> tuple[int, int]:
    """Writes which episodes are kept, which are left out, and why.

    Args:
        path: the list, a JSON file.
        about: the data set, for human readers of the list.
        refs: every episode's id and fingerprint.
        reasons: why episodes are left out, by id.

    Returns:
        How many episodes are kept, and how many are left out.

    Raises:
        FileError: the file cannot be written.
    """
    kept = [{"id": name, "fingerprint": mark} for name, mark in refs if name not in reasons]
    out = [{"id": name, "fingerprint": mark, "reasons": reasons[name]} for name, mark in refs if name in reasons]
    content = {"format": FORMAT, "data_set": about, "kept": kept, "left_out": out}
    with disk_guard(path):
        write_atomically(path, json.dumps(content, indent=1).encode())
    return len(kept), len(out)


@dataclass
class Selected:
    """A source that refuses to read the episodes that a list leaves out; the error gives the reasons.

    It still lists these episodes. An episode that has changed since the list was written is read.

    Attributes:
        source: the source that is read.
        reasons: why episodes are left out, by id and fingerprint.
        name: name of the source.
    """

    source: EpisodeSource
    reasons: dict[tuple[str, str], str]
    name: str

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists all episodes; one that is left out gets another fingerprint, so that earlier work on it is not used."""
        for ref in self.source.episodes():
            why = self.reasons.get((ref.id, ref.fingerprint))
            if why is None:
                yield ref
            else:
                yield EpisodeRef(ref.id, fingerprint((), ref.fingerprint, why), {"left_out": why})

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode; raises :class:`EpisodeError` with the reasons if it is left out."""
        if "left_out" in ref.location:
            raise EpisodeError(f"{ref.id}: left out by the list: {ref.location['left_out']}")
        return self.source.read(ref)


def select(source: EpisodeSource, path: Path) -> Selected:
    """Returns a source that refuses the episodes that the list at ``path`` leaves out.

    Raises:
        SourceError: the list cannot be read, or is about other episodes or about these read with other options.
    """
    try:
        content = parse_json(regular(path).read_bytes())
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']}, this code reads format {FORMAT}")
        reasons = {_key(entry): "; ".join(map(str, entry["reasons"])) for entry in content["left_out"]}
        listed = {*reasons, *map(_key, content["kept"])}
    except FileNotFoundError as error:
        raise SourceError(f"{path}: not there; make it with experiments.doctor … --fix {path.name}") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise SourceError(f"{path}: not a list of experiments.doctor ({error}); make it again with --fix") from error
    names, known = {name for name, _ in listed}, False
    for ref in source.episodes():
        known = known or ref.id in names
        if (ref.id, ref.fingerprint) in listed:
            return Selected(source, reasons, source.name)
    if known:
        raise SourceError(
            f"{path}: the data set was read with other options then, or all its files have changed; run "
            f"experiments.doctor --fix again, with the same --option"
        )
    raise SourceError(f"{path}: names no episode of this data set; give the list that was made for it")


def _key(entry: Mapping[str, object]) -> tuple[str, str]:
    return str(entry["id"]), str(entry["fingerprint"])
