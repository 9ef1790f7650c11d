"""Reads data sets as worker processes do: sources and references are pickled on the way."""

import pickle
from pathlib import Path
from typing import Any

from rsjax.errors import UserError
from rsjax.tools.ingest.episode import Episode
from rsjax.tools.ingest.formats import open_source


def read_all(name: str, path: Path, **options: Any) -> list[Episode]:
    """Reads every episode."""
    source = pickle.loads(pickle.dumps(open_source(name, path, **options)))
    return [source.read(pickle.loads(pickle.dumps(ref))) for ref in source.episodes()]


def read_first(name: str, path: Path, **options: Any) -> Episode:
    """Reads the first episode."""
    source = pickle.loads(pickle.dumps(open_source(name, path, **options)))
    return source.read(pickle.loads(pickle.dumps(next(source.episodes()))))


def read_everything(name: str, path: Path, **options: Any) -> tuple[int, list[UserError]]:
    """Returns how many episodes are listed, and all errors, of pictures and depth maps too; each is one line."""
    listed = 0
    errors: list[UserError] = []
    try:
        source = open_source(name, path, **options)
        for ref in source.episodes():
            listed += 1
            try:
                episode = source.read(ref)
                for pictures in (*episode.cameras.values(), *episode.depth.values()):
                    pictures.read([0, len(pictures) - 1])
            except UserError as error:
                errors.append(error)
    except UserError as error:
        errors.append(error)
    assert not any("\n" in str(error) for error in errors)
    return listed, errors
