"""One client's episode in the served world, and what each of its messages asks for.

Axes: T frames, S×S pixels, A action dimensions.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from rsjax.errors import UserError, did_you_mean
from rsjax.models.trained import as_array
from rsjax.tools.policies.worlds.actions import ActionRange
from rsjax.tools.policies.worlds.environments import WorldModelEnv
from rsjax.tools.serve.wire import WireError

START = ("seed", "clip", "rgb", "depth", "draw")  # fields that choose an episode's first frame and draws


class ClientSession:
    """The episode of one client.

    Args:
        make: makes an environment whose steps are shared with those of other clients.
        most_frames: frames of an episode or of a generated video, at most.
        check_present: raises once the client has left.
    """

    def __init__(self, make: Callable[[], WorldModelEnv], most_frames: int, check_present: Callable[[], None]) -> None:
        self._make = make
        self._most = most_frames
        self._check_present = check_present
        self._env = make()
        self._frame = -1  # number of the current one; -1 before the first reset
        self._answers = {"reset": self.reset, "step": self.step, "generate": self.generate}

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        """Does what a message asks for.

        Raises:
            UserError: the message names no endpoint, or a field is unknown, missing or wrong; the episode goes on.
        """
        name = message.get("endpoint")
        if not isinstance(name, str) or name not in self._answers:
            raise WireError(f"endpoint is {name!r:.40}; it is one of {', '.join(self._answers)}")
        return self._answers[name]({key: value for key, value in message.items() if key != "endpoint"})

    def reset(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Begins an episode."""
        _check_names(fields, START)
        observation, info = _begin(self._env, fields)
        self._frame = 0
        return observation | info | {"frame": 0}

    def step(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Generates the episode's next frame."""
        _check_names(fields, ("action",))
        if self._frame < 0:
            raise WireError("a step comes after a reset")
        if self._frame + 1 >= self._most:
            raise WireError(f"this episode has had its {self._most} frames; reset")
        observation, reward, terminated, truncated, info = self._env.step(fields.get("action"))
        self._frame += 1
        facts = {"frame": self._frame, "reward": reward, "terminated": terminated, "truncated": truncated}
        return observation | info | facts

    def generate(self, fields: dict[str, Any]) -> dict[str, Any]:
        """Generates a whole video; the client's episode stays as it is.

        The field "actions" is (T, A); row t leads into frame t, and row 0 is not read.
        """
        _check_names(fields, ("actions", *START))
        rows = as_array("actions", fields.pop("actions", None))
        if rows.ndim != 2 or not 2 <= len(rows) <= self._most:
            raise WireError(f"actions have shape {rows.shape}; expected (T, A) with T from 2 to {self._most}")
        env = self._make()
        space: Any = env.action_space
        allowed = ActionRange(space.low, space.high, "in the units of the clips' actions")
        allowed.clip(rows, len(rows), ignored=np.arange(len(rows)) == 0)  # refuses wrong rows before any is generated
        observation, info = _begin(env, fields)
        frames = [observation]
        success = [bool(info["success"])]
        for row in rows[1:]:
            self._check_present()
            observation, _, _, _, info = env.step(row)
            frames.append(observation)
            success.append(bool(info["success"]))
        video: dict[str, Any] = {name: np.stack([frame[name] for frame in frames]) for name in observation}
        return video | {"success": np.array(success), "clipped": info["clipped"], "clip": info["clip"]}


def _begin(env: WorldModelEnv, fields: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Resets an environment as the fields of a message say."""
    if "rgb" in fields and "clip" in fields:
        raise WireError("an episode begins with a clip or with rgb, not with both")
    options = dict(fields)
    seed = options.pop("seed", None)
    return env.reset(seed=seed, options=options)


def _check_names(fields: dict[str, Any], known: tuple[str, ...]) -> None:
    for name in fields:
        if name not in known:
            raise UserError(f"unknown field {name!r:.40}{did_you_mean(name, known)} (fields: {', '.join(known)})")
