"""Key maps, which say what each feature of an RLDS data set is. Some are built in; users can write their own."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rsjax.errors import did_you_mean
from rsjax.tools.ingest.actions import Kind
from rsjax.tools.ingest.episode import MAX_FPS, SourceError
from rsjax.tools.ingest.formats.files import read_json
from rsjax.tools.ingest.formats.options import from_json


@dataclass(frozen=True)
class KeyMap:
    """Says what the features below ``steps/`` are.

    Attributes:
        cameras: the feature of each camera's pictures, by a name for the camera.
        action: features that make up the action, in order.
        fps: steps per second, > 0; RLDS does not store it.
        state: features that make up the state, in order.
        task: text features; the first that is not empty counts.
        kind: what the numbers of the action are, as in :class:`rsjax.tools.ingest.actions.ActionLayout`; None: not
            declared.
        quaternions: likewise.
        held: likewise; None: not declared.
        after: whether a step's observation was recorded after its action, contrary to the convention.
        depth: the feature of each camera's depth maps, by the camera's name.
        depth_scale: length in metres of one unit of a depth map of whole numbers; floats are metres.
        angles: dimensions of the action that are angles in radians, likewise.
        names: names of the data sets that this map is for.
    """

    cameras: Mapping[str, str]
    action: tuple[str, ...]
    fps: float
    state: tuple[str, ...] = ()
    task: tuple[str, ...] = ("language_instruction",)
    kind: Kind | None = "delta"
    quaternions: tuple[int, ...] = ()
    held: tuple[int, ...] | None = ()
    after: bool = False
    depth: Mapping[str, str] = field(default_factory=dict)
    depth_scale: float = 0.001
    angles: tuple[int, ...] = ()
    names: tuple[str, ...] = field(default=(), compare=False)

    def to_json(self) -> dict[str, Any]:
        """Returns the map as it is written to a file, without the fields that a file may omit."""
        blank = asdict(KeyMap({}, (), 0.0)) | {"names": self.names}
        always = ("kind", "held")  # always written, so that users see them; in a file, null means not declared
        return {name: value for name, value in asdict(self).items() if name in always or value != blank[name]}


def _cameras(*names: str) -> dict[str, str]:
    return {name: f"observation/{name}" for name in names}


_OXE_MOVE = ("action/world_vector", "action/rotation_delta")
_OXE_TASK = ("observation/natural_language_instruction",)

# bridge is tested on real files; the others follow the data sets' documentation and are checked against features.json.
MAPS: dict[str, KeyMap] = {
    "bridge": KeyMap(
        _cameras("image_0", "image_1", "image_2", "image_3"),
        ("action",),
        5.0,
        ("observation/state",),
        held=(6,),
        names=("bridge_dataset", "bridge_orig"),
    ),
    "bridge_poses": KeyMap(  # the pose that the hand reached and how far it is open, in place of the command
        _cameras("image_0", "image_1", "image_2", "image_3"),
        ("observation/state",),
        5.0,
        ("observation/state",),
        kind="absolute",
        after=True,
        angles=(3, 4, 5),
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
    """Returns the key map that a user chose.

    Args:
        keys: one of :data:`MAPS`, or the path of a JSON file with the fields of :class:`KeyMap`; "": the map for the
            data set's name.
        dataset: the data set's name.
        folder: the data set's folder, for error messages.

    Raises:
        SourceError: there is no such map, or the file has wrong fields.
    """
    choices = f"{', '.join(MAPS)}, a .json file, or auto"
    if keys in MAPS:
        return MAPS[keys]
    if keys.endswith(".json"):
        values = read_json(Path(keys))
        undeclared = {"kind": None, "held": None}  # the defaults are only for the maps above, whose actions are known
        keymap = from_json(KeyMap, undeclared | values if isinstance(values, dict) else values, keys)
        if not 0 < keymap.fps <= MAX_FPS:
            raise SourceError(f"{keys}: fps is {keymap.fps!r}, should be a number above 0 and at most {MAX_FPS:g}")
        if keymap.depth_scale <= 0:
            raise SourceError(f"{keys}: depth_scale is {keymap.depth_scale!r}, should be the metres that a 1 counts")
        if unknown := keymap.depth.keys() - keymap.cameras.keys():
            raise SourceError(
                f"{keys}: depth names the camera {min(unknown)!r}; cameras are {', '.join(keymap.cameras)}"
            )
        return keymap
    if keys:
        raise SourceError(f"unknown key map {keys!r}{did_you_mean(keys, MAPS)}; there are {choices}")
    for known in MAPS.values():
        if dataset in known.names:
            return known
    raise SourceError(f"{folder}: no key map for the data set {dataset!r}; choose one with keys: {choices}")
