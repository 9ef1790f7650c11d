"""Reads data sets as worker processes do: sources and references are pickled on the way."""

import pickle
from pathlib import Path
from typing import Any

from rsjax.tools.ingest.episode import Episode, EpisodeError
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
