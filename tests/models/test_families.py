"""Every family goes through one training engine: what the engine promises holds for each, in both its networks."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType

import rsjax
from rsjax.config import ConfigError, LoopConfig, presets
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.evaluation.results import load_evaluation
from rsjax.layers.cpu import convolution
from rsjax.layers.partition import FSDP
from rsjax.models.base import create_autoencoder, create_model
from rsjax.tools.describe import count, describe
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.replay import replay
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.pipeline.videos import VideoRequest, resampled, write_videos
from rsjax.tools.studies.ablation.grid import expand, parse_axes
from rsjax.trainable import StepContext
from rsjax.training import loop as loop_module
from rsjax.training.checkpoint import load_weights
from rsjax.training.log import SkippedSteps, read_log
from rsjax.training.sharding import cut_elements, partitioned_arrays
from rsjax.training.state import create_state
from tests.models import families
from tests.tools.pipeline import toy

PUBLIC = {
    "genie": "genie_35m_actions",
    "ivideogpt": "ivideogpt_64",
    "irasim": "irasim_s",
    "cogvideox": "cogvideox_2b",
}
SETTING = {"genie": "steps", "ivideogpt": "top_k", "irasim": "steps", "cogvideox": "steps"}  # of sampling
TERM = {"genie": "rgb", "ivideogpt": "token", "irasim": "error", "cogvideox": "error"}
WORK: dict[str, Callable[[Run], None]] = {
    "collect": stages.collect_clips,
    "tokenizer": partial(stages.train_tokenizer, resume=True),
    "tokens": stages.prepare,
    "world_model": partial(stages.train_world_model, resume=True),
    "evaluation": stages.evaluate,
}

every_family = pytest.mark.parametrize("family", families.FAMILIES)
own_autoencoder = pytest.mark.parametrize("family", ["ivideogpt", "irasim", "cogvideox"])


@pytest.fixture(scope="module", params=["ivideogpt", "irasim", "cogvideox"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A finished run; one of the families has a report. Genie's is RoboScape's, which has tests of its own."""
    folder = tmp_path_factory.mktemp(request.param)
    config = families.FAMILIES[request.param]()
    run = Run(on_store(config, toy.store(folder / "clips").path), folder / "run", folder)
    run.prepare(overwrite=False)
    if request.param == "irasim":
        stages.run_all(run)
        return run
    for stage, work in WORK.items():
        with run.stage(stage):
            work(run)
    return run


def test_a_run_goes_through_all_stages(run: Run) -> None:
    assert run.stages == (*WORK, "report")
    assert all(map(run.finished, WORK))
    assert run.finished("report") == (run.config.model.family == "irasim")
    result = load_evaluation(run.output("evaluation"))
    scores = {name for name, value in result.metrics.items() if value is not None}
    assert {"psnr", "psnr_tokenizer"} <= scores
    if run.config.model.family == "cogvideox":
        assert result.reasons["delta_psnr"] == "the model takes no actions"
    else:
        assert "delta_psnr" in scores
    if run.config.model.uses_depth:
        assert {"depth_absrel", "depth_delta1", "depth_delta2", "depth_absrel_tokenizer"} <= scores
    else:
        assert result.reasons["depth_absrel"] == "the model generates no depth"
    for stage in ("tokenizer", "world_model"):
        rows = read_log(run.directory / stage)
        assert any("validation/psnr" in row for row in rows)
    assert sum(TERM[run.config.model.family] in row for row in rows) == 4
    assert run.open_prepared().counts() == run.open_clips().counts()


