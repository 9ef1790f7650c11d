"""The stages of the pipeline. Each reads the output of the previous one and can be run again."""

from collections.abc import Callable
from typing import Any, Literal

from rsjax.config import Config, LoopConfig
from rsjax.data.curriculum import check_stages
from rsjax.data.normalization import Normalization
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.evaluation.results import save_evaluation
from rsjax.files import disk_guard
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.load_run import load_tokenizer
from rsjax.progress import Progress, duration, note, stage
from rsjax.tools.pipeline.evaluations import evaluate_own
from rsjax.tools.pipeline.limits import check_batch, check_episodes
from rsjax.tools.pipeline.metric_files import check_metric_files
from rsjax.tools.pipeline.provenance import record_data, record_start
from rsjax.tools.pipeline.run import TRAINED, Run, link
from rsjax.tools.pipeline.setup import note_curriculum, starting, tokenizer_setup, world_model_setup
from rsjax.tools.pipeline.summary import write_summary
from rsjax.tools.pipeline.validation import TokenizerValidation, WorldModelValidation
from rsjax.tools.sim.collect import collect
from rsjax.training.checkpoint import save_weights
from rsjax.training.distributed import agree, barrier, is_lead, on_lead
from rsjax.training.log import find_wandb
from rsjax.training.loop import fit
from rsjax.training.sharding import Sharding


def run_all(run: Run, resume: bool = True, command: str = "") -> None:
    """Runs every unfinished stage in order, and prints which stages are skipped.

    Several processes with a common run directory train together; the lead process runs the other stages.

    Args:
        resume: False restarts an unfinished training stage instead of resuming from its checkpoint.
        command: the command that repeats the run, for ``run.json`` and the report.
    """
    _check_starts(run)
    on_lead("run.json", lambda: _record_start(run, command))
    works: dict[str, tuple[str, Callable[[], None]]] = {
        "collect": (_collecting(run), lambda: collect_clips(run)),
        "tokenizer": ("training the tokenizer", lambda: train_tokenizer(run, resume)),
        "tokens": ("preparing all clips for the model", lambda: prepare(run)),
        "world_model": ("training the world model", lambda: train_world_model(run, resume)),
        "evaluation": ("evaluating on the test split", lambda: evaluate(run)),
        "report": ("writing the report", lambda: write_summary(run, command)),
    }
    for number, name in enumerate(run.stages, 1):
        title, work = works[name]
        finished = agree(run.finished(name), name)
        if is_lead():
            seconds = f" ({duration(run.mark(name)['seconds'])} when it ran)" if finished else ""
            stage(number, len(run.stages), name, f"up to date, skipped{seconds}" if finished else title)
        if not finished:
            _do(run, name, work)


def _do(run: Run, name: str, work: Callable[[], None]) -> None:
    def marked() -> None:
        with run.stage(name):
            work()
        record_data(run)

    if name not in TRAINED:
        on_lead(name, marked)
    elif is_lead():
        marked()
    else:
        work()
    barrier(name)


def _check_starts(run: Run) -> None:
    """Raises for a wrong path, a missing file or package, or a batch that does not fit, before hours of work."""
    cfg = run.config
    if not cfg.data.key and not run.finished("collect"):
        check_episodes(cfg.sim, run.clips)
    trained: dict[Literal["tokenizer", "world_model"], tuple[LoopConfig, Callable[[Config], Any]]] = {
        "tokenizer": (cfg.loop("tokenizer"), create_autoencoder),
        "world_model": (cfg.loop("world_model"), create_model),
    }
    for name, (loop, create) in trained.items():
        if name not in run.stages or run.finished(name):
            continue
        Sharding.create(loop)
        check_batch(cfg, loop, name)
        starting(create(cfg), loop.start_from, name)
        if loop.wandb:
            find_wandb()
    if "world_model" in run.stages and not run.finished("world_model"):
        create_model(cfg).check_files()
    if not run.finished("evaluation"):
        check_metric_files(cfg.eval)


