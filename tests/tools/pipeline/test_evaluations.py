import contextlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import Config, presets, to_dict
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.coverage import Coverage
from rsjax.evaluation.depth_estimator import DepthEstimator
from rsjax.evaluation.evaluate import EvaluationClips
from rsjax.evaluation.metrics import fvd
from rsjax.evaluation.probes import Probes
from rsjax.evaluation.protocols import Protocol, find
from rsjax.evaluation.registry import Unavailable
from rsjax.evaluation.results import Evaluation, read_frames, read_result
from rsjax.files import write_json
from rsjax.models.trained import TrainedModel
from rsjax.runtime import HUGE_PAGES
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.commands import compare as compare_command
from rsjax.tools.pipeline import evaluation_clips as eval_clips
from rsjax.tools.pipeline import evaluations
from rsjax.tools.pipeline.evaluation_clips import evaluation_store, longer_episodes, probes_of
from rsjax.tools.pipeline.evaluations import EvaluationRequest, evaluate_own, evaluate_run
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.sim import retakes
from rsjax.training.checkpoint import save_weights
from tests.tools.pipeline import toy
from tests.tools.pipeline.conftest import Commands

FRAMES = toy.config().clips.frames
LIFT = "robosuite/Lift/Panda"
CHANGES = {"horizon": FRAMES - 1, "clips": toy.TEST, "action_draws": 0}
MADE: list[Path] = []  # where batches of the evaluations that were made lie


def scored(
    trained: TrainedModel,
    store: Store,
    protocol: Protocol | None,
    eval_clips: EvaluationClips,
    folder: Path,
    estimator: DepthEstimator | None,
    probes: Probes | Unavailable,
    coverage: Coverage | None,
) -> Evaluation:
    """Stands for an evaluation, whose scores other tests look at: PSNR rises by 1 dB from clip to clip."""
    MADE.append(folder)
    folder.mkdir(parents=True)
    rgb = eval_clips.clips.rgb
    per_clip = {f"psnr{suffix}": [20.0 + i for i in range(len(rgb))] for suffix in ("", "_repeat_first", "_tokenizer")}
    metrics = {name: float(np.mean(values)) for name, values in per_clip.items()}
    kept = {"rows": np.arange(len(rgb)), "truth": rgb, "prediction": rgb, "reconstruction": rgb}
    shown = {"clip": eval_clips.clips.index}
    return Evaluation(metrics, {"lpips_alex": "no weights"}, shown, per_clip, {}, [metrics], eval_clips.ids(), kept)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """A run of random parameters on a store of clips; nothing is generated for its evaluations."""
    base, plain = tmp_path_factory.mktemp("evaluated"), toy.clip
    with pytest.MonkeyPatch.context() as patch:  # frames of a recording at 10 frames a second, of which every other
        timing = {"fps": 10.0, "frames": list(range(0, 2 * FRAMES, 2))}
        timed = lambda *numbers: replace(clip := plain(*numbers), provenance=clip.provenance | timing)  # noqa: E731
        patch.setattr(toy, "clip", timed)
        store = toy.store(base / "clips")
    config = on_store(toy.config(), base / "clips")
    run = Run(config, base / "run", base)
    for stage in ("tokenizer", "world_model", "tokens"):
        (run.directory / stage).mkdir(parents=True)
    save_weights(run.output("tokenizer"), zeros(config))
    save_weights(run.output("world_model"), toy.world_model_params(config))
    Normalization.create(store).save(run.directory / "tokens")
    write_json(run.directory / "config.json", to_dict(config))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "evaluate", scored)
        yield run


def zeros(config: Config) -> Any:
    """A tokenizer's parameters."""
    shapes = jax.eval_shape(Tokenizer(config.tokenizer).init_params, jax.random.key(0))
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)


def evaluated(run: Run, overwrite: bool = False, **changes: Any) -> list[Path]:
    wanted = EvaluationRequest("paper", CHANGES | changes, overwrite=overwrite)
    return list(evaluate_run(run.directory, run.data_directory, wanted))


@pytest.fixture(scope="module")
def folder(run: Run) -> Path:
    return evaluated(run)[0]


def test_a_changed_result_is_refused(folder: Path, tmp_path: Path) -> None:
    text = (folder / "result.json").read_text()
    changed = text.replace('"psnr": 2', '"psnr": 3', 1)
    (tmp_path / "result.json").write_text(changed)
    with pytest.raises(UserError) as error:
        read_result(tmp_path)
    assert changed != text and "its checksum is wrong; rsjax evaluate makes it again" in str(error.value)


