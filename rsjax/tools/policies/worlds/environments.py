"""The worlds as Gymnasium environments: ``gymnasium.make("rsjax/WorldModel-v0", run="runs/tiny")`` (docs/policies.md).

Axes: S×S pixels, A action dimensions.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, UInt8

from rsjax.config import SimConfig
from rsjax.data.state_labels import STATE
from rsjax.errors import UserError, did_you_mean
from rsjax.files import checked_path
from rsjax.model_directory import locate
from rsjax.models.base import Imagination
from rsjax.models.load_run import load, load_config, load_normalization
from rsjax.models.trained import TrainedModel
from rsjax.runtime import keep_compiled_programs
from rsjax.tools.policies.judges.head_judge import NAME as HEAD
from rsjax.tools.policies.judges.head_judge import HeadJudge, head_judge
from rsjax.tools.policies.judges.judge import LABELS, Judge
from rsjax.tools.policies.judges.judge_training import judge_of
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.worlds.actions import OutOfRange, action_range, check_out_of_range, check_world_model
from rsjax.tools.policies.worlds.arguments import check_render_mode, checked_count, checked_seed
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.policies.worlds.starts import Starts
from rsjax.tools.policies.worlds.world import Observation, WorldState
from rsjax.tools.sim.expert import LiftState

FAR = 10.0  # metres; nothing that the simulator's cameras see is farther
MOST_STEPS = 10**6  # of an episode
MOST_ENVIRONMENTS = 2**16
STEPS = 30  # default length of an episode: 6 s at 5 frames per second
DEFAULT = SimConfig(camera="near")


@dataclass(frozen=True)
class EnvironmentSettings:
    """Settings of an environment in a world model.

    Attributes:
        data_dir: the directory of simulated data sets, where a run on simulated clips finds its first frames.
        store: the new path of the run's store of ingested clips, if it was moved.
        split: the clips whose first frames episodes begin with.
        max_steps: steps after which an episode is truncated; it may be longer than the model's window.
        judge: decides reward and termination: a judge, the directory of a trained one, "run" for the judge that
            ``rsjax judge`` trained for the run, if any, or "head" for the model's own success head. Without a
            judge, every reward is 0.
        out_of_range: whether actions outside the action space are clipped and counted ("clip"), or raise ("refuse").
        depth: whether observations have depth, if the model generates it. Without, a step takes less time and gives
            the same RGB; the model still reads the first frame's depth.
    """

    data_dir: Path | str = "data"
    store: Path | str | None = None
    split: str = "test"
    max_steps: int = STEPS
    judge: Judge | Path | str | None = "run"
    out_of_range: OutOfRange = "clip"
    depth: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.depth, bool):
            raise UserError(f"depth is {self.depth!r:.80}; it is True or False")
        checked_count("max_steps", self.max_steps, MOST_STEPS)
        check_out_of_range(self.out_of_range)
        checked_path(self.data_dir, "data_dir")
        if self.store is not None:
            checked_path(self.store, "store")
        if not isinstance(self.split, str):
            raise UserError(f"split is {self.split!r:.80}; give the name of a split, such as test")
        if self.judge is not None and not isinstance(self.judge, str | Path) and not callable(self.judge):
            raise UserError(f"judge is {self.judge!r:.80}; give a judge, the directory of one, 'run', 'head' or None")

    @classmethod
    def read(cls, values: dict[str, Any]) -> "EnvironmentSettings":
        """Returns the settings of these names and values.

        Raises:
            UserError: there is no such setting, or its value is not allowed.
        """
        known = [field.name for field in fields(cls)]
        for name in values:
            if name not in known:
                hint = did_you_mean(name, known)
                raise UserError(f"an environment has no setting {name}{hint} (settings: {', '.join(known)})")
        return cls(**values)


class _Model:
    """The parts that both environments of a world model need: its world, first frames and spaces."""

    def __init__(
        self,
        run: Path | str | TrainedModel | RunData,
        count: int,
        settings: EnvironmentSettings,
        imagination: Imagination | None = None,
    ) -> None:
        if isinstance(run, TrainedModel):
            config = run.config
            normalization = run.assets.normalization
            folder = run.directory or Path(".")
            name = "the model"
        elif isinstance(run, RunData):
            config = run.trained.config
            normalization = run.trained.assets.normalization
            folder = run.run
            name = f"{folder}: the model"
        else:
            folder = locate(checked_path(run, "run"))
            config = load_config(folder)
            normalization = load_normalization(folder)
            name = f"{run}: the model"
        check_world_model(config, name)
        size = config.clips.image_size
        depth_range = normalization.depth_range
        has_depth = config.model.uses_depth and depth_range is not None
        if settings.store:
            store = Path(settings.store)
        else:
            store = None
        self.starts = Starts(config, folder, Path(settings.data_dir), store, settings.split, has_depth)
        actions = action_range(config, normalization)
        self.action_space = spaces.Box(actions.low, actions.high)
        observation: dict[str, spaces.Space[Any]] = {"rgb": spaces.Box(0, 255, (size, size, 3), np.uint8)}
        if has_depth and settings.depth:
            observation["depth"] = spaces.Box(0.0, max(FAR, depth_range[1]), (size, size))  # type: ignore[index]
        self.observation_space = spaces.Dict(observation)
        self._world: ModelWorld | None = None
        if not _forked:  # neither JAX nor TensorStore works in a forked process; the first reset says so
            keep_compiled_programs()
            if isinstance(run, RunData):
                trained = run.trained
            elif isinstance(run, TrainedModel):
                trained = run
            else:
                trained = load(run)
            judge: Judge | HeadJudge | None
            if settings.judge == HEAD:
                judge = head_judge(trained, folder)
            else:
                judge = judge_of(run if isinstance(run, TrainedModel) else folder, settings.judge, size)
            self._world = ModelWorld(
                trained, count, judge, whole_videos=False, imagination=imagination, depth=settings.depth
            )

    @property
    def world(self) -> ModelWorld:
        """The world.

        Raises:
            UserError: this process was forked from one that had the environment.
        """
        if self._world is None:
            raise UserError(
                "a world model cannot run in a forked process: start processes anew, with "
                'gymnasium.make_vec(…, vectorization_mode="async", vector_kwargs={"context": "spawn"}), or leave out '
                "vectorization_mode: then one program steps all environments"
            )
        return self._world


_forked = False


def _note_fork() -> None:
    global _forked
    _forked = True


os.register_at_fork(after_in_child=_note_fork)


def _info(state: WorldState, clipped: np.ndarray, clip: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the ``info`` of episodes in a world model: success, the judge's label and verdict, and the counts.

    With state heads it has the object's height and the gripper's opening too, in metres.
    """
    labels = ["unjudged"] * len(state.success)
    verdict = np.zeros((len(labels), len(LABELS)))
    if state.verdict is not None:
        labels = [LABELS[number] for number in state.verdict.argmax(-1)]
        verdict = state.verdict
    info = {
        "success": state.success,
        "label": np.array(labels, object),
        "verdict": verdict,
        "clipped": clipped.copy(),
        "clip": clip.copy(),
    }
    if state.read is not None:
        info |= {name: state.read[:, STATE.index(name)] for name in ("height", "opening")}
    return info


