from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.data.store import write_store
from rsjax.errors import UserError
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.convert import directory
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import run_all, train_tokenizer, train_world_model
from tests.tools.pipeline import toy


def random_params(init: Any) -> Any:
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(init, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.1, size=x.shape).astype(np.float32), shapes)


def test_a_run_of_no_steps_keeps_the_weights_that_it_starts_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg, public = toy.config(), tmp_path / "public"
    tokenizer = random_params(Tokenizer(cfg.tokenizer).init_params)
    alone = replace(Architecture.create(cfg), depth="none", action_encoder="none", action_inputs=0)
    model = random_params(Transformer(alone).init_params)
    directory.save(public, cfg.tokenizer, tokenizer)
    directory.save(public, alone, model)
    cfg = replace(
        cfg,
        tokenizer=replace(cfg.tokenizer, compute_dtype="bfloat16"),  # which weights do not depend on
        tokenizer_train=replace(cfg.tokenizer_train, start_from=str(public), steps=0),
        train=replace(cfg.train, start_from=str(public), steps=0),
    )
    run = Run(cfg, tmp_path / "run", tmp_path / "data")
    run.prepare(overwrite=False)
    toy.store(run.clips)
    train_tokenizer(run, resume=True)
    assert "LPIPS" not in capsys.readouterr().out, "a term that is off is not missed"
    meta = {"key": "toy", "action_mean": [0.0], "action_std": [1.0], "depth_range": None}
    write_store(run.output("tokens"), "tokens", {"train": iter([{"rgb": np.zeros(3, np.int32)}])}, meta)
    train_world_model(run, resume=True)
    # A run directory is laid out as the converted one.
    jax.tree.map(np.testing.assert_array_equal, directory.load_tokenizer(run.directory)[1], tokenizer)
    begun = directory.load_world_model(run.directory)[1]
    jax.tree.map(np.testing.assert_array_equal, begun["blocks"]["rgb"], model["blocks"]["rgb"])
    assert not np.any(begun["action_encoder"]["kernel"])


@pytest.mark.parametrize("section", ["tokenizer_train", "train"])
def test_a_path_without_weights_is_an_error_before_anything_is_simulated(tmp_path: Path, section: str) -> None:
    cfg = toy.config()
    loop = replace(getattr(cfg, section), start_from=str(tmp_path / "nowhere"))
    run = Run(replace(cfg, **{section: loop}), tmp_path / "run", tmp_path / "data")
    with pytest.raises(UserError, match=f"^{section}.start_from: .*nowhere"):
        run_all(run)
    assert not run.clips.exists() and not run.mark("collect")
