import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rsjax
from rsjax.clip import Video
from rsjax.data.merge import merge
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.tools.policies.demos import load_demos
from rsjax.tools.policies.studies import synthesis as module
from rsjax.tools.policies.studies.synthesis import Synthesis, choose_clips, labels, perturb, synthesize
from tests.tools.ingest.formats.reading import read_all
from tests.tools.policies.toy import CONTROLS, SIZE, WIDTH, demo_store, picture
from tests.tools.policies.toy_worlds import action_range, judge

LIMITS = action_range(1.0)


def trained(store: Any, fails_at: int = -1, weight: float = 1.0) -> Any:
    """A world model in which the dot moves as the actions say; it fails at a call."""
    calls: list[list[int]] = []

    def generate(params: Any, assets: Any, prompt: Video, actions: np.ndarray, index: np.ndarray) -> Video:
        calls.append(index.tolist())
        if len(calls) == fails_at:
            raise KeyboardInterrupt
        places = prompt.rgb[:, 0, 7, :, 0].argmax(-1)[:, None] + np.cumsum(
            actions.reshape(*actions.shape[:2], CONTROLS, WIDTH)[..., 0].sum(-1), 1
        )
        rgb = np.stack([[picture(place) for place in row] for row in np.rint(places)])
        return Video(rgb, np.full(rgb.shape[:-1], 0.5, np.float32))

    clips, family = SimpleNamespace(image_size=SIZE), SimpleNamespace(family="toy", takes_actions=True)
    config = SimpleNamespace(prompt_frames=1, clips=clips, tokenizer=None, model=family)
    assets = SimpleNamespace(normalization=Normalization.create(store), tokenizer=None)
    return SimpleNamespace(
        config=config, model=SimpleNamespace(generate=generate), params={"w": weight}, assets=assets, calls=calls
    )


def test_labels_are_a_judges_verdicts_on_the_video_so_far() -> None:
    def verdicts(frames: np.ndarray) -> np.ndarray:
        """Success is light in six frames in a row."""
        light = frames[:, -6:].min((1, 2, 3, 4)) > 0
        return np.stack([light, ~light, 0 * light], -1).astype(float)

    wants: Any = verdicts
    wants.in_a_row = 6
    rgb = np.zeros((1, 12, SIZE, SIZE, 3), np.uint8)
    rgb[:, 4:] = 255
    assert labels(rgb, wants)[0].tolist() == [1] * 9 + [0] * 3


@pytest.fixture
def store(tmp_path: Path) -> Any:
    return demo_store(tmp_path / "store", 9)


def test_a_perfect_model_without_noise_gives_the_recordings(tmp_path: Path, store: Any) -> None:
    out = tmp_path / "out"
    made = synthesize(trained(store), store, out, Synthesis(demos=3, batch=2), LIMITS, judge=judge)
    assert (made["demos"], made["clipped"], made["sources"], made["success"]) == (3, 0, 3, 3)
    clips, source = rsjax.open_store(out / "clips"), store.source("train")
    originals = {source[n]["provenance"]["episode"]: source[n] for n in range(len(source))}
    assert clips.counts() == {"train": 3, "test": 0}
    for number in range(3):
        clip = clips.source("train")[number]
        origin = originals[clip["provenance"]["from"]["episode"]]
        np.testing.assert_array_equal(clip["rgb"], origin["rgb"])
        np.testing.assert_array_equal(clip["actions"], origin["actions"])
        assert origin["success"][-1] and clip["provenance"]["source"] == "generated" and (clip["depth"] == 0.5).all()
    assert load_demos(clips, ["train"]).controls == CONTROLS
    for version in ("v3.0", "v2.1"):
        episodes = read_all("lerobot", out / f"lerobot-{version}")
        np.testing.assert_array_equal(episodes[2].actions, clips.source("train")[2]["actions"])
        assert episodes[0].fps == 5 and list(episodes[0].cameras) == ["front"]
    assert sorted(path.name for path in out.iterdir() if path.name[0] != ".") == [
        "clips",
        "lerobot-v2.1",
        "lerobot-v3.0",
        "synthesis.json",
    ]


