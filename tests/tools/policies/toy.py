"""Demonstrations of a dot that moves right."""

from pathlib import Path
from typing import Any

import numpy as np

import rsjax
from rsjax.data.store import Store
from rsjax.tools.policies.demos import Demos

SIZE, CONTROLS, WIDTH = 16, 2, 3
RANGE = 1.0


def picture(place: float) -> np.ndarray:
    frame = np.full((SIZE, SIZE, 3), 40, np.uint8)
    column = int(np.clip(place, 0, SIZE - 2))
    frame[6:9, column : column + 2] = 250
    return frame


def demo(number: int, frames: int = 8) -> dict[str, Any]:
    """The dot moves right by 2 each frame; the last number of a control is a command of -1 or 1."""
    rng = np.random.default_rng(number)
    actions = rng.normal(0, 0.1, (frames, CONTROLS, WIDTH)).astype(np.float32).clip(-RANGE, RANGE)
    actions[..., 0] = 1
    actions[..., -1] = np.where(np.arange(frames) < frames // 2, -1, 1)[:, None]
    actions[0] = 0
    rgb = np.stack([picture(number % 5 + 2 * frame) for frame in range(frames)])
    return {"rgb": rgb, "actions": actions.reshape(frames, -1)}


def demos(count: int = 4) -> Demos:
    return Demos(tuple(demo(number) for number in range(count)), CONTROLS)


def demo_store(path: Path, count: int = 6, depth: bool = True, fps: float | None = 5.0) -> Store:
    """Demonstrations of which each third one fails."""

    def clips() -> Any:
        for number in range(count):
            made = demo(number) | {"success": number % 3 != 2, "task": "move right", "fps": fps}
            made["provenance"] = {"control_steps": CONTROLS, "camera": "front"}
            yield made | (
                {"depth": np.tile(np.linspace(0.5, 1, SIZE, dtype=np.float32), (8, SIZE, 1))} if depth else {}
            )

    return rsjax.write_store(path, clips(), test_share=0.2)
