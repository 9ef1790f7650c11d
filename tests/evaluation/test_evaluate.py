from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import EvalConfig, SampleConfig
from rsjax.data.codec import Record
from rsjax.data.store import Store, StoreError
from rsjax.errors import UserError
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.evaluate import EvaluationClips, evaluate
from rsjax.evaluation.generation import ClipBatch, Generation, rolled_out, with_baselines
from rsjax.evaluation.metrics.delta_psnr import action_range, other_clips, uniform_actions
from rsjax.evaluation.metrics.psnr import psnr as pixels
from rsjax.evaluation.protocols import PAPER, find, of_run
from rsjax.evaluation.registry import Unavailable, metrics
from rsjax.evaluation.results import Evaluation, load_evaluation, save_evaluation
from rsjax.evaluation.shown import choose_clips
from rsjax.models.trained import TrainedModel
from tests.tools.pipeline import toy

NO_SIMULATOR = Unavailable("there is no simulator")
# Its draws are random, and two clips are one batch.
SAMPLED = replace(
    toy.with_model(toy.config(), sample=SampleConfig(steps=2, temperature=1.0)),
    eval=EvalConfig(clips=2, batch_size=2, action_draws=1, weights=""),
)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("toy") / "clips")


@pytest.fixture(scope="module")
def trained(clips: Store) -> TrainedModel:
    return toy.trained(clips)


@pytest.fixture(scope="module")
def result(trained: TrainedModel, clips: Store) -> Evaluation:
    return evaluate(trained, clips, probes=NO_SIMULATOR)


@pytest.fixture(scope="module")
def own(trained: TrainedModel) -> Video:
    """All clips, generated in one batch."""
    return generated(trained, TRUTH["actions"])


def eval_clips() -> list[dict[str, np.ndarray]]:
    return [vars(toy.clip(toy.TRAIN + i, toy.SUCCESS[i])) for i in range(toy.TEST)]


PLACES = {"cube_error_widths", "gripper_error_widths", "lifted_accuracy"}
PROBED = {
    *("contact_false_success", "contact_false_failure", "contact_brier", "contact_judge_accuracy"),
    *("drive_gripper_error_widths", "drive_psnr", "drive_worse_frames"),
}
TRUTH = {name: np.stack([clip[name] for clip in eval_clips()]) for name in ("rgb", "depth", "actions")}


def psnr(truth: np.ndarray, frames: np.ndarray) -> float:
    """Mean over clips and predicted frames, from the definition."""
    error = np.square(truth.astype(np.float64) - frames.astype(np.float64)).mean((2, 3, 4))[:, 1:]
    return float(np.mean(10 * np.log10(255**2 / error)))


def abs_rel(truth: np.ndarray, depth: np.ndarray) -> float:
    return float((np.abs(truth - depth) / truth)[:, 1:].mean())


def generated(trained: TrainedModel, actions: np.ndarray) -> Video:
    return trained.generate(TRUTH["rgb"][:, :1], actions, TRUTH["depth"][:, :1])


