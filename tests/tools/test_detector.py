"""Tests of the detector of generated video, on toy videos: detailed ones are real, blurred ones generated."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8

import rsjax
from rsjax.clip import GENERATED, GENERATED_MARK
from rsjax.errors import UserError
from rsjax.tools.detector.judging import judged
from rsjax.tools.detector.spectra import FEATURES, RINGS, SHIPPED, Detector, load_detector, video_features
from rsjax.tools.detector.training import AS_IT_IS, LEARNED, TREATMENTS, RunFeatures, measure, scores, tables, train
from rsjax.tools.logistic_regression import fit
from rsjax.tools.studies.report.video import write_mp4

rng = np.random.default_rng(0)


def real(frames: int = 4, side: int = 64) -> UInt8[np.ndarray, "T S S 3"]:
    return rng.integers(0, 256, (frames, side, side, 3), np.uint8)


def blurred(video: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    return np.stack([cv2.GaussianBlur(frame, (0, 0), 2) for frame in video])


@pytest.fixture(scope="module")
def detector() -> Detector:
    videos = [real() for _ in range(8)]
    features = np.stack([video_features(video) for video in [*videos, *map(blurred, videos)]])
    return Detector(fit(features, np.repeat([False, True], 8)))


def test_power_is_in_the_ring_of_a_waves_frequency() -> None:
    x = np.arange(64) / 64
    for waves in (4, 12, 24):
        picture = np.round(128 + 100 * np.cos(2 * np.pi * waves * x)).astype(np.uint8)
        video = np.broadcast_to(picture[None, None, :, None], (3, 64, 64, 3))
        luma = video_features(video)[:RINGS]
        assert luma.argmax() == int(waves / 64 / np.hypot(0.5, 0.5) * RINGS)
        assert np.allclose(video_features(video)[RINGS:], 0, atol=1e-3)  # it is grey


def test_features_do_not_depend_on_the_size_of_enlarged_pixels() -> None:
    video = real()
    large = video.repeat(3, axis=1).repeat(3, axis=2)
    wide = np.pad(large, ((0, 0), (0, 0), (10, 10), (0, 0)))
    assert np.allclose(video_features(video), video_features(wide), atol=1e-4)


def test_scores_equal_a_loop() -> None:
    negative = rng.random(7).round(1)
    positive = rng.random(9).round(1)
    pairs = [(p > n) + 0.5 * (p == n) for p in positive for n in negative]
    found = scores(negative, positive)
    assert found["auc"] == pytest.approx(np.mean(pairs), abs=1e-4)
    assert (found["real"], found["generated"]) == (7, 9)


@pytest.mark.parametrize("name", TREATMENTS)
def test_treatments_keep_the_number_of_frames(name: str) -> None:
    treated = TREATMENTS[name](blurred(real()))
    assert treated.dtype == np.uint8 and len(treated) == 4
    assert treated.shape[1] in (32, 64, 96)


def test_a_saved_detector_is_the_same_and_damage_is_noticed(detector: Detector, tmp_path: Path) -> None:
    detector.save(tmp_path)
    features = video_features(real())[None]
    assert load_detector(tmp_path)(features) == pytest.approx(detector(features), abs=1e-5)
    path = tmp_path / "detector.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(UserError) as damaged:
        load_detector(tmp_path)
    assert "SHA-256" in str(damaged.value)
    with pytest.raises(UserError) as missing:
        load_detector(tmp_path / "nowhere")
    assert "missing; train it again with rsjax detect" in str(missing.value)


def test_the_detector_of_the_package_knows_the_packages_clips_as_recorded() -> None:
    detector = load_detector(SHIPPED)
    clip = rsjax.examples("tiny")[0]["rgb"]
    assert detector(video_features(clip)[None])[0] < 0.5
    assert detector.about["runs"]


def test_videos_and_stores_are_judged_by_pictures_and_marks(detector: Detector, tmp_path: Path) -> None:
    write_mp4(tmp_path / "made.mp4", blurred(real()), 5, comment=GENERATED_MARK)
    (line,) = judged(detector, tmp_path / "made.mp4", "test")
    assert "looks generated; marked as generated" in line
    actions = np.zeros((4, 2), np.float32)
    clips = [{"rgb": real(), "actions": actions}, {"rgb": blurred(real()), "actions": actions}]
    clips[1]["provenance"] = {"source": GENERATED}  # type: ignore[assignment]
    rsjax.write_store(tmp_path / "store", clips, test_share=0.0)
    first, second = judged(detector, tmp_path / "store", "train")
    assert "looks recorded  " in first and "looks generated; marked" in second
    with pytest.raises(UserError) as unknown:
        list(judged(detector, tmp_path / "store", "none"))
    assert "has no split 'none'" in str(unknown.value)


def toy_footage(name: str, family: str, clips: str) -> RunFeatures:
    values = {kind: {way: rng.normal(size=(6, FEATURES)) for way in TREATMENTS} for kind in ("real", "generated")}
    for way in TREATMENTS:
        values["generated"][way] = values["generated"][way] + 2
    return RunFeatures(name, family, clips, **values)


def test_each_run_is_tested_with_its_clips_left_out() -> None:
    footage = [toy_footage("a", "roboscape", "0"), toy_footage("b", "genie", "1"), toy_footage("c", "roboscape", "1")]
    rows = measure(footage)
    first = [row for row in rows if row["run"] == "a" and row["treatment"] == AS_IT_IS]
    assert [row["without"] for row in first] == ["clips", "clips and family"]
    alone = train(footage[1:])
    expected = scores(alone(footage[0].real[AS_IT_IS]), alone(footage[0].generated[AS_IT_IS]))
    assert {name: first[0][name] for name in expected} == expected
    assert len(tables(rows)["treatments"].rows) == len(TREATMENTS) and set(LEARNED) < set(TREATMENTS)
    with pytest.raises(UserError):
        measure(footage[1:])
