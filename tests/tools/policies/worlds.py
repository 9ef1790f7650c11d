"""Worlds of one dot that moves right or left, whose episodes succeed when it comes to the right edge."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from rsjax.clip import Video
from rsjax.files import write_json
from rsjax.tools.policies.config import toy as toy_size
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy
from rsjax.tools.policies.rollouts import Imagined, Simulated
from tests.tools.policies.toy import CONTROLS, RANGE, SIZE, WIDTH, picture

MODEL = DiffusionPolicy(toy_size(), SIZE, CONTROLS, WIDTH)


class ToyEnv:
    """Moves the dot by the sum of an action's first numbers, like :class:`rsjax.tools.policies.simulator.LiftEnv`."""

    def __init__(self, goal: float = 10.0) -> None:
        self.action_space = spaces.Box(-RANGE, RANGE, (CONTROLS * WIDTH,))
        self._goal, self.steps, self.closed = goal, 0, False

    def reset(self, *, seed: int, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        self._place, self._clipped = float(seed % 5), 0
        return self._seen(), {"success": False, "clipped": 0}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        done = np.clip(action, -RANGE, RANGE).astype(np.float32)
        self._clipped += int((done != action).sum())
        self._place += float(done.reshape(CONTROLS, WIDTH)[:, 0].sum())
        self.steps += 1
        success = self._place >= self._goal
        return (
            self._seen(),
            float(success),
            success,
            False,
            {"success": success, "clipped": self._clipped, "action": done},
        )

    def close(self) -> None:
        self.closed = True

    def _seen(self) -> dict[str, np.ndarray]:
        return {"rgb": picture(self._place), "depth": np.ones((SIZE, SIZE), np.float32)}


@dataclass(frozen=True)
class ToyPolicy:
    """Moves right at a speed, as a :class:`rsjax.tools.policies.policy.Policy` that nobody had to train."""

    speed: float
    model: Any = MODEL

    def actor(self, seed: int = 0) -> Any:
        row = np.zeros((CONTROLS, WIDTH), np.float32)
        row[:, 0] = self.speed
        return lambda frames: np.repeat(row.reshape(1, -1), len(frames), 0)

    @property
    def key(self) -> str:
        return f"speed {self.speed}"

    def save(self, directory: Path) -> None:
        write_json(directory / "policy.json", {"speed": self.speed})


class ToyImagination:
    """A world model in which the dot moves at a share of its true speed, and the judge's eye."""

    def __init__(self, pace: float, count: int) -> None:
        self._pace, self._place = pace, np.zeros(count)
        self.draws: list[list[int]] = []

    def restart(self, which: np.ndarray, first: Video, index: np.ndarray) -> Video:
        self._place[which] = first.rgb[:, 0, 7, :, 0].argmax(-1)
        self.draws.append(index.tolist())
        return first

    def step(self, actions: np.ndarray) -> Video:
        self._place += self._pace * actions.reshape(-1, CONTROLS, WIDTH)[..., 0].sum(1)
        rgb = np.stack([picture(place) for place in self._place])[:, None]
        return Video(rgb, np.ones((*rgb.shape[:-1],), np.float32))


def judge(frames: np.ndarray) -> np.ndarray:
    """Success is a dot at column 10 or farther in the last frame."""
    done = frames[:, -1, 7, :, 0].argmax(-1) >= 10
    return np.stack([done, ~done, np.zeros_like(done)], -1).astype(float)


def imagined(count: int, pace: float = 1.0, judge: Any = judge) -> Imagined:
    """A world of ``count`` imagined episodes."""

    class Model:
        def imagine(self, params: Any, assets: Any, count: int) -> ToyImagination:
            return ToyImagination(pace, count)

    config = SimpleNamespace(prompt_frames=1, clips=None, tokenizer=None, model=None)
    assets = SimpleNamespace(normalization=None, tokenizer=None)
    trained = SimpleNamespace(config=config, model=Model(), params={"pace": pace}, assets=assets)
    low = np.full(CONTROLS * WIDTH, -RANGE, np.float32)
    return Imagined(trained, count, judge, low, -low)


def simulated(count: int) -> Simulated:
    """A world of ``count`` true episodes."""
    return Simulated([ToyEnv() for _ in range(count)])
