"""Adapts a world model to policies: it learns for minutes from what they do in the simulator, mixed with its own clips.

A round has four parts: the policies act in the simulator; their episodes become clips; a new run starts from the
model's weights and trains on both; and everything is measured again. The new run is a run directory like any other.
"""

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.artifact import Work, make_once
from rsjax.config import ComponentConfig, Config, CurriculumStageConfig, TokenModelConfig, content_key
from rsjax.config.config_fields import with_values
from rsjax.data.curriculum import record_count
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.evaluation.results import Result, read_result
from rsjax.evaluation.statistics import Estimate, bootstrap, wilson
from rsjax.files import read_json, write_file, write_json
from rsjax.progress import note, stage
from rsjax.tools.pipeline.evaluations import EvaluationRequest, evaluate_run
from rsjax.tools.pipeline.prepared import prepare_store
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import run_all
from rsjax.tools.policies.judges.head_judge import head_rule
from rsjax.tools.policies.judges.judge_training import FOLDER as JUDGE
from rsjax.tools.policies.judges.trained_judge import VALIDATION
from rsjax.tools.policies.on_policy import cut, rollouts
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.studies.policy_evaluation import compare
from rsjax.tools.policies.studies.policy_learning import interval_text, percent
from rsjax.tools.policies.studies.trials import Trials
from rsjax.tools.policies.worlds.model_world import model_key
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.studies.tables import ABSENT, Table, as_markdown
from rsjax.training.log import read_log

OTHERS = (
    "holds an adaptation of another run, to other policies or episodes, or with other settings; choose another --out"
)
BEFORE = "before"
SCORES_HEAD = ("world model", "PSNR, own test clips", "gain", "95 %", "PSNR, on-policy clips", "gain", "95 %")
SUCCESS_HEAD = ("world model", "policy", "success in it", "in the simulator", "same outcome", "uninterpretable")


@dataclass(frozen=True)
class Adaptation:
    """The settings of an adaptation.

    Attributes:
        rounds: rounds; each learns from new episodes, and from those of the rounds before.
        rollouts: episodes of each round to learn from; several policies take turns.
        held_out: further episodes, on whose clips the models are scored.
        minutes: duration of a round's training, converted to steps by the run's own log.
        steps: training steps of a round instead; 0: by ``minutes``.
        share: share of on-policy clips among the clips that training draws.
        learning_rate: peak of the learning rate, as a share of the run's.
    """

    rounds: int = 1
    rollouts: int = 50
    held_out: int = 20
    minutes: float = 5.0
    steps: int = 0
    share: float = 0.5
    learning_rate: float = 0.3

    def __post_init__(self) -> None:
        if self.rounds not in (1, 2):
            raise UserError(f"--rounds is {self.rounds}; it is 1 or 2")
        if self.rollouts < 1 or self.held_out < 2 or self.steps < 0:
            raise UserError(
                f"--rollouts {self.rollouts}, --held-out {self.held_out}, --steps {self.steps}: 1, 2 and 0 at least"
            )
        for name in ("minutes", "learning_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise UserError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be above 0")
        if not 0 < self.share < 1:
            raise UserError(f"--share is {self.share}; it is a share of on-policy clips, between 0 and 1")


@dataclass(frozen=True)
class Behaviour:
    """The data that the model is adapted to: policies in the simulator, recorded episodes, or both.

    Attributes:
        policies: by name; measured in the simulator and in the models. Without ``episodes`` the model learns from them.
        simulator: in which they act; None without policies.
        trials: the episodes in which success is measured, and their steps, which are also those of rollouts.
        judge: folder of the judge that decides on success in the models, or "head" for each model's own success head;
            None: the run's judge.
        episodes: a store of recorded episodes to learn from, with held-out ones in its test split.
    """

    policies: Mapping[str, Policy]
    simulator: SimulatorWorld | None
    trials: Trials
    judge: Path | None = None
    episodes: Path | None = None


def adapt(data: RunData, behaviour: Behaviour, settings: Adaptation, out: Path, command: str = "") -> dict[str, Any]:
    """Adapts a run's world model, and measures it before and after. An interrupted call resumes with the same bytes.

    Args:
        data: the run.
        out: the directory of the new runs (``round-1``, ``round-2``), the clips and results.
        command: the command that repeats this, for the new runs' reports.

    Returns:
        The content of ``out/results.json``.

    Raises:
        UserError: the run is unfinished, the episodes do not fit it, or ``out`` holds another adaptation.
        FileError: another process adapts in ``out``.
    """
    scores_of(data.run)  # raises before anything is simulated if the run was not evaluated
    fixed = replace(settings, rounds=1)  # a second round may follow later
    policies = ""
    steps = ""
    episodes = ""
    if behaviour.episodes:  # what policies do is measured alone
        episodes = str(open_store(behaviour.episodes).manifest.get("key"))
    else:
        assert behaviour.simulator is not None
        policies = str({name: policy.key for name, policy in behaviour.policies.items()})
        # The episodes' draws depend on the simulator's count, which is at most ``together``.
        steps = str((behaviour.trials.max_steps, behaviour.simulator.count))
    key = content_key("adapt", str(fixed), model_key(data.trained), policies, steps, episodes)
    with make_once(out, key, refuse=OTHERS, again=True) as work:
        count = steps_of(data.run, settings, work)
        stores: list[Path] = []
        runs = {BEFORE: data.run}
        for number in range(1, settings.rounds + 1):
            stage(number, settings.rounds, f"round {number}", f"episodes of the policies, {count} steps of training")
            clips = on_policy_clips(data, behaviour, settings, number, out)
            stores.append(clips.path)
            tokens = [prepare_store(data.run, data.config, open_store(place)).path for place in stores]
            start = list(runs.values())[-1]
            config = adapted(data.config, data.clips, tokens, start, settings, count, number)
            runs[f"round-{number}"] = train(config, data, out / f"round-{number}", command)
        return measure(data, behaviour, settings, runs, stores[0], count, out)