def test_a_result_says_all_that_decided_it(run: Run, folder: Path) -> None:
    result = read_result(folder)
    assert folder.parent == run.directory / "evaluations"
    assert result.label == folder.name == f"paper,horizon={FRAMES - 1},clips=5,action_draws=0"
    assert result.protocol["prompt_frames"] == 1
    assert result.data["key"] == "toy"
    assert (result.data["split"], result.data["frames"]) == ("test", FRAMES)
    assert (result.data["fps"], result.settings["physics_iq_threshold"]) == (5.0, 10)
    assert result.sampling["unmask"] == "greedy"
    assert result.model["parameters"] > 0
    assert len(result.model["weights_sha256"]) == 16
    assert result.model["training"]["train"]["steps"] == run.config.train.steps
    assert "seed" not in result.model["training"]["train"]
    assert result.code["version"]
    assert result.made["machine"]["devices"] >= 1
    assert [clip["number"] for clip in result.clips] == list(range(toy.TEST))
    assert len({clip["sha256"] for clip in result.clips}) == toy.TEST
    assert result.metrics["lpips_alex"] is None
    assert result.reasons == {"lpips_alex": "no weights"}
    assert read_frames(folder)["prediction"].shape[0] == toy.TEST
    assert MADE[0].parent == folder
    assert not MADE[0].exists()


def test_what_is_up_to_date_is_skipped_and_other_weights_are_another_model(run: Run, folder: Path) -> None:
    MADE.clear()
    assert evaluated(run) == [folder]
    assert not MADE
    assert evaluated(run, clips=4)[0].name.endswith("clips=4,action_draws=0")
    evaluated(run, clips=4, overwrite=True)
    assert len(MADE) == 2
    assert MADE[0] == MADE[1]
    weights, kept = run.output("world_model").parent, run.directory / "kept"
    weights.rename(kept)
    weights.mkdir()
    try:
        save_weights(run.output("world_model"), jax.tree.map(lambda x: x + 1, toy.world_model_params(run.config)))
        evaluated(run, clips=4)
    finally:
        weights.rename(run.directory / "other")
        kept.rename(weights)
    assert len(MADE) == 3
    assert MADE[2] != MADE[1]


def test_other_weights_of_a_metric_at_the_same_path_are_evaluated_anew(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "check_files", lambda settings: None)

    def evaluated(name: str) -> str:
        settings = {"weights": str(tmp_path / name)}
        return read_result(
            *evaluate_run(run.directory, run.data_directory, EvaluationRequest("run", settings=settings))
        ).key

    (tmp_path / "i3d").mkdir()
    (tmp_path / "i3d" / fvd.FILE).write_bytes(b"1")
    first = evaluated("i3d")
    MADE.clear()
    (tmp_path / "i3d").rename(tmp_path / "moved")
    assert evaluated("moved") == first
    assert not MADE
    (tmp_path / "moved" / fvd.FILE).write_bytes(b"2")
    assert evaluated("moved") != first
    assert len(MADE) == 1


def test_results_of_other_stores_stay_apart_and_in_the_run(run: Run, folder: Path, tmp_path: Path) -> None:
    def evaluated(name: str, key: str | None) -> Path:
        path = shutil.copytree(run.clips, tmp_path / name)
        manifest = json.loads((path / "manifest.json").read_text())
        write_json(path / "manifest.json", manifest | {"key": key})
        (made,) = evaluate_run(run.directory, run.data_directory, EvaluationRequest("paper", CHANGES, data=path))
        return made

    made = {
        evaluated("a", "x/../../../elsewhere"),
        evaluated("b", None),
        evaluated("c", None),
        evaluated("d", "abc-0.1"),
    }
    assert len(made) == 4
    assert all(each.resolve().parent == run.directory / "evaluations" for each in made)
    assert f"{folder.name},data=abc-0.1" in {each.name for each in made}


def test_overwriting_begins_without_the_batches_of_an_interrupted_evaluation(run: Run, folder: Path) -> None:
    left = folder / f"parts-{read_result(folder).key}"
    left.mkdir()
    MADE.clear()
    evaluated(run, overwrite=True)  # the stand-in makes this folder, which must not be there
    assert [left] == MADE


