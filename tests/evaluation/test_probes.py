"""Probes of a model that generates the simulator's own frames, read by a judge that is always right."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Clip, Video
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.evaluation.evaluate import evaluate
from rsjax.evaluation.localiser import Localiser
from rsjax.evaluation.probes import Probes, probe
from rsjax.evaluation.protocols import of_run
from rsjax.evaluation.registry import Places
from tests.tools.pipeline import toy

GRASPS = 5
DRIVES = 2
LENGTH = 9  # longer than the clips
WIDTH = 0.1


def placed(number: int, success: bool, offset: float = 0.0) -> Clip:
    """A toy clip that says where cube and gripper are."""
    clip = toy.clip(number, success)
    xy = np.random.default_rng(number).random((2, len(clip.rgb), 2))
    objects = {"cube": xy[0].tolist(), "gripper": xy[1].tolist(), "cube_width": WIDTH}
    return replace(clip, provenance=clip.provenance | {"objects": objects, "expert": {"offset": offset}})


def longer(number: int) -> dict[str, Any]:
    """A drive: two toy clips in a row, cut to its length."""
    one = encode_clip(placed(number, False))
    other = encode_clip(placed(number + 50, False))
    drive = {name: np.concatenate([one[name], other[name]])[:LENGTH] for name in ("rgb", "depth", "actions", "success")}
    drive |= {name: np.concatenate([one[name], other[name]], 1)[:, :LENGTH] for name in ("tracks", "visible")}
    places = [each["provenance"]["objects"] for each in (one, other)]
    objects = {name: (places[0][name] + places[1][name])[:LENGTH] for name in ("cube", "gripper")}
    return one | drive | {"provenance": {"objects": objects | {"cube_width": WIDTH}}}


@pytest.fixture(scope="module")
def probes() -> Probes:
    grasps = [encode_clip(placed(100 + i, success=i % 2 == 0, offset=0.01 * i)) for i in range(GRASPS)]
    return Probes(grasps, [longer(200 + i) for i in range(DRIVES)])


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("probed") / "clips")


@dataclass(frozen=True)
class Perfect:
    """A model that knows the simulator's frames by their actions."""

    model: Any
    known: dict[bytes, np.ndarray]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)

    def generate(self, params: Any, assets: Any, prompt: Video, actions: np.ndarray, **_: Any) -> Video:
        return Video(np.stack([self.known[each.tobytes()] for each in actions]))


@dataclass(frozen=True)
class Right(Localiser):
    """A judge that knows places and success by the frame."""

    known: dict[bytes, tuple[np.ndarray, bool]]

    def __call__(self, rgb: np.ndarray, batch: int = 256) -> Places:
        found = [self.known.get(frame.tobytes(), (np.zeros((2, 2)), False)) for frame in rgb]
        return Places(np.stack([xy for xy, _ in found]), np.array([lifted for _, lifted in found]))

    def lifted(self, rgb: np.ndarray, batch: int = 256) -> np.ndarray:
        return self(rgb).lifted.astype(float)


def test_the_simulator_s_frames_as_generated_ones_are_never_wrong(clips: Store, probes: Probes) -> None:
    records = [*probes.grasps, *probes.drives]
    videos = {record["actions"].tobytes(): record["rgb"] for record in records}
    frames = {}
    for record in records:
        objects = record["provenance"]["objects"]
        for t, frame in enumerate(record["rgb"]):
            xy = np.array([objects["cube"][t], objects["gripper"][t]])
            frames[frame.tobytes()] = (xy, bool(record["success"][t]))
    trained = toy.trained(clips)
    trained = replace(trained, model=Perfect(trained.model, videos))  # type: ignore[arg-type]
    found = probe(trained, Right({}, frames), probes, of_run(trained.config))
    assert found.keys() == {"", "_repeat_first", "_tokenizer"}
    own = found[""]
    np.testing.assert_array_equal(own.grasps.prediction, own.grasps.success)
    np.testing.assert_array_equal(own.grasps.success, [True, False, True, False, True])
    np.testing.assert_allclose(own.grasps.offset, 0.01 * np.arange(GRASPS))
    np.testing.assert_array_equal(own.drives.prediction.rgb, own.drives.truth.rgb)
    np.testing.assert_array_equal(own.drives.located, own.drives.gripper)
    still = found["_repeat_first"]
    assert still.grasps.on_truth is None
    assert not still.grasps.prediction.any()
    assert (still.drives.prediction.rgb == still.drives.truth.rgb[:, :1]).all()


def test_an_evaluation_scores_its_probes_and_generates_them_as_the_model_does(
    clips: Store, probes: Probes, tmp_path: Path
) -> None:
    records = {
        "train": [encode_clip(placed(i, success=i == 0)) for i in range(toy.TRAIN)],
        "test": [encode_clip(placed(toy.TRAIN + i, toy.SUCCESS[i])) for i in range(toy.TEST)],
    }
    meta = {name: clips.manifest[name] for name in ("depth_range", "action_mean", "action_std")} | {"key": "toy"}
    write_store(tmp_path / "clips", "clips", records, meta)
    store = open_store(tmp_path / "clips")
    config = toy.config()
    config = replace(config, eval=replace(config.eval, clips=2, action_draws=1, localiser_steps=2))
    trained = toy.trained(store, config)
    result = evaluate(trained, store, probes=probes, folder=tmp_path / "parts")
    fails = [record for record in probes.grasps if not record["success"][-1]]
    assert len(result.per_clip["contact_false_success"]) == len(fails)
    assert len(result.per_clip["contact_brier"]) == GRASPS
    assert {"contact_judge_accuracy", "contact_brier_tokenizer", "drive_psnr_repeat_first"} <= result.metrics.keys()
    assert result.curves["contact_offset_cm"] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert result.curves["drive_frame"] == list(range(2, LENGTH + 1))
    assert len(result.curves["drive_psnr"]) == LENGTH - 1
    assert result.reasons.keys() >= {"drive_gripper_error_widths"}  # it has no frame 48
    drives = {name: np.stack([drive[name] for drive in probes.drives]) for name in ("rgb", "depth", "actions")}
    own = trained.generate(drives["rgb"][:, :1], drives["actions"], drives["depth"][:, :1]).rgb
    error = np.square(own.astype(float) - drives["rgb"]).mean((2, 3, 4))[:, 1:]
    assert result.metrics["drive_psnr"] == pytest.approx((10 * np.log10(255**2 / error)).mean(), rel=1e-4)