def steps_of(run: Path, settings: Adaptation, work: Work) -> int:
    """Returns the training steps of a round, the same ones for all calls on one ``out``.

    Raises:
        UserError: they follow from ``minutes``, and the run has no log of its speed.
    """
    if settings.steps:
        return settings.steps
    if "steps" not in work.metadata:
        rows = read_log(run / "world_model")
        seconds = [row["seconds_per_step"] for row in rows if row.get("seconds_per_step")]
        if not seconds:
            raise UserError(f"{run}: its world_model/log.jsonl does not say how long a step takes; name --steps")
        work.save(steps=max(1, round(60 * settings.minutes / float(np.median(seconds)))))
        note(f"{settings.minutes:g} minutes are {work.metadata['steps']} steps, at the speed of the run's own training")
    return int(work.metadata["steps"])


def on_policy_clips(data: RunData, behaviour: Behaviour, settings: Adaptation, number: int, out: Path) -> Store:
    """Returns the clips of a round, of the recorded episodes or of new rollouts; those of round 1 have a test split."""
    place = out / f"on-policy-{number}"
    frames = data.config.clips.frames
    if behaviour.episodes:
        made = cut(open_store(behaviour.episodes), data.clips, frames, place / "clips")
        counts = made.counts()
        train = counts.get("train", 0)
        test = counts.get("test", 0)
        if train < 1 or test < 2:
            raise UserError(
                f"{behaviour.episodes}: gives {train} clips to train and {test} to test; the model learns from one at "
                f"least, and is scored on two at least"
            )
        return made
    assert behaviour.simulator is not None
    first = settings.held_out + (number - 1) * settings.rollouts
    episodes = {"train": range(first, first + settings.rollouts)}
    if number == 1:
        episodes["test"] = range(settings.held_out)
    steps = max(behaviour.trials.max_steps, frames - 1)
    name = f"round {number}"
    whole = rollouts(behaviour.policies, behaviour.simulator, data.simulator, episodes, steps, place, name)
    return cut(whole, data.clips, frames, place / "clips")


