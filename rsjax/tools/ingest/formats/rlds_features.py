"""Reads the features of an RLDS data set's steps from its ``features.json``, and proposes a key map from them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.errors import did_you_mean
from rsjax.tools.ingest.episode import SourceError
from rsjax.tools.ingest.formats.keymap import MAPS, KeyMap

_TEXT = re.compile(r"instruction|language|task")
_STATE = re.compile(r"state|proprio|pose|position|joint|gripper|eef|effector")
_WIDEST = 64  # largest size of a state; more numbers are an embedding


@dataclass(frozen=True)
class Feature:
    """A feature of a step.

    Attributes:
        kind: ``image``, ``text``, ``tensor`` or ``other``.
        shape: shape of a step's value, -1 for an open length; None if the file does not say.
        dtype: such as ``uint8``, "" if the file does not say.
    """

    kind: str
    shape: tuple[int, ...] | None = None
    dtype: str = ""

    @property
    def is_row(self) -> bool:
        """Returns whether it is one or a few floats."""
        few = self.shape is None or (len(self.shape) <= 1 and (self.shape or (1,))[0] <= _WIDEST)
        return self.kind == "tensor" and few and self.dtype in ("", "float32", "float64")

    @property
    def is_map(self) -> bool:
        """Returns whether it has one channel, as depth maps have."""
        if self.kind == "image":
            return self.shape is not None and self.shape[2:] == (1,)
        return (
            self.kind == "tensor" and self.shape is not None and len(self.shape) in (2, 3) and min(self.shape[:2]) > 7
        )


def step_features(path: Path, content: Mapping[str, Any]) -> dict[str, Feature]:
    """Returns the features of a step by their keys below ``steps/``; none if the file is empty.

    Args:
        path: path of ``features.json``, for error messages.
        content: content of the file.

    Raises:
        SourceError: the content is not in the form that TFDS writes.
    """
    try:
        steps = content.get("featuresDict", {}).get("features", {}).get("steps", {})
        return _features(steps.get("sequence", {}).get("feature", {}))
    except (AttributeError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: not such as TFDS writes ({error}); fetch it again") from error


def _features(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Feature]:
    features: dict[str, Feature] = {}
    for name, child in tree.get("featuresDict", {}).get("features", {}).items():
        if "featuresDict" in child:
            features |= _features(child, f"{prefix}{name}/")
            continue
        kind = next((kind for kind in ("image", "text", "tensor") if kind in child), "other")
        values = child.get(kind, {})
        shape = None
        if "shape" in values:
            shape = tuple(int(side) for side in values["shape"].get("dimensions", ()))
        features[f"{prefix}{name}"] = Feature(kind, shape, str(values.get("dtype", "")))
    return features


def propose(path: Path, features: Mapping[str, Feature], fps: float) -> KeyMap:
    """Returns a key map by the features' names, kinds and shapes; these do not say what the actions' numbers mean.

    Args:
        path: path of ``features.json``, for error messages.
        features: the features of a step.
        fps: steps per second, which no file states.

    Raises:
        SourceError: there are no pictures or no actions, or ``fps`` is 0.
    """
    maps = {_name(key): key for key, feature in features.items() if feature.is_map and "depth" in key}
    pictures = [key for key, feature in features.items() if feature.kind == "image" and key not in maps.values()]
    cameras = {_name(key): key for key in sorted(pictures) if not features[key].is_map}
    whole = features.get("action")
    action = ["action"] if whole and whole.is_row else []
    action = action or [key for key, one in features.items() if one.is_row and key.startswith(("action/", "action_"))]
    if not cameras or not action:
        lacks = "pictures" if not cameras else "actions"
        raise SourceError(f"{path}: no {lacks} among {', '.join(features) or 'no features'}; write a key map as JSON")
    if not fps:
        raise SourceError(f"{path}: no file of RLDS says how fast its pictures are; add --option fps=…")
    observed = [key for key, one in features.items() if key.startswith("observation/") and one.is_row]
    own = [key for key in observed if key == "observation/state"]
    texts = [key for key, one in features.items() if one.kind == "text" and _TEXT.search(key)]
    return KeyMap(
        cameras=cameras,
        action=tuple(action),
        fps=fps,
        state=tuple(own or [key for key in observed if _STATE.search(key)]),
        task=tuple(sorted(texts, key=len)),
        kind=None,
        held=None,
        depth=_pairs(cameras, maps),
    )


def _name(key: str) -> str:
    return key.removeprefix("observation/").replace("/", "_")


def _pairs(cameras: Mapping[str, str], maps: Mapping[str, str]) -> dict[str, str]:
    """Returns each camera's depth maps.

    A single camera has the only maps; otherwise the names must match without words such as ``depth`` and ``rgb``.
    """

    def bare(name: str) -> str:
        return "_".join(word for word in name.split("_") if word not in ("depth", "image", "rgb", "color"))

    if len(cameras) == len(maps) == 1:
        return dict(zip(cameras, maps.values(), strict=True))
    by_name = {bare(name): key for name, key in maps.items()}
    return {name: by_name[bare(name)] for name in cameras if bare(name) in by_name}


def check_keys(keys: KeyMap, path: Path, features: Mapping[str, Feature]) -> None:
    """Checks that a data set has each feature of a map.

    Args:
        path: path of ``features.json``, for error messages.
        features: the features of a step; nothing is checked if there are none.

    Raises:
        SourceError: a feature is missing or of another kind.
    """
    wanted: list[tuple[str, tuple[str, ...]]] = [(key, ("image",)) for key in keys.cameras.values()]
    wanted += [(key, ("tensor",)) for key in (*keys.action, *keys.state)]
    wanted += [(key, ("image", "tensor")) for key in keys.depth.values()]
    for key, kinds in wanted if features else ():
        if key not in features:
            hint = did_you_mean(key, features) or f"; steps have {', '.join(sorted(features))}"
            raise SourceError(f"{path}: no steps/{key}, which the key map names{hint}. Maps: {', '.join(MAPS)}")
        if features[key].kind not in kinds:
            says = f"steps/{key} is of kind {features[key].kind}, the key map says {' or '.join(kinds)}"
            raise SourceError(f"{path}: {says}; mend the map")