def _collecting(run: Run) -> str:
    if run.config.data.key:
        return f"the clips of {run.clips}"
    sim = run.config.sim
    what = "Lift episodes" if sim.env == "lift" else f"Meta-World episodes of {len(sim.train_tasks)} tasks"
    return f"simulating {sim.episodes} {what} into {run.clips}"


def _record_start(run: Run, command: str) -> None:
    changed = " and ".join(record_start(run, command))
    if changed and not all(run.finished(name) for name in TRAINED if name in run.stages):
        note(f"since the last start {changed} changed (run.json); results may differ from those of one unbroken run")


def collect_clips(run: Run) -> None:
    """Stage 1: collects episodes in the simulator, unless another run has done so; or checks an existing store."""
    cfg = run.config
    if cfg.data.key:
        if cfg.model.uses_depth and not run.open_clips().manifest.get("depth_range"):
            note(
                "no clip has depth, so the depth branch trains with its loss masked; "
                "--model.use-depth False trains without it in half the time"
            )
        return
    with Progress("collect", cfg.sim.episodes, "episodes") as progress:
        collect(cfg.sim, run.clips, lambda done, total: progress.update(done))


def train_tokenizer(run: Run, resume: bool) -> None:
    """Stage 2: trains the tokenizer, or the model's own autoencoder."""
    train, directory = run.config.tokenizer_train, run.directory / "tokenizer"
    if train.lpips_missing:
        note("the LPIPS term is off: tokenizer_train.lpips_weights is empty (docs/tokenizer.md says how to make them)")
    # Checks the world model's curriculum and clips before the tokenizer is trained.
    for store in check_stages(run.config.train, run.open_clips()):
        create_model(run.config).check_clips(store)
    setup, model = tokenizer_setup(run), create_autoencoder(run.config)
    note_curriculum(setup.loader)
    for line in model.notes() if is_lead() else ():
        note(line)
    state = fit(
        model,
        setup.loop,
        setup.loader,
        directory,
        name="tokenizer",
        to_batch=setup.to_batch,
        start=setup.start,
        resume=resume,
        validate=TokenizerValidation(run),
        per_step=("images", train.batch_size * train.frames_per_clip),
    )
    if is_lead():
        save_weights(run.output("tokenizer"), model.tokenizer_params(state.weights))


def prepare(run: Run) -> None:
    """Stage 3: makes the store that the model trains on instead of clips, such as tokens, and links to it."""
    clips, folder, cfg = run.open_clips(), run.directory / "tokens", run.config
    (folder / QUARANTINE).unlink(missing_ok=True)
    assets = Assets(Normalization.create(clips), load_tokenizer(cfg, run.directory))
    prepared = create_model(cfg).prepare(clips, assets, folder, cfg.runtime.max_damaged) or clips
    with disk_guard(folder):
        folder.mkdir(parents=True, exist_ok=True)
        assets.normalization.save(folder)
        link(prepared.path.absolute(), run.output("tokens"))


def train_world_model(run: Run, resume: bool) -> None:
    """Stage 4: trains the world model."""
    cfg, train = run.config, run.config.train
    if cfg.model.uses_tokenizer and train.start_from and train.start_from != cfg.tokenizer_train.start_from:
        note(
            f"train.start_from {train.start_from} is not tokenizer_train.start_from; "
            f"its model has to know the tokens of this run's tokenizer"
        )
    setup = world_model_setup(run)
    note_curriculum(setup.loader)
    state = fit(
        setup.model,
        setup.loop,
        setup.loader,
        run.directory / "world_model",
        name="world model",
        to_batch=setup.to_batch,
        start=setup.start,
        resume=resume,
        validate=WorldModelValidation(run),
        per_step=("frames", train.batch_size * cfg.clips.frames),
    )
    if is_lead():
        save_weights(run.output("world_model"), state.weights)


def evaluate(run: Run) -> None:
    """Stage 5: computes the scores, and the arrays of the report."""
    with disk_guard(run.directory):
        save_evaluation(run.output("evaluation"), evaluate_own(run))
