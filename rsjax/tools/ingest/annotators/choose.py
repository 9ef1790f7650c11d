"""Parses a step's method from one word of a command line: ``lucas-kanade``, ``lucas-kanade:grid=32``, ``none``.

Networks take the paths of their files: ``bootstapir:checkout=/opt/tapnet,weights=bootstapir_checkpoint_v2.pt``.
"""

import dataclasses
import pkgutil
import typing
from pathlib import Path
from typing import Any, Literal

from rsjax.config import ConfigError
from rsjax.errors import did_you_mean
from rsjax.tools.ingest.annotate import Annotators
from rsjax.tools.ingest.annotators.depth import RecordedDepth

NONE = "none"
METHODS = {  # step → method's name → module and class in this package
    "shots": {"hsv-histogram": "shots:HistogramShots", "transnetv2": "shots:TransNetShots"},
    "motion": {"dis": "motion:DISFlow", "raft": "motion:RaftFlow"},
    "depth": {
        "recorded": "depth:RecordedDepth",
        "depth-anything": "depth:DepthAnything",
        "video-depth-anything": "depth:VideoDepthAnything",
    },
    "tracks": {
        "lucas-kanade": "tracks:LucasKanade",
        "spatial-tracker": "tracks:SpatialTracker",
        "bootstapir": "tracks:BootsTapir",
    },
    "semantics": {"own": "semantics:OwnSemantics", "internvl": "semantics:InternVL"},
}


def choose_annotators(words: dict[str, str]) -> Annotators:
    """Returns the methods that the words choose, one for each step.

    Raises:
        ConfigError: there is no such step, method or field, or a value does not fit.
    """
    chosen = {stage: choose(stage, word) for stage, word in words.items()}
    if isinstance(chosen.get("depth"), RecordedDepth):
        chosen["depth"] = None  # clips read recorded depth as they are cut
    return Annotators(**chosen)


def choose_recorded(word: str) -> RecordedDepth | None:
    """Returns how recorded depth is read with this depth method; None if ``none`` turns depth off."""
    chosen = choose("depth", word)
    if chosen is None or isinstance(chosen, RecordedDepth):
        return chosen
    return RecordedDepth()


def choose(stage: str, text: str) -> Any:
    """Returns the annotator that a word describes; None for ``none``. Errors as in :func:`choose_annotators`."""
    name, _, settings = text.partition(":")
    methods = METHODS[stage]
    if name == NONE:
        return None
    if name not in methods:
        raise ConfigError(
            f"{stage}: no method {name!r}{did_you_mean(name, methods)}; choose {', '.join(methods)} or none"
        )
    method = pkgutil.resolve_name(f"rsjax.tools.ingest.annotators.{methods[name]}")
    fields = {field.name: field for field in dataclasses.fields(method)}
    values: dict[str, Any] = {}
    for setting in filter(None, settings.split(",")):
        key, equals, value = setting.partition("=")
        if key not in fields or not equals:
            takes = ", ".join(f"{field}=…" for field in fields)
            raise ConfigError(f"{stage} {name}: no field {setting!r}{did_you_mean(key, fields)}; it takes {takes}")
        if key in values:
            raise ConfigError(f"{stage} {name}: {key} is given twice; give it once")
        values[key] = _parse(f"{stage} {name}: {key}", fields[key].type, value)
    missing = [key for key, field in fields.items() if key not in values and field.default is dataclasses.MISSING]
    if missing:
        raise ConfigError(f"{stage} {name}: {' and '.join(missing)} missing; write {name}:{missing[0]}=VALUE")
    return method(**values)


def _parse(where: str, kind: Any, text: str) -> Any:
    """Converts the text to a field's type: a Literal, bool, Path, int, float or str."""
    if typing.get_origin(kind) is Literal:
        if text not in typing.get_args(kind):
            raise ConfigError(f"{where} is {text!r}; choose {' or '.join(typing.get_args(kind))}")
        return text
    if kind is bool:
        if text not in ("True", "False"):
            raise ConfigError(f"{where} is {text!r}; write True or False")
        return text == "True"
    if kind is Path:
        return Path(text).expanduser().absolute()  # workers may run in another directory
    try:
        return kind(text)
    except ValueError as error:
        raise ConfigError(f"{where} is {text!r}; it should be a number") from error
