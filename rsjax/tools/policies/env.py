"""A trained world model as a Gymnasium environment: ``gymnasium.make("rsjax/WorldModel-v0", run="runs/tiny")``."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.episodes import Episodes, Settings
from rsjax.tools.policies.simulator import Observation


class WorldModelEnv(gymnasium.Env[Any, Any]):
    """One episode in the world model of a run. docs/policies.md has the details.

    The observation is a generated frame, {"rgb": uint8 (S, S, 3), "depth": float32 (S, S), metres}, without "depth" if
    the model generates none. A step is one frame at the clips' rate, and its action is like a row of a clip's actions.
    When the judge says "success", the reward is 1 and the episode terminates.

    Args:
        run: a run directory of experiments.train, or a model that ``rsjax.load`` loaded.
        render_mode: "rgb_array", or None.
        settings: fields of :class:`rsjax.tools.policies.episodes.Settings`.

    Raises:
        UserError: the run is missing or unfinished, or its model takes no actions or cannot generate frame by frame.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 - Gymnasium's own type

    def __init__(self, run: Path | str | TrainedModel, render_mode: str | None = None, **settings: Any) -> None:
        self._episodes = Episodes(run, None, Settings(**settings))
        self._frame: np.ndarray | None = None
        self.render_mode = render_mode
        self.action_space = self._episodes.action_space
        self.observation_space = self._episodes.observation_space

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
        super().reset(seed=seed)
        seen = self._episodes.restart(np.ones(1, bool), [self.np_random], options or {})
        return self._only(seen), self._only(self._episodes.info(self._episodes.verdict()))

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
        made = self._episodes.step(action)
        success = bool(made.success[0])
        return self._only(made.seen), float(success), success, bool(made.over[0]), self._only(made.info)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Returns the current frame; None without a render mode."""
        return self._frame if self.render_mode else None

    def _only(self, batched: dict[str, np.ndarray]) -> dict[str, Any]:
        if "rgb" in batched:
            self._frame = batched["rgb"][0]
        return {name: values[0] for name, values in batched.items()}
