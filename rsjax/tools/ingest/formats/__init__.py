"""Readers of common formats, one module each, with the interface :class:`rsjax.tools.ingest.episode.EpisodeSource`.

Each module has ``open_source(path, **options)``. :func:`open_source` imports a format's module, and the libraries that
it needs, when a data set of that format is opened.
"""

import importlib
from pathlib import Path
from typing import Any, get_type_hints

from rsjax.errors import did_you_mean
from rsjax.tools.ingest.episode import EpisodeSource, SourceError
from rsjax.tools.ingest.formats.files import exists
from rsjax.tools.ingest.formats.options import check_options

FORMATS = ("agibot", "lerobot", "robomimic", "libero", "rlds", "bair", "folder", "npz", "sim")


def open_source(name: str, path: Path | str, **options: Any) -> EpisodeSource:
    """Opens the data set of format ``name`` at ``path``; ``options`` are those of the format's own ``open_source``.

    Raises:
        SourceError: there is no such format, an option is unknown or of another type, or nothing readable is at
            ``path``.
    """
    if name not in FORMATS:
        raise SourceError(f"unknown format {name!r}{did_you_mean(name, FORMATS)}; there are {', '.join(FORMATS)}")
    opener = importlib.import_module(f"rsjax.tools.ingest.formats.{name}").open_source
    known = {option: hint for option, hint in get_type_hints(opener).items() if option not in ("path", "return")}
    check_options(options, known, name, "option")
    if not exists(Path(path)):
        raise SourceError(f"{path}: not there; give the folder or file of the {name} data set")
    return opener(Path(path), **options)
