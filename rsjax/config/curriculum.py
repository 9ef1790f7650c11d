"""Reads a curriculum from JSON: a list of stages.

The paper's is ``[{"difficulties": ["simple"], "epochs": 2}, {"difficulties": ["difficult"], "epochs": 3}]``. A stage
has the fields of :class:`CurriculumStageConfig`; those of its only component may stand beside its epochs.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

from rsjax.config.fields import ConfigError, from_dict, require
from rsjax.config.train import ComponentConfig, CurriculumStageConfig
from rsjax.files import read_json

COMPONENT_FIELDS = {field.name for field in dataclasses.fields(ComponentConfig)}
EXAMPLE = '[{"difficulties": ["simple"], "epochs": 2}]'


def read_curriculum(text: str) -> tuple[CurriculumStageConfig, ...]:
    """Returns the stages of a JSON list, or of the JSON file at this path.

    Raises:
        ConfigError: the text is no list of stages; the message names the mistake.
        rsjax.files.FileError: the file is missing or damaged.
    """
    if text.lstrip().startswith("["):
        try:
            entries = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"curriculum {text:.80}: not JSON ({error}); write a list such as {EXAMPLE}") from error
    else:
        entries = read_json(Path(text), list, cure=f"name a file with a list of stages, such as {EXAMPLE}")
    stages = []
    for number, entry in enumerate(entries, 1):
        try:
            require(isinstance(entry, dict), f"not fields by name but {entry!r:.40}")
            component = {name: entry[name] for name in entry if name in COMPONENT_FIELDS}
            stage = {name: entry[name] for name in entry if name not in COMPONENT_FIELDS}
            if component:
                require("components" not in stage, f"{', '.join(component)} stand beside components; write them inside")
                stage["components"] = [component]
            stages.append(from_dict(CurriculumStageConfig, stage))
        except ConfigError as error:
            raise ConfigError(f"stage {number} of the curriculum: {error}") from error
    return tuple(stages)


def write_curriculum(stages: tuple[CurriculumStageConfig, ...]) -> str:
    """Returns the JSON list of these stages, without fields at their defaults, for :func:`read_curriculum`."""
    entries = []
    default = vars(ComponentConfig())
    for stage in stages:
        components = [
            {name: value for name, value in vars(component).items() if value != default[name]}
            for component in stage.components
        ]
        entry: dict[str, Any] = {"components": components}
        if len(components) == 1:
            entry = components[0]
        entry = entry | {"epochs": stage.epochs}
        if stage.restart:
            entry["restart"] = True
        if stage.frames:
            entry["frames"] = stage.frames
        entries.append(entry)
    return json.dumps(entries)
