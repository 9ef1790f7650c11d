"""The stages of the pipeline. Each reads the output of the previous one and can be run again."""

from collections.abc import Callable
from typing import Any, Literal

import jax

from rsjax.config import Config
from rsjax.data.curriculum import LoaderFactory, check_stages, loader_factory
from rsjax.data.normalization import Normalization
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.evaluation.metrics.lpips import advice
from rsjax.evaluation.protocols import of_run
from rsjax.evaluation.results import save_evaluation
from rsjax.files import disk_guard
from rsjax.model_directory import Part, load_part, locate
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.load_run import load_tokenizer
from rsjax.progress import Progress, duration, note, stage
from rsjax.tools.pipeline.depth_stage import check_depth, make_depth_network
from rsjax.tools.pipeline.estimated_annotations import with_estimates
from rsjax.tools.pipeline.evaluations import check_generated, evaluate_own
from rsjax.tools.pipeline.limits import check_batch, check_episodes
from rsjax.tools.pipeline.metric_files import check_metric_files
from rsjax.tools.pipeline.provenance import record_data, record_start
from rsjax.tools.pipeline.run import TRAINED, Run, link
from rsjax.tools.pipeline.validation import TokenizerValidation, WorldModelValidation
from rsjax.tools.sim.collect import collect
from rsjax.trainable import Params
from rsjax.training.checkpoint import save_weights
from rsjax.training.distributed import agree, barrier, is_lead, on_lead
from rsjax.training.log import find_wandb
from rsjax.training.loop import fit
from rsjax.training.sharding import Sharding

START_FIELDS: dict[Part, str] = {"tokenizer": "tokenizer_train.start_from", "world_model": "train.start_from"}


def run_all(run: Run, resume: bool = True, command: str = "") -> None:
    """Runs every unfinished stage in order, and prints which stages are skipped.

    Several processes with a common run directory train together; the lead process runs the other stages.

    Args:
        resume: False restarts an unfinished training stage instead of resuming from its checkpoint.
        command: the command that repeats the run, for ``run.json`` and the report.
    """
    check_before_start(run)
    on_lead("run.json", note_changes, run, command)
    if _begins(run, "collect", _where_clips_come_from(run)):
        _do(run, "collect", collect_clips)
    if _begins(run, "tokenizer", "training the tokenizer"):
        _do(run, "tokenizer", train_tokenizer, resume)
    if _begins(run, "tokens", "preparing all clips for the model"):
        _do(run, "tokens", prepare)
    if _begins(run, "world_model", "training the world model"):
        _do(run, "world_model", train_world_model, resume)
    if _begins(run, "depth_estimator", "training the depth estimator on the clips' exact depth"):
        _do(run, "depth_estimator", make_depth_network)
    if _begins(run, "evaluation", "evaluating on the test split"):
        _do(run, "evaluation", evaluate)
    if _begins(run, "report", "writing the report"):
        from rsjax.tools.pipeline.summary import write_summary  # not at the start, as matplotlib takes a second

        _do(run, "report", write_summary, command)


def _begins(run: Run, name: str, title: str) -> bool:
    """Prints a stage's headline, and returns whether it is still to be done."""
    if name not in run.stages:
        return False
    finished = agree(run.finished(name), name)
    if is_lead():
        headline = f"up to date, skipped ({duration(run.seconds(name))} when it ran)" if finished else title
        stage(run.stages.index(name) + 1, len(run.stages), name, headline)
    return not finished


def _do(run: Run, name: str, work: Callable[..., None], *arguments: Any) -> None:
    """Does a stage's work: a training in all processes, everything else in the lead, which also marks the stage."""
    if name not in TRAINED:
        on_lead(name, _mark_and_do, run, name, work, *arguments)
    elif is_lead():
        _mark_and_do(run, name, work, *arguments)
    else:
        work(run, *arguments)
    barrier(name)


def _mark_and_do(run: Run, name: str, work: Callable[..., None], *arguments: Any) -> None:
    with run.stage(name):
        work(run, *arguments)
    record_data(run)


