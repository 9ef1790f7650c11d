"""Makes what metrics compare: recorded videos with the prediction and both baselines, at the protocol's resolution."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from rsjax.clip import Video
from rsjax.data.clips import Clips, readable, spread
from rsjax.data.codec import Record
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.evaluation.depth_estimator import DepthEstimator, estimate_depth
from rsjax.evaluation.generation import OWN
from rsjax.evaluation.localiser import recorded_places, train_localiser
from rsjax.evaluation.protocols import Protocol
from rsjax.evaluation.registry import Located, Places, Scene
from rsjax.models.base import TeacherForced
from rsjax.models.trained import TrainedModel

LOCALISER_CLIPS = 1000  # training clips from which the localiser learns

Locate = Callable[[Video, bool], Located]


def make_scenes(
    trained: TrainedModel,
    protocol: Protocol,
    clips: Clips,
    videos: Mapping[str, Sequence[Video]],
    estimator: DepthEstimator | None,
    locate: Locate | None,
    taught: TeacherForced | None = None,
    retakes: Video | None = None,
) -> dict[str, Scene]:
    """Returns the scenes by the suffix that names their scores: "" for the prediction, and one for each baseline.

    Args:
        videos: by kind of actions, one for each draw; the first under the clips' own actions is the prediction.
        taught: how well the model predicts tokens from true frames.
        retakes: second recordings of the clips' scenes.
    """
    reconstruction = trained.model.reconstruct(trained.assets, clips.video)
    shown = {"": videos[OWN][0], "_repeat_first": _repeat_first(clips.metric_video, protocol.prompt_frames)}
    if reconstruction is not None:
        shown["_tokenizer"] = reconstruction
    truth = scored_frames(trained, protocol, clips, reconstruction)
    compared = {suffix: scaled(video, protocol.resolution) for suffix, video in shown.items()}
    rgb = {suffix: video.rgb for suffix, video in compared.items()}
    estimated = estimate_depth(estimator, truth.rgb, rgb) if estimator else {}
    others = {kind: [scaled(each, protocol.resolution) for each in of] for kind, of in videos.items() if kind != OWN}
    truth_cache: dict[Any, Any] = {}
    return {
        suffix: Scene(
            truth,
            video,
            protocol.prompt_frames,
            {} if suffix else others,
            estimated.get(suffix),
            locate(shown[suffix], not suffix) if locate else None,
            None if suffix else taught,
            scaled(retakes, protocol.resolution) if retakes is not None else None,
            settings=trained.config.eval,
            truth_cache=truth_cache,
        )
        for suffix, video in compared.items()
    }


def scored_frames(
    trained: TrainedModel, protocol: Protocol, clips: Clips, reconstruction: Video | None = None
) -> Video:
    """Returns what predictions are compared with: recorded frames or their reconstruction, with recorded depth.

    Raises:
        UserError: the protocol compares with reconstructions, and the model has no tokenizer.
    """
    truth = clips.metric_video
    if protocol.reference == "reconstruction":
        if reconstruction is None:
            reconstruction = trained.model.reconstruct(trained.assets, clips.video)
        if reconstruction is None:
            raise UserError(
                f"protocol {protocol.name} compares with the tokenizer's reconstruction, and a model of family "
                f"{trained.config.model.family!r} has no tokenizer; choose another protocol"
            )
        truth = Video(reconstruction.rgb, truth.depth)
    return scaled(truth, protocol.resolution)


def locating(trained: TrainedModel, store: Store, records: Sequence[Record], last: int) -> Locate | None:
    """Trains a localiser and returns a function that pairs its reading of a video's last frames with the truth.

    Returns None if the clips do not record where cube and gripper are.

    Args:
        store: the store of the run; the localiser learns from its training clips.
        records: the scored clips.
        last: the index of the last frame that is scored.
    """
    recorded, train = recorded_places(records), store.source("train")
    clips = [clip for _, clip in readable(train, spread(train, LOCALISER_CLIPS))] if recorded else []
    if recorded is None or recorded_places(clips) is None:
        return None
    places, width = recorded
    truth = Places(places.xy[:, last], places.lifted[:, last])
    localiser = train_localiser(clips, trained.config.eval.localiser_steps)
    on_truth = localiser(np.stack([record["rgb"][last] for record in records]))
    return lambda video, own: Located(truth, width, on_truth if own else None, localiser(video.rgb[:, -1]))


def _repeat_first(video: Video, prompt_frames: int) -> Video:
    """Returns a video that repeats the last prompt frame: the baseline without motion."""
    last, frames = video.frames(prompt_frames - 1, prompt_frames), video.rgb.shape[1]
    return Video(np.repeat(last.rgb, frames, 1), None if last.depth is None else np.repeat(last.depth, frames, 1))


def scaled(video: Video, side: int) -> Video:
    """Returns a video resized to ``side`` pixels per side: RGB by area means, depth by nearest neighbour."""
    if video.rgb.shape[2] == side:
        return video
    lead = video.rgb.shape[:2]
    rgb = [cv2.resize(frame, (side, side), interpolation=cv2.INTER_AREA) for frame in np.concatenate(video.rgb)]
    if video.depth is None:
        return Video(np.stack(rgb).reshape(*lead, side, side, 3))
    depth = [cv2.resize(frame, (side, side), interpolation=cv2.INTER_NEAREST) for frame in np.concatenate(video.depth)]
    return Video(np.stack(rgb).reshape(*lead, side, side, 3), np.stack(depth).reshape(*lead, side, side))
