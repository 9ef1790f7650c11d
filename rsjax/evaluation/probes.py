"""Generates probes: simulated episodes that each test one ability, apart from the clips that training resembles.

A grasp closes the fingers at a set offset from the cube, and a drive moves the arm as a person would. The model gets
their first frames and actions. The localiser, which has learned from true frames, reads what became of them: the same
network for the simulator's frames, the generated ones and the baselines.

Axes: G grasps, D drives, T frames, H×W pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rsjax.clip import Video
from rsjax.data.clips import Clips
from rsjax.data.codec import Record
from rsjax.evaluation.generation import OWN, Generation, with_baselines
from rsjax.evaluation.localiser import OBJECTS, Localiser, recorded_places
from rsjax.evaluation.protocols import Protocol
from rsjax.evaluation.registry import Drives, Grasps, Probed, Scene, Unavailable
from rsjax.models.trained import TrainedModel


@dataclass(frozen=True)
class Probes:
    """Episodes of the simulator that a model's clips are from, seen by the same camera.

    Attributes:
        grasps: with their ``offset``, in metres, in ``provenance["expert"]``.
        drives: all of one length, which may exceed that of the clips.
    """

    grasps: Sequence[Record]
    drives: Sequence[Record]


def probe(
    trained: TrainedModel, localiser: Localiser, probes: Probes, protocol: Protocol, folder: Path | None = None
) -> dict[str, Probed]:
    """Generates all probes and reads them, by the suffix of the scenes: the prediction and both baselines.

    Args:
        folder: where generated batches are kept until the evaluation is finished; None: in memory.
    """
    grasps = _stacked(probes.grasps)
    offset = np.array([record["provenance"]["expert"]["offset"] for record in probes.grasps])
    success = grasps.success[:, -1]
    lifted = localiser.lifted(grasps.rgb[:, -1])

    drives = _stacked(probes.drives)
    recorded = recorded_places(probes.drives)
    assert recorded is not None, "the simulator records places"
    places, width = recorded
    gripper = _gripper(localiser, drives.video)

    grasp_videos = _generated(trained, grasps, protocol, folder and folder / "grasps")
    drive_videos = _generated(trained, drives, protocol, folder and folder / "drives")
    probed = {}
    for suffix, video in grasp_videos.items():
        drive = drive_videos[suffix]
        probed[suffix] = Probed(
            Grasps(offset, success, None if suffix else lifted, localiser.lifted(video.rgb[:, -1])),
            Drives(
                drives.video,
                drive,
                places.xy[:, :, OBJECTS.index("gripper")],
                width,
                None if suffix else gripper,
                _gripper(localiser, drive),
            ),
        )
    return probed


def with_probes(scenes: Mapping[str, Scene], probed: Mapping[str, Probed] | Unavailable) -> dict[str, Scene]:
    """Returns the scenes with what became of the probes in each, or with the reason why there are none."""
    if isinstance(probed, Unavailable):
        return {suffix: replace(scene, probed=probed) for suffix, scene in scenes.items()}
    return {suffix: replace(scene, probed=probed[suffix]) for suffix, scene in scenes.items()}


def _stacked(records: Sequence[Record]) -> Clips:
    return Clips.stacked(records, range(len(records)))


def _generated(trained: TrainedModel, clips: Clips, protocol: Protocol, folder: Path | None) -> dict[str, Video]:
    """Returns the prediction and both baselines by the suffix that names their scores."""
    settings = trained.config.eval
    settings = replace(settings, batch_size=min(settings.batch_size, len(clips.rgb)))
    trained = replace(trained, config=replace(trained.config, eval=settings))
    once = replace(protocol, samples=1, repetitions=1)
    generation = Generation(trained, once, clips, {OWN: clips.actions[None]}, len(clips.rgb), lambda *_: {}, folder)
    generation.make()
    return with_baselines(trained, clips, generation.videos(0)[OWN][0], protocol.prompt_frames)


def _gripper(localiser: Localiser, video: Video) -> np.ndarray:
    """Returns the gripper's place in all frames of videos, (D, T, 2)."""
    places = localiser(np.concatenate(video.rgb))
    return places.xy[:, OBJECTS.index("gripper")].reshape(*video.rgb.shape[:2], 2)
