"""A clip without a finite loss, from training around it to finding it again."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.data.store import open_store, write_store
from rsjax.errors import UserError
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.replay import replay, skipped_steps
from rsjax.tools.pipeline.run import Run
from rsjax.training.log import read_skipped
from tests.tools.pipeline import toy


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Of the three training clips, the second one's actions are not numbers."""
    cfg = toy.config()
    run = Run(replace(cfg, train=replace(cfg.train, steps=4)), *(tmp_path_factory.mktemp(name) for name in "rd"))
    toy.store(run.clips)
    toy.save_tokenizer(run)
    stages.prepare(run)
    tokens = open_store(run.output("tokens"))
    splits = {split: [tokens.source(split)[i] for i in range(len(tokens.source(split)))] for split in tokens.splits}
    splits["train"][1]["actions"] = np.full_like(splits["train"][1]["actions"], np.nan)
    meta = {name: value for name, value in tokens.manifest.items() if name not in ("splits", "format", "kind")}
    write_store(run.output("tokens"), "tokens", splits, meta)
    stages.train_world_model(run, resume=True)
    return run


def test_the_clip_that_left_a_step_out_is_found(trained: Run) -> None:
    rows = read_skipped(trained.directory / "world_model")
    assert rows and len(skipped_steps(trained, "world_model")) == len(rows)
    for row in rows:
        clips = list(replay(trained, "world_model", row["step"]))
        assert [clip.source["record"] for clip in clips] == [record["record"] for record in row["records"]]
        assert [clip.finite for clip in clips] == [record["provenance"]["episode"] != 1 for record in row["records"]]


def test_a_step_that_was_not_left_out_is_refused(trained: Run) -> None:
    with pytest.raises(UserError, match="step 99 was not skipped .skipped: "):
        next(replay(trained, "world_model", 99))


def test_without_its_checkpoints_a_trained_stage_is_not_replayed(trained: Run, tmp_path: Path) -> None:
    run = replace(trained, directory=shutil.copytree(trained.directory, tmp_path / "run", symlinks=True))
    shutil.rmtree(run.directory / "world_model" / "checkpoints")
    step = read_skipped(run.directory / "world_model")[0]["step"]
    with pytest.raises(UserError, match="no checkpoint can be read .there is none."):
        next(replay(run, "world_model", step))
