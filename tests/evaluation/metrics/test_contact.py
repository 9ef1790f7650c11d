"""Scores of grasps and drives whose ends are known."""

from dataclasses import replace

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.evaluate import frame_curves
from rsjax.evaluation.metrics.contact import success_curves
from rsjax.evaluation.registry import Drives, Grasps, Probed, Scene, Unavailable
from rsjax.evaluation.statistics import wilson
from tests.evaluation.metrics.scored import score

RNG = np.random.default_rng(0)
OFFSET = np.tile([0.0, 0.02, 0.04], 12)
SUCCESS = RNG.random(36) < 1 - 25 * OFFSET
FRAMES = 50
SHAPE = (3, FRAMES, 16, 16, 3)


def scene(prediction: np.ndarray, on_truth: np.ndarray | None = None, success: np.ndarray = SUCCESS) -> Scene:
    """A scene in which the judge reads these probabilities, and whose drives are noise."""
    truth = Video(RNG.integers(0, 256, SHAPE, np.uint8))
    shown = Video(RNG.integers(0, 256, SHAPE, np.uint8))
    gripper = RNG.random((3, FRAMES, 2))
    located = gripper + np.arange(1, FRAMES + 1)[:, None] / 48 * np.array([0.03, 0.04])  # 0.05 away in frame 48
    drives = Drives(truth, shown, gripper, np.array([0.1, 0.2, 0.4]), gripper, located)
    return Scene(truth, shown, probed=Probed(Grasps(OFFSET, success, on_truth, prediction), drives))


def test_scores_of_grasps_are_those_of_a_loop() -> None:
    p = RNG.random(36)
    lied = [1.0 if p[i] > 0.5 else 0.0 for i in range(36) if not SUCCESS[i]]
    lost = [0.0 if p[i] > 0.5 else 1.0 for i in range(36) if SUCCESS[i]]
    squares = [(p[i] - 1) ** 2 if SUCCESS[i] else p[i] ** 2 for i in range(36)]
    for name, expected in (("false_success", lied), ("false_failure", lost), ("brier", squares)):
        scores = score(f"contact_{name}", scene(p))
        assert scores.keys() == {""}
        np.testing.assert_allclose(scores[""], expected)


def test_the_judge_s_own_errors_stand_beside_the_model_s() -> None:
    right = SUCCESS.astype(float)
    blind = scene(right, on_truth=np.ones(36))
    failed = np.ones(int((~SUCCESS).sum()))
    succeeded = np.zeros(int(SUCCESS.sum()))
    for name, errors in (("false_success", failed), ("false_failure", succeeded), ("brier", 1 - right)):
        scores = score(f"contact_{name}", blind)
        assert not scores[""].any()
        np.testing.assert_array_equal(scores["_truth"], errors)
    np.testing.assert_array_equal(score("contact_judge_accuracy", blind), right)
    with pytest.raises(Unavailable):
        score("contact_judge_accuracy", scene(right))


def test_the_curve_has_the_shares_of_each_offset_in_both_worlds() -> None:
    p = RNG.random(36)
    curves = success_curves(scene(p))
    assert curves["contact_offset_cm"] == [0.0, 2.0, 4.0]
    for name, success in (("contact_simulator", SUCCESS), ("contact_model", p > 0.5)):
        for point, offset in enumerate((0.0, 0.02, 0.04)):
            share = wilson(int(success[offset == OFFSET].sum()), 12)
            found = [curves[f"{name}{edge}"][point] for edge in ("", "_low", "_high")]
            assert found == [share.value, share.low, share.high]


def test_a_drive_s_errors_are_in_widths_of_its_cube_and_baselines_have_curves() -> None:
    own = scene(SUCCESS.astype(float))
    errors = score("drive_gripper_error_widths", own)
    np.testing.assert_allclose(errors[""], [0.5, 0.25, 0.125])
    assert not errors["_truth"].any()
    squares = (own.drives.truth.rgb.astype(float) - own.drives.prediction.rgb) ** 2
    expected = 10 * np.log10(255**2 / squares.mean((2, 3, 4)))[:, 1:]
    np.testing.assert_allclose(score("drive_psnr", own), expected.mean(1), rtol=1e-5)
    still = np.repeat(own.drives.truth.rgb[:, :1], FRAMES, 1)
    squares = (own.drives.truth.rgb.astype(float) - still) ** 2
    worse = expected < 10 * np.log10(255**2 / squares.mean((2, 3, 4))[:, 1:])
    assert worse.any() and not worse.all()
    np.testing.assert_allclose(score("drive_worse_frames", own), worse.mean(1))
    repeated = replace(own, probed=Probed(own.grasps, replace(own.drives, prediction=Video(still))))
    assert not score("drive_worse_frames", repeated).any()
    curves = frame_curves({"": own, "_repeat_first": own})
    assert curves["drive_frame"] == list(range(2, FRAMES + 1))
    np.testing.assert_allclose(np.array(curves["drive_psnr"], float), expected.mean(0), rtol=1e-5)
    assert curves["drive_psnr_repeat_first"] == curves["drive_psnr"]
    assert len(curves["drive_gripper_error_widths"]) == FRAMES - 1


def test_the_reason_for_no_probes_is_that_of_every_metric() -> None:
    reason = Unavailable("there is no simulator")
    none = replace(scene(SUCCESS.astype(float)), probed=reason)
    names = ("contact_false_success", "contact_false_failure", "contact_brier", "contact_judge_accuracy", "drive_psnr")
    for name in (*names, "drive_gripper_error_widths"):
        with pytest.raises(Unavailable) as raised:
            score(name, none)
        assert raised.value is reason
    assert success_curves(none) == {}
    with pytest.raises(Unavailable):
        score("contact_false_success", scene(np.ones(36), success=np.ones(36, bool)))
