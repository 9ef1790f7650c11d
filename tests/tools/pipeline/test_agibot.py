"""The preset ``roboscape_agibot``, from recordings in AgiBot-World's layout to a trained, scored model in toy sizes.

Also: that it is the paper's setting, and refuses to train without a store.
"""

import json
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import h5py
import jax
import numpy as np
import pytest

from rsjax.config import RoboScapeConfig, TokenizerConfig, presets
from rsjax.data.store import open_store
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.commands import ingest
from rsjax.tools.compile import programs
from rsjax.tools.convert.directory import save
from rsjax.training.log import read_log
from tests.tools.ingest.formats.videos import write_pictures
from tests.tools.pipeline.conftest import Commands

FRAMES = 4  # of a clip; the preset's 16 would take recordings of 226 frames
COUNT = 15 * (FRAMES - 1) + 1  # frames at 30 fps that make one clip at 2 Hz
TASKS = {"619": ("Grab the toy", "simple"), "475": ("Ironing Clothes", "difficult")}
EPISODES = {"619": range(103, 108), "475": range(203, 208)}  # of each, a hash puts one into the test split
SIDE = 64
TOKENIZER = TokenizerConfig(patch_size=4, channels=16, channel_multipliers=(1, 2), res_blocks=1, norm_groups=8)
TOY = {
    "tokenizer.patch-size": 4,
    "tokenizer.channels": 16,
    "tokenizer.channel-multipliers": "1 2",
    "tokenizer.res-blocks": 1,
    "tokenizer.norm-groups": 8,
    "tokenizer.compute-dtype": "float32",
    "model.width": 16,
    "model.blocks": 1,
    "model.heads": 2,
    "model.remat": "none",
    "train.batch-size": 1,
    "runtime.log-every": 1,
    "runtime.eval-every": 0,
    "eval.clips": 2,
    "eval.repetitions": 1,
    "eval.batch-size": 2,
    "eval.action-draws": 1,
    "eval.weights": "",
}


