"""Reads and writes one stage of a curriculum as a word of a command line: ``simple:2``, ``difficult:3:restart``.

A stage is ``PARTS:EPOCHS`` or ``PARTS:EPOCHS:restart``; ``+`` joins its parts. A part is
``DIFFICULTIES[/TASKS][=WEIGHT][@STORE]``: shell patterns joined by commas (``all`` matches everything), a weight, and
the directory of another store. So ``all/pick*,place*=2+difficult@runs/b/tokens/store:1.5`` draws two picking or placing
clips of the run's own for each difficult clip of run b. Names that contain one of ``: + @ = / ,`` cannot be written
this way; in Python, :class:`CurriculumStageConfig` takes them.
"""

import math

from rsjax.config.fields import ConfigError
from rsjax.config.train import ComponentConfig, CurriculumStageConfig

GRAMMAR = "DIFFICULTIES[/TASKS][=WEIGHT][@STORE][+…]:EPOCHS[:restart]"
EXAMPLE = "simple:2 or difficult:3:restart"


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
    labels, equals, weight = body.partition("=")
    difficulties, slash, tasks = labels.partition("/")
    return ComponentConfig(
        difficulties=_patterns(text, "difficulty", difficulties),
        tasks=_patterns(text, "task", tasks) if slash else ("*",),
        store=store,
        weight=_number(text, "weight", weight) if equals else 1.0,
    )


def _format_part(part: ComponentConfig) -> str:
    difficulties, tasks = (",".join(patterns) for patterns in (part.difficulties, part.tasks))
    tasks = "" if part.tasks == ("*",) else f"/{tasks}"
    weight = "" if part.weight == 1 else f"={_plain(part.weight)}"
    return f"{difficulties}{tasks}{weight}{'@' if part.store else ''}{part.store}"


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


def _plain(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def _error(text: str, reason: str) -> ConfigError:
    return ConfigError(f"stage {text!r}: {reason}; write {GRAMMAR}, such as {EXAMPLE}")
