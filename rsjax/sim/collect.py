"""Collects Lift episodes in parallel processes into a store of clips.

Each finished episode is a file in ``<out>.partial``, so that an interrupted collection resumes; at the end they are
packed into one store. An episode that the simulator fails at is left out and named in the manifest.
"""

import functools
import importlib.metadata
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int32

from rsjax.clip import Clip
from rsjax.config import SimConfig, content_key, to_dict
from rsjax.data.store import Record, complete_key, decode, encode, encode_clip, write_store
from rsjax.errors import UserError
from rsjax.files import disk_guard, making, write_atomically
from rsjax.processes import WorkerDied, count_cores, run_items
from rsjax.sim.expert import MODES, Expert, difficulty, draw_manner
from rsjax.sim.gl import GLError, choose_gl
from rsjax.sim.lift import TASK, LiftSim
from rsjax.sim.render import Camera
from rsjax.sim.tracks import Snapshot, grid_pixels, object_pixels, track

SOURCE = "robosuite/Lift/Panda"
RECIPE = 5  # to raise when the same configuration gives other episodes
MAX_FAILURES = 0.1  # share of the episodes; more failures mean a broken installation


class CollectError(UserError):
    """The collection cannot be completed. The message names the reason and the cure."""


def collection_key(config: SimConfig) -> str:
    """Returns the content key of the store that :func:`collect` makes."""
    return content_key("lift", RECIPE, MODES, config)


def run_episode(sim: LiftSim, config: SimConfig, episode: int) -> Clip:
    """Simulates one episode, which depends on nothing but the configuration's seed and the episode's number.

    Frame 0 is the start; ``config.control_steps`` control steps of 50 ms lead to each later frame.
    """
    rng = np.random.default_rng([config.seed, episode])
    sim.reset(int(rng.integers(2**32)))
    manner = draw_manner(rng)
    expert = Expert(manner, rng)
    views, shots, success, objects = [], [], [], []
    actions = np.zeros((config.frames, config.control_steps, 7), np.float32)
    for frame in range(config.frames):
        for step in range(config.control_steps if frame else 0):
            actions[frame, step] = expert.act(sim.state)
            sim.step(actions[frame, step])
        views.append(sim.render())
        shots.append(Snapshot(sim.camera, *sim.body_poses(), views[-1].fine_depth))
        success.append(sim.success)
        objects.append((sim.state.cube, sim.state.gripper))
        if frame == 0:
            bodies = sim.segment()
            pixels = _track_pixels(config, sim, bodies, np.random.default_rng([config.seed, episode, 1]))
    tracks, visible = track(pixels, views[0].depth, bodies, shots)
    return Clip(
        rgb=np.stack([view.rgb for view in views]),
        depth=np.stack([view.depth for view in views]),
        actions=actions.reshape(config.frames, -1),
        tracks=tracks,
        visible=visible,
        success=np.array(success),
        task=TASK,
        provenance={
            "source": SOURCE,
            "seed": config.seed,
            "episode": episode,
            "camera": config.camera,
            "control_hz": 20,
            "expert": to_dict(manner),
            "objects": _in_the_image(shots[0].camera, np.array(objects), sim.cube_width),
            "versions": {name: importlib.metadata.version(name) for name in ("robosuite", "mujoco")},
        },
    )


def _in_the_image(camera: Camera, positions: Float[np.ndarray, "T 2 3"], cube_width: float) -> dict[str, Any]:
    """Returns where cube and gripper are in each frame, as (x, y) like tracks, and the cube's width in frame 0."""
    xy, depth = camera.project(positions)
    width = cube_width / (camera.extent * float(depth[0, 0]))
    return {"cube": xy[:, 0].tolist(), "gripper": xy[:, 1].tolist(), "cube_width": width}


def _track_pixels(
    config: SimConfig, sim: LiftSim, bodies: Int32[np.ndarray, "S S"], rng: np.random.Generator
) -> Int[np.ndarray, "N 2"]:
    """Returns the pixels to track. The generator is their own: the episode does not depend on where tracks start."""
    if config.track_points == "grid":
        return grid_pixels(config.image_size, config.tracks, rng)
    return object_pixels(bodies, sim.movable, sim.cube_body, config.tracks, rng)


def collect(config: SimConfig, out: Path, report: Callable[[int, int], None]) -> None:
    """Collects ``config.episodes`` episodes into a store at ``out``; its test split is the last ``test_episodes``.

    Returns at once if ``out`` is a store made by the same configuration, and waits for another process that makes it.

    Args:
        report: called with (episodes done, episodes in all) as they finish.

    Raises:
        GLError: there is no usable OpenGL library.
        FileError: ``out`` cannot be written, e.g. on a full disk.
        CollectError: two worker processes die over an episode, or more than ``MAX_FAILURES`` of the episodes fail.
    """
    if complete_key(out) == collection_key(config):
        report(config.episodes, config.episodes)
        return
    choose_gl()
    with making(out, wait=True):
        if complete_key(out) == collection_key(config):  # that one has made it
            report(config.episodes, config.episodes)
        else:
            _make(config, out, report)


