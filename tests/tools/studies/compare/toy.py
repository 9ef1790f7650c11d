"""Results of evaluations that never ran: numbers in files."""

from pathlib import Path
from typing import Any

import numpy as np

from rsjax.evaluation.protocols import PAPER
from rsjax.evaluation.results import Result, write_result

CLIPS, FRAMES, SIZE = 40, 4, 16
rng = np.random.default_rng(0)
DIFFICULTY = rng.normal(0, 3, CLIPS)  # of each clip, for every model
ENDS = np.argsort(DIFFICULTY)[[0, 1, 2, -3, -2, -1]]  # the clips in which most and least moves
ROWS = np.union1d(np.arange(0, CLIPS, 7), ENDS)
TRUTH = rng.integers(0, 256, (len(ROWS), FRAMES, SIZE, SIZE, 3), np.uint8)


def result(gain: float, seed: int = 0, noise: float = 0.5, **changes: Any) -> Result:
    """A model whose PSNR is ``gain`` dB above 20, clip by clip alike but for a little noise."""
    psnr = 20 + gain + DIFFICULTY + noise * np.random.default_rng([seed, int(100 * abs(gain))]).normal(size=CLIPS)
    still, tokens = 15 + DIFFICULTY, 25 + DIFFICULTY
    per_clip = {
        "psnr": psnr,
        "psnr_repeat_first": still,
        "psnr_tokenizer": tokens,
        "depth_absrel_median_branch": 0 * psnr,
    }
    curve: list[float | None] = [psnr.mean() - t for t in range(FRAMES - 1)]
    fields: dict[str, Any] = {
        "label": "paper",
        "key": "k",
        "protocol": PAPER.described(),
        "sampling": {"steps": 2},
        "settings": {"localiser_steps": 800, "physics_iq_threshold": 10},
        "data": {"key": "toy", "split": "test", "frames": FRAMES, "image_size": SIZE, "fps": 5.0},
        "model": {"run": f"runs/{gain}", "family": "roboscape", "seed": seed, "trained_on": "toy", "settings": {}},
        "code": {"revision": "abc"},
        "made": {},
        "metrics": {name: float(values.mean()) for name, values in per_clip.items()}
        | {"lpips_alex": None, "fvd": 100.0},
        "reasons": {"lpips_alex": "no weights"},
        "curves": {"frame": [2.0, 3.0, 4.0], "psnr": curve},
        "per_clip": {name: values.tolist() for name, values in per_clip.items()},
        "clips": [{"number": 2 * i, "sha256": f"{i:04d}"} for i in range(CLIPS)],
    }
    return Result(**fields | changes)


def run(folder: Path, made: Result, keep: np.ndarray | slice = slice(None)) -> Path:
    """A run directory with a result, and the frames of all ``ROWS``, or of some places of them."""
    every = {"rows": ROWS, "truth": TRUTH, "prediction": 255 - TRUTH, "reconstruction": TRUTH // 2}
    frames = {name: values[keep] for name, values in every.items()}
    write_result(folder / "evaluations" / made.label, made, frames)
    return folder