def check_before_start(run: Run) -> None:
    """Raises for a wrong path, a missing file or package, or a batch that does not fit, before hours of work."""
    cfg = run.config
    if cfg.data is None and not run.finished("collect"):
        check_episodes(cfg.sim, run.clips)
    trained: dict[Literal["tokenizer", "world_model"], Callable[[Config], Any]] = {
        "tokenizer": create_autoencoder,
        "world_model": create_model,
    }
    for name, create in trained.items():
        if name not in run.stages or run.finished(name):
            continue
        loop = cfg.loop(name)
        Sharding.create(loop)
        check_batch(cfg, loop, name)
        pretrained_start(create(cfg), loop.start_from, name)
        if loop.wandb:
            find_wandb()
    if "world_model" in run.stages and not run.finished("world_model"):
        create_model(cfg).check_files()
    if not run.finished("evaluation"):
        check_generated(cfg, of_run(cfg), "lower --eval.clips, --eval.repetitions or --eval.action-draws")
        check_metric_files(cfg.eval)
        check_depth(run)


def note_changes(run: Run, command: str) -> None:
    """Records this start in ``run.json``; says what has changed since the last one, and how to get missing weights."""
    if not run.finished("evaluation") and (line := advice(run.config.eval)):
        note(line)
    changed = " and ".join(record_start(run, command))
    if changed and not all(run.finished(name) for name in TRAINED if name in run.stages):
        note(f"since the last start {changed} changed (run.json); results may differ from those of one unbroken run")


def _where_clips_come_from(run: Run) -> str:
    if run.config.data is not None:
        return f"the clips of {run.clips}"
    sim = run.config.sim
    if sim.env == "lift":
        return f"simulating {sim.episodes} Lift episodes into {run.clips}"
    if sim.env == "metaworld":
        return f"simulating {sim.episodes} Meta-World episodes of {len(sim.train_tasks)} tasks into {run.clips}"
    return f"simulating {sim.episodes} episodes of {', '.join(sim.train_tasks)} into {run.clips}"


def collect_clips(run: Run) -> None:
    """Stage 1: collects episodes in the simulator, unless another run has done so; or checks an existing store."""
    cfg = run.config
    if cfg.data is not None:
        if cfg.model.uses_depth and not run.open_clips().manifest.get("depth_range"):
            note(
                f"no clip has depth, so depth trains with its loss masked; {cfg.model.without_depth} trains without it"
            )
        return
    with Progress("collect", cfg.sim.episodes, "episodes") as progress:
        collect(cfg.sim, run.clips, lambda done, total: progress.update(done), cfg.runtime.workers)


def train_tokenizer(run: Run, resume: bool) -> None:
    """Stage 2: trains the tokenizer, or the model's own autoencoder."""
    cfg = run.config
    train = cfg.tokenizer_train
    if train.lpips_missing:
        note("the LPIPS term is off: tokenizer_train.perceptual.lpips is empty (docs/tokenizer.md says how to get it)")
    # Checks the world model's curriculum and clips before the tokenizer is trained.
    for store in check_stages(cfg.train, run.open_clips()):
        create_model(cfg).check_clips(store)
    model = create_autoencoder(cfg)
    loader = tokenizer_loader(run)
    if is_lead():
        for line in (*loader.summary(), *model.notes()):
            note(line)
    state = fit(
        model,
        loader.loop,
        loader,
        run.directory / "tokenizer",
        name="tokenizer",
        start=pretrained_start(model, train.start_from, "tokenizer"),
        resume=resume,
        validate=TokenizerValidation(run),
        per_step=("images", train.batch_size * train.frames_per_clip),
    )
    if is_lead():
        save_weights(run.output("tokenizer"), model.tokenizer_params(state.weights))


