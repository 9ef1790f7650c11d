"""Errors of the state heads, of clips whose labels are partly unknown, against loops from their definitions."""

from collections.abc import Callable

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.data.state_labels import STATE
from rsjax.evaluation.registry import Scene, Unavailable
from tests.evaluation.metrics.scored import per_frame, score

RNG = np.random.default_rng(0)
CLIPS = 4
FRAMES = 6
PROMPT = 2
PIXELS = np.zeros((CLIPS, FRAMES, 8, 8, 3), np.uint8)
READ = RNG.random((CLIPS, FRAMES, 3)).astype(np.float32)
LABELS = RNG.random((CLIPS, FRAMES, 3)).astype(np.float32)
LABELS[..., 0] = LABELS[..., 0] > 0.5
LABELS[0, 3] = np.nan
LABELS[1, 4, 1] = np.nan
LABELS[2] = np.nan  # a clip without labels


def right(read: float, label: float) -> float:
    return float((read > 0.5) == (label == 1))


def centimetres(read: float, label: float) -> float:
    return 100 * abs(read - label)


def brier(read: float, label: float) -> float:
    return (read - label) ** 2


def scene(read: np.ndarray | None = READ, labels: np.ndarray = LABELS) -> Scene:
    return Scene(Video(PIXELS, state=labels), Video(PIXELS, state=read), prompt_frames=PROMPT)


def loop(quantity: str, error: Callable[[float, float], float]) -> tuple[list[float], np.ndarray]:
    """Each labelled clip's mean, and all frames' errors."""
    column = STATE.index(quantity)
    errors = np.full((CLIPS, FRAMES - PROMPT), np.nan)
    means = []
    for clip in range(CLIPS):
        known = []
        for frame in range(PROMPT, FRAMES):
            label = float(LABELS[clip, frame, column])
            if not np.isnan(label):
                errors[clip, frame - PROMPT] = error(float(READ[clip, frame, column]), label)
                known.append(errors[clip, frame - PROMPT])
        if known:
            means.append(np.mean(known))
    return means, errors


@pytest.mark.parametrize(
    ("name", "quantity", "error"),
    [
        ("state_success_accuracy", "success", right),
        ("state_height_error", "height", centimetres),
        ("state_opening_error", "opening", centimetres),
    ],
)
def test_scores_are_those_of_a_loop(name: str, quantity: str, error: Callable[[float, float], float]) -> None:
    means, errors = loop(quantity, error)
    assert len(means) == CLIPS - 1
    found = score(name, scene())
    if quantity == "success":
        np.testing.assert_allclose(found["_brier"], loop(quantity, brier)[0], rtol=1e-5)
        found = found[""]
    np.testing.assert_allclose(found, means, rtol=1e-5)
    np.testing.assert_allclose(per_frame(name, scene()), errors, rtol=1e-5)


@pytest.mark.parametrize("name", ["state_success_accuracy", "state_height_error", "state_opening_error"])
def test_models_without_heads_and_clips_without_labels_have_no_score(name: str) -> None:
    for without in (scene(read=None), scene(labels=np.full_like(LABELS, np.nan))):
        with pytest.raises(Unavailable):
            score(name, without)