class WorldModelEnv(gymnasium.Env[Any, Any]):
    """One episode in the world model of a run. docs/policies.md has the details.

    The observation is a generated frame, {"rgb": uint8 (S, S, 3), "depth": float32 (S, S), metres}, without "depth" if
    the model generates none. A step is one frame at the clips' rate, and its action is like a row of a clip's actions.
    When the judge says "success", the reward is 1 and the episode terminates.

    Args:
        run: a run directory of rsjax train, a saved model, or a model that ``rsjax.load`` loaded.
        render_mode: "rgb_array", or None.
        imagination: generates the frames; by default the model itself, in this process.
        settings: fields of :class:`EnvironmentSettings`.

    Raises:
        UserError: the run is missing or unfinished, its model takes no actions or cannot generate frame by frame, or
            the judge is missing, damaged or takes frames of another size.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's own type

    def __init__(
        self,
        run: Path | str | TrainedModel | RunData,
        render_mode: str | None = None,
        imagination: Imagination | None = None,
        **settings: Any,
    ) -> None:
        check_render_mode(render_mode, self.metadata)
        self._settings = EnvironmentSettings.read(settings)
        model = _Model(run, 1, self._settings, imagination)
        self._model = model
        self._starts = model.starts
        self._frame: np.ndarray | None = None
        self._clipped = 0
        self._steps = 0
        self.render_mode = render_mode
        self.action_space = model.action_space
        self.observation_space = model.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode with the first frame of a clip, by default a random one of the test split.

        Args:
            seed: determines the choice of clips and the model's draws.
            options: "clip", the number of a clip, or "rgb" and "depth", a frame; "draw", a number that determines the
                model's draws (0 gives the video of ``TrainedModel.generate``).

        Raises:
            StartError: the given frame does not fit, or the run's clips are missing.
        """
        super().reset(seed=checked_seed(seed))
        world = self._model.world  # before clips are read, which kills a forked process
        start = self._starts.choose(self.np_random, {} if options is None else options)
        self._clip = start.clip
        self._clipped = 0
        self._steps = 0
        return self._seen(world.reset([start]))

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Generates the next frame.

        Args:
            action: (A,), in the recording's units.

        Returns:
            Observation, reward, terminated, truncated, and info: "success", "label", "verdict" (probabilities),
            "clipped" (numbers clipped in this episode), "clip", and "action", the action after clipping.

        Raises:
            ActionError: the action has the wrong shape or a value that is not finite, or is refused as out of range.
        """
        if self._frame is None:
            raise gymnasium.error.ResetNeeded("reset the environment before its first step")
        row, outside = self._model.world.actions.clip(action, None, self._settings.out_of_range)
        state = self._model.world.step(row[None])
        self._clipped += int(outside.sum())
        self._steps += 1
        observation, info = self._seen(state)
        success = bool(state.success[0])
        over = self._steps >= self._settings.max_steps
        return observation, float(success), success, over, info | {"action": row}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Returns the current frame; None without a render mode."""
        if self.render_mode:
            return self._frame
        return None

    def _seen(self, state: WorldState) -> tuple[Observation, dict[str, Any]]:
        observation = {name: frames[0] for name, frames in state.observation.items()}
        self._frame = observation["rgb"]
        info = _info(state, np.array([self._clipped]), np.array([self._clip]))
        return observation, {name: values[0] for name, values in info.items()}


class WorldModelVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """``num_envs`` environments like :class:`WorldModelEnv`, all stepped by one compiled program.

    An environment whose episode ended restarts in the next step and ignores that step's action (Gymnasium's NEXT_STEP
    mode). The values in ``info`` are arrays over the environments.

    Args:
        run: a run directory of rsjax train, or a model that ``rsjax.load`` loaded.
        num_envs: the number of environments.
        settings: fields of :class:`EnvironmentSettings`.

    Raises:
        UserError: the run is missing or unfinished, or its model takes no actions or cannot generate frame by frame.
    """

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's own type

    def __init__(self, run: Path | str | TrainedModel, num_envs: int = 1, **settings: Any) -> None:
        num_envs = checked_count("num_envs", num_envs, MOST_ENVIRONMENTS)
        self._settings = EnvironmentSettings.read(settings)
        model = _Model(run, num_envs, self._settings)
        self._model = model
        self._starts = model.starts
        self.num_envs = num_envs
        self.single_action_space = model.action_space
        self.single_observation_space = model.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._steps = np.zeros(num_envs, int)
        self._clipped = np.zeros(num_envs, int)
        self._clip = np.full(num_envs, -1)
        self._over = np.zeros(num_envs, bool)
        self._rng: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins all episodes, with arguments as for one environment; environment i takes the seed + i.

        From a list of seeds, each environment takes its own. The options apply to all.

        Raises:
            UserError: there are more or fewer seeds than environments.
            StartError: the given frame does not fit, or the run's clips are missing.
        """
        if seed is not None or not self._rng:
            count = self.num_envs
            seeds: list[int | None]
            if seed is None:
                seeds = [None] * count
            elif not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str) or getattr(seed, "ndim", 1) != 1:
                first = checked_seed(seed)
                assert first is not None
                seeds = [first + number for number in range(count)]
            else:
                seeds = [checked_seed(each) for each in seed]
            if len(seeds) != count:
                raise UserError(
                    f"{len(seeds)} seeds for {count} environments; give one number, or one for each environment"
                )
            self._rng = [np.random.default_rng(each) for each in seeds]
        everything = np.ones(self.num_envs, bool)
        state = self._model.world.reset(self._begin(everything, {} if options is None else options))
        self._over[:] = False
        return state.observation, _masked(_info(state, self._clipped, self._clip))

    def step(self, actions: Any) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Generates the next frame of every episode; episodes that ended restart instead.

        Args:
            actions: (num_envs, A), in the recording's units.

        Raises:
            ActionError: the actions have the wrong shape, or an episode that does not restart has a value that is not
                finite or is refused as out of range.
        """
        if not self._rng:
            raise gymnasium.error.ResetNeeded("reset the environments before their first step")
        again = self._over
        rows, outside = self._model.world.actions.clip(actions, self.num_envs, self._settings.out_of_range, again)
        state = self._model.world.step(rows, ignored=again)
        self._clipped += outside.sum(1)
        self._steps += 1
        if again.any():
            state = self._model.world.reset(self._begin(again, {}), which=again)
        success = state.success & ~again
        truncated = self._steps >= self._settings.max_steps
        self._over = success | truncated
        info = _info(state, self._clipped, self._clip) | {"action": rows}
        return state.observation, success.astype(np.float64), success, truncated, _masked(info)

    def restart(self, which: Bool[np.ndarray, " B"]) -> Observation:
        """Begins new episodes in these environments now, and returns the observations of all."""
        state = self._model.world.reset(self._begin(which, {}), which=which)
        self._over[which] = False
        return state.observation

    def _begin(self, which: np.ndarray, options: dict[str, Any]) -> list[FirstFrame]:
        """Chooses first frames for these environments, and sets their counts back."""
        starts = [self._starts.choose(self._rng[number], options) for number in np.flatnonzero(which)]
        self._steps[which] = 0
        self._clipped[which] = 0
        self._clip[which] = [start.clip for start in starts]
        return starts


