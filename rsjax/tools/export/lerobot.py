"""Writes a store of clips as a LeRobotDataset v3.0 or v2.1, which the training code of LeRobot and openpi reads.

Each clip becomes an episode. LeRobot's row t has the frame at t and the action that leads out of it; a clip's row t has
the action that leads into it. So actions move up by one row, and the last row repeats the one before it, because no
action follows the last frame.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Shaped

from rsjax.clip import GENERATED, GENERATED_MARK
from rsjax.config.fields import require_range
from rsjax.data.clips import frame_rate, keeps_rate, readable
from rsjax.data.codec import Record
from rsjax.data.state_labels import knows_success
from rsjax.data.store import Store, StoreError
from rsjax.errors import UserError
from rsjax.files import disk_guard, making, replace_directory, write_json
from rsjax.progress import note
from rsjax.tools.export.lerobot_files import (
    LayoutV21,
    LayoutV30,
    LeRobotEpisode,
    VideoSettings,
    describe_features,
    outcome_columns,
    video_rate,
)
from rsjax.tools.ingest.actions import ActionLayout, described_layout
from rsjax.tools.ingest.formats.lerobot import EXPORTED, PROVENANCE

LAYOUTS: dict[str, type[LayoutV30 | LayoutV21]] = {"v3.0": LayoutV30, "v2.1": LayoutV21}
CONTROLS = ("delta_x", "delta_y", "delta_z", "delta_roll", "delta_pitch", "delta_yaw", "gripper")  # of simulated Lift
# Names of a constant state's numbers; from one number LeRobot would make (B, T), but its policies want (B, T, D).
ZEROS = ("zero_0", "zero_1")
STATE = "observation.state"
OPENPI_HORIZON = 50  # action_horizon of Pi0Config
MOST_PADDING = 0.25  # share of action targets that is acceptable


@dataclass(frozen=True)
class LeRobotOptions:
    """The options of an export.

    Attributes:
        version: version of the format; v3.0 for LeRobot 0.4 and later, v2.1 for earlier ones and openpi.
        split: the clips to export. LeRobot trains on all episodes of a data set, so the default leaves test clips out.
        state: ``observation.state``, which most policies ask for and clips do not have. zeros: two zeros;
            command: the action that led into the frame; none: no such column.
        codec: codec of the videos; LeRobot's own default is av1.
        crf: constant rate factor of the codec, 0 to 63 (av1) or 51 (h264): lower is larger and sharper (LeRobot: 30).
        fps: frames per second; 0: as the clips say.
        robot: ``robot_type`` in ``meta/info.json``.
    """

    version: Literal["v3.0", "v2.1"] = "v3.0"
    split: Literal["train", "test", "all"] = "train"
    state: Literal["zeros", "command", "none"] = "zeros"
    codec: Literal["av1", "h264"] = "av1"
    crf: int = 20
    fps: float = 0.0
    robot: str = "unknown"

    def __post_init__(self) -> None:
        require_range(self, "export", 0, 63 if self.codec == "av1" else 51, "crf")


def export_lerobot(
    store: Store,
    out: Path,
    options: LeRobotOptions = LeRobotOptions(),
    report: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Writes a LeRobotDataset to ``out``, which appears only when it is complete.

    Args:
        store: a store of clips, all of one size and rate; clips that cannot be read are left out with a note.
        out: a directory that does not exist.
        report: called with (episodes done, episodes in all).

    Returns:
        The content of the data set's ``meta/info.json``.

    Raises:
        UserError: ``out`` exists, the store has no clips, or their sizes or frame rates differ or do not suit a video.
        FileError: the disk is full, or ``out`` cannot be written.

    If a world model generated some of the clips, ``meta/provenance.json`` lists these episodes. Rows have the columns
    ``next.success``, ``next.reward`` and ``next.done`` if the store knows which clips succeed.
    """
    with new_data_set(out) as building:
        return _write(store, building, options, report or (lambda done, total: None))


@contextmanager
def new_data_set(out: Path) -> Iterator[Path]:
    """Yields the directory in which a data set is built, and moves it to ``out`` if all goes well.

    Raises:
        UserError: ``out`` exists.
        FileError: the disk is full, or ``out`` cannot be written.
    """
    if out.exists():
        raise UserError(f"{out}: exists; choose another place for the data set, or move it away")
    building = out.with_name(f"{out.name}.building")
    with disk_guard(out), making(out, wait=False):
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir(parents=True)
        try:
            yield building
            replace_directory(building, out)
        finally:
            shutil.rmtree(building, ignore_errors=True)


def padding(frames: int, horizon: int) -> float:
    """Returns the share of action targets after an episode's end, if each frame asks for ``horizon`` actions.

    openpi pads them by repeating the last action, and its loss counts them like the others.
    """
    inside = sum(min(horizon, frames - start) for start in range(frames))
    return 1 - inside / (frames * horizon)


def openpi_advice(frames: int) -> str:
    """Returns which action horizon fits episodes of this length; "" if openpi's default does."""
    if padding(frames, OPENPI_HORIZON) <= MOST_PADDING:
        return ""
    fitting = next(horizon for horizon in range(OPENPI_HORIZON, 0, -1) if padding(frames, horizon) <= MOST_PADDING)
    return (
        f"episodes have {frames} frames: with openpi's default action_horizon of {OPENPI_HORIZON}, "
        f"{padding(frames, OPENPI_HORIZON):.0%} of the action targets are padding, which its loss counts; set "
        f"action_horizon={fitting} ({padding(frames, fitting):.0%}) in its model's configuration"
    )


