"""A toy model with random weights, fine-tuned for a few steps on a folder of noise."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from rsjax.config import (
    BackwardsConfig,
    EarlyStopConfig,
    GenieConfig,
    KeepStillConfig,
    RoboScapeConfig,
    content_key,
    to_dict,
)
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.models.base import create_model
from rsjax.models.load_run import load
from rsjax.tools.commands import describe
from rsjax.tools.convert import genie, tokenizer
from rsjax.tools.convert.directory import load_world_model
from rsjax.tools.finetune.finetune import finetune, make_clips, prepare
from rsjax.tools.finetune.recipe import (
    FIXED_CAMERA,
    LEAST_BETWEEN,
    Finetuning,
    ReconstructionScores,
    finetuned,
    moving_share,
)
from rsjax.tools.finetune.recordings import Cutting, Recordings, find_recordings
from rsjax.tools.finetune.start import find_source
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import prepare as prepare_tokens
from rsjax.tools.pipeline.stages import train_tokenizer, train_world_model
from rsjax.training.checkpoint import load_weights, save_weights
from tests.tools.convert.public import genie_shapes, random_tensors, tokenizer_shapes
from tests.tools.pipeline import toy

CUTTING = Cutting(test_share=0.4, validation_share=0.2, workers=0)
SETTINGS = Finetuning(steps=4, tokenizer_steps=2)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory, as far as fine-tuning reads one."""
    run = tmp_path_factory.mktemp("model")
    cfg = toy.config()
    write_json(run / "config.json", to_dict(cfg))
    for part, params in {"tokenizer": toy.tokenizer_params(), "world_model": toy.world_model_params(cfg)}.items():
        (run / part).mkdir()
        save_weights(run / part / "weights", params)
    return run


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five episodes of another robot, whose actions have three numbers, at 10 Hz; nobody says what they mean."""
    folder = tmp_path_factory.mktemp("episodes")
    rng = np.random.default_rng(0)
    for number in range(5):
        frames = rng.integers(0, 256, (14, 64, 64, 3), np.uint8)
        np.savez(folder / f"{number}.npz", frames=frames, actions=rng.normal(size=(14, 3)), fps=10.0)
    return folder


@pytest.fixture(scope="module")
def whole(model: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A fine-tuning whose trainings nothing stopped; it is not evaluated."""
    out = tmp_path_factory.mktemp("whole")
    run = finetune(find_source(model), Recordings("npz", data), CUTTING, SETTINGS, out, only_cost=True)
    train_tokenizer(run, resume=True)
    prepare_tokens(run)
    train_world_model(run, resume=True)
    return run


def test_clips_fit_the_recordings_and_the_model(whole: Run) -> None:
    store = open_store(whole.clips)
    assert whole.config.clips.action_dim == 6  # two recorded actions for each frame
    assert whole.config.clips.frames == 5
    split_of = {name: split for split, names in store.manifest["episodes"].items() for name in names}
    assert sorted(split_of.values()) == ["test", "test", "train", "train", "validation"]


def test_the_run_starts_from_the_model_and_is_like_any_other(whole: Run, model: Path) -> None:
    trained = load(whole.directory)
    assert trained.config.train.early_stop is None  # the last weights count: few clips are held out
    assert trained.config.tokenizer_train.steps == SETTINGS.tokenizer_steps  # noise is not reconstructed
    _, start = load_world_model(whole.directory / "start")
    _, own = load_world_model(model)
    assert own.keys() - start.keys() == {"action_encoder"}
    jax.tree.map(np.testing.assert_array_equal, start, {name: own[name] for name in start})
    changes = jax.tree.map(lambda x, y: np.abs(x - y).max(), start, {name: trained.params[name] for name in start})
    assert 0 < max(jax.tree.leaves(changes)) < 0.1


def test_other_clips_do_not_replace_those_of_a_run(whole: Run, model: Path, data: Path) -> None:
    made = (whole.clips / "manifest.json").read_bytes()
    with pytest.raises(UserError) as refused:
        finetune(
            find_source(model),
            Recordings("npz", data),
            replace(CUTTING, frames=4),
            SETTINGS,
            whole.directory,
            only_cost=True,
        )
    assert "start: holds weights of another model, or for other clips" in str(refused.value)
    assert (whole.clips / "manifest.json").read_bytes() == made