def prepare(run: Run) -> None:
    """Stage 3: makes the store that the model trains on instead of clips, such as tokens, and links to it."""
    clips = run.open_clips()
    folder = run.directory / "tokens"
    cfg = run.config
    (folder / QUARANTINE).unlink(missing_ok=True)
    assets = Assets(Normalization.create(clips), load_tokenizer(cfg, run.directory))
    prepared = create_model(cfg).prepare(clips, assets, folder, cfg.runtime.max_damaged) or clips
    with disk_guard(folder):
        folder.mkdir(parents=True, exist_ok=True)
        assets.normalization.save(folder)
        link(prepared.path.absolute(), run.output("tokens"))


def train_world_model(run: Run, resume: bool) -> None:
    """Stage 4: trains the world model."""
    cfg = run.config
    train = cfg.train
    if cfg.model.uses_tokenizer and train.start_from and train.start_from != cfg.tokenizer_train.start_from:
        note(
            f"train.start_from {train.start_from} is not tokenizer_train.start_from; "
            f"its model has to know the tokens of this run's tokenizer"
        )
    model = create_model(cfg)
    if jax.process_count() > 1:  # one makes what the next line then finds in all
        on_lead("estimated annotations", with_estimates, run, cfg.loop("world_model"))
    loader = world_model_loader(run)
    per_step = ("frames", train.batch_size * cfg.clips.frames)
    if any(part.frames for part in train.curriculum):
        per_step = ("clips", train.batch_size)
    if is_lead():
        for line in loader.summary():
            note(line)
    state = fit(
        model,
        loader.loop,
        loader,
        run.directory / "world_model",
        name="world model",
        start=pretrained_start(model, train.start_from, "world_model"),
        resume=resume,
        validate=WorldModelValidation(run),
        per_step=per_step,
    )
    if is_lead():
        save_weights(run.output("world_model"), state.weights)


def evaluate(run: Run) -> None:
    """Computes the scores, and the arrays of the report."""
    with disk_guard(run.directory):
        save_evaluation(run.output("evaluation"), evaluate_own(run))


def tokenizer_loader(run: Run) -> LoaderFactory:
    """Returns a factory of loaders of the tokenizer's training: the run's clips, as the curriculum orders them.

    Raises:
        StoreError: the clips are missing, or the curriculum of ``tokenizer_train`` does not fit them.
    """
    transform = create_autoencoder(run.config).transform()
    return loader_factory(run.config.loop("tokenizer"), run.open_clips(), transform, run.directory / "tokenizer")


def world_model_loader(run: Run) -> LoaderFactory:
    """Returns a factory of loaders of the world model's training: prepared records, as the curriculum orders them.

    Raises:
        StoreError: the prepared store is missing, or the curriculum of ``train`` does not fit it.
    """
    prepared = run.open_prepared()
    loop = with_estimates(run, run.config.loop("world_model"))
    ours = _depth_range(prepared)
    for store in check_stages(loop, prepared):
        theirs = _depth_range(store)
        if theirs and theirs != ours and is_lead():
            note(f"{store.path}: its depth covers {theirs}, this run's {ours}; the model does not see the difference")
    transform = create_model(run.config).transform(Normalization.create(prepared))
    return loader_factory(loop, prepared, transform, run.directory / "world_model")


def _depth_range(store: Store) -> str:
    near_far = store.manifest.get("depth_range")
    if not near_far:
        return ""
    return f"{near_far[0]:g} to {near_far[1]:g} {store.manifest.get('depth_unit') or 'metres'}"


def pretrained_start(model: Any, start_from: str, part: Part) -> Callable[[Params], Params] | None:
    """Returns a function that makes initial parameters from a directory's weights; None if ``start_from`` is empty.

    Args:
        part: "tokenizer" or "world_model".

    Raises:
        UserError: the weights are missing or of another network; the message names the differing fields.
    """
    if not start_from:
        return None
    try:
        directory = locate(start_from)
        shapes = model.pretrained_shapes(directory)
    except UserError as error:
        raise UserError(f"{START_FIELDS[part]}: {error}") from error

    def start(fresh: Params) -> Params:
        return model.start(fresh, load_part(directory, part, shapes), directory)

    return start