def test_it_is_the_papers_setting() -> None:
    ours, small = presets.get("roboscape_agibot"), presets.get("roboscape_s")
    arch = Architecture.create(ours)
    assert (arch.frames, arch.grid, arch.width, arch.blocks, arch.action_inputs) == (16, 16, 256, 32, 16)
    assert (ours.model, ours.train, ours.eval) == (small.model, small.train, small.eval)
    stages = [(stage.components[0].difficulties, stage.epochs) for stage in ours.train.curriculum]
    assert stages == [(("simple",), 2.0), (("difficult",), 3.0)]
    assert (ours.eval.clips, ours.eval.repetitions) == (1200, 5)
    assert (ours.tokenizer_train.steps, ours.tokenizer_train.start_from) == (0, "magvit2")
    assert isinstance(ours.model, RoboScapeConfig)
    assert (ours.model.loss.depth_weight, ours.model.loss.keypoint_weight, ours.model.loss.gamma) == (1, 0.01, 5)
    shapes = jax.eval_shape(create_model(ours).init, jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 71_501_568 - (28 - 16) * 256


def test_its_training_step_is_lowered_at_full_size() -> None:
    """tests/tools/compile compiles it for GPUs, where their compilers are installed."""
    program = programs.train(presets.get("roboscape_agibot"), jax.devices()[:1])
    assert (program.count, program.steps) == (256, 127_000)
    shapes = [x.shape for x in jax.tree.leaves(program.lower().in_avals)]
    assert any(shape[-3:] == (256, 16, 16) for shape in shapes), "the actions"


def test_without_a_store_it_names_what_is_missing(command: Commands, tmp_path: Path) -> None:
    text = command.refused("experiments.train", "roboscape_agibot", "--run-dir", tmp_path / "run")
    assert "trains on a store of clips, and none is named" in text
    assert "--store STORE (docs/agibot.md)" in text
    assert not (tmp_path / "run" / "config.json").exists()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of two tasks: a texture that drifts, hands that move along, grippers that close half-way, depth."""
    root = tmp_path_factory.mktemp("agibot")
    (root / "task_info").mkdir()
    for task, (name, _) in TASKS.items():
        entries = []
        for episode in EPISODES[task]:
            write_episode(root, task, episode)
            action = {"start_frame": 0, "end_frame": COUNT, "action_text": name.lower(), "skill": "Pick"}
            entry = {"episode_id": episode, "task_name": name, "init_scene_text": "a table"}
            entries.append(entry | {"label_info": {"action_config": [action]}})
        (root / f"task_info/task_{task}.json").write_text(json.dumps(entries))
    return root


def write_episode(root: Path, task: str, episode: int) -> None:
    rng = np.random.default_rng(episode)
    place = root / f"observations/{task}/{episode}"
    texture = cv2.resize(rng.integers(0, 256, (SIDE // 8, SIDE // 8, 3), np.uint8), (SIDE, SIDE))
    write_pictures(place / "videos/head_color.mp4", [np.roll(texture, frame // 3, axis=1) for frame in range(COUNT)])
    (place / "depth").mkdir()
    for frame in range(COUNT):
        depth = np.full((SIDE, SIDE), 800 + 10 * frame, np.uint16)
        depth[: SIDE // 2] += 400
        cv2.imwrite(str(place / f"depth/head_depth_{frame:06d}.png"), depth)
    path = root / f"proprio_stats/{task}/{episode}/proprio_stats.h5"
    path.parent.mkdir(parents=True)
    moved = np.cumsum(rng.normal(0, 0.01, (COUNT, 2, 3)), axis=0)
    half = np.cumsum(rng.normal(0, 0.02, (COUNT, 2)), axis=0)
    turned = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)
    grip = np.tile((np.arange(COUNT) >= COUNT // 2).astype(float)[:, None], (1, 2))
    arrays: dict[str, Any] = {"timestamp": np.arange(COUNT, dtype=np.uint64) * 33_333_333 + 10**18}
    for name, shift in (("state", 0), ("action", 1)):
        arrays |= {
            f"{name}/end/position": np.roll(moved, -shift, axis=0),
            f"{name}/end/orientation": np.roll(turned, -shift, axis=0),
            f"{name}/joint/position": np.zeros((COUNT, 14)),
            f"{name}/head/position": np.zeros((COUNT, 2)),
            f"{name}/waist/position": np.zeros((COUNT, 2)),
            f"{name}/effector/position": grip if name == "action" else 80 - 80 * grip,
        }
    for name in ("end", "joint", "effector"):
        arrays[f"action/{name}/index"] = np.arange(COUNT)
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array


def test_twenty_steps_on_agibots_layout(recordings: Path, tmp_path: Path, command: Commands) -> None:
    store = tmp_path / "store"
    line = ["agibot", recordings, "--out", store, "--recipe", "paper", "--windows.rate", 2, "--windows.frames", FRAMES]
    line += ["--difficulty", "agibot", "--option", 'cameras=["head"]', "--test-share", 0.2, "--workers", 0]
    with patch.object(sys, "argv", ["ingest", *map(str, line)]):
        ingest.main()
    clips = open_store(store)
    counts = clips.labels("train").counts()["difficulty"]
    assert counts == {"simple": 4, "difficult": 4}
    first = clips.source("train")[0]
    assert first["actions"].shape == (FRAMES, 16)
    assert first["depth"] is not None
    assert (first["tracks"].shape[0], first["provenance"]["difficulty"]) == (256, "difficult")

    params = jax.jit(Tokenizer(TOKENIZER).init_params)(jax.random.key(0))
    save(tmp_path / "magvit2", TOKENIZER, params)
    run = tmp_path / "run"
    toy = [word for name, value in TOY.items() for word in (f"--{name}", *str(value).split(" "))]
    start = ["--tokenizer-train.start-from", tmp_path / "magvit2"]
    command.here("experiments.train", "roboscape_agibot", "--store", store, "--run-dir", run, *start, *toy)
    rows = [row for row in read_log(run / "world_model") if "loss" in row]
    assert [row["step"] for row in rows] == list(range(1, 21)), "2 epochs of 4 simple clips, then 3 of 4 difficult ones"
    assert all(np.isfinite(row["loss"]) and row["depth"] > 0 and row["keypoint"] >= 0 for row in rows)
    scores = json.loads((run / "metrics.json").read_text())
    assert {"psnr", "delta_psnr", "depth_absrel"} <= {name for name, value in scores.items() if value is not None}
