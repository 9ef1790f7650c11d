"""The stages of the main job; each reads what the one before left and can be run again."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rsjax.config import ModelConfig, TokenizerConfig
from rsjax.data import loader
from rsjax.data.store import Record, disk_guard, open_store, write_store
from rsjax.pipeline import evaluation, transforms
from rsjax.pipeline.run import STAGES, Run
from rsjax.pipeline.summary import write_summary
from rsjax.progress import Progress, duration, note, stage
from rsjax.sample.generator import Codec, Generator, Units, load_tokenizer
from rsjax.sim.collect import collect
from rsjax.train.checkpoint import save_weights
from rsjax.train.loop import fit
from rsjax.train.objectives import TokenizerObjective, WorldModelObjective
from rsjax.train.parts import check_part, start_tokenizer, start_world_model


def run_all(run: Run, resume: bool = True, command: str = "") -> None:
    """Runs every stage that is not finished, in order, and says which were skipped.

    Args:
        resume: False starts an unfinished training stage over instead of going on from its checkpoint.
        command: how to repeat the run, for the report.
    """
    _check_starts(run)
    works: dict[str, Callable[[Run], None]] = {
        "collect": collect_clips,
        "tokenizer": partial(train_tokenizer, resume=resume),
        "tokens": tokenize,
        "world_model": partial(train_world_model, resume=resume),
        "evaluation": evaluate,
        "report": partial(write_summary, command=command),
    }
    notes = {
        "collect": f"simulating {run.config.sim.episodes} Lift episodes into {run.clips}",
        "tokenizer": "training the tokenizer",
        "tokens": "tokenizing all clips",
        "world_model": "training the world model",
        "evaluation": "generating from held-out first frames",
        "report": "writing the report",
    }
    for number, name in enumerate(STAGES, 1):
        if run.finished(name):
            stage(number, len(STAGES), name, f"up to date, skipped ({duration(run.mark(name)['seconds'])} when it ran)")
            continue
        stage(number, len(STAGES), name, notes[name])
        with run.stage(name):
            works[name](run)


def _check_starts(run: Run) -> None:
    """A mistyped path is told before hours of work, not after."""
    cfg = run.config
    starts = {"tokenizer": (cfg.tokenizer_train, TokenizerConfig), "world_model": (cfg.train, ModelConfig)}
    for name, (loop, kind) in starts.items():
        if loop.start_from and not run.finished(name):
            check_part(Path(loop.start_from), kind)


def collect_clips(run: Run) -> None:
    """Stage 1: episodes from the simulator, where another run has not collected them yet."""
    with Progress("collect", run.config.sim.episodes, "episodes") as progress:
        collect(run.config.sim, run.clips, lambda done, total: progress.update(done))


def train_tokenizer(run: Run, resume: bool) -> None:
    """Stage 2."""
    cfg, train = run.config, run.config.tokenizer_train
    transform = partial(
        transforms.tokenizer_images,
        count=train.frames_per_clip,
        depth_share=train.depth_share,
        scale=cfg.tokenizer.depth_scale,
        flip=train.flip,
    )
    objective = TokenizerObjective(cfg.tokenizer, train)
    if train.lpips_missing:
        note("the LPIPS term is off: tokenizer_train.lpips_weights is empty (docs/tokenizer.md says how to make them)")
    source = open_store(run.clips).source("train")
    state = fit(
        objective,
        train,
        lambda data: loader.batches(source, transform, train.batch_size, train.seed, state=data),
        run.directory / "tokenizer",
        name="tokenizer",
        to_batch=transforms.image_batch,
        start=partial(start_tokenizer, cfg.tokenizer, Path(train.start_from)) if train.start_from else None,
        resume=resume,
    )
    save_weights(run.output("tokenizer"), objective.tokenizer_params(state.weights))


def tokenize(run: Run) -> None:
    """Stage 3: both token grids of every clip, with the actions in the model's units."""
    clips = open_store(run.clips)
    units = Units.create(clips)
    codec = Codec(run.config, load_tokenizer(run.config, run.directory), units)
    total = sum(len(clips.source(split)) for split in clips.splits)

    with Progress("tokens", total, "clips") as progress:
        done = 0

        def tokenized(split: str) -> Any:
            nonlocal done
            source = clips.source(split)
            for index in range(len(source)):
                yield _token_record(codec, source[index])
                done += 1
                progress.update(done)

        meta = {name: clips.manifest[name] for name in ("action_mean", "action_std", "depth_range")}
        key = {"key": run.keys()["tokens"], "source": str(run.clips)}
        write_store(run.output("tokens"), "tokens", {s: tokenized(s) for s in clips.splits}, meta | key)


def _token_record(codec: Codec, clip: Record) -> Record:
    return {
        "rgb": codec.encode_rgb(clip["rgb"]),
        "depth": codec.encode_depth(clip["depth"]),
        "actions": codec.units.action_inputs(clip["actions"], codec.config.model.integrate_actions),
        "tracks": clip["tracks"],
        "visible": clip["visible"],
        "task": clip["task"],
        "provenance": clip["provenance"],
    }


def train_world_model(run: Run, resume: bool) -> None:
    """Stage 4."""
    cfg, train = run.config, run.config.train
    if train.start_from and train.start_from != cfg.tokenizer_train.start_from:
        note(
            f"train.start_from {train.start_from} is not tokenizer_train.start_from; "
            f"its model has to know the tokens of this run's tokenizer"
        )
    source = open_store(run.output("tokens")).source("train")
    state = fit(
        WorldModelObjective.create(cfg),
        train,
        lambda data: loader.batches(source, transforms.token_clip, train.batch_size, train.seed, state=data),
        run.directory / "world_model",
        name="world model",
        to_batch=transforms.token_batch,
        start=partial(start_world_model, cfg.model, Path(train.start_from)) if train.start_from else None,
        resume=resume,
    )
    save_weights(run.output("world_model"), state.weights)


def evaluate(run: Run) -> None:
    """Stage 5: metrics and the arrays that the report shows."""
    with disk_guard(run.directory):
        result = evaluation.evaluate(Generator.load(run.directory), open_store(run.clips))
        evaluation.save(run.output("evaluation"), result)