def test_an_interrupted_synthesis_resumes(tmp_path: Path, store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "VERSIONS", ())
    options = Synthesis(demos=5, batch=2, noise=0.5)
    whole, cut, rest = (trained(store, fails_at) for fails_at in (-1, 3, -1))
    synthesize(whole, store, tmp_path / "whole", options, LIMITS)
    with pytest.raises(KeyboardInterrupt):
        synthesize(cut, store, tmp_path / "cut", options, LIMITS)
    assert not (tmp_path / "cut" / "clips").exists()
    synthesize(rest, store, tmp_path / "cut", options, LIMITS)
    assert (len(whole.calls), len(cut.calls), len(rest.calls)) == (3, 3, 1)
    assert [len(call) for call in whole.calls] == [2, 2, 2]  # the last one is filled up
    one, other = (rsjax.open_store(tmp_path / name / "clips").source("train") for name in ("whole", "cut"))
    for number in range(5):
        np.testing.assert_array_equal(one[number]["actions"], other[number]["actions"])
        np.testing.assert_array_equal(one[number]["rgb"], other[number]["rgb"])
    mark = json.loads((tmp_path / "cut" / "synthesis.json").read_text())
    assert synthesize(rest, store, tmp_path / "cut", options, LIMITS) == mark and len(rest.calls) == 1
    with pytest.raises(UserError, match="holds demonstrations of other settings"):
        synthesize(rest, store, tmp_path / "cut", replace(options, noise=0.1), LIMITS)
    for other, arbiter in ((trained(store), judge), (trained(store, weight=2.0), None)):
        with pytest.raises(UserError, match="another model or judge"):
            synthesize(other, store, tmp_path / "cut", options, LIMITS, judge=arbiter)


@given(st.integers(0, 2**32 - 1), st.floats(0, 3))
def test_noise_leaves_commands_alone_and_stays_in_range(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (6, 4)).astype(np.float32)
    actions[:, 3] = np.sign(actions[:, 3])
    actions[0] = 0
    low, high = np.full(4, -1.0), np.full(4, 1.0)
    taken, clipped = perturb(actions, np.full(4, noise), low, high, np.random.default_rng(seed))
    np.testing.assert_array_equal(taken[:, 3], actions[:, 3])
    assert not taken[0].any() and np.abs(taken).max() <= 1
    free, none = perturb(actions, np.full(4, noise), low - 99, high + 99, np.random.default_rng(seed))
    assert (none, clipped) == (0, int((np.abs(free[1:]) > 1).sum()))
    np.testing.assert_array_equal(taken, np.clip(free, -1, 1))
    if not noise:
        np.testing.assert_array_equal(taken, actions)


def test_what_cannot_be_made_is_named(tmp_path: Path, store: Any) -> None:
    for field, wrong, message in (
        ("demos", 0, "--demos 0"),
        *(("fps", fps, f"--fps {fps:g}: frames per second, 0.001 to 1000") for fps in (-1, 1e-4, float("nan"))),
    ):
        with pytest.raises(UserError, match=message):
            Synthesis(**{field: wrong})  # type: ignore[arg-type]
    wide, still, large = (trained(store) for _ in range(3))
    wide.assets = SimpleNamespace(normalization=Normalization((0.0,) * 7, (1.0,) * 7, None), tokenizer=None)
    still.config.model.takes_actions = False
    large.config.clips.image_size = 64
    for other, message in (
        (wide, "actions of 6 numbers, the model takes 7"),
        (still, r"the model takes no actions \(family 'toy'\), so its videos do not show"),
        (large, "frames of 16 × 16 pixels, the model takes 64 × 64"),
    ):
        with pytest.raises(UserError, match=message):
            synthesize(other, store, tmp_path / "out", Synthesis(2), LIMITS)


def test_clips_without_a_frame_rate_need_one_before_anything_is_generated(tmp_path: Path) -> None:
    still = demo_store(tmp_path / "still", fps=None)
    model = trained(still)
    with pytest.raises(UserError, match="still: its clips do not say how many frames a second have; give --fps"):
        synthesize(model, still, tmp_path / "out", Synthesis(2), LIMITS)
    assert not model.calls
    synthesize(model, still, tmp_path / "out", Synthesis(2, fps=12.5), LIMITS)
    assert read_all("lerobot", tmp_path / "out" / "lerobot-v3.0")[0].fps == 12.5
    slow, fast = (demo_store(tmp_path / f"{fps:g} Hz", fps=fps) for fps in (2.0, 5.0))
    both = merge([slow.path, fast.path], tmp_path / "both")
    with pytest.raises(UserError, match="both: its clips have several frame rates, such as . Hz; give --fps"):
        choose_clips(both, Synthesis(8))
    assert len(choose_clips(both, Synthesis(8, fps=5))) == 6