def test_who_waited_for_the_lock_takes_what_the_other_process_made(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, whole, left = folder / "result.json", (folder / "result.json").read_bytes(), folder / "parts-of-another"
    made.unlink()
    left.mkdir()
    real, seen = evaluations.making, []

    @contextlib.contextmanager
    def waiting(path: Path, wait: bool) -> Iterator[None]:
        seen.append(left.exists())  # --overwrite deletes in the lock alone
        with real(path, wait):
            made.write_bytes(whole)
            yield

    monkeypatch.setattr(evaluations, "making", waiting)
    monkeypatch.setattr(evaluations, "_parts", lambda folder, key: left)
    MADE.clear()
    assert evaluated(run) == [folder]
    assert not MADE
    assert seen == [True]
    left.mkdir()
    evaluated(run, overwrite=True)
    assert [left] == MADE
    assert seen == [True, True, False]


def test_the_evaluation_stage_writes_such_a_file_too(run: Run) -> None:
    found = evaluate_own(run)
    own = read_result(run.directory / "evaluation")
    assert own.label == "run"
    assert own.per_clip == found.per_clip
    assert own.protocol["action_draws"] == run.config.eval.action_draws
    assert own.data["frames"] == FRAMES


def test_second_takes_are_a_result_of_their_own(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="clips: these clips were not simulated, so there is no second take of them"):
        list(evaluate_run(run.directory, run.data_directory, EvaluationRequest("paper", CHANGES, retakes=True)))
    takes: list[np.ndarray] = []
    whole = [{"rgb": np.full((FRAMES + 2, 8, 8, 3), i, np.uint8)} for i in range(toy.TEST)]
    monkeypatch.setattr(retakes, "collect_retakes", lambda clips, split, numbers, *_: [whole[i] for i in numbers])

    def evaluate(*inputs: Any) -> Evaluation:
        eval_clips: EvaluationClips = inputs[3]
        assert eval_clips.retakes is not None
        takes.append(eval_clips.retakes.rgb)
        return scored(*inputs)

    monkeypatch.setattr(evaluation, "evaluate", evaluate)
    (with_takes,) = evaluate_run(run.directory, run.data_directory, EvaluationRequest("paper", CHANGES, retakes=True))
    np.testing.assert_array_equal(takes[0][:, -1, 0, 0, 0], range(toy.TEST))
    assert takes[0].shape[:2] == (toy.TEST, FRAMES), "cut to the protocol's frames"
    assert with_takes.name == f"{folder.name},second-takes"
    results = read_result(folder), read_result(with_takes)
    assert [each.settings.get("second_take_jitter") for each in results] == [None, retakes.JITTER]
    assert results[0].key != results[1].key
    reconstructed = EvaluationRequest("1xgpt", {"prompt_frames": 2, "horizon": 2}, retakes=True)
    with pytest.raises(UserError, match="protocol 1xgpt compares with reconstructions, of which there is no second"):
        list(evaluate_run(run.directory, run.data_directory, reconstructed))


def test_a_protocol_changes_the_settings_of_sampling(run: Run) -> None:
    changes = {"prompt_frames": 2, "horizon": 2, "clips": 3}
    (folder,) = evaluate_run(run.directory, run.data_directory, EvaluationRequest("1xgpt", changes))
    result = read_result(folder)
    assert folder.name == "1xgpt,prompt_frames=2,horizon=2,clips=3"
    assert (result.sampling["steps"], result.sampling["temperature"], result.sampling["unmask"]) == (2, 0.0, "random")
    assert result.protocol["teacher_forced"]
    assert len(result.clips) == 3
    tiny: Any = presets.tiny()
    assert tiny.model.sample.shows_means
    assert not replace(tiny.model.sample, **find("1xgpt", tiny).sampling).shows_means
    assert result.protocol.items() >= {"mean_codes": False, "guidance": 1.0}.items()


def test_a_full_size_preset_raises_the_clips_but_not_those_of_several_samples() -> None:
    full_size = presets.get("ivideogpt_64")
    assert [find(name, full_size).clips for name in ("paper", "ivideogpt-bair")] == [1200, 256]
    longest = find("horizon48", replace(presets.tiny(), eval=full_size.eval))
    assert (longest.clips, longest.repetitions) == (1200, 5)
    evaluations.check_request(presets.tiny(), longest)


def test_a_comparison_of_a_run_with_itself(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GLIBC_TUNABLES", HUGE_PAGES)
    arguments = [f"a={run.directory}", f"b={run.directory}", "--protocol", folder.name, "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", ["compare", *arguments])
    compare_command.main()
    assert "| same" in capsys.readouterr().out
    assert {path.suffix for path in tmp_path.iterdir()} == {".md", ".csv", ".json", ".html"}
    assert json.loads((tmp_path / "compare.json").read_text())["protocol"]["name"] == "paper"


def asked(**changes: Any) -> EvaluationRequest:
    return EvaluationRequest("paper", CHANGES | changes)


REFUSED = {
    "predicts 15 frames after 1, .* clips of 16 frames; .* have 6: lower --horizon": EvaluationRequest("paper"),
    "no split 'unseen'; it has train, test: choose with --split": replace(asked(), splits=("unseen",)),
    r"no split 'unseen\*'; it has train, test": EvaluationRequest("unseen", CHANGES),
    "nowhere: not there": replace(asked(), data=Path("nowhere")),
    "estimator needs a network .* --eval.depth-estim": asked(depth_source="estimator"),
    "clips of 1000000005 frames, each generated .* are more": asked(prompt_frames=10**9),
    "each generated .* lower --clips, .* --samples, ": asked(samples=9_999_999),
    "each generated .* --repetitions or --action-draws": asked(repetitions=9_999_999),
    "--repetitions or --action-draws": asked(action_draws=9_999_999),
    r"steps is 999999, but a frame has \d+ cells": asked(steps=999_999),
    "scores frames of 999 pixels per side; those of .*run have": EvaluationRequest("paper", {"resolution": 999}),
    "resolution is 1; frames have at least 16 pixels": asked(resolution=1),
    "eval.weights is nowhere: no such directory": replace(asked(), settings={"weights": "nowhere"}),
}


@pytest.mark.parametrize("says", REFUSED)
def test_what_cannot_be_evaluated_is_one_line(run: Run, says: str) -> None:
    with pytest.raises(UserError, match=says) as refused:
        list(evaluate_run(run.directory, run.data_directory, REFUSED[says]))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("splits", "frames", "simulated"),
    [
        (("test",), FRAMES, None),
        (("test",), FRAMES + 9, "longer"),
        (("tset",), FRAMES, None),
        (("tset",), FRAMES + 9, None),
        (("unseen_camera", "tset"), FRAMES, None),
        (("unseen_camera",), FRAMES, "unseen"),
        (("unseen*",), FRAMES + 9, "unseen"),
        (("contacts_*",), FRAMES, "contacts"),
        (("contacts_grasps", "contacts_driving"), FRAMES, "contacts"),
        (("contacts_grasp",), FRAMES, None),
        (("train",), FRAMES + 9, None),
        (("train", "test"), FRAMES + 9, None),
    ],
)
def test_only_splits_that_there_can_be_are_simulated(
    run: Run, splits: tuple[str, ...], frames: int, simulated: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulating = replace(run, config=toy.config())
    words = {"scenes": "unseen", "contacts": "contacts"}
    monkeypatch.setattr(eval_clips, "_simulated", lambda what, make: words.get(what.split()[0].strip(","), "longer"))
    protocol = replace(find("paper", run.config), splits=splits, horizon=frames - 1)
    store = run.open_clips()
    assert evaluation_store(simulating, store, protocol) == (simulated or store)


IN_LIFT_ALONE = "grasps and drives are simulated in Lift alone; the clips are of"


@pytest.mark.parametrize(
    ("source", "split", "changes", "reason"),
    [
        (None, "test", {}, f"{IN_LIFT_ALONE} recordings"),
        ("metaworld/Sawyer", "test", {}, f"{IN_LIFT_ALONE} metaworld/Sawyer"),
        (LIFT, "train", {}, "grasps and drives are scored with the split test, not with train"),
        (LIFT, "test", {"teacher_forced": True}, "protocol paper gives the true frames before each predicted one"),
        (LIFT, "test", {}, f"{toy.TEST} clips are scored; grasps and drives are simulated where 48 or more are"),
    ],
)
def test_an_evaluation_without_grasps_and_drives_says_why(
    run: Run, source: str | None, split: str, changes: dict[str, Any], reason: str
) -> None:
    store = run.open_clips()
    store = replace(store, manifest=store.manifest | {"source": source})
    protocol = replace(find("paper", run.config), horizon=FRAMES - 1, clips=100, **changes)
    chosen = EvaluationClips.read(store, "test", protocol, run.config.clips)
    found = probes_of(run, store, replace(chosen, split=split))
    assert isinstance(found, Unavailable)
    assert str(found) == reason
    inactive = replace(run, config=toy.with_model(run.config, action_encoder="none"))
    assert str(probes_of(inactive, store, chosen)) == "the model takes no actions"


def test_longer_episodes_are_none_of_the_runs_own() -> None:
    sim = toy.config().sim
    longer = longer_episodes(sim, 49, 10)
    assert (longer.frames, longer.test_episodes) == (49, 10)
    assert longer.seed != sim.seed
    assert replace(longer, frames=sim.frames, seed=0, episodes=sim.episodes, test_episodes=sim.test_episodes) == sim


def test_commands_without_runs_say_how(command: Commands) -> None:
    assert "name a run directory" in command.refused("experiments.evaluate", "--protocol", "paper")
    assert "unknown argument '--protocl'; did you mean '--protocol'" in command.refused(
        "experiments.evaluate", "--protocl"
    )
    assert "is not a run directory" in command.refused("experiments.evaluate", "nowhere")
