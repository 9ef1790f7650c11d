"""Loads what the policy experiments take from a run: its clips, simulator, judge and world model."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from rsjax.config import Config, SimConfig, content_key, from_dict
from rsjax.data.clips import readable
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.evaluation.coverage import make_coverage
from rsjax.model_directory import has_weights, is_saved, locate
from rsjax.models.load_run import load, load_config
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.provenance import training_settings
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import relocated
from rsjax.tools.policies.config import PolicyConfig, policy_preset
from rsjax.tools.policies.demos import Demos, Only, load_demos
from rsjax.tools.policies.judges.head_judge import NAME as HEAD
from rsjax.tools.policies.judges.head_judge import HeadJudge, check_heads, head_judge
from rsjax.tools.policies.judges.judge import Judge
from rsjax.tools.policies.judges.judge_training import FOLDER
from rsjax.tools.policies.judges.trained_judge import load_judge
from rsjax.tools.policies.worlds.actions import check_world_model
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.sim.episode import begins_episode

TAKEN = {"policy", "simulator", "videos"}  # folders beside those of the runs, in the results of policy_evaluation


@dataclass(frozen=True)
class RunData:
    """A run directory and where its clips are.

    Attributes:
        run: the directory.
        data_dir: the directory of simulated data sets.
        moved: the new path of the run's store of ingested clips, if it was moved.
    """

    run: Path
    data_dir: Path = Path("data")
    moved: Path | None = None

    @cached_property
    def config(self) -> Config:
        config = load_config(self.run)
        if self.moved:
            return relocated(config, self.moved)
        return config

    @cached_property
    def clips(self) -> Store:
        """The store that the run was trained on."""
        return Run(self.config, self.run, self.data_dir).open_clips()

    @cached_property
    def trained(self) -> TrainedModel:
        return load(self.run)

    @property
    def simulator(self) -> SimConfig:
        """The simulator that the clips are from.

        Raises:
            UserError: the clips are recordings, or from another simulator.
        """
        source = str(self.clips.manifest.get("source") or "an unknown source")
        if not source.startswith("robosuite/Lift"):
            raise UserError(
                f"{self.clips.path}: clips of {source}; policies are tried in the simulated Lift, so take a run on its "
                f"clips"
            )
        return from_dict(SimConfig, self.clips.manifest["config"])

    def world(
        self, count: int, judge: Path | None = None, measured: bool = False, rule: HeadJudge | None = None
    ) -> ModelWorld:
        """Returns the run's world model as a world of ``count`` episodes, with a judge as of :meth:`world_judge`.

        Args:
            measured: whether to measure how far episodes are from the training clips.

        Raises:
            UserError: the run is unfinished, its model takes no actions or reads a second view, or there is no judge
                for its frames.
        """
        check_world_model(self.config, f"{self.run}: the model")
        coverage = None
        if measured:
            coverage = make_coverage(self.trained, self.clips, self.run)
        return ModelWorld(self.trained, count, self.world_judge(judge, rule), coverage=coverage)

    def world_judge(self, folder: Path | None = None, rule: HeadJudge | None = None) -> Judge | HeadJudge:
        """Returns the run's judge, that in another folder, or for the path "head" that of the model's own heads.

        Args:
            rule: by which the heads decide, one for all models that are compared; None: as they were validated.

        Raises:
            UserError: there is no judge, its frames differ in size from the run's, or the model has no state heads.
        """
        if folder == Path(HEAD):
            judge = head_judge(self.trained, self.run)
            if rule is None or rule.key == judge.key:
                return judge
            return rule
        return self.judge(folder)

    def check_world(self, like: "RunData", judge: Path | None = None) -> None:
        """Checks, without loading weights, that policies of another run's clips can act in this run's model.

        Args:
            judge: as of :meth:`world_judge`.

        Raises:
            UserError: the run is unfinished, its model takes no actions, reads a second view or lacks the judge's
                heads, or frames or actions differ in size.
        """
        check_world_model(self.config, f"{self.run}: the model")
        if judge == Path(HEAD):
            check_heads(self.config.model, str(self.run))
        shapes = [(clips.image_size, clips.action_dim) for clips in (self.config.clips, like.config.clips)]
        if shapes[0] != shapes[1]:
            raise UserError(
                f"{self.run}: frames of {shapes[0][0]} pixels and actions of {shapes[0][1]} numbers, {like.run} has "
                f"{shapes[1][0]} and {shapes[1][1]}; compare runs on the same clips"
            )
        if not has_weights(self.run, "world_model"):
            raise UserError(f"{self.run}: its world model is not trained yet; the train command of this run goes on")

    def judge(self, folder: Path | None = None) -> Judge:
        """Returns the run's judge, or the one in another folder.

        Raises:
            UserError: there is no judge, or its frames differ in size from the run's.
        """
        return load_judge(folder or self.run / FOLDER, self.config.clips.image_size)

    def first_frames(self, count: int) -> list[FirstFrame]:
        """Returns the first frames of training clips that begin as their episodes do, with depth if they have it.

        At most ``count``, all different: paired grasps begin with the same frame.

        Raises:
            UserError: no clip begins as its episode does.
        """
        starts: dict[bytes, FirstFrame] = {}
        for number, clip in readable(self.clips.source("train")):
            if len(starts) == count:
                break
            if begins_episode(clip):
                rgb = clip["rgb"][0]
                depth = None if clip["depth"] is None else clip["depth"][0]
                starts.setdefault(rgb.tobytes(), FirstFrame(rgb, depth, number, number))
        if not starts:
            raise UserError(f"{self.clips.path}: no training clip begins as its episode does, so nothing can start")
        return list(starts.values())

    def demos(self, only: Only = "success", seed: int = 0) -> Demos:
        """Returns the run's training clips as demonstrations."""
        return load_demos(self.clips, ["train"], only, seed)