def _masked(info: dict[str, np.ndarray]) -> dict[str, Any]:
    """Adds Gymnasium's masks, which say that every environment has each value."""
    return info | {f"_{name}": np.ones(len(values), bool) for name, values in info.items()}


class LiftEnv(gymnasium.Env[Any, Any]):
    """Lift as a Gymnasium environment that steps from frame to frame of a clip. Call :meth:`close` when done.

    The observation is the frame. When the cube is lifted, the reward is 1 and the episode terminates.

    Args:
        config: image size, camera and control steps per frame, as for the clips (``load_config(run).sim``).
        max_steps: steps after which an episode is truncated.
        out_of_range: whether actions beyond ±1 are clipped and counted ("clip"), or raise an error ("refuse").
        render_mode: "rgb_array", or None.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera, or the clips are of another simulator.
        UserError: another argument is not allowed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's own type

    def __init__(
        self,
        config: SimConfig = DEFAULT,
        max_steps: int = STEPS,
        out_of_range: OutOfRange = "clip",
        render_mode: str | None = None,
    ) -> None:
        if not isinstance(config, SimConfig):
            raise UserError(f"config is {config!r:.80}; give a SimConfig, such as load_config(run).sim")
        checked_count("max_steps", max_steps, MOST_STEPS)
        check_out_of_range(out_of_range)
        check_render_mode(render_mode, self.metadata)
        self._world = SimulatorWorld.lift(config, 1)
        self._max_steps = max_steps
        self._out_of_range = out_of_range
        self._frame: np.ndarray | None = None
        self._steps = 0
        self._clipped = 0
        self.render_mode = render_mode
        size = config.image_size
        self.action_space = spaces.Box(-1.0, 1.0, (config.action_dim,))
        self.observation_space: Any = spaces.Dict(
            rgb=spaces.Box(0, 255, (size, size, 3), np.uint8), depth=spaces.Box(0.0, FAR, (size, size))
        )

    @property
    def success(self) -> bool:
        """Whether the cube is lifted now, by the simulator's own predicate."""
        return self._world.simulators[0].success

    @property
    def state(self) -> LiftState:
        """The places of gripper and cube, for scripted policies."""
        state: LiftState = self._world.simulators[0].state
        return state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode; the seed (0 … 2³² - 1) determines the arm's start and the cube's place.

        If there is no seed, one is drawn from the generator that the last seed started. There are no options.

        Raises:
            UserError: the seed is not allowed, or there are options.
        """
        seed = checked_seed(seed)
        if options is not None and (not isinstance(options, dict) or options):
            raise UserError(f"options are {options!r:.80}; an episode in the simulator has none, only a seed")
        super().reset(seed=seed)
        if seed is None:
            start = int(self.np_random.integers(2**32))
        else:
            start = seed
        state = self._world.reset([start])
        self._steps = 0
        self._clipped = 0
        return self._seen(state), {"success": bool(state.success[0]), "clipped": 0}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Runs one frame's control steps.

        Args:
            action: (A,), like a row of a clip's actions; or a control, which is called at each control step.

        Returns:
            Observation, reward, terminated, truncated, and info: "success", "clipped" (numbers clipped in this episode)
            and "action", the action after clipping.

        Raises:
            ActionError: the action has the wrong shape or a value that is not finite, or is refused as out of range.
            ArithmeticError: the simulation diverged.
        """
        if self._frame is None:
            raise gymnasium.error.ResetNeeded("reset the environment before its first step")
        if callable(action):
            state = self._world.step([action])
        else:
            row, outside = self._world.actions.clip(action, None, self._out_of_range)
            state = self._world.step(row[None])
            self._clipped += int(outside.sum())
        if self._world.diverged:
            raise self._world.diverged[0]
        self._steps += 1
        success = bool(state.success[0])
        info = {"success": success, "clipped": self._clipped, "action": state.actions[0]}
        return self._seen(state), float(success), success, self._steps >= self._max_steps, info

    def render(self) -> UInt8[np.ndarray, "S S 3"] | None:  # type: ignore[override]
        """Returns the current frame; None without a render mode."""
        if self.render_mode:
            return self._frame
        return None

    def close(self) -> None:
        """Frees the renderer and the simulation."""
        self._world.close()

    def _seen(self, state: WorldState) -> Observation:
        observation = {name: frames[0] for name, frames in state.observation.items()}
        self._frame = observation["rgb"]
        return observation
