"""Which feature of an RLDS data set is what: named maps, and such as a user writes."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from rsjax.errors import did_you_mean
from rsjax.ingest.actions import Kind
from rsjax.ingest.episode import MAX_FPS, SourceError, plain


@dataclass(frozen=True)
class KeyMap:
    """Which feature below ``steps/`` is what.

    Attributes:
        cameras: the feature of each camera's pictures, by a name for the camera.
        action: features that make up the action, in order.
        fps: steps per second, > 0; RLDS does not store it.
        state: features that make up the state, in order.
        task: features of text; the first that says anything counts.
        kind: what the numbers of the action are, as :class:`rsjax.ingest.actions.Layout` has it.
        quaternions: as there.
        held: as there.
        after: whether a step's observation was recorded after its action, against the convention.
        names: of the data sets that this map is for.
    """

    cameras: Mapping[str, str]
    action: tuple[str, ...]
    fps: float
    state: tuple[str, ...] = ()
    task: tuple[str, ...] = ("language_instruction",)
    kind: Kind = "delta"
    quaternions: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    after: bool = False
    names: tuple[str, ...] = field(default=(), compare=False)


def _cameras(*names: str) -> dict[str, str]:
    return {name: f"observation/{name}" for name in names}


_OXE_MOVE = ("action/world_vector", "action/rotation_delta")
_OXE_TASK = ("observation/natural_language_instruction",)

# bridge is tried on real files; the others are after the data sets' documentation, and features.json is asked.
MAPS: dict[str, KeyMap] = {
    "bridge": KeyMap(
        _cameras("image_0", "image_1", "image_2", "image_3"),
        ("action",),
        5.0,
        ("observation/state",),
        held=(6,),
        names=("bridge_dataset", "bridge_orig"),
    ),
    "bridge_oxe": KeyMap(
        _cameras("image"),
        (*_OXE_MOVE, "action/open_gripper"),
        5.0,
        ("observation/state",),
        _OXE_TASK,
        held=(6,),
        names=("bridge",),
    ),
    "rt1": KeyMap(
        _cameras("image"),
        (*_OXE_MOVE, "action/gripper_closedness_action"),
        3.0,
        ("observation/base_pose_tool_reached", "observation/gripper_closed"),
        _OXE_TASK,
        names=("fractal20220817_data",),
    ),
    "droid": KeyMap(
        _cameras("exterior_image_1_left", "exterior_image_2_left", "wrist_image_left"),
        ("action_dict/cartesian_velocity", "action_dict/gripper_position"),
        15.0,
        ("observation/cartesian_position", "observation/gripper_position"),
        ("language_instruction", "language_instruction_2", "language_instruction_3"),
        held=(6,),
        names=("droid", "droid_100"),
    ),
    "language_table": KeyMap(
        _cameras("rgb"),
        ("action",),
        10.0,
        ("observation/effector_translation",),
        ("observation/instruction",),
        names=("language_table",),
    ),
    "libero": KeyMap(
        _cameras("image", "wrist_image"),
        ("action",),
        20.0,
        ("observation/state",),
        held=(6,),
        names=tuple(f"libero_{suite}_no_noops" for suite in ("spatial", "object", "goal", "10")),
    ),
}


def key_map(keys: str, dataset: str, folder: Path) -> KeyMap:
    """The map that a user names.

    Args:
        keys: one of :data:`MAPS`, or the path of a JSON file with the fields of :class:`KeyMap`; "": by the data set's
            name.
        dataset: that name.
        folder: of the data set, for messages.

    Raises:
        SourceError: there is no such map, or the file has other fields.
    """
    if keys in MAPS:
        return MAPS[keys]
    if keys.endswith(".json"):
        return _from_file(Path(keys))
    if keys:
        raise SourceError(
            f"unknown key map {keys!r}{did_you_mean(keys, MAPS)}; there are {', '.join(MAPS)}, or a .json"
        )
    for known in MAPS.values():
        if dataset in known.names:
            return known
    raise SourceError(
        f"{folder}: no key map for the data set {dataset!r}; choose one with keys: {', '.join(MAPS)}, or a .json file"
    )


def _from_file(path: Path) -> KeyMap:
    try:
        values = json.loads(plain(path).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise SourceError(f"{path}: not a readable key map ({error}); write the fields of KeyMap as JSON") from error
    known = [entry.name for entry in fields(KeyMap)]
    if not isinstance(values, dict):
        raise SourceError(f"{path}: should be an object with {', '.join(known)}")
    for name in values:
        if name not in known:
            raise SourceError(f"{path}: no field {name!r}{did_you_mean(name, known)}; a key map has {', '.join(known)}")
    for name in ("cameras", "action", "fps"):
        if not values.get(name):
            raise SourceError(f"{path}: {name} is missing; a key map needs cameras, action and fps")
    return _checked(path, values)


def _checked(path: Path, values: Mapping[str, Any]) -> KeyMap:
    """The map of these values, if each is of its type."""
    lists = {"action": str, "state": str, "task": str, "names": str, "quaternions": int, "held": int}
    made = dict(values)
    for name, kind in ((name, kind) for name, kind in lists.items() if name in values):
        items = values[name]
        if not isinstance(items, list) or not all(isinstance(item, kind) for item in items):
            raise SourceError(f"{path}: {name} is {items!r}, should be a list of {kind.__name__}")
        made[name] = tuple(items)
    cameras = values["cameras"]
    if not isinstance(cameras, dict) or not all(isinstance(key, str) for key in cameras.values()):
        raise SourceError(f"{path}: cameras is {cameras!r}, should be an object of feature names")
    if not isinstance(values["fps"], int | float) or not 0 < values["fps"] <= MAX_FPS:
        raise SourceError(f"{path}: fps is {values['fps']!r}, should be a number above 0 and at most {MAX_FPS:g}")
    if values.get("kind", "delta") not in ("delta", "absolute"):
        raise SourceError(f"{path}: kind is {values['kind']!r}, should be delta or absolute")
    if not isinstance(values.get("after", False), bool):
        raise SourceError(f"{path}: after is {values['after']!r}, should be true or false")
    return KeyMap(**made)


def read_json(path: Path) -> dict[str, Any]:
    """A file of one JSON object; empty where there is no file."""
    try:
        content = json.loads(plain(path).read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise SourceError(f"{path}: not readable JSON ({error}); fetch it again") from error
    if not isinstance(content, dict):
        raise SourceError(f"{path}: holds {type(content).__name__}, should be an object; fetch it again")
    return content


def check_keys(keys: KeyMap, folder: Path) -> None:
    """Asks ``features.json``, where there is one, for each feature of a map and its kind.

    Raises:
        SourceError: a feature is not there or of another kind.
    """
    path = folder / "features.json"
    try:
        kinds = _kinds(read_json(path))
    except (AttributeError, TypeError) as error:
        raise SourceError(f"{path}: not such as TFDS writes ({error}); fetch it again") from error
    if not kinds:
        return
    wanted = [(key, "image") for key in keys.cameras.values()]
    wanted += [(key, "tensor") for key in (*keys.action, *keys.state)]
    for key, kind in wanted:
        if key not in kinds:
            hint = did_you_mean(key, kinds) or f"; steps have {', '.join(sorted(kinds))}"
            raise SourceError(f"{path}: no steps/{key}, which the key map names{hint}. Maps: {', '.join(MAPS)}")
        if kinds[key] != kind:
            raise SourceError(
                f"{path}: steps/{key} is of kind {kinds[key]}, the key map takes it as {kind}; mend the map"
            )


def _kinds(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """The kind (image, text, tensor …) of every feature of a step by its key below ``steps/``."""
    if not prefix:
        steps = tree.get("featuresDict", {}).get("features", {}).get("steps", {})
        tree = steps.get("sequence", {}).get("feature", {})
    found: dict[str, str] = {}
    for name, child in tree.get("featuresDict", {}).get("features", {}).items():
        key = f"{prefix}{name}"
        if "featuresDict" in child:
            found |= _kinds(child, f"{key}/")
        else:
            found[key] = next((kind for kind in ("image", "text", "tensor") if kind in child), "other")
    return found