def test_the_baselines_are_plain_numpys(clips: Store, result: Evaluation) -> None:
    codec = toy.codec(clips)
    first = np.broadcast_to(TRUTH["rgb"][:, :1], TRUTH["rgb"].shape)
    reconstruction = codec.decode_rgb(codec.encode_rgb(TRUTH["rgb"]))
    assert result.metrics["psnr_repeat_first"] == pytest.approx(psnr(TRUTH["rgb"], first), rel=1e-4)
    frames = TRUTH["rgb"].shape[1]
    late = [0, *range(1 + (frames - 1) // 2, frames)]  # a prompt frame, then the second half of the predicted ones
    assert result.metrics["psnr_tokenizer_second_half"] == pytest.approx(
        psnr(TRUTH["rgb"][:, late], reconstruction[:, late]), rel=1e-4
    )
    assert result.metrics["psnr_tokenizer"] == pytest.approx(psnr(TRUTH["rgb"], reconstruction), rel=1e-4)
    first_depth = np.broadcast_to(TRUTH["depth"][:, :1], TRUTH["depth"].shape)
    depth = codec.decode_depth(codec.encode_depth(TRUTH["depth"]))
    assert result.metrics["depth_absrel_repeat_first"] == pytest.approx(abs_rel(TRUTH["depth"], first_depth), rel=1e-4)
    assert result.metrics["depth_absrel_tokenizer"] == pytest.approx(abs_rel(TRUTH["depth"], depth), rel=1e-4)


def test_the_last_frame_of_a_longer_prompt_is_repeated(clips: Store, trained: TrainedModel) -> None:
    recorded = EvaluationClips.read(clips, "test", of_run(trained.config), trained.config.clips).clips
    still = with_baselines(trained, recorded, recorded.video, prompt_frames=3)["_repeat_first"]
    assert still.depth is not None
    for frame in range(TRUTH["rgb"].shape[1]):
        np.testing.assert_array_equal(still.rgb[:, frame], TRUTH["rgb"][:, 2])
        np.testing.assert_array_equal(still.depth[:, frame], TRUTH["depth"][:, 2])


def test_batches_with_a_filled_up_last_one_score_as_one_batch_does(
    trained: TrainedModel, own: Video, result: Evaluation
) -> None:
    """5 clips in batches of 2 against one batch of 5; ΔPSNR with the same key under other clips' actions."""
    assert own.depth is not None
    assert result.metrics["psnr"] == pytest.approx(psnr(TRUTH["rgb"], own.rgb), rel=1e-4)
    assert result.metrics["depth_absrel"] == pytest.approx(abs_rel(TRUTH["depth"], own.depth), rel=1e-4)
    others = other_clips(toy.TEST, draws=2, seed=0)
    worse = [psnr(TRUTH["rgb"], generated(trained, TRUTH["actions"][order]).rgb) for order in others]
    assert result.metrics["delta_psnr"] == pytest.approx(psnr(TRUTH["rgb"], own.rgb) - np.mean(worse), abs=1e-4)
    assert result.metrics["delta_psnr"] != 0
    low, high = action_range(np.stack([toy.clip(number).actions for number in range(toy.TRAIN)]))
    uniform = uniform_actions(TRUTH["actions"], low, high, draws=2, seed=0)
    worse = [psnr(TRUTH["rgb"], generated(trained, actions).rgb) for actions in uniform]
    expected = psnr(TRUTH["rgb"], own.rgb) - np.mean(worse)
    assert result.metrics["delta_psnr_uniform"] == pytest.approx(expected, abs=1e-4)


def test_own_actions_in_place_of_random_ones_make_no_difference(clips: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sampling key is the same: with the same actions every ΔPSNR is 0, at random draws too."""
    monkeypatch.setattr(evaluation.delta_psnr, "other_clips", lambda clips, draws, seed: np.arange(clips)[None])
    monkeypatch.setattr(evaluation.delta_psnr, "uniform_actions", lambda own, *_, seed: own[None])
    metrics = evaluate(toy.trained(clips, SAMPLED), clips).metrics
    deltas = {name: value for name, value in metrics.items() if name.startswith("delta_psnr")}
    assert len(deltas) == 24
    assert set(deltas.values()) == {0.0}


def test_every_registered_metric_has_a_score_or_a_reason(result: Evaluation) -> None:
    assert {name for name in metrics() if name in result.metrics} == metrics().keys() - result.reasons.keys()
    assert {name for name in result.reasons if "estimator" not in name} == {
        *("lpips_alex", "lpips_vgg", "fvd", "physics_iq_score"),
        *PLACES,
        *PROBED,
        *(name for name in metrics() if name.startswith(("state_", "coverage"))),
    }
    assert {name for name, reason in result.reasons.items() if reason == str(NO_SIMULATOR)} == PROBED
    assert result.metrics["depth_absrel_median_branch_repeat_first"] > 0


def test_shown_clips_are_typical_ones_and_the_worst_by_their_own_psnr(own: Video, result: Evaluation) -> None:
    scores = [psnr(TRUTH["rgb"][[i]], own.rgb[[i]]) for i in range(toy.TEST)]
    rows, ranks = choose_clips(np.array(scores), np.array(toy.SUCCESS), 6)
    assert result.shown["clip"].tolist() == rows.tolist()
    assert rows[1] == np.argmin(scores)
    assert result.shown["rank"].tolist() == ranks.tolist() == [0, 1, 0, 2, 0]
    np.testing.assert_allclose(result.shown["psnr"], np.array(scores)[rows], rtol=1e-4)
    np.testing.assert_array_equal(result.shown["truth"], TRUTH["rgb"][rows])
    np.testing.assert_array_equal(result.shown["true_depth"], TRUTH["depth"][rows])
    assert len({array.shape[0] for array in result.shown.values()}) == 1


def test_scores_of_single_clips_and_frames_have_the_scores_as_their_means(result: Evaluation) -> None:
    frames = TRUTH["rgb"].shape[1]
    assert result.curves["frame"] == list(range(2, frames + 1))
    names = ("psnr", "ssim_repeat_first", "psnr_tokenizer", "depth_absrel", "depth_absrel_repeat_first")
    for name in (*names, "token_cross_entropy", "physics_iq_mse"):
        assert len(result.per_clip[name]) == toy.TEST
        assert np.mean(result.per_clip[name]) == pytest.approx(result.metrics[name], rel=1e-5)
        assert len(result.curves[name]) == frames - 1
        assert np.mean(np.array(result.curves[name], float)) == pytest.approx(result.metrics[name], rel=1e-5)
    assert np.mean(np.array(result.curves["delta_psnr"], float)) == pytest.approx(result.metrics["delta_psnr"])
    assert "delta_psnr_repeat_first" not in result.curves
    still = {name: scores for name, scores in result.per_clip.items() if name.startswith("delta_psnr_repeat_first")}
    assert still == dict.fromkeys(("delta_psnr_repeat_first", "delta_psnr_repeat_first_t4"), [0.0] * toy.TEST)


def test_a_result_comes_back_as_it_was_saved_or_is_refused(result: Evaluation, tmp_path: Path) -> None:
    path = tmp_path / "result.msgpack"
    save_evaluation(path, result)
    again = load_evaluation(path)
    for name in ("metrics", "reasons", "per_clip", "curves"):
        assert getattr(again, name) == getattr(result, name)
    for name, array in result.shown.items():
        np.testing.assert_array_equal(again.shown[name], array)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(StoreError, match=r"result.msgpack: damaged \(its checksum is wrong\); delete it"):
        load_evaluation(path)


def test_batches_on_disk_are_not_generated_again_and_damaged_ones_are(
    clips: Store, trained: TrainedModel, result: Evaluation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    eval_clips = EvaluationClips.read(clips, "test", of_run(trained.config), trained.config.clips)
    for process in range(2):  # two processes share the work; the second is killed over its last file
        evaluation.plan(trained, clips, eval_clips, tmp_path).make(process, 2)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 5 * 3  # own, 2 × other, 2 × uniform actions; 5 clips by 2
    files[4].write_bytes(files[4].read_bytes()[:-1])
    made, generate = [], Generation._generate

    def counted(self: Generation, batch: ClipBatch) -> Record:
        made.append(batch)
        return generate(self, batch)

    monkeypatch.setattr(Generation, "_generate", counted)
    monkeypatch.setattr("rsjax.evaluation.shown.KEPT_CLIPS", 2)
    # A second take that is the first one sets the limits 1, 1, 1 and 0.
    again = evaluate(trained, clips, eval_clips=replace(eval_clips, retakes=eval_clips.clips.video), folder=tmp_path)
    assert [batch.name for batch in made] == [files[4].name]
    score, own = "physics_iq_score", again.metrics
    assert ({k: v for k, v in own.items() if score not in k}, again.per_clip) == (result.metrics, result.per_clip)
    ious = [own[f"physics_iq_{kind}_all_frames"] for kind in ("spatial", "spatiotemporal", "weighted")]
    expected = np.clip(100 * (np.mean(ious) - own["physics_iq_mse_all_frames"]), 0, 100)
    assert own[score] == pytest.approx(expected, abs=0.02)
    assert own.keys() >= {f"{score}_repeat_first", f"{score}_tokenizer"}
    ends = np.argsort(result.per_clip["psnr_repeat_first"])[[0, 1, -2, -1]]
    assert again.kept["rows"].tolist() == sorted({0, toy.TEST - 1, *ends.tolist()})
    assert [clip["number"] for clip in again.clips] == list(range(toy.TEST))
    assert len({clip["sha256"] for clip in again.clips}) == toy.TEST


def test_batches_for_other_devices_are_made_anew(
    clips: Store, trained: TrainedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    protocol = replace(of_run(trained.config), action_draws=0)
    eval_clips, made = EvaluationClips.read(clips, "test", protocol, trained.config.clips), []

    def true_frames(self: Generation, batch: ClipBatch) -> Record:
        made.append((batch.start, batch.clips))
        return {"rgb": self.clips.rgb[batch.start : batch.start + batch.clips], "depth": None}

    monkeypatch.setattr(Generation, "_generate", true_frames)
    evaluation.plan(trained, clips, eval_clips, tmp_path).make(0, 2)  # stopped before the second of three batches
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    resumed = evaluation.plan(trained, clips, eval_clips, tmp_path).videos(0)["own"][0]
    np.testing.assert_array_equal(resumed.rgb, eval_clips.clips.rgb)
    assert made == [(0, 2), (4, 1), (0, 4)], "the last clip is a batch of both sizes"


def test_repetitions_are_averaged_and_draw_differently(clips: Store, tmp_path: Path) -> None:
    trained = toy.trained(clips, SAMPLED)
    protocol = replace(of_run(SAMPLED), repetitions=2, action_draws=0, samples=2)
    found = evaluate(trained, clips, protocol, folder=tmp_path)
    first, second = (each["psnr"] for each in found.repetitions)
    assert first != second
    assert found.metrics["psnr"] == found.metrics["psnr_n1_pred_only"] == pytest.approx((first + second) / 2)
    one, other = found.repetitions
    assert one.keys() == other.keys() and {"psnr_tokenizer", "ssim_repeat_first"} <= one.keys()
    assert all(one[name] == other[name] for name in one if "_tokenizer" in name or "_repeat_first" in name)
    assert "generates no videos under other actions" in found.reasons["delta_psnr"]
    assert found.reasons.keys() >= PROBED
    eval_clips = EvaluationClips.read(clips, "test", protocol, SAMPLED.clips)
    generation = evaluation.plan(trained, clips, eval_clips, tmp_path)  # reads what was generated
    videos = np.stack([generation.videos(run)["own"][0].rgb for run in range(2)])
    truth = np.broadcast_to(eval_clips.clips.rgb, videos.shape)
    own = np.asarray(pixels(truth, videos)).mean(-1)  # the prompt included
    best = np.maximum(own, [generation.samples(run)[0]["psnr"] for run in range(2)])
    assert (best != own).any()
    np.testing.assert_allclose(found.per_clip["psnr_best2_incl_ctx"], best.mean(0), rtol=1e-5)


@pytest.mark.parametrize("teacher_forced", [False, True])
def test_teacher_forced_frames_follow_true_ones_and_actions_into_these_stay_the_clips_own(teacher_forced: bool) -> None:
    """Random actions that contradict the frames of a prompt would count as loss of PSNR under other actions."""
    own = np.zeros((1, 5, 1))
    others = np.ones((1, 5, 1))
    truth = np.ones((1, 5, 2, 2, 3), np.uint8) * np.arange(5, dtype=np.uint8)[:, None, None, None]
    seen = []

    def generate(prompt: Video, actions: np.ndarray) -> Video:
        """Generates frames that are brighter by 10 than the last one of the prompt."""
        seen.append((prompt.rgb[0, :, 0, 0, 0].tolist(), actions[0, :, 0].tolist()))
        return Video(np.repeat(prompt.rgb[:, -1:] + np.uint8(10), actions.shape[1], axis=1))

    protocol = replace(PAPER, prompt_frames=3, teacher_forced=teacher_forced)
    made = rolled_out(generate, protocol, Video(truth), own, others).rgb
    if teacher_forced:
        assert seen == [([0, 1, 2], [0, 0, 0, 1]), ([0, 1, 2, 3], [0, 0, 0, 0, 1])]
        assert made[0, :, 0, 0, 0].tolist() == [12, 12, 12, 12, 13]
    else:
        assert seen == [([0, 1, 2], [0, 0, 0, 1, 1])]
        assert made[0, :, 0, 0, 0].tolist() == [12] * 5


def test_clips_that_are_too_short_or_small_are_refused(clips: Store, trained: TrainedModel) -> None:
    shape, long = trained.config.clips, find("horizon48", trained.config)
    large = replace(find("ivideogpt-bair", trained.config), horizon=1, resolution=99)
    for split, protocol, message in (
        ("test", long, f"predicts 48 frames after 1, so it takes clips of 49 .* have {shape.frames}"),
        ("test", large, f"scores frames of 99 pixels per side; .* have {shape.image_size}"),
        ("unseen", of_run(trained.config), "no split 'unseen'; it has train, test"),
    ):
        with pytest.raises(UserError, match=message):
            EvaluationClips.read(clips, split, protocol, shape)
    with pytest.raises(UserError, match="unknown protocol 'papr'; did you mean 'paper'"):
        find("papr", trained.config)
