"""Many episodes in a trained world model, batched on the device, as a Gymnasium vector environment."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from rsjax.errors import UserError
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.episodes import Episodes, Settings
from rsjax.tools.policies.simulator import Observation


class WorldModelVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """``num_envs`` environments like :class:`WorldModelEnv`, all stepped by one compiled program.

    An environment whose episode ended restarts in the next step and ignores that step's action (Gymnasium's NEXT_STEP
    mode). The values in ``info`` are arrays over the environments.

    Args:
        run: a run directory of experiments.train, or a model that ``rsjax.load`` loaded.
        num_envs: the number of environments.
        settings: fields of :class:`rsjax.tools.policies.episodes.Settings`.

    Raises:
        UserError: the run is missing or unfinished, or its model takes no actions or cannot generate frame by frame.
    """

    metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's own type

    def __init__(self, run: Path | str | TrainedModel, num_envs: int = 1, **settings: Any) -> None:
        self._episodes = Episodes(run, num_envs, Settings(**settings))
        self.num_envs = num_envs
        self.single_action_space = self._episodes.action_space
        self.single_observation_space = self._episodes.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
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
            self._rng = [np.random.default_rng(each) for each in _seeds(seed, self.num_envs)]
        self._over[:] = False
        seen = self._episodes.restart(np.ones(self.num_envs, bool), self._rng, options or {})
        return seen, _marked(self._episodes.info(self._episodes.verdict()))

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
        made = self._episodes.step(actions, again)
        seen, info, success, over = made.seen, made.info, made.success, made.over
        if again.any():
            first = self._episodes.restart(again, [self._rng[i] for i in np.flatnonzero(again)], {})
            for name, values in first.items():
                seen[name] = seen[name].copy()  # jax's own arrays cannot be written
                seen[name][again] = values
            info |= self._episodes.info(self._episodes.verdict())
            success, over = success & ~again, over & ~again
        self._over = success | over
        return seen, success.astype(np.float64), success, over, _marked(info)


def _seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """Returns the seed of each environment."""
    if seed is None:
        return [None] * count
    seeds: list[int | None]
    seeds = [int(seed) + i for i in range(count)] if np.isscalar(seed) else list(seed)  # type: ignore[arg-type]
    if len(seeds) != count:
        raise UserError(f"{len(seeds)} seeds for {count} environments; give one number, or one for each environment")
    return seeds


def _marked(info: dict[str, np.ndarray]) -> dict[str, Any]:
    """Adds Gymnasium's masks, which say that every environment has each value."""
    return info | {f"_{name}": np.ones(len(values), bool) for name, values in info.items()}
