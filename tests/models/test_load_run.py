import json
from pathlib import Path

import jax
import numpy as np
import pytest

import rsjax
from rsjax.config import presets, to_dict
from rsjax.errors import UserError
from rsjax.models.load_run import load_config
from rsjax.tools.pipeline.run import Run
from rsjax.training.checkpoint import save_weights
from tests.tools.pipeline import toy

CONFIG = presets.debug()


def test_a_runs_model_comes_back_and_a_missing_part_is_named(tmp_path: Path) -> None:
    run = Run(toy.config(), tmp_path / "run", tmp_path / "data")
    trained = toy.trained(toy.store(run.clips))
    run.prepare(overwrite=False)
    with pytest.raises(UserError, match="world_model/weights: no such weights; train first"):
        rsjax.load(run.directory)
    toy.save_tokenizer(run)
    run.output("world_model").parent.mkdir(parents=True)
    save_weights(run.output("world_model"), trained.params)
    (run.directory / "tokens").mkdir()
    with pytest.raises(UserError, match="units.json: missing or damaged"):
        rsjax.load(run.directory)
    trained.assets.normalization.save(run.directory / "tokens")
    loaded = rsjax.load(str(run.directory))
    assert (loaded.config, loaded.model) == (trained.config, trained.model)
    assert loaded.assets.normalization == trained.assets.normalization
    jax.tree.map(np.testing.assert_array_equal, loaded.params, trained.params)
    jax.tree.map(np.testing.assert_array_equal, loaded.assets.tokenizer, trained.assets.tokenizer)


def test_a_runs_configuration_comes_back_or_is_named(tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    whole = json.dumps(to_dict(CONFIG))
    path.write_text(whole)
    assert load_config(tmp_path) == CONFIG
    older = to_dict(CONFIG) | {"loss": {"keypoints": True}, "mask": {"prompt_frames": 1}}
    for text, words in (
        (None, "is not a run directory"),
        (json.dumps(older), r"config.json: not a configuration of this version .* no field loss, mask"),
        (whole[:-5], "config.json: not JSON"),
        (json.dumps(to_dict(CONFIG) | {"colour": 1}), "Config has no field colour"),
        ("{}", "config.json: not a configuration"),
    ):
        path.unlink(missing_ok=True)
        if text is not None:
            path.write_text(text)
        with pytest.raises(UserError, match=words):
            load_config(tmp_path)
