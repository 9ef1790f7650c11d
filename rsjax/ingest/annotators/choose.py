"""A stage's method as one word of a command line: ``lucas-kanade``, ``lucas-kanade:grid=32``, ``none``.

Networks say where their files are: ``bootstapir:checkout=/opt/tapnet,weights=bootstapir_checkpoint_v2.pt,device=cuda``.
"""

import dataclasses
import importlib
import typing
from pathlib import Path
from typing import Any, Literal

from rsjax.config import ConfigError
from rsjax.errors import did_you_mean
from rsjax.ingest.annotators.depth import RecordedDepth
from rsjax.ingest.stages import Annotators

NONE = "none"
METHODS: dict[str, dict[str, tuple[str, str]]] = {  # of each stage: module and class by the method's name
    "shots": {"hsv-histogram": ("shots", "HistogramShots"), "transnetv2": ("networks.shots", "TransNetShots")},
    "motion": {"dis": ("motion", "DISFlow"), "raft": ("networks.motion", "RaftFlow")},
    "depth": {
        "recorded": ("depth", "RecordedDepth"),
        "depth-anything": ("networks.depth", "DepthAnything"),
        "video-depth-anything": ("networks.depth", "VideoDepthAnything"),
    },
    "tracks": {
        "lucas-kanade": ("tracks", "LucasKanade"),
        "spatial-tracker": ("networks.tracks", "SpatialTracker"),
        "bootstapir": ("networks.tracks", "BootsTapir"),
    },
    "semantics": {"own": ("semantics", "OwnSemantics"), "internvl": ("networks.semantics", "InternVL")},
}


def choose_annotators(words: dict[str, str]) -> Annotators:
    """The methods by their words, one for each stage.

    Raises:
        ConfigError: no such stage, method or field, or a value that does not fit.
    """
    chosen = {stage: choose(stage, word) for stage, word in words.items()}
    if words.get("depth", "").partition(":")[0] == "recorded":
        chosen["depth"] = None  # recorded depth is read where clips are cut
    return Annotators(**chosen)


def choose_recorded(word: str) -> RecordedDepth | None:
    """How depth that the data set has is read beside the depth stage of this word; None where it is not to be read."""
    chosen = choose("depth", word)
    return chosen if chosen is None or isinstance(chosen, RecordedDepth) else RecordedDepth()


def choose(stage: str, text: str) -> Any:
    """The annotator that a word describes; None for ``none``. Errors as in :func:`choose_annotators`."""
    name, _, fields = text.partition(":")
    methods = METHODS[stage]
    if name == NONE:
        return None
    if name not in methods:
        raise ConfigError(
            f"{stage}: no method {name!r}{did_you_mean(name, methods)}; choose {', '.join(methods)} or none"
        )
    module, kind = methods[name]
    made = getattr(importlib.import_module(f"rsjax.ingest.annotators.{module}"), kind)
    hints = typing.get_type_hints(made)
    known = [field.name for field in dataclasses.fields(made)]
    values: dict[str, Any] = {}
    for part in filter(None, fields.split(",")):
        key, equals, value = part.partition("=")
        if key not in known or not equals:
            takes = ", ".join(f"{field}=…" for field in known)
            raise ConfigError(f"{stage} {name}: no field {part!r}{did_you_mean(key, known)}; it takes {takes}")
        values[key] = _value(f"{stage} {name}: {key}", hints[key], value)
    missing = [f.name for f in dataclasses.fields(made) if f.name not in values and _required(f)]
    if missing:
        raise ConfigError(f"{stage} {name}: {' and '.join(missing)} missing; write {name}:{missing[0]}=VALUE")
    return made(**values)


def _required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _value(where: str, hint: Any, text: str) -> Any:
    if typing.get_origin(hint) is Literal:
        if text not in typing.get_args(hint):
            raise ConfigError(f"{where} is {text!r}; choose {' or '.join(map(str, typing.get_args(hint)))}")
        return text
    if hint is bool:
        if text not in ("True", "False"):
            raise ConfigError(f"{where} is {text!r}; write True or False")
        return text == "True"
    if hint is Path:
        return Path(text).expanduser().absolute()  # workers may run in another directory
    if hint not in (int, float, str):
        raise ConfigError(f"{where} cannot be set on the command line")
    try:
        return hint(text)
    except ValueError as error:
        raise ConfigError(f"{where} is {text!r}; it should be a number") from error
