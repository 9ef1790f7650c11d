"""Reads data sets as worker processes do: sources and references are pickled on the way."""

import pickle
from pathlib import Path
from typing import Any

from rsjax.errors import UserError
from rsjax.tools.ingest.episode import Episode, EpisodeError, SourceError
from rsjax.tools.ingest.formats import open_source


def read_all(name: str, path: Path, **options: Any) -> list[Episode]:
    """Reads every episode."""
    source = pickle.loads(pickle.dumps(open_source(name, path, **options)))
    return [source.read(pickle.loads(pickle.dumps(ref))) for ref in source.episodes()]


def read_first(name: str, path: Path, **options: Any) -> Episode:
    """Reads the first episode."""
    source = pickle.loads(pickle.dumps(open_source(name, path, **options)))
    return source.read(pickle.loads(pickle.dumps(next(source.episodes()))))


def error_of(name: str, path: Path, number: int = 0, **options: Any) -> str:
    """Returns the message of the one episode that cannot be read."""
    source = open_source(name, path, **options)
    messages = {}
    for place, ref in enumerate(source.episodes()):
        try:
            source.read(ref)
        except EpisodeError as error:
            messages[place] = str(error)
    assert list(messages) == [number], messages
    assert "\n" not in messages[number]
    return messages[number]


def failures(name: str, path: Path, **options: Any) -> list[UserError]:
    """Returns every error of opening a data set, and of reading its episodes, pictures and depth maps."""
    errors: list[UserError] = []
    try:
        source = open_source(name, path, **options)
        for ref in source.episodes():
            try:
                episode = source.read(ref)
                for pictures in (*episode.cameras.values(), *episode.depth.values()):
                    pictures.read([0, len(pictures) - 1])
            except EpisodeError as error:
                errors.append(error)
    except SourceError as error:
        errors.append(error)
    return errors
