"""Worlds of one dot that moves right or left, whose episodes succeed when it comes to the right edge."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np

from rsjax.clip import Video
from rsjax.files import write_json
from rsjax.tools.policies.config import toy as toy_size
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy
from rsjax.tools.policies.judges.judge import HISTORY
from rsjax.tools.policies.judges.trained_judge import JudgeNetwork, TrainedJudge
from rsjax.tools.policies.worlds.actions import PANDA_UNIT, ActionRange
from rsjax.tools.policies.worlds.model_world import ModelWorld
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from tests.tools.policies.toy import CONTROLS, RANGE, SIZE, WIDTH, picture

MODEL = DiffusionPolicy(toy_size(), SIZE, CONTROLS, WIDTH)


class ToySimulator:
    """Moves the dot by a control's first number, like :class:`rsjax.tools.sim.lift.LiftSim`.

    Args:
        diverges: whether every step raises.
    """

    state = None

    def __init__(self, size: int = SIZE, diverges: bool = False) -> None:
        self.place = 0.0
        self.diverges = diverges
        self._size = size

    def reset(self, seed: int) -> None:
        self.place = float(seed % 5)

    def step(self, control: np.ndarray) -> None:
        if self.diverges:
            raise ArithmeticError("the simulation diverged")
        self.place += float(control[0])

    @property
    def success(self) -> bool:
        return self.place >= 10

    def render(self) -> Any:
        rgb = picture(self.place) if self._size == SIZE else np.zeros((self._size, self._size, 3), np.uint8)
        return SimpleNamespace(rgb=rgb, depth=np.ones(rgb.shape[:2], np.float32))

    def close(self) -> None:
        pass


@dataclass(frozen=True)
class ToyPolicy:
    """Moves right at a speed, as a :class:`rsjax.tools.policies.policy.Policy` that nobody had to train."""

    speed: float
    model: Any = MODEL

    def actor(self, seed: int = 0) -> Any:
        row = np.zeros((CONTROLS, WIDTH), np.float32)
        row[:, 0] = self.speed
        return lambda observation: np.repeat(row.reshape(1, -1), len(observation["rgb"]), 0)

    @property
    def key(self) -> str:
        return f"speed {self.speed}"

    def save(self, directory: Path) -> None:
        write_json(directory / "policy.json", {"speed": self.speed})


class ToyImagination:
    """A world model in which the dot moves at a share of its true speed; notes the draws of each restart."""

    def __init__(self, pace: float, count: int, draws: list[list[int]]) -> None:
        self._pace, self._place = pace, np.zeros(count)
        self._draws = draws

    def restart(self, which: np.ndarray, first: Video, index: np.ndarray) -> Video:
        self._place[which] = first.rgb[:, 0, 7, :, 0].argmax(-1)
        self._draws.append(index.tolist())
        return first

    def step(self, actions: np.ndarray) -> Video:
        self._place += self._pace * actions.reshape(-1, CONTROLS, WIDTH)[..., 0].sum(1)
        rgb = np.stack([picture(place) for place in self._place])[:, None]
        return Video(rgb, np.ones((*rgb.shape[:-1],), np.float32))


def judge(frames: np.ndarray) -> np.ndarray:
    """Success is a dot at column 10 or farther in the last frame."""
    done = frames[:, -1, 7, :, 0].argmax(-1) >= 10
    return np.stack([done, ~done, np.zeros_like(done)], -1).astype(float)


def untrained_judge(side: int, temperature: float = 1.0) -> TrainedJudge:
    """A judge with random parameters, for frames of ``side`` pixels."""
    frames = jax.ShapeDtypeStruct((1, HISTORY, side, side, 3), np.uint8)
    shapes = jax.eval_shape(JudgeNetwork().init, jax.random.key(0), frames)["params"]
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: rng.normal(scale=0.1, size=x.shape).astype(np.float32), shapes)
    return TrainedJudge(params, temperature, side)


def imagined(count: int, pace: float = 1.0, judge: Any = judge, draws: list[list[int]] | None = None) -> ModelWorld:
    """A world of ``count`` imagined episodes; ``draws`` gets those of each start."""
    noted = [] if draws is None else draws

    class Model:
        def imagine(self, params: Any, assets: Any, count: int, depth: bool = True) -> ToyImagination:
            return ToyImagination(pace, count, noted)

    return ModelWorld(trained_like(Model(), {"pace": pace}), count, judge, action_range(RANGE))


def trained_like(model: Any, params: Any, uses_depth: bool = False) -> Any:
    """A trained model as far as a world looks at it."""
    settings = SimpleNamespace(uses_depth=uses_depth)
    config = SimpleNamespace(prompt_frames=2, clips=SimpleNamespace(action_dim=6), tokenizer=None, model=settings)
    assets = SimpleNamespace(normalization=None, tokenizer=None)
    return SimpleNamespace(config=config, model=model, params=params, assets=assets)


def action_range(most: float) -> ActionRange:
    high = np.full(CONTROLS * WIDTH, most, np.float32)
    return ActionRange(-high, high, PANDA_UNIT)


def simulated(count: int) -> SimulatorWorld:
    """A world of ``count`` true episodes."""
    simulators: Any = [ToySimulator() for _ in range(count)]
    return SimulatorWorld(simulators, CONTROLS, WIDTH)
