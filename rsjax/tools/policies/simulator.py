"""Lift in the simulator as a closed loop at the clips' frame rate, so that a policy can act in what clips recorded.

One step is one frame. An action is like a clip's: ``control_steps`` controls of 7 numbers (docs/policies.md). Frames
are rendered as in clips, so replaying a clip's actions from the clip's start reproduces its frames.

Axes: T frames, S×S pixels, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Float32, UInt8

from rsjax.config import SimConfig, require
from rsjax.tools.policies.actions import OutOfRange, check_out_of_range, checked_actions
from rsjax.tools.sim.expert import Expert, Manner
from rsjax.tools.sim.lift import LiftSim, State

Observation: TypeAlias = dict[str, np.ndarray]  # "rgb": uint8 (S, S, 3); "depth": float32 (S, S), metres
Control: TypeAlias = Callable[[State], Float[np.ndarray, " 7"]]  # from the simulator's state, at each control step
Actor: TypeAlias = Callable[[Observation], Any]  # the policy of one episode; it returns a frame's action, or a control
UNIT = "6-D change of the goal pose and gripper (+1 closes) for each control step, from -1 to 1"
FAR = 10.0  # metres; nothing that the simulator's cameras see is farther
DEFAULT = SimConfig(camera="near")
STEPS = 30  # default length of an episode: 6 s at 5 frames per second


def clip_seed(provenance: dict[str, Any]) -> int:
    """Returns the seed with which :meth:`LiftEnv.reset` starts where a simulated clip started."""
    return int(np.random.default_rng([provenance["seed"], provenance["episode"]]).integers(2**32))


def skilled_expert(seed: int) -> Expert:
    """Returns a scripted expert that always tries to lift: fast, without noise, and centred on the cube."""
    manner = Manner("lift", 1.0, 0.0, 0.0, 0, 0.06, (0.0, 0.0, -0.004), 6, (0.03, 0.0, 0.15), -1)
    return Expert(manner, np.random.default_rng(seed))


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
        UserError: ``out_of_range`` is neither of the two.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's own type

    def __init__(
        self,
        config: SimConfig = DEFAULT,
        max_steps: int = STEPS,
        out_of_range: OutOfRange = "clip",
        render_mode: str | None = None,
    ) -> None:
        require(config.env == "lift", f"sim.env is {config.env}; only lift can be acted in so far")
        check_out_of_range(out_of_range)
        size = config.image_size
        self._config, self._max_steps, self._out_of_range = config, max_steps, out_of_range
        self._sim = LiftSim(config.camera, size)
        self._steps, self._clipped = 0, 0
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (config.action_dim,))
        self.observation_space: Any = spaces.Dict(
            rgb=spaces.Box(0, 255, (size, size, 3), np.uint8), depth=spaces.Box(0.0, FAR, (size, size))
        )

    @property
    def success(self) -> bool:
        """Whether the cube is lifted now, by the simulator's own predicate."""
        return self._sim.success

    @property
    def state(self) -> State:
        """Where gripper and cube are, for scripted policies."""
        return self._sim.state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode; the seed (0 … 2³² - 1) determines the arm's start and the cube's place.

        If there is no seed, one is drawn from the generator that the last seed started.
        """
        super().reset(seed=seed)
        self._sim.reset(int(self.np_random.integers(2**32)) if seed is None else seed)
        self._steps, self._clipped = 0, 0
        return self._observe(), {"success": self.success, "clipped": 0}

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
        done = np.zeros((self._config.control_steps, 7), np.float32)
        if not callable(action):
            box = self.action_space
            assert isinstance(box, spaces.Box)
            flat, clipped = checked_actions(action, box.low, box.high, self._out_of_range, UNIT)
            done, self._clipped = flat.reshape(done.shape), self._clipped + int(clipped.sum())
        for number in range(len(done)):
            if callable(action):
                done[number] = action(self._sim.state)
            self._sim.step(done[number])
        self._steps += 1
        success = self.success
        info = {"success": success, "clipped": self._clipped, "action": done.reshape(-1)}
        return self._observe(), float(success), success, self._steps >= self._max_steps, info

    def render(self) -> UInt8[np.ndarray, "S S 3"] | None:  # type: ignore[override]
        """Returns the current frame; None without a render mode."""
        return self._sim.render().rgb if self.render_mode else None

    def close(self) -> None:
        """Frees the renderer and the simulation."""
        self._sim.close()

    def _observe(self) -> Observation:
        view = self._sim.render()
        return {"rgb": view.rgb, "depth": view.depth}


@dataclass(frozen=True)
class Episode:
    """The record of one episode in an environment.

    Attributes:
        rgb: all frames, including the first one.
        depth: of the same frames, metres; None if the environment has none.
        actions: row t led to frame t; row 0 is zeros, as in clips.
        success: whether the task was done at each frame.
        clipped: how many numbers of the actions were clipped to their range.
        uninterpretable: whether the judge cannot interpret the last frame.
    """

    rgb: UInt8[np.ndarray, "T S S 3"]
    depth: Float32[np.ndarray, "T S S"] | None
    actions: Float32[np.ndarray, "T A"]
    success: Bool[np.ndarray, " T"]
    clipped: int
    uninterpretable: bool = False


def run_episode(env: gymnasium.Env[Any, Any], act: Actor, seed: int, options: dict[str, Any] | None = None) -> Episode:
    """Runs one episode until it is terminated or truncated.

    Args:
        env: an environment of this package.
        act: the policy, fresh for this episode.
        seed: for :meth:`gymnasium.Env.reset`.
        options: for the same call.
    """
    seen, info = env.reset(seed=seed, options=options)
    frames, actions, success, over = [seen], [], [bool(info["success"])], False
    while not over:
        seen, _, terminated, truncated, info = env.step(act(seen))
        frames.append(seen)
        actions.append(info["action"])
        success.append(bool(info["success"]))
        over = terminated or truncated
    depth = np.stack([frame["depth"] for frame in frames]) if "depth" in seen else None
    rows = np.stack([np.zeros_like(actions[0]), *actions])
    return Episode(np.stack([frame["rgb"] for frame in frames]), depth, rows, np.array(success), info["clipped"])
