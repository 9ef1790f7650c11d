"""Small videos of known motion, and episodes around them."""

import numpy as np
from numpy.typing import NDArray

from rsjax.tools.ingest.episode import Episode, Segment
from rsjax.tools.ingest.pictures import ArrayFrames


def texture(height: int, width: int, seed: int = 0) -> NDArray[np.float32]:
    """Smooth random grey levels, 0–255."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    waves = sum(np.sin(rows * a + columns * b + c) for a, b, c in rng.uniform((-0.9, -0.9, 0), (0.9, 0.9, 6), (12, 3)))
    return ((waves - waves.min()) / np.ptp(waves) * 255).astype(np.float32)


def sliding(count: int, step: tuple[int, int], size: tuple[int, int] = (48, 64), seed: int = 0) -> ArrayFrames:
    """A textured picture that moves ``step`` = (right, down) whole pixels a frame."""
    right, down = step
    margin = count * max(abs(right), abs(down), 1)
    big = texture(size[0] + 2 * margin, size[1] + 2 * margin, seed)
    frames = [
        big[margin - t * down : margin - t * down + size[0], margin - t * right : margin - t * right + size[1]]
        for t in range(count)
    ]
    return ArrayFrames(np.repeat(np.stack(frames).astype(np.uint8)[..., None], 3, -1))


def episode(
    frames: ArrayFrames,
    task: str = "",
    segments: tuple[Segment, ...] = (),
    grip: NDArray[np.float32] | None = None,
    depth: NDArray[np.float32] | None = None,
) -> Episode:
    """An episode of one camera at 10 fps; ``grip`` is the command of its gripper, the second of two dimensions."""
    count = len(frames)
    actions = np.zeros((count, 2), np.float32)
    if grip is not None:
        actions[:, 1] = grip
    return Episode(
        id="e0",
        fingerprint="0" * 16,
        task=task,
        fps=10.0,
        timestamps=np.arange(count) / 10,
        actions=actions,
        states=None,
        cameras={"top": frames},
        depth={} if depth is None else {"top": ArrayFrames(depth.astype(np.float32))},
        segments=segments,
        meta={"actions": {"kind": "delta", "held": [1]}},
    )
