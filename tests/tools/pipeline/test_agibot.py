"""The preset ``roboscape_agibot``: that it is the paper's setting, and refuses to train without a store."""

from pathlib import Path

import jax

from rsjax.config import RoboScapeConfig, presets
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from tests.tools.pipeline.conftest import Commands


def test_it_is_the_papers_setting() -> None:
    ours, small = presets.get("roboscape_agibot"), presets.get("roboscape_s")
    arch = Architecture.create(ours)
    assert (arch.frames, arch.grid, arch.width, arch.blocks, arch.action_inputs) == (16, 16, 256, 32, 16)
    assert (ours.model, ours.train, ours.eval) == (small.model, small.train, small.eval)
    stages = [(stage.components[0].difficulties, stage.epochs) for stage in ours.train.curriculum]
    assert stages == [(("simple",), 2.0), (("difficult",), 3.0)]
    assert (ours.eval.clips, ours.eval.repetitions) == (1200, 5)
    assert (ours.tokenizer_train.steps, ours.tokenizer_train.start_from) == (0, "magvit2")
    assert isinstance(ours.model, RoboScapeConfig)
    assert (ours.model.loss.depth_weight, ours.model.loss.keypoint_weight, ours.model.loss.gamma) == (1, 0.01, 5)
    shapes = jax.eval_shape(create_model(ours).init, jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 71_501_568 - (28 - 16) * 256


def test_without_a_store_it_names_what_is_missing(command: Commands, tmp_path: Path) -> None:
    text = command.refused("experiments.train", "roboscape_agibot", "--run-dir", tmp_path / "run")
    assert "trains on a store of clips, and none is named" in text
    assert "--store STORE (docs/agibot.md)" in text
    assert not (tmp_path / "run" / "config.json").exists()
