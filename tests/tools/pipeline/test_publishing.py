"""Tests saving a finished run to publish, and what the commands do with the directory it makes."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

import rsjax
from rsjax.clip import GENERATED_MARK
from rsjax.data.clips import load_clips
from rsjax.errors import UserError
from rsjax.evaluation.results import read_result
from rsjax.files import read_json
from rsjax.model_directory import PRETRAINED, SHIPPED
from rsjax.models.load_run import load_config
from rsjax.tools.commands.evaluate import Options
from rsjax.tools.pipeline.evaluations import EvaluationRequest, evaluate_run
from rsjax.tools.pipeline.provenance import record_start
from rsjax.tools.pipeline.publishing import Publication, predicted_psnr, publish
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.videos import VideoRequest, write_demo, write_videos
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.policies.run_data import RunData
from rsjax.training.checkpoint import save_weights
from tests.tools.pipeline import toy
from tests.tools.pipeline.conftest import Commands


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A finished run on the toy clips, with random weights and made-up scores; its prompts have two frames."""
    place = tmp_path_factory.mktemp("publishing")
    run = Run(replace(toy.config(), prompt_frames=2), place / "run", place / "data")
    trained = toy.trained(toy.store(run.clips), run.config)
    run.prepare(overwrite=False)
    toy.save_tokenizer(run)
    run.output("world_model").parent.mkdir(parents=True)
    save_weights(run.output("world_model"), trained.params)
    (run.directory / "tokens").mkdir()
    trained.assets.normalization.save(run.directory / "tokens")
    record_start(run, "rsjax train toy --run-dir run")
    scores = {"psnr": 23.256, "psnr_repeat_first": 16.0, "psnr_tokenizer": 25.7, "delta_psnr": 7.3, "ssim": None}
    (run.directory / "metrics.json").write_text(json.dumps(scores))
    return run