def adapted(
    config: Config, own: Store, tokens: Sequence[Path], start: Path, settings: Adaptation, steps: int, number: int
) -> Config:
    """Returns the configuration of a round's run: the run's own, from ``start``, on its clips and the on-policy ones.

    Of the run's own clips it draws as the run did at the end, in the last stage of its curriculum.

    Args:
        config: the run's configuration.
        own: the run's clips.
        tokens: the prepared stores of the on-policy clips.
        start: the run whose weights training starts from; its tokenizer stays as it is.
    """
    last = (CurriculumStageConfig(), *config.train.curriculum)[-1]
    total = sum(part.weight for part in last.components)
    old = [replace(part, weight=(1 - settings.share) * part.weight / total) for part in last.components]
    counts = [len(open_store(place).source("train")) for place in tokens]
    new = [
        ComponentConfig(store=str(place.absolute()), weight=settings.share * count / sum(counts))
        for place, count in zip(tokens, counts, strict=True)
    ]
    components = (*old, *new)
    loop = config.train
    epochs = steps * loop.batch_size / sum(record_count(part, own) for part in components)
    optimizer = replace(
        loop.optimizer,
        learning_rate=settings.learning_rate * loop.optimizer.learning_rate,
        warmup_steps=min(loop.optimizer.warmup_steps, steps // 10),
    )
    begin = str(start.absolute())
    config = replace(
        config,
        tokenizer_train=replace(config.tokenizer_train, start_from=begin, steps=0, curriculum=()),
        train=replace(
            loop,
            start_from=begin,
            steps=steps,
            curriculum=(CurriculumStageConfig(components, epochs=epochs, frames=last.frames),),
            optimizer=optimizer,
            seed=loop.seed + number,
        ),
        runtime=replace(config.runtime, checkpoint_every=min(config.runtime.checkpoint_every, max(1, steps // 4))),
    )
    if isinstance(config.model, TokenModelConfig):  # the model has learnt to read its own frames
        config = with_values(config, {"model.departures.self_conditioning_after": 0})
    return config


def train(config: Config, data: RunData, directory: Path, command: str) -> Path:
    """Runs all stages of a round's run, with the judge of the run that it adapts, and returns its directory."""
    run = Run(config, directory, data.data_dir)
    with run.locked():
        run.prepare(overwrite=False)
        run_all(run, command=command)
    judge = data.run / JUDGE
    if judge.exists() and not (directory / JUDGE).exists():
        partial = directory / f"{JUDGE}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(judge, partial, ignore=shutil.ignore_patterns(VALIDATION))  # was measured with the old model
        partial.rename(directory / JUDGE)
    return directory


def scores_of(run: Path) -> Result:
    """Returns the scores on a run's own test clips, of its evaluation stage.

    Raises:
        UserError: the run was not evaluated.
    """
    try:
        return read_result(run / "evaluation")
    except UserError as error:
        raise UserError(f"{error}; the train command of {run} finishes its evaluation") from error


def measure(
    data: RunData,
    behaviour: Behaviour,
    settings: Adaptation,
    runs: Mapping[str, Path],
    held_out: Path,
    steps: int,
    out: Path,
) -> dict[str, Any]:
    """Scores the models on the run's own test clips and on held-out on-policy clips, and tries the policies in them.

    Writes ``results.json`` and ``results.md``.

    Args:
        runs: the run before, and those of the rounds.
        held_out: the store whose test split has the held-out clips.
        steps: of each training.
    """
    stage(settings.rounds, settings.rounds, "measure", "the model before and after")
    results: list[dict[str, Any]] = []
    first: dict[str, Result] = {}
    for name, run in runs.items():
        (folder,) = evaluate_run(run, data.data_dir, EvaluationRequest("run", data=held_out))
        scores = {"own": scores_of(run), "on_policy": read_result(folder)}
        first = first or scores
        row: dict[str, Any] = {"name": name, "run": str(run)}
        for kind, result in scores.items():
            gains = np.subtract(result.per_clip["psnr"], first[kind].per_clip["psnr"])
            gain = bootstrap(by_episode(gains, result.clips))
            row[kind] = {"psnr": result.metrics["psnr"], "gain": asdict(gain), "clips": len(gains)}
        results.append(row)
    about = {"settings": asdict(settings), "steps": steps, "run": str(data.run), "models": results}
    if behaviour.policies:
        assert behaviour.simulator is not None
        trials = behaviour.trials
        judge = behaviour.judge or data.run / JUDGE
        made = {name: RunData(run, data.data_dir) for name, run in runs.items()}
        rule = head_rule(data.run)  # no run of a round has one
        worlds = {name: partial(one.world, trials.together, judge, rule=rule) for name, one in made.items()}
        compare(behaviour.policies, behaviour.simulator, worlds, trials, out / "policy_evaluation")
        about["success"] = read_json(out / "policy_evaluation" / "results.json")["runs"]
    write_json(out / "results.json", about)
    write_file(out / "results.md", adaptation_tables(about).encode())
    return about


def by_episode(values: Float[np.ndarray, " clips"], clips: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, " N"]:
    """Returns the mean of each episode's clips: those of one episode are alike, so only episodes are resampled."""
    episodes = np.array([str(clip["episode"]) for clip in clips])
    return np.array([values[episodes == episode].mean() for episode in np.unique(episodes)])


def adaptation_tables(results: Mapping[str, Any]) -> str:
    """Returns the results in Markdown: the scores before and after, and the policies' success."""
    scores = []
    for row in results["models"]:
        cells = [row["name"]]
        for kind in ("own", "on_policy"):
            gain = row[kind]["gain"]
            cells.append(f"{row[kind]['psnr']:.2f} dB")
            if row["name"] == BEFORE:
                cells += ["", ""]
            elif gain["low"] is None:
                cells += [f"{gain['value']:+.2f}", ABSENT]
            else:
                cells += [f"{gain['value']:+.2f}", f"{gain['low']:+.2f} … {gain['high']:+.2f}"]
        scores.append(cells)
    lines = [
        f"{results['run']}, adapted by {results['steps']} steps a round.",
        "",
        as_markdown(Table(SCORES_HEAD, scores)),
    ]
    successes = []
    for row in results.get("success", []):
        for name, each in row["policies"].items():
            made = wilson(sum(each["world_model"]), len(each["world_model"]))
            true = wilson(sum(each["simulator"]), len(each["simulator"]))
            same = np.equal(each["world_model"], each["simulator"])
            unclear = wilson(sum(each["uninterpretable"]), len(each["uninterpretable"]))
            shares = [share_text(share) for share in (made, true, wilson(int(same.sum()), len(same)))]
            successes.append([row["run"], name, *shares, percent(unclear)])
    if successes:
        lines += ["", as_markdown(Table(SUCCESS_HEAD, successes))]
    return "\n".join([*lines, ""])


def share_text(share: Estimate) -> str:
    """Returns a share with its interval."""
    return f"{percent(share)} [{interval_text(share)}]"
