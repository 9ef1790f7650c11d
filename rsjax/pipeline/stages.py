"""The stages of the main job; each reads what the one before left and can be run again."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rsjax.config import ModelConfig, TokenizerConfig
from rsjax.data.curriculum import check_stages
from rsjax.data.normalization import Normalization
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.evaluation import evaluate as evaluation
from rsjax.files import disk_guard
from rsjax.pipeline.generator import Generator, load_tokenizer
from rsjax.pipeline.jobs import tokenizer_job, world_model_job
from rsjax.pipeline.provenance import record_data, record_start
from rsjax.pipeline.run import STAGES, TRAINED, Run
from rsjax.pipeline.summary import write_summary
from rsjax.pipeline.tokens import link, tokenize_store
from rsjax.progress import Progress, duration, note, stage
from rsjax.sim.collect import collect
from rsjax.training.checkpoint import save_weights
from rsjax.training.distributed import agree, barrier, is_lead, on_lead
from rsjax.training.placement import Placement
from rsjax.training.pretrained import check_part
from rsjax.training.wandb_run import find_wandb


def run_all(run: Run, resume: bool = True, command: str = "") -> None:
    """Runs every stage that is not finished, in order, and says which were skipped.

    Several processes, which have one run directory, train together; the lead alone does the other stages.

    Args:
        resume: False starts an unfinished training stage over instead of going on from its checkpoint.
        command: how to repeat the run, for the report.
    """
    _check_starts(run)
    on_lead("run.json", partial(_record_start, run, command))
    works: dict[str, Callable[[Run], None]] = {
        "collect": collect_clips,
        "tokenizer": partial(train_tokenizer, resume=resume),
        "tokens": tokenize,
        "world_model": partial(train_world_model, resume=resume),
        "evaluation": evaluate,
        "report": partial(write_summary, command=command),
    }
    notes = {
        "collect": _collecting(run),
        "tokenizer": "training the tokenizer",
        "tokens": "tokenizing all clips",
        "world_model": "training the world model",
        "evaluation": "generating from held-out first frames",
        "report": "writing the report",
    }
    for number, name in enumerate(STAGES, 1):
        finished = agree(run.finished(name), name)
        if is_lead():
            seconds = f" ({duration(run.mark(name)['seconds'])} when it ran)" if finished else ""
            stage(number, len(STAGES), name, f"up to date, skipped{seconds}" if finished else notes[name])
        if not finished:
            _do(run, name, works[name])


def _do(run: Run, name: str, work: Callable[[Run], None]) -> None:
    def marked() -> None:
        with run.stage(name):
            work(run)
        record_data(run)

    if name not in TRAINED:
        on_lead(name, marked)
    elif is_lead():
        marked()
    else:
        work(run)
    barrier(name)


def _check_starts(run: Run) -> None:
    """A mistyped path, a missing package or a batch that does not divide is told before hours of work, not after."""
    cfg = run.config
    starts = {"tokenizer": (cfg.tokenizer_train, TokenizerConfig), "world_model": (cfg.train, ModelConfig)}
    for name, (loop, kind) in starts.items():
        if run.finished(name):
            continue
        Placement.create(loop)
        if loop.start_from:
            check_part(Path(loop.start_from), kind)
        if loop.wandb:
            find_wandb()


def _collecting(run: Run) -> str:
    if run.config.data.key:
        return f"the clips of {run.clips}"
    return f"simulating {run.config.sim.episodes} Lift episodes into {run.clips}"


def _record_start(run: Run, command: str) -> None:
    changed = " and ".join(record_start(run, command))
    if changed and not all(map(run.finished, TRAINED)):
        note(f"since the last start {changed} changed (run.json); results may differ from those of one unbroken run")


def collect_clips(run: Run) -> None:
    """Stage 1: episodes from the simulator, where another run has not collected them yet; or a store that is there."""
    cfg = run.config
    if cfg.data.key:
        if cfg.model.depth and not run.open_clips().manifest.get("depth_range"):
            note(
                "no clip has depth, so the depth branch trains with its loss masked; "
                "--model.depth False leaves it out, in half of the time"
            )
        return
    with Progress("collect", cfg.sim.episodes, "episodes") as progress:
        collect(cfg.sim, run.clips, lambda done, total: progress.update(done))


def train_tokenizer(run: Run, resume: bool) -> None:
    """Stage 2."""
    train = run.config.tokenizer_train
    if train.lpips_missing:
        note("the LPIPS term is off: tokenizer_train.lpips_weights is empty (docs/tokenizer.md says how to make them)")
    # Before the tokenizer is trained, whose clips the world model's stages choose from.
    check_stages(run.config.train, run.open_clips())
    job = tokenizer_job(run)
    state = job.fit(resume)
    if is_lead():
        save_weights(run.output("tokenizer"), job.objective.tokenizer_params(state.weights))


def tokenize(run: Run) -> None:
    """Stage 3: both token grids of every clip, beside the clips, for all runs that have this tokenizer."""
    clips, folder = run.open_clips(), run.directory / "tokens"
    (folder / QUARANTINE).unlink(missing_ok=True)
    out = tokenize_store(clips, run.config, load_tokenizer(run.config, run.directory), folder)
    with disk_guard(folder):
        folder.mkdir(parents=True, exist_ok=True)
        Normalization.create(clips).save(folder)
        link(out, run.output("tokens"))


def train_world_model(run: Run, resume: bool) -> None:
    """Stage 4."""
    cfg, train = run.config, run.config.train
    if train.start_from and train.start_from != cfg.tokenizer_train.start_from:
        note(
            f"train.start_from {train.start_from} is not tokenizer_train.start_from; "
            f"its model has to know the tokens of this run's tokenizer"
        )
    state = world_model_job(run).fit(resume)
    if is_lead():
        save_weights(run.output("world_model"), state.weights)


def evaluate(run: Run) -> None:
    """Stage 5: metrics and the arrays that the report shows."""
    with disk_guard(run.directory):
        result = evaluation.evaluate(Generator.load(run.directory), run.open_clips())
        evaluation.save(run.output("evaluation"), result)