@pytest.fixture(scope="module")
def published(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("published") / "toy"
    lost = publish(run, out, Publication(clips=2, measured=toy.TEST, license="apache-2.0", note="For tests."))
    assert lost in (out / "README.md").read_text()
    return out


def test_a_published_run_is_a_model_with_clips(run: Run, published: Path) -> None:
    loaded = rsjax.load(published)
    assert loaded.config == run.config
    clips = Run(loaded.config, published, Path("nowhere")).open_clips()
    assert clips.counts() == {"test": 2}
    originals = run.open_clips().source("test")
    for place, number in enumerate(clips.manifest["excerpt"]["records"]):
        record = clips.source("test")[place]
        np.testing.assert_array_equal(record["rgb"], originals[number]["rgb"])
        np.testing.assert_array_equal(record["actions"], originals[number]["actions"])


def test_the_card_is_made_of_the_runs_records(run: Run, published: Path) -> None:
    card = (published / "README.md").read_text()
    for words in (
        "license: apache-2.0",
        "For tests.",
        "3 training clips and 5 held-out ones",
        "Key of the store: `toy`. In `clips/`: held-out clips 0, 4.",
        "`rsjax train toy --run-dir run`, preset `debug`",
        "| prediction | 23.26 | 7.30 |",
        "| first frame repeated | 16.00 |",
        "## Limits and misuse",
    ):
        assert words in card, words
    assert "SSIM" not in card  # has no score
    assert read_json(published / "metrics.json") == read_json(run.directory / "metrics.json")


def test_the_loss_of_rounding_is_the_difference_of_two_means(run: Run, published: Path) -> None:
    clips = load_clips(run.open_clips(), toy.TEST)
    means = [predicted_psnr(rsjax.load(folder), clips).mean() for folder in (run.directory, published)]
    assert f"a loss of {means[0] - means[1]:.3f} dB" in (published / "README.md").read_text()


def test_videos_the_demo_and_the_playground_work_from_the_directory_alone(published: Path, tmp_path: Path) -> None:
    request = VideoRequest("test", (1,), None, None, None, {})
    (written,) = write_videos(published, Path("nowhere"), request, tmp_path, "mp4", 4.0, 1)
    assert written.name == "test_001.mp4"
    video, strip = write_demo(published, Path("nowhere"), tmp_path / "demo", 1)
    with av.open(str(video)) as container:
        assert container.metadata["comment"] == GENERATED_MARK
        assert len(list(container.decode(video=0))) == toy.config().sim.frames
    with Image.open(strip) as picture:
        assert min(picture.size) > 100
        assert picture.info["Comment"] == GENERATED_MARK
    source = PlayRun(RunData(published, Path("nowhere"))).source
    assert source is not None
    outcomes = [bool(source[number]["success"][-1]) for number in range(2)]
    first = outcomes.index(True) if any(outcomes) else 0
    assert write_demo(published, Path("nowhere"), tmp_path / "demo")[1].name == f"clip-{first}.png"
    with pytest.raises(UserError) as caught:
        write_demo(published, Path("nowhere"), tmp_path / "demo", 2)
    assert str(caught.value) == "--clip 2: the model has clips 0 … 1"
    play = PlayRun(RunData(published, Path("nowhere")))
    assert (play.clips, play.missing, play.describe()["name"]) == (2, "", "toy")
    assert play.controls.width == toy.config().clips.action_dim


def test_a_saved_model_is_evaluated_on_its_own_clips(
    run: Run, published: Path, command: Commands, tmp_path: Path
) -> None:
    saved = shutil.copytree(published, tmp_path / "saved")
    printed = command.here("experiments.evaluate", saved, "--protocol", "run")
    folder = Path(printed.split("result: ")[1].partition("\n")[0]).parent
    assert folder == saved / "evaluations" / "run,data=toy-2-of-test"
    result = read_result(folder)
    model = rsjax.load(published)
    clips = load_clips(Run(model.config, published, Path("nowhere")).open_clips(), 2)
    assert result.metrics["psnr"] == pytest.approx(predicted_psnr(model, clips).mean(), abs=0.01)
    assert "no training clips" in result.reasons["delta_psnr_uniform"]
    assert result.metrics["delta_psnr"] is not None
    (whole,) = evaluate_run(saved, Path("nowhere"), EvaluationRequest("run", store=run.clips))
    assert whole.name == "run,data=toy" and (saved / "coverage").exists()
    assert read_result(whole).metrics["delta_psnr_uniform"] is not None
    assert Options((Path("tiny"),)).made_run == Path("runs/tiny")


def test_commands_that_need_training_clips_say_so_of_a_saved_model(published: Path, command: Commands) -> None:
    for module in ("experiments.judge", "experiments.synthesize"):
        assert "without the clips of its training; name a run directory" in command.refused(module, published)
        assert "tiny: a saved model, without the clips" in command.refused(module, "tiny")


def test_an_unfinished_run_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        publish(Run(run.config, tmp_path, tmp_path), tmp_path / "out", Publication())
    assert "metrics.json: missing; the train command of this run makes it" in str(caught.value)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_package_holds_a_small_model_that_rounding_cost_next_to_nothing(name: str) -> None:
    folder = PRETRAINED / name
    assert (folder / "model.safetensors").stat().st_size <= 10e6
    assert sum(path.stat().st_size for path in (folder / "clips").iterdir()) <= 3e6
    assert load_config(folder).name == name
    found = re.search(r"a loss of ([\d.]+) dB", (folder / "README.md").read_text())
    assert found is not None and float(found[1]) <= 0.02


def test_multitask_beats_repeating_the_first_frame() -> None:
    """The first notebook shows it of tiny."""
    folder = PRETRAINED / "multitask"
    clips = load_clips(Run(load_config(folder), folder, Path()).open_clips(), 2)
    still = 10 * np.log10(255**2 / ((clips.rgb[:, 1:] - clips.rgb[:, :1].astype(float)) ** 2).mean((2, 3, 4)))
    assert predicted_psnr(rsjax.load("multitask"), clips).mean() > still.mean() + 2
