"""A curriculum's stage as one word of a command line: ``simple:2``, ``difficult:3:restart``.

A stage is ``PARTS:EPOCHS`` or ``PARTS:EPOCHS:restart``; parts are joined by ``+``. A part is
``DIFFICULTIES[/TASKS][=WEIGHT][@STORE]``: patterns with commas between them, ``all`` for every one, and the directory
of another store. So ``all/pick*,place*=2+difficult@runs/b/tokens/store:1.5`` draws two of its clips from the run's own
picking and placing for each difficult one of run b. Names with one of ``: + @ = / ,`` are out of its reach; Python's
:class:`StageConfig` takes them.
"""

import math

from rsjax.config.fields import ConfigError
from rsjax.config.train import PartConfig, StageConfig

GRAMMAR = "DIFFICULTIES[/TASKS][=WEIGHT][@STORE][+…]:EPOCHS[:restart]"
EXAMPLE = "simple:2 or difficult:3:restart"


def parse_stage(text: str) -> StageConfig:
    """The stage that the word describes.

    Raises:
        ConfigError: it describes none; the message says what is wrong and how it is written.
    """
    body = text.removesuffix(":restart")
    parts, colon, epochs = body.rpartition(":")
    if not colon:
        raise _error(text, "its epochs are missing")
    return StageConfig(
        parts=tuple(_parse_part(text, part) for part in parts.split("+")),
        epochs=_number(text, "epochs", epochs),
        restart=body != text,
    )


def format_stage(stage: StageConfig) -> str:
    """The inverse of :func:`parse_stage`."""
    parts = "+".join(_format_part(part) for part in stage.parts)
    return f"{parts}:{_plain(stage.epochs)}{':restart' if stage.restart else ''}"


def _parse_part(text: str, part: str) -> PartConfig:
    body, at, store = part.partition("@")
    if at and not store:
        raise _error(text, "nothing follows its @")
    labels, equals, weight = body.partition("=")
    difficulties, slash, tasks = labels.partition("/")
    return PartConfig(
        difficulties=_patterns(text, "difficulty", difficulties),
        tasks=_patterns(text, "task", tasks) if slash else ("*",),
        store=store,
        weight=_number(text, "weight", weight) if equals else 1.0,
    )


def _format_part(part: PartConfig) -> str:
    difficulties, tasks = (",".join(patterns) for patterns in (part.difficulties, part.tasks))
    tasks = "" if part.tasks == ("*",) else f"/{tasks}"
    weight = "" if part.weight == 1 else f"={_plain(part.weight)}"
    return f"{difficulties}{tasks}{weight}{'@' if part.store else ''}{part.store}"


def _patterns(text: str, what: str, patterns: str) -> tuple[str, ...]:
    found = tuple("*" if pattern == "all" else pattern for pattern in patterns.split(","))
    if "" in found:
        raise _error(text, f"a {what} is empty; all stands for every one")
    return found


def _number(text: str, what: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise _error(text, f"{what} {value!r} is no number above 0")
    return number


def _plain(value: float) -> str:
    return repr(float(value)).removesuffix(".0")


def _error(text: str, reason: str) -> ConfigError:
    return ConfigError(f"stage {text!r}: {reason}; write {GRAMMAR}, such as {EXAMPLE}")