def _write(store: Store, root: Path, options: LeRobotOptions, report: Callable[[int, int], None]) -> dict[str, Any]:
    if options.split == "all":
        names = store.splits
    else:
        names = (options.split,)
    if store.manifest.get("kind") != "clips":
        raise StoreError(f"{store.path}: holds {store.manifest.get('kind')}, not clips; export the clips themselves")
    total = sum(len(store.source(name)) for name in names)
    layout = None
    splits = {}
    generated: list[int] = []
    cameras: dict[str, None] = {}
    second = False
    recordings: list[str] = []
    for name in names:
        if layout:
            begins = layout.episodes
        else:
            begins = 0
        for _, clip in readable(store.source(name)):
            if layout is None:
                layout = _layout(store, clip, root, options)
            actions = clip["actions"]
            columns: dict[str, Shaped[np.ndarray, "T ..."]] = {"action": np.concatenate([actions[1:], actions[-1:]])}
            state = layout.features.get(STATE)
            if state is not None and state["names"] == list(ZEROS):
                columns[STATE] = np.zeros((len(actions), len(ZEROS)), np.float32)
            elif state is not None:
                columns[STATE] = actions
            if "next.success" in layout.features:
                columns |= outcome_columns(clip["success"])
            if clip["rgb"].shape[1:] != (layout.video.size, layout.video.size, 3):
                raise StoreError(f"{store.path}: has clips of several sizes; export them from stores of their own")
            if not options.fps and not keeps_rate(clip, store.manifest, layout.video.fps):
                rate = frame_rate(clip, store.manifest)
                raise StoreError(
                    f"{store.path}: has clips of {layout.video.fps:g} and {rate or 0:g} frames a second (0: unknown); "
                    f"export them from stores of their own, or give --fps"
                )
            cameras[_camera(clip)] = None
            second |= "second" in clip
            recordings.append(str(clip["provenance"].get("episode", layout.episodes)))
            if clip["provenance"].get("source") == GENERATED:
                generated.append(layout.episodes)
            layout.add(LeRobotEpisode({layout.cameras[0]: clip["rgb"]}, columns, str(clip["task"])))
            report(layout.episodes, total)
        if layout is not None and layout.episodes > begins:
            splits[name] = f"{begins}:{layout.episodes}"
    if layout is None:
        raise StoreError(f"{store.path}: has no readable clip of split {options.split}")
    if generated:
        mark = {"generated_episodes": generated, "episodes": layout.episodes, "note": GENERATED_MARK}
        write_json(root / "meta" / PROVENANCE, mark)
    if second:
        note(f"{store.path}: the second view of its clips is left out")
    if len(cameras) > 1:
        note(f"{store.path}: has clips of the cameras {', '.join(cameras)}; all are in {layout.cameras[0]}")
    about: dict[str, Any] = {"store": str(store.manifest.get("key")), "split": options.split, "recordings": recordings}
    meaning = actions_of(store, layout.features["action"]["shape"][0])
    if meaning:
        about["actions"] = meaning.to_json()
    write_json(root / "meta" / EXPORTED, about)
    return layout.finish({"codebase_version": options.version, "robot_type": options.robot, "splits": splits})


def actions_of(store: Store, width: int) -> ActionLayout | None:
    """Returns what the ``width`` numbers of a store's actions mean; None if it does not say so."""
    if names_controls(store, width):
        return ActionLayout("delta", held=tuple(range(len(CONTROLS) - 1, width, len(CONTROLS))))
    return described_layout(store.manifest.get("action_dimensions") or [])


def names_controls(store: Store, width: int) -> bool:
    """Returns whether an action is a few controls of the simulated Lift in a row."""
    return store.manifest.get("source", "").startswith("robosuite/") and width % len(CONTROLS) == 0


def _layout(store: Store, clip: Record, root: Path, options: LeRobotOptions) -> LayoutV30 | LayoutV21:
    """Returns the layout for clips of the first clip's size and rate."""
    fps = options.fps or frame_rate(clip, store.manifest)
    if not fps:
        raise UserError(f"{store.path}: its clips do not say how many frames a second have; give --fps")
    size = clip["rgb"].shape[1]
    if size % 2 or not 0.001 <= fps <= 1000:
        raise UserError(
            f"{store.path}: {size} × {size} pixels at {fps:g} Hz; videos need even sides and 0.001 to 1000 Hz"
        )
    fps = float(video_rate(fps))  # timestamps have to be those of the frames, even in a long video of many episodes
    width = clip["actions"].shape[1]
    names = [f"action_{number}" for number in range(width)]
    if names_controls(store, width):
        names = [f"{name}_{step}" for step in range(width // len(CONTROLS)) for name in CONTROLS]
    columns: dict[str, Sequence[str]] = {}
    if options.state == "zeros":
        columns[STATE] = ZEROS
    elif options.state == "command":
        columns[STATE] = names
    columns["action"] = names
    video = VideoSettings(options.codec, options.crf, fps, size)
    features = describe_features(video, [f"observation.images.{_camera(clip)}"], columns, knows_success(store))
    return LAYOUTS[options.version](root, video, features)


def _camera(clip: Record) -> str:
    return "".join(c if c.isalnum() else "_" for c in str(clip["provenance"].get("camera") or "image"))
