"""What a folder of videos says of itself in ``dataset.json``."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from rsjax.errors import did_you_mean
from rsjax.ingest.actions import Kind
from rsjax.ingest.episode import MAX_FPS, SourceError

Rows = Literal["given", "led"]


@dataclass(frozen=True)
class FolderConfig:
    """What a data set says of all its episodes; see :mod:`rsjax.ingest.formats.folder`.

    Attributes:
        task: of episodes that name none.
        fps: frames per second; 0: as the videos or the timestamps say.
        rows: what a row of a table is.
        kind: see :class:`rsjax.ingest.actions.Layout`, as the two below.
        held: likewise.
        quaternions: likewise.
    """

    task: str = ""
    fps: float = 0.0
    rows: Rows = "given"
    kind: Kind = "delta"
    held: tuple[int, ...] = ()
    quaternions: tuple[int, ...] = ()

    @classmethod
    def of(cls, values: Any, where: Path) -> "FolderConfig":
        """From JSON; raises :class:`SourceError` that names the field which is wrong."""
        if not isinstance(values, Mapping):
            raise SourceError(f"{where}: should be an object with fields; mend it")
        known = [field.name for field in dataclasses.fields(cls)]
        for name, value in values.items():
            numbers = isinstance(value, list | tuple) and all(type(item) is int for item in value)
            good, wanted = {
                "task": (isinstance(value, str), "text"),
                "fps": (type(value) in (int, float) and 0 <= value <= MAX_FPS, f"a number from 0 to {MAX_FPS:g}"),
                "rows": (value in get_args(Rows), " or ".join(get_args(Rows))),
                "kind": (value in get_args(Kind), " or ".join(get_args(Kind))),
            }.get(name, (numbers, "a list of whole numbers"))
            if name not in known:
                raise SourceError(f"{where}: no field {name!r}{did_you_mean(name, known)}; it has {', '.join(known)}")
            if not good:
                raise SourceError(f"{where}: {name} is {value!r}, should be {wanted}; mend it")
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**fields)
