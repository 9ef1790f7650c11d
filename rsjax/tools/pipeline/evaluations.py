"""Evaluates runs by protocols. Each result is a folder, ``RUN/evaluations/LABEL``, with ``result.json``."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

import rsjax
from rsjax.config import Config, content_key, to_dict
from rsjax.data.clips import frame_rate
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.coverage import make_coverage
from rsjax.evaluation.evaluate import EvaluationClips
from rsjax.evaluation.metrics.physics_iq import THRESHOLD
from rsjax.evaluation.protocols import Protocol, check, find, label, of_run
from rsjax.evaluation.results import NAME, Evaluation, fingerprint, read_result, result_of, write_result
from rsjax.files import FileError, disk_guard, making, safe_id
from rsjax.model_directory import is_saved, output_directory
from rsjax.models.load_run import load, load_config
from rsjax.models.trained import TrainedModel
from rsjax.progress import note
from rsjax.tools.pipeline.depth_stage import check_depth, depth_estimator
from rsjax.tools.pipeline.evaluation_clips import chosen_splits, evaluation_store, probes_of, with_retakes
from rsjax.tools.pipeline.limits import GIB, host_memory
from rsjax.tools.pipeline.metric_files import by_content, check_metric_files
from rsjax.tools.pipeline.provenance import code_version, data_fingerprint, machine, training_settings
from rsjax.tools.pipeline.run import RECIPE, Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.pipeline.videos import resampled
from rsjax.tools.sim import probes, retakes
from rsjax.training.distributed import agree, barrier, is_lead, on_lead

FOLDER = "evaluations"
MOST_FRAMES = 10_000_000  # generated for an evaluation; the authors' 1,200 clips, five times, of 48 frames: 2 million
NOT_OF_METRICS = ("clips", "repetitions", "action_draws", "batch_size")


@dataclass(frozen=True)
class EvaluationRequest:
    """The settings of an evaluation.

    Attributes:
        protocol: the protocol's name.
        changes: fields of the protocol to change.
        settings: fields of :class:`rsjax.config.EvalConfig` to change, such as paths of weights.
        data: a store with the clips to score; None: the run's own.
        splits: splits of that store; empty: the protocol's.
        store: the new path of the run's store of ingested clips, if it was moved; of a saved model, the store with all
            clips of its training.
        overwrite: whether to replace results that are up to date.
        retakes: whether to simulate the scored clips once more, for Physics-IQ's score.
    """

    protocol: str
    changes: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    data: Path | None = None
    splits: tuple[str, ...] = ()
    store: Path | None = None
    overwrite: bool = False
    retakes: bool = False


def evaluate_run(directory: Path, data: Path, request: EvaluationRequest) -> Iterator[Path]:
    """Evaluates one run, each split by itself; skips results that are up to date. All processes call it together.

    A saved model is scored on the clips in it, without the scores that training clips are needed for.

    Args:
        directory: of a run or a saved model.
        data: the directory of simulated data sets.

    Yields:
        The folder of each result.

    Raises:
        UserError: the run, its data, a split or a file of weights is missing; the clips do not fit the protocol, or
            second takes of them cannot be simulated.
    """
    config = load_config(directory)
    saved = is_saved(directory)
    if request.store and not saved:
        config = relocated(config, request.store)
    config = replace(config, eval=replace(config.eval, **request.settings))
    check_metric_files(config.eval)
    standard = find(request.protocol, config)
    protocol = replace(standard, **request.changes, splits=request.splits or standard.splits)
    check_request(config, protocol)
    resolution = config.clips.image_size
    check(protocol, protocol.prompt_frames + max(protocol.horizon, 1), resolution, str(directory))
    trained = replace(load(directory), config=config)
    sampling = getattr(config.model, "sample", None)
    known = {each.name for each in fields(sampling)} if is_dataclass(sampling) else set()
    if missing := ", ".join(sorted(protocol.sampling.keys() - known)):
        note(f"a model of family {config.model.family!r} has no {missing}, which {protocol.name} fixes; left out")
    trained = resampled(trained, {name: value for name, value in protocol.sampling.items() if name in known})
    run = Run(config, directory, data)
    store = open_store(request.store) if saved and request.store else run.open_clips()
    check_depth(run)
    if request.retakes and "train" not in store.splits:
        raise UserError(f"{directory}: second takes are kept beside a run's clips; name these with --store")
    if request.data:
        scored_store = open_store(request.data)
    else:
        scored_store = evaluation_store(run, store, protocol)
    for split in chosen_splits(scored_store, protocol.splits):
        parts = [label(protocol, standard)]
        if split != "test":
            parts.append(split)
        if request.data or saved:  # other clips than the run's, whose results may lie in the same place
            key = str(scored_store.manifest.get("key") or scored_store.path.absolute())
            parts.append(f"data={safe_id(key)}")  # a key may be unsafe as a path
        name = ",".join(parts)
        chosen = EvaluationClips.read(scored_store, split, replace(protocol, splits=(split,)), config.clips)
        if request.retakes:
            name = f"{name},second-takes"
            chosen = with_retakes(chosen, config.runtime.workers)
        folder = output_directory(directory, FOLDER) / name
        evaluate_into(folder, name, trained, run, store, chosen, request.overwrite)
        yield folder


def check_request(config: Config, protocol: Protocol) -> None:
    """Checks, before anything is loaded or simulated, that an evaluation can be made.

    Raises:
        UserError: the depth scores in tables need an estimator, and there is none; or the clips would not fit into
            memory, or take days to simulate and generate.
    """
    if protocol.depth_source == "estimator" and not config.eval.depth_estimator:
        raise UserError(
            "--depth-source estimator needs a network that estimates depth: set --eval.depth-estimator "
            "(docs/evaluation.md), or --depth-source branch"
        )
    check_generated(
        config, protocol, "lower --clips, --prompt-frames, --horizon, --samples, --repetitions or --action-draws"
    )
    frames = protocol.prompt_frames + protocol.horizon
    needed = protocol.clips * frames * config.clips.image_size**2 * (3 + 4 * config.model.uses_depth)
    there = host_memory()
    if needed > there:
        raise UserError(
            f"protocol {protocol.name}: {protocol.clips} clips of {frames} frames take {needed / GIB:,.0f} GiB; this "
            f"machine has {there / GIB:,.0f} GiB of memory; lower --prompt-frames, --horizon or --clips"
        )


def check_generated(config: Config, protocol: Protocol, cure: str) -> None:
    """Raises :class:`UserError` if an evaluation generates more than ``MOST_FRAMES``; ``cure`` says what to lower."""
    frames = protocol.prompt_frames + (protocol.horizon or config.clips.frames - protocol.prompt_frames)
    videos = protocol.repetitions * (protocol.samples + 2 * protocol.action_draws)
    if protocol.clips * videos * frames > MOST_FRAMES:
        raise UserError(
            f"protocol {protocol.name}: {protocol.clips} clips of {frames} frames, each generated {videos} times, are "
            f"more than {MOST_FRAMES:,} frames, which take days; {cure}"
        )


def evaluate_own(run: Run) -> Evaluation:
    """Evaluates a run by its own configuration, in its evaluation stage; only the lead process calls it."""
    trained = load(run.directory)
    store = run.open_clips()
    eval_clips = EvaluationClips.read(store, "test", of_run(run.config), run.config.clips)
    folder = run.directory / "evaluation"
    return _evaluate(
        folder, eval_clips.protocol.name, _key(trained, store, eval_clips), trained, run, store, eval_clips
    )


def evaluate_into(
    folder: Path, name: str, trained: TrainedModel, run: Run, store: Store, eval_clips: EvaluationClips, overwrite: bool
) -> None:
    """Evaluates into a folder unless its result is up to date. Several processes share the work."""
    key = _key(trained, store, eval_clips)
    parts = _parts(folder, key)
    skipped = f"{folder}: up to date, skipped (--overwrite evaluates again)"
    if agree(not overwrite and _key_of(folder) == key, "evaluated before"):
        if is_lead():
            note(skipped)
        return

    def clear() -> None:
        with making(folder, wait=True):
            shutil.rmtree(parts, ignore_errors=True)

    if overwrite:  # an interrupted evaluation's batches may be from another version
        on_lead("old batches", clear)
    if jax.process_count() > 1:
        with disk_guard(parts):
            plan = evaluation.plan(trained, store, eval_clips, parts)
            plan.make(jax.process_index(), jax.process_count())
        barrier("generation")

    def finish() -> None:
        with making(folder, wait=True):
            if overwrite or _key_of(folder) != key:
                _evaluate(folder, name, key, trained, run, store, eval_clips)
            else:  # another process made it while this one waited
                note(skipped)
                shutil.rmtree(parts, ignore_errors=True)

    on_lead("evaluation", finish)


def _evaluate(
    folder: Path, name: str, key: str, trained: TrainedModel, run: Run, store: Store, eval_clips: EvaluationClips
) -> Evaluation:
    parts = _parts(folder, key)
    with disk_guard(folder):
        for old in folder.glob("parts-*"):
            if old != parts:  # from an evaluation with other settings that never finished
                shutil.rmtree(old, ignore_errors=True)
        estimator = depth_estimator(run)
        bank = make_coverage(trained, store, run.directory)
        simulated = probes_of(run, store, eval_clips)
        scores = evaluation.evaluate(trained, store, None, eval_clips, parts, estimator, simulated, bank)
        about = {"label": name, "key": key, "code": code_version(Path(rsjax.__file__).resolve().parents[1])}
        about |= _described(trained, run, store, eval_clips)
        write_result(folder, result_of(scores, **about), scores.kept)
        shutil.rmtree(parts, ignore_errors=True)
    return scores


def _described(trained: TrainedModel, run: Run, store: Store, eval_clips: EvaluationClips) -> dict[str, Any]:
    """Returns the entries of ``result.json`` on protocol, sampling, data, model and machine."""
    config = trained.config
    frames, size = eval_clips.clips.rgb.shape[1:3]
    rate = frame_rate(eval_clips.records[0], eval_clips.store.manifest)
    data = {name: value for name, value in data_fingerprint(eval_clips.store.path).items() if name != "splits"}
    by_hash = to_dict(by_content(config.eval))  # files by their content
    settings = {name: value for name, value in by_hash.items() if name not in NOT_OF_METRICS}
    settings["physics_iq_threshold"] = THRESHOLD
    if eval_clips.retakes is not None:
        settings["second_take_jitter"] = retakes.JITTER
    return {
        "protocol": eval_clips.protocol.described(),
        "sampling": _sample_settings(config),
        "settings": settings,
        "data": data | {"split": eval_clips.split, "frames": frames, "image_size": size, "fps": rate},
        "model": {
            "run": str(run.directory),
            "preset": config.name,
            "family": config.model.family,
            "settings": to_dict(config.model),
            "training": training_settings(config),
            "seed": config.train.seed,
            "parameters": sum(x.size for x in jax.tree.leaves(trained.params)),
            "weights_sha256": _weights(trained),
            "trained_on": store.manifest.get("key"),
        },
        "made": {"time": datetime.now(UTC).isoformat(timespec="seconds"), "machine": machine()},
    }


def _key(trained: TrainedModel, store: Store, eval_clips: EvaluationClips) -> str:
    """Returns a hash of everything that determines the scores, except the code."""
    data = [
        (each.manifest.get("key"), data_fingerprint(each.path)["manifest_sha256"]) for each in (store, eval_clips.store)
    ]
    protocol = json.dumps([eval_clips.protocol.described(), _sample_settings(trained.config), data, eval_clips.split])
    takes = [] if eval_clips.retakes is None else [json.dumps([retakes.RECIPE, retakes.JITTER])]
    settings = by_content(trained.config.eval)
    return content_key(RECIPE, "evaluation", probes.RECIPE, protocol, _weights(trained), settings, *takes)


def _weights(trained: TrainedModel) -> str:
    return fingerprint((trained.params, trained.assets.tokenizer))


def _key_of(folder: Path) -> str:
    try:
        return read_result(folder).key if (folder / NAME).exists() else ""
    except FileError:
        return ""


def _parts(folder: Path, key: str) -> Path:
    return folder / f"parts-{key}"


def _sample_settings(config: Config) -> dict[str, Any]:
    settings = getattr(config.model, "sample", None)
    return to_dict(settings) if is_dataclass(settings) else {}
