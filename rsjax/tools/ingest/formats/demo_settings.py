"""Reads what an HDF5 file of robomimic, robosuite or LIBERO says about its simulator, in attributes that are JSON."""

import json
from pathlib import Path
from typing import Any

from rsjax.clip import words_of
from rsjax.tools.ingest.actions import Kind
from rsjax.tools.ingest.episode import MAX_FPS, EpisodeError
from rsjax.tools.ingest.formats.hdf5 import attribute


def settings_of(group: Any, path: Path) -> dict[str, Any]:
    """Returns ``env_args``, ``env_info`` (robosuite's own) and ``problem_info`` of a file.

    Args:
        group: the file's group ``data``.
        path: the file.

    Raises:
        EpisodeError: one of them is not JSON.
    """
    settings: dict[str, Any] = {}
    for name in ("env_info", "env_args", "problem_info"):
        text = attribute(group, name)
        try:
            values = json.loads(text) if text else {}
        except (TypeError, ValueError, RecursionError) as error:
            raise EpisodeError.at(path, f"data.{name} is not JSON ({error})", "mend the attribute") from error
        settings |= values if isinstance(values, dict) else {}
    return settings


def fps_of(settings: dict[str, Any], path: Path) -> float:
    """Returns the rate of the simulator; 0 if the file does not say.

    Raises:
        EpisodeError: the rate is impossible.
    """
    arguments = settings.get("env_kwargs")
    fps = arguments.get("control_freq", 0) if isinstance(arguments, dict) else 0
    if not isinstance(fps, int | float) or not 0 <= fps <= MAX_FPS:
        raise EpisodeError.at(path, f"control_freq in data.env_args is {fps!r}, should be steps per second", "mend it")
    return float(fps)


def kind_of(settings: dict[str, Any]) -> Kind:
    """Returns the kind of the arms' commands: targets if robosuite's controller settings, old or new, say so."""
    arguments = settings.get("env_kwargs")
    text = json.dumps(arguments.get("controller_configs") if isinstance(arguments, dict) else None)
    return "absolute" if '"control_delta": false' in text or '"input_type": "absolute"' in text else "delta"


def instruction_of(group: Any, settings: dict[str, Any]) -> str:
    """Returns the instruction of a demo, or of its file; "" if there is none."""
    text = attribute(group, "ep_meta")
    try:
        instruction = json.loads(text).get("lang") if text else None
    except (AttributeError, TypeError, ValueError, RecursionError):
        instruction = None
    instruction = instruction or settings.get("language_instruction")
    if isinstance(instruction, list):
        instruction = instruction[0] if instruction else ""
    return words_of(instruction).strip('" ')