def test_a_loaded_model_generates_plans_and_goes_on_beyond_its_clips(run: Run, tmp_path: Path) -> None:
    model = rsjax.load(run.directory)
    clip = run.open_clips().source("test")[0]
    candidates = np.stack([clip["actions"], -clip["actions"]])
    prompts = clip["rgb"][[0, 0], None]  # two of them, as in the evaluation, need no program of their own
    video = model.generate(prompts, candidates)
    assert video.rgb.shape == (2, *clip["rgb"].shape) and video.depth is None
    if run.config.model.uses_depth:
        depth = model.generate(prompts, candidates, depth=clip["depth"][[0, 0], None]).depth
        assert depth is not None and depth.shape == (2, *clip["depth"].shape)
        assert np.isfinite(depth).all()
    many = model.plan(clip["rgb"][:1], candidates)
    np.testing.assert_allclose(many.rgb[0].astype(int), video.rgb[0], atol=1)  # two sizes may round differently
    setting = SETTING[run.config.model.family]
    request = VideoRequest("test", (0,), None, None, len(clip["rgb"]) + 2, {setting: 4})
    (written,) = write_videos(run.directory, tmp_path, request, tmp_path / "videos", "gif", 4.0, 1)
    assert written.stat().st_size > 0
    with pytest.raises(UserError, match="no setting nothing"):
        resampled(model, {"nothing": 3})


def trained_stages(run: Run) -> tuple[Literal["tokenizer", "world_model"], ...]:
    """Of the autoencoders, the one that is compiled fastest stands for all."""
    if run.config.model.family == "irasim":
        return ("tokenizer", "world_model")
    return ("world_model",)


def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = Run(run.config, tmp_path / "again", run.data_directory)
    again.directory.mkdir()
    for stage in {"collect", "tokenizer", "tokens"}.difference(trained_stages(run)):
        (again.directory / stage).symlink_to(run.directory / stage)
    shapes = {
        "tokenizer": create_autoencoder(run.config).shapes(),
        "world_model": jax.eval_shape(create_model(run.config).init, jax.random.key(0)),
    }
    for name in trained_stages(run):
        for stop_at in (2, None):
            with monkeypatch.context() as patch:
                changed = {"stop_at": stop_at, "validate": None}  # without validation
                patch.setattr(stages, "fit", lambda *args, more=changed, **own: loop_module.fit(*args, **(own | more)))
                WORK[name](again)
        whole, ours = (load_weights(one.output(name), shapes[name]) for one in (run, again))
        jax.tree.map(np.testing.assert_array_equal, ours, whole)
        rows = [[row["loss"] for row in read_log(one.directory / name) if "loss" in row] for one in (run, again)]
        assert rows[0] == rows[1] and len(rows[0]) == 4


def test_clips_replay_alone_as_in_their_batch(run: Run) -> None:
    """The batch of a step, as if it had been skipped: every clip has a loss of its own."""
    loaders = {"tokenizer": stages.tokenizer_loader, "world_model": stages.world_model_loader}
    for stage in trained_stages(run):
        with loaders[stage](run)(None) as batches:
            before = batches.state()
            arrays = next(batches)
            SkippedSteps(run.directory / stage, 0).add(
                4, {"loss": 1.0, "grad_norm": 1.0}, batches.identify(arrays), before
            )
        clips = list(replay(run, stage, 4))
        assert len(clips) == 2 and all(clip.finite for clip in clips)
        assert clips[0].scalars["loss"] != clips[1].scalars["loss"]