def with_clips(run: Path, cure: str = "") -> Path:
    """Returns the directory of a run, which knows the clips of its training.

    Args:
        cure: what else could be done without them.

    Raises:
        UserError: it is a saved model, which has a few held-out clips at most.
    """
    if is_saved(locate(run)):
        raise UserError(
            f"{run}: a saved model, without the clips of its training; name a run directory, which rsjax train "
            f"makes{cure}"
        )
    return run


def synthetic_demos(path: Path, run: Path) -> Demos:
    """Returns the demonstrations that ``rsjax synthesize`` made.

    Raises:
        UserError: there are none.
    """
    if not path.exists():
        raise UserError(f"{path}: not there; make synthetic demonstrations with rsjax synthesize {run}")
    return load_demos(open_store(path), ["train"])


def sized_policy(size: str, steps: int) -> PolicyConfig:
    """Returns the policy settings of a named size, with another number of training steps if one is given.

    Raises:
        ConfigError: there is no such size.
    """
    config = policy_preset(size)
    if steps:
        return replace(config, train=replace(config.train, steps=steps))
    return config


def named(runs: Sequence[Path]) -> dict[str, Path]:
    """Names each run by the shortest end of its path that tells the runs apart, and from other folders of results.

    Raises:
        UserError: two runs are the same.
    """
    for parts in range(1, 8):
        names = ["-".join(run.absolute().parts[-parts:]) for run in runs]
        if len(set(names) - TAKEN) == len(names):
            return dict(zip(names, runs, strict=True))
    raise UserError(f"two of the runs {', '.join(map(str, runs))} are the same; name each once")


def training_of(policy: Path) -> str:
    """Returns the directory of the training that a policy's directory is from: of ``at-50``, the one it is in."""
    place = policy.absolute()
    if place.name.startswith("at-"):
        place = place.parent
    return str(place)


def replicates(runs: Mapping[str, RunData]) -> dict[str, str]:
    """Returns for each run the name of the first run that differs from it in the seeds of its trainings alone."""
    first: dict[str, str] = {}
    by_key = {}
    for name, run in runs.items():
        config = run.config
        data = config.data or replace(config.sim, seed=0)
        settings = json.dumps(training_settings(config), sort_keys=True)
        key = content_key(settings, config.model, config.prompt_frames, data)
        by_key[name] = first.setdefault(key, name)
    return by_key
