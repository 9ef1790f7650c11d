"""Reads and writes one stage of a curriculum as a word of a command line: ``simple:2``, ``difficult:3``.

A stage is ``PARTS:EPOCHS`` or ``PARTS:EPOCHS:restart``; ``+`` joins its parts. A part is
``DIFFICULTIES[/TASKS[/SCENES]][=WEIGHT][#CLIPS][@STORE]``: shell patterns joined by commas (``all`` matches
everything), a weight, how many of the clips to use (the first ones), and the directory of another store. So
``all/pick*,place*=2+difficult@runs/b/tokens/store:1.5`` draws two picking or placing clips of the run's own for each
difficult clip of run b, and ``all/all/kitchen*:1`` the clips in kitchens. Names that contain one of ``: + @ = / , #``
cannot be written this way; in Python, :class:`CurriculumStageConfig` takes them.
"""

import math

from rsjax.config.fields import ConfigError
from rsjax.config.train import ComponentConfig, CurriculumStageConfig

GRAMMAR = "DIFFICULTIES[/TASKS[/SCENES]][=WEIGHT][#CLIPS][@STORE][+…]:EPOCHS[:restart]"
EXAMPLE = "simple:2 or difficult:3"
_COLUMNS = (("difficulties", "difficulty"), ("tasks", "task"), ("scenes", "scene"))  # field, and one of its words


def parse_stage(text: str) -> CurriculumStageConfig:
    """Returns the stage that a word describes.

    Raises:
        ConfigError: the word is malformed; the message says where, and how a stage is written.
    """
    body = text.removesuffix(":restart")
    parts, colon, epochs = body.rpartition(":")
    if not colon:
        raise _error(text, "its epochs are missing")
    return CurriculumStageConfig(
        components=tuple(_parse_part(text, part) for part in parts.split("+")),
        epochs=_number(text, "epochs", epochs),
        restart=body != text,
    )


def format_stage(stage: CurriculumStageConfig) -> str:
    """Returns the word that describes a stage; the inverse of :func:`parse_stage`."""
    parts = "+".join(_format_part(part) for part in stage.components)
    return f"{parts}:{_plain(stage.epochs)}{':restart' if stage.restart else ''}"


def _parse_part(text: str, part: str) -> ComponentConfig:
    body, at, store = part.partition("@")
    if at and not store:
        raise _error(text, "nothing follows its @")
    body, number_sign, clips = body.partition("#")
    labels, equals, weight = body.partition("=")
    words = labels.split("/")
    if len(words) > len(_COLUMNS):
        raise _error(text, f"{'/'.join(words[len(_COLUMNS) :])!r} follows its scenes")
    patterns = {field: _patterns(text, name, word) for (field, name), word in zip(_COLUMNS, words, strict=False)}
    return ComponentConfig(
        **patterns,
        store=store,
        weight=_number(text, "weight", weight) if equals else 1.0,
        clips=_count(text, clips) if number_sign else 0,
    )


def _format_part(part: ComponentConfig) -> str:
    words = [",".join(getattr(part, field)) for field, _ in _COLUMNS]
    while len(words) > 1 and words[-1] == "*":
        words.pop()
    weight = "" if part.weight == 1 else f"={_plain(part.weight)}"
    clips = f"#{part.clips}" if part.clips else ""
    return f"{'/'.join(words)}{weight}{clips}{'@' if part.store else ''}{part.store}"


def _patterns(text: str, name: str, joined: str) -> tuple[str, ...]:
    patterns = tuple("*" if pattern == "all" else pattern for pattern in joined.split(","))
    if "" in patterns:
        raise _error(text, f"a {name} is empty; write all to match every {name}")
    return patterns


def _number(text: str, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise _error(text, f"{name} {value!r} is not a number above 0")
    return number


def _count(text: str, value: str) -> int:
    if not (value.isascii() and value.isdecimal() and int(value)):
        raise _error(text, f"{value!r} is no number of clips")
    return int(value)


def _plain(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def _error(text: str, reason: str) -> ConfigError:
    return ConfigError(f"stage {text!r}: {reason}; write {GRAMMAR}, such as {EXAMPLE}")