@pytest.mark.usefixtures("bf16_units")
def test_an_autoencoder_that_convolves_in_bf16_has_the_same_weights_and_operations(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(convolution, "LEAST", 4)
    one = create_autoencoder(run.config)
    other = create_autoencoder(with_values(run.config, {"model.autoencoder.compute_dtype": "bfloat16"}))
    assert one.shapes() == other.shapes() and one.flops() == other.flops()
    saved = other.pretrained_shapes(run.directory)
    assert jax.tree.map(jnp.shape, saved) == jax.tree.map(jnp.shape, one.shapes())


@every_family
def test_blocks_gather_their_parameters_one_after_another(family: str) -> None:
    """Which the train step leaves to them, where a mesh splits the parameters; also where they compute twice."""
    config = with_values(families.FAMILIES[family](), {"model.remat": "blocks"})
    model, shapes, batch = families.model_batch(config, 2)
    assert config.model.scanned > 0
    mesh = jax.make_mesh((1,), (FSDP,), axis_types=(AxisType.Auto,))
    with jax.set_mesh(mesh):
        program = jax.make_jaxpr(model.loss_terms)(
            shapes, batch, jax.random.key(0), StepContext(jnp.int32(0), None, None)
        )
    gathered = str(program).count("sharding_constraint[")
    assert gathered >= len(jax.tree.leaves(shapes["blocks"]))


@own_autoencoder
def test_the_counts_of_the_small_presets_in_the_docs_are_theirs(family: str) -> None:
    config = presets.get(f"{family}_tiny")
    page = "cogvideox.md" if family == "cogvideox" else "baselines.md"
    text = (Path(rsjax.__file__).parents[1] / "docs" / page).read_text()
    (row,) = (line for line in text.splitlines() if line.startswith(f"| `{family}_tiny` |"))
    model = jax.eval_shape(create_model(config).init, jax.random.key(0))
    autoencoder = {name: x for name, x in create_autoencoder(config).shapes().items() if name != "latents"}
    for shapes in (model, autoencoder):
        assert f" {count(shapes):,}" in row


@own_autoencoder
def test_rows_of_an_autoencoders_batch_keep_their_place_over_all_hosts(family: str) -> None:
    """Otherwise the clips of two hosts would share their noise and dropout."""
    autoencoder = create_autoencoder(families.FAMILIES[family]())
    clip = autoencoder.transform()({"rgb": toy.clip(0).rgb, "depth": None}, np.random.default_rng(0))
    arrays = {name: np.repeat(x[None], 4, axis=0) for name, x in clip.items()} | {"index": np.arange(4, dtype=np.int32)}
    whole = autoencoder.batch(arrays)
    rows = len(whole["index"]) // 4
    np.testing.assert_array_equal(whole["index"], np.arange(4 * rows))
    hosts = [autoencoder.batch({name: x[host::2] for name, x in arrays.items()}) for host in range(2)]
    for host, batch in enumerate(hosts):
        assert batch["index"].dtype == np.int32
        np.testing.assert_array_equal(batch["index"], whole["index"].reshape(4, rows)[host::2].reshape(-1))


@own_autoencoder
def test_an_autoencoder_without_discriminator_takes_no_adversarial_terms(family: str) -> None:
    config = with_values(families.FAMILIES[family](), {"tokenizer_train.adversarial": "on"})
    with pytest.raises(ConfigError, match="adversarial is on, but .* has no discriminator here; switch it off"):
        create_autoencoder(config)


@every_family
def test_a_public_size_is_cut_over_devices_and_described(family: str) -> None:
    config = presets.get(PUBLIC[family])
    state = jax.eval_shape(lambda: create_state(create_model(config), LoopConfig(ema=0.9)))
    rows = partitioned_arrays(state, 2)
    assert cut_elements(rows) / sum(int(np.prod(row.shape)) for row in rows) > 0.99
    tiny = describe(with_values(families.FAMILIES[family](), {"model.blocks": 8})).figures
    assert tiny["flops_train_per_clip"] > 0 and tiny["params_world_model"] > 0
    assert 0 < tiny["bytes_activations_per_clip_remat"] < tiny["bytes_activations_per_clip"]


@every_family
def test_a_grid_has_the_familys_own_fields(family: str) -> None:
    config = families.FAMILIES[family]()
    grid = expand(config, parse_axes(config, ["model.width=32,64", f"model.sample.{SETTING[family]}=1,2"]), [0, 1])
    assert len(grid.cells) == 8
    assert {config.model.width for config in grid.cells.values()} == {32, 64}  # type: ignore[attr-defined]