def _make(config: SimConfig, out: Path, report: Callable[[int, int], None]) -> None:
    partial = out.with_name(f"{out.name}.partial")
    with disk_guard(partial):
        _prepare(partial, collection_key(config))
    todo = [
        i for i in range(config.episodes) if not (_clip_file(partial, i).exists() or _error_file(partial, i).exists())
    ]
    report(config.episodes - len(todo), config.episodes)
    if todo:
        with disk_guard(partial):
            _simulate(config, partial, todo, report)
    _pack(config, partial, out)
    shutil.rmtree(partial)


def _prepare(partial: Path, key: str) -> None:
    """Makes the directory of finished episodes and removes those of another configuration."""
    marker = partial / "key"
    if not marker.exists() or marker.read_text() != key:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        write_atomically(marker, key.encode())


def _simulate(config: SimConfig, partial: Path, todo: list[int], report: Callable[[int, int], None]) -> None:
    workers, done = min(config.workers or count_cores(), len(todo)), config.episodes - len(todo)

    def settle(episode: int, died: WorkerDied | None) -> None:
        nonlocal done
        if died is not None:  # leaving the episode out would make the store depend on this machine's memory
            raise CollectError(
                f"simulator processes died over episode {episode}, most likely for lack of memory, after {done} of "
                f"{config.episodes} episodes; run again with fewer sim.workers (now {workers}), finished episodes "
                f"are kept"
            )
        done += 1
        report(done, config.episodes)

    run_items(functools.partial(_open_simulator, config, partial, workers), todo, workers, settle)


def _open_simulator(config: SimConfig, partial: Path, workers: int) -> Callable[[int], None]:
    """Opens a worker's simulator, on its share of the cores: more threads of Mesa's renderer would be in the way."""
    os.environ.setdefault("LP_NUM_THREADS", str(max(1, count_cores() // workers)))
    return functools.partial(_work, LiftSim(config.camera, config.image_size), config, partial)


def _work(sim: LiftSim, config: SimConfig, partial: Path, episode: int) -> None:
    """Simulates one episode and leaves its clip, or why there is none, in ``partial``."""
    try:
        payload = encode(encode_clip(run_episode(sim, config, episode)))
    except (GLError, OSError, MemoryError):
        raise
    except Exception as error:  # whatever the simulator throws costs this episode only
        write_atomically(_error_file(partial, episode), f"{type(error).__name__}: {error}".encode())
    else:
        write_atomically(_clip_file(partial, episode), payload)


def _clip_file(partial: Path, episode: int) -> Path:
    return partial / f"{episode:06d}.clip"


def _error_file(partial: Path, episode: int) -> Path:
    return partial / f"{episode:06d}.error"


def _pack(config: SimConfig, partial: Path, out: Path) -> None:
    """Writes the finished episodes as one store."""
    failures = {path.stem: path.read_text() for path in sorted(partial.glob("*.error"))}
    if len(failures) > MAX_FAILURES * config.episodes:
        shutil.rmtree(partial)
        raise CollectError(
            f"{len(failures)} of {config.episodes} episodes failed in the simulator, the first one with: "
            f"{next(iter(failures.values()))}; nothing was stored, check the installation with `make test`"
        )
    cut = config.episodes - config.test_episodes
    numbers = {"train": range(cut), "test": range(cut, config.episodes)}
    files = {split: [path for i in of if (path := _clip_file(partial, i)).exists()] for split, of in numbers.items()}
    meta = {"key": collection_key(config), "source": SOURCE, "config": to_dict(config), "quarantine": failures}
    meta |= _statistics(files["train"], files["test"])
    stamp = {"depth_range": meta["depth_range"]}
    splits = {
        split: (clip | {"provenance": clip["provenance"] | stamp} for clip in _clips(paths))
        for split, paths in files.items()
    }
    write_store(out, "clips", splits, meta, labels)


def labels(clip: Record) -> dict[str, str]:
    """Returns the labels by which a curriculum can choose a clip."""
    return {"task": clip["task"], "difficulty": difficulty(clip["provenance"])}


def _clips(paths: list[Path]) -> Iterator[Record]:
    return (decode(path.read_bytes()) for path in paths)


def _statistics(train: list[Path], test: list[Path]) -> dict[str, Any]:
    """Returns fields of the manifest.

    Over the train split, the depth range in metres, and mean and standard deviation of the actions (frame 0 has none);
    over both splits, tasks, expert modes, and the share of clips that end in success and that ever succeed.
    """
    actions, depths, modes, final, ever = [], [], Counter[str](), [], []
    tasks = set[str]()
    for number, record in enumerate(_clips(train + test)):
        if number < len(train):
            depths += [float(record["depth"].min()), float(record["depth"].max())]
            actions.append(record["actions"][1:])
        tasks.add(record["task"])
        modes[record["provenance"]["expert"]["mode"]] += 1
        final.append(bool(record["success"][-1]))
        ever.append(bool(record["success"].any()))
    flat = np.concatenate(actions).astype(np.float64)
    return {
        "depth_range": [min(depths), max(depths)],
        "action_mean": flat.mean(0).tolist(),
        "action_std": flat.std(0).tolist(),
        "tasks": sorted(tasks),
        "modes": dict(modes),
        "success_share": float(np.mean(final)),
        "success_ever_share": float(np.mean(ever)),
    }
