"""The batched world model as a ``VecEnv`` of stable-baselines3, which steps all its environments in one program.

Gymnasium's environments restart an episode in the step after its end. A ``VecEnv`` restarts it in the step that ends
it: the observation is the next episode's first, and the last one is in ``info["terminal_observation"]``.

Axes: B environments, A action dimensions.
"""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.errors import UserError
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.worlds.environments import WorldModelVectorEnv


def vec_env(run: Path | str | TrainedModel, num_envs: int = 1, **settings: Any) -> Any:
    """Returns a ``VecEnv`` of environments like :class:`WorldModelVectorEnv`, whose arguments and errors it has.

    Raises:
        UserError: in addition, stable-baselines3 is not installed.
    """
    try:
        base = import_module("stable_baselines3.common.vec_env").VecEnv
    except ImportError as error:
        raise UserError(f"a VecEnv needs stable-baselines3 ({error}); pip install stable-baselines3") from error

    class WorldModelVecEnv(base):  # type: ignore[misc,valid-type]
        def __init__(self, many: WorldModelVectorEnv) -> None:
            self.many = many
            self.render_mode = None
            super().__init__(many.num_envs, many.single_observation_space, many.single_action_space)

        def reset(self) -> Any:
            seeds = None
            if any(seed is not None for seed in self._seeds):
                seeds = self._seeds
            observation, info = self.many.reset(seed=seeds, options=self._options[0])
            self.reset_infos = _rows(info, self.num_envs)
            self._reset_seeds()
            self._reset_options()
            return observation

        def step_async(self, actions: np.ndarray) -> None:
            self._actions = actions

        def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            observation, reward, terminated, truncated, info = self.many.step(self._actions)
            over = terminated | truncated
            infos = _rows(info, self.num_envs)
            if over.any():
                last = {name: np.array(frames) for name, frames in observation.items()}
                observation = self.many.restart(over)
                for number in np.flatnonzero(over).tolist():
                    infos[number]["terminal_observation"] = {name: frames[number] for name, frames in last.items()}
                    infos[number]["TimeLimit.truncated"] = bool(truncated[number] and not terminated[number])
            return observation, reward.astype(np.float32), over, infos

        def close(self) -> None:
            self.many.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(self.many, attr_name)] * len(self._chosen(indices))

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise UserError(f"{attr_name} cannot be set: all environments of this VecEnv share one program")

        def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
            raise UserError(f"{method_name} cannot be called: all environments of this VecEnv share one program")

        def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
            return [False] * len(self._chosen(indices))

        def _chosen(self, indices: int | Sequence[int] | None) -> Sequence[int]:
            if indices is None:
                return range(self.num_envs)
            if isinstance(indices, int):
                return [indices]
            return indices

    return WorldModelVecEnv(WorldModelVectorEnv(run, num_envs, **settings))


def _rows(info: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Returns the values of each environment, without Gymnasium's masks."""
    values = {name: column for name, column in info.items() if not name.startswith("_")}
    return [{name: column[number] for name, column in values.items()} for number in range(count)]