def test_a_prepared_run_says_what_its_clips_lack_and_can_be_described(
    whole: Run, model: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finetune(find_source(model), Recordings("npz", data), CUTTING, SETTINGS, whole.directory, only_cost=True)
    said = capsys.readouterr().out
    assert "actions are not combined" in said and "--option kind=absolute" in said
    assert "no clip has depth: the depth loss is masked" in said and "--depth video-depth-anything:" in said
    with patch.object(sys, "argv", ["rsjax describe", str(whole.directory)]):
        describe.main()
    assert f"rsjax compile {whole.directory} --target" in capsys.readouterr().out


def test_killed_and_started_again_it_has_the_same_weights(whole: Run) -> None:
    before = load(whole.directory).params
    shutil.rmtree(whole.output("world_model"))
    steps = sorted(int(path.name) for path in (whole.directory / "world_model" / "checkpoints").glob("[0-9]*"))
    for step in steps[1:]:
        shutil.rmtree(whole.directory / "world_model" / "checkpoints" / str(step))
    train_world_model(whole, resume=True)
    jax.tree.map(np.testing.assert_array_equal, before, load(whole.directory).params)


def test_short_clips_and_an_early_stop_are_chosen_by_word(whole: Run, model: Path) -> None:
    settings = replace(SETTINGS, short_share=0.5, patience=3)
    train = finetuned(find_source(model), open_store(whole.clips), "", settings, adapts=True).train
    assert train.early_stop == EarlyStopConfig(every=LEAST_BETWEEN, patience=3)
    assert whole.config.tokenizer_train.early_stop is not None
    short, long = train.curriculum
    assert (short.frames, long.frames) == (2, 0)
    assert short.epochs == long.epochs == SETTINGS.steps / 2 * toy.config().train.batch_size / 2
    assert len(whole.config.train.curriculum) == 1


def test_a_moved_model_is_the_same_and_other_weights_or_settings_are_not(
    whole: Run, model: Path, tmp_path: Path
) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(model, moved)
    assert prepare(find_source(moved), open_store(whole.clips), SETTINGS, whole.directory) == whole.config
    params = toy.world_model_params(toy.config())
    save_weights(moved / "world_model" / "weights", jax.tree.map(lambda x: x + 1, params))
    for source, settings in ((moved, SETTINGS), (model, replace(SETTINGS, seed=1))):
        with pytest.raises(UserError) as caught:
            prepare(find_source(source), open_store(whole.clips), settings, whole.directory)
        assert "choose another --out" in str(caught.value)


def test_public_weights_are_taken_by_path(whole: Run, tmp_path: Path) -> None:
    """In the format of Open-MAGVIT2 and 1xgpt: codes of 6 bits, 4 × 4 in a frame of 64 pixels."""
    magvit = random_tensors(tokenizer_shapes(32, (1, 1, 1, 1, 1), res=1, bits=6, adaptive=False))
    published = random_tensors(genie_shapes(layers=2, d=16, heads=2, frames=5, cells=16, codes=8, qk_norm=False))
    settings = {"num_layers": 2, "num_heads": 2, "d_model": 16, "T": 5, "S": 16, "image_vocab_size": 64}
    write_json(tmp_path / "genie" / "config.json", settings)
    save_file(magvit, tmp_path / "magvit.safetensors")
    save_file(published, tmp_path / "genie" / "model.safetensors")
    public = tmp_path / "public"
    tokenizer.convert(tmp_path / "magvit.safetensors", public, "raw")
    genie.convert(tmp_path / "genie" / "model.safetensors", public, None)
    keeping = replace(SETTINGS, tokenizer="keep")
    config = prepare(find_source(public), open_store(whole.clips), keeping, tmp_path / "out")
    assert isinstance(config.model, GenieConfig)
    assert (config.model.width, config.clips.action_dim) == (16, 6)
    start = Path(config.train.start_from)
    assert start == (tmp_path / "out" / "start").absolute() == Path(config.tokenizer_train.start_from)
    world_model: Any = create_model(config)
    begun = load_weights(start / "world_model" / "weights", world_model.pretrained_shapes(start))
    np.testing.assert_array_equal(
        begun["rgb_embed"]["factored_embed_0"]["embedding"], published["token_embed.factored_embeds.0.weight"]
    )


def test_what_stands_still_is_kept_if_the_camera_does_not_move_or_by_word(whole: Run, model: Path) -> None:
    store = open_store(whole.clips)
    assert moving_share(store) > FIXED_CAMERA  # all pixels of noise move
    assert isinstance(whole.config.model, RoboScapeConfig)
    assert whole.config.model.sample.keep_still is None
    source = find_source(model)
    kept = finetuned(source, store, "", SETTINGS.for_clips(source.config, 2), adapts=True, still=True)
    assert isinstance(kept.model, RoboScapeConfig)
    assert kept.model.sample == replace(whole.config.model.sample, keep_still=KeepStillConfig())
    assert content_key(SETTINGS) != content_key(replace(SETTINGS, keep_still="on"))


def test_the_rule_finds_a_camera_that_stands_still(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its recordings differ in their rate, and all of them become clips."""
    rng = np.random.default_rng(0)
    for number in range(4):
        frames = rng.integers(0, 256, (1, 64, 64, 3), np.uint8).repeat(7, axis=0)
        for time in range(7):
            frames[time, 8:24, 4 * time : 4 * time + 16] = 255  # a white square crosses the picture
        np.savez(tmp_path / f"{number}.npz", frames=frames, actions=rng.normal(size=(7, 3)), fps=5 - number / 5)
    source = find_source(model)
    store = make_clips(Recordings("npz", tmp_path), CUTTING, source, tmp_path / "run")
    assert not store.manifest["quarantine"] and "4.7 Hz" in capsys.readouterr().out
    assert 0 < moving_share(store) < FIXED_CAMERA
    config = prepare(source, store, replace(SETTINGS, tokenizer="keep"), tmp_path / "run")
    assert isinstance(config.model, RoboScapeConfig)
    assert config.model.sample.keep_still == KeepStillConfig()


def test_few_clips_run_backwards_if_their_actions_are_known_or_never(whole: Run, model: Path, tmp_path: Path) -> None:
    source = find_source(model)
    store = open_store(whole.clips)
    assert isinstance(whole.config.model, RoboScapeConfig)
    assert whole.config.model.backwards is None  # nobody says what the numbers mean
    known = replace(store, manifest=store.manifest | {"action_dimensions": ["x (delta)", "grip (held)"]})
    settings = SETTINGS.for_clips(source.config, 2)

    def turned(dimensions: Store, chosen: Finetuning) -> BackwardsConfig | None:
        config = finetuned(source, dimensions, "", chosen, adapts=True)
        assert isinstance(config.model, RoboScapeConfig)
        return config.model.backwards

    assert turned(known, settings) is None  # steps, which nobody knows to act when they are recorded
    assert turned(known, replace(settings, backwards="on")) == BackwardsConfig(held=(1,))
    named = ["yaw (absolute, an angle)", "grip (held)"]
    targets = replace(store, manifest=store.manifest | {"action_dimensions": named})
    assert turned(targets, settings) == BackwardsConfig(held=(0, 1))
    assert turned(targets, replace(settings, backwards="off")) is None
    turns = replace(store, manifest=store.manifest | {"action_dimensions": ["q (delta, of a quaternion)"]})
    assert turned(turns, replace(settings, backwards="on")) is None


def test_targets_are_not_added_up(whole: Run, model: Path) -> None:
    source = find_source(model)
    own = source.config.model
    assert isinstance(own, RoboScapeConfig)
    adds = replace(own, departures=replace(own.departures, integrate_actions=True))
    source = replace(source, config=replace(source.config, model=adds))
    store = open_store(whole.clips)
    for kind, added in {"delta": True, "absolute": False, "absolute, of a quaternion": False}.items():
        known = replace(store, manifest=store.manifest | {"action_dimensions": [f"x ({kind})", "grip (held)"]})
        config = finetuned(source, known, "", SETTINGS.for_clips(source.config, 2), adapts=True)
        assert isinstance(config.model, RoboScapeConfig)
        assert config.model.departures.integrate_actions is added


@pytest.mark.parametrize(("psnr", "kept"), [(30.0, True), (22.0, False), (14.9, False)])
def test_the_tokenizer_is_kept_where_it_beats_the_first_frame(psnr: float, kept: bool) -> None:
    assert ReconstructionScores(psnr, repeat_first=20.0).good is kept


def test_mistakes_are_one_line(model: Path, data: Path, tmp_path: Path) -> None:
    mistakes = {
        "write SOURCE:PATH": lambda: find_recordings("/data/pusht", Cutting()),
        "no model there": lambda: find_source(tmp_path),
        "has no episode": lambda: make_clips(Recordings("folder", tmp_path), CUTTING, find_source(model), tmp_path),
        "--rate or --frames": lambda: make_clips(
            Recordings("npz", data), replace(CUTTING, rate=1.0), find_source(model), tmp_path
        ),
    }
    for words, mistake in mistakes.items():
        with pytest.raises(UserError) as caught:
            mistake()
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
