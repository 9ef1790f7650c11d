"""Makes synthetic demonstrations: videos that a world model generates from the first frames and actions of a data set.

Axes: B clips, T frames, S×S pixels, A action dimensions.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from rsjax.artifact import make_once
from rsjax.clip import GENERATED
from rsjax.config import content_key
from rsjax.data.build import write_clips
from rsjax.data.clips import Clips, frame_rate, keeps_rate, readable
from rsjax.data.codec import Record, decode, encode
from rsjax.data.store import MANIFEST, Store
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.files import disk_guard, read_json, write_atomically, write_json
from rsjax.models.trained import TrainedModel
from rsjax.tools.export.lerobot import LeRobotOptions, export_lerobot
from rsjax.tools.policies.demos import Only, chooses, controls_of, is_demo
from rsjax.tools.policies.judges.judge import SUCCESS, UNINTERPRETABLE, Judge, frames_of, judge_key, last_frames
from rsjax.tools.policies.judges.validation import summary
from rsjax.tools.policies.worlds.actions import ActionRange, check_takes_actions
from rsjax.tools.policies.worlds.model_world import model_key

SUMMARY = "synthesis.json"
CLIPS = "clips"  # the store's folder
VERSIONS: tuple[Literal["v3.0", "v2.1"], ...] = ("v3.0", "v2.1")


@dataclass(frozen=True)
class Synthesis:
    """The settings of the demonstrations to make.

    Attributes:
        demos: number of demonstrations. Beyond the number of clips, clips are used again with new noise and new draws
            of the model.
        noise: standard deviation of the noise on actions, in each number's own standard deviation in the data set.
            Numbers with at most two values in a clip, such as a gripper command, get no noise.
        split: split of the clips whose first frames and actions are used.
        only: success uses only clips that end in success, if the data set says which do.
        seed: seed of the choice of clips, the noise and the model's draws.
        batch: clips that are generated together.
        fps: frames per second; 0: as the clips say.
    """

    demos: int = 200
    noise: float = 0.0
    split: str = "train"
    only: Only = "success"
    seed: int = 0
    batch: int = 10
    fps: float = 0.0

    def __post_init__(self) -> None:
        if self.fps and not 0.001 <= self.fps <= 1000:
            raise UserError(f"--fps {self.fps:g}: frames per second, 0.001 to 1000; 0: as the clips say")
        if self.demos < 1 or self.batch < 1 or not 0 <= self.noise < float("inf"):
            raise UserError(f"--demos {self.demos}, --batch {self.batch}, --noise {self.noise}: 1, 1 and 0 at least")
        if self.seed < 0:
            raise UserError(f"--seed {self.seed}: 0 at least")


def synthesize(
    trained: TrainedModel,
    store: Store,
    out: Path,
    options: Synthesis,
    limits: ActionRange,
    *,
    judge: Judge | None = None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Makes ``out/clips``, a store, and ``out/lerobot-v3.0`` and ``out/lerobot-v2.1``. An interrupted call resumes.

    Args:
        trained: the world model.
        store: the data set.
        limits: the range of actions; numbers out of range are clipped and counted.
        judge: labels the frames that show success; None: the store has no such labels.
        report: called with (demonstrations done, demonstrations in all).

    Returns:
        The content of ``out/synthesis.json``: ``demos``, ``clipped`` (numbers of actions), ``success`` and
        ``uninterpretable`` (how many demonstrations get that label at their end; None without a judge), ``judge`` (its
        validation, if it has one), the options and the sources.

    Raises:
        UserError: the data set has no suitable clip, does not fit the model, or ``out`` holds other clips.
    """
    inputs = (model_key(trained), judge_key(judge), fingerprint(((limits.low, limits.high),)))
    key = content_key(6, *inputs, str(store.manifest.get("key")), str(asdict(options)))
    if (out / SUMMARY).exists():
        finished: dict[str, Any] = read_json(out / SUMMARY, cure=f"delete {out}")
        if finished.get("key") != key:
            raise UserError(
                f"{out}: holds demonstrations of other settings, another model or judge; choose another --out, or "
                f"delete it"
            )
        return finished
    with disk_guard(out), make_once(out / "partial", key, refuse=None, temporary=True) as work:
        _generate(trained, store, work.folder, options, limits, judge, report)
        records = (decode(_file(work.folder, number).read_bytes()) for number in range(options.demos))
        clips = write_clips(out / CLIPS, records, test_share=0.0)
        for version in VERSIONS:
            place = out / f"lerobot-{version}"
            shutil.rmtree(place, ignore_errors=True)  # left by an attempt that did not finish
            export_lerobot(clips, place, LeRobotOptions(version))
        made = [clip for _, clip in readable(clips.source("train"))]
        origins = [clip["provenance"] for clip in made]
        content = {
            "key": key,
            **asdict(options),
            "clipped": sum(origin["clipped"] for origin in origins),
            "success": None if judge is None else sum(bool(clip["success"][-1]) for clip in made),
            "uninterpretable": None if judge is None else sum(origin["uninterpretable"] for origin in origins),
            "judge": summary(getattr(judge, "validation", None)),
            "sources": len({str(origin["from"]["episode"]) for origin in origins}),
            "from": origins[0]["from"]["key"],
            "manifest": str(clips.path / MANIFEST),
        }
        write_json(out / SUMMARY, content)
    return content


def _generate(
    trained: TrainedModel,
    store: Store,
    folder: Path,
    options: Synthesis,
    limits: ActionRange,
    judge: Judge | None,
    report: Callable[[int, int], None],
) -> None:
    """Writes each demonstration to its own file, unless that exists."""
    source = store.source(options.split)
    chosen = choose_clips(store, options)
    spread = np.asarray(trained.assets.normalization.action_std)
    first_clip = source[chosen[0]]
    check_takes_actions(trained.config.model)
    size = trained.config.clips.image_size
    width = len(spread)
    if first_clip["actions"].shape[1] != width:
        raise UserError(f"{store.path}: actions of {first_clip['actions'].shape[1]} numbers, the model takes {width}")
    if first_clip["rgb"].shape[1:3] != (size, size):
        height, wide = first_clip["rgb"].shape[1:3]
        raise UserError(f"{store.path}: frames of {wide} × {height} pixels, the model takes {size} × {size}")
    if not options.fps and not frame_rate(first_clip, store.manifest):
        raise UserError(f"{store.path}: its clips do not say how many frames a second have; give --fps")
    for first in range(0, options.demos, options.batch):
        numbers = range(first, min(first + options.batch, options.demos))
        if not all(_file(folder, number).exists() for number in numbers):
            clips = [source[chosen[number % len(chosen)]] for number in numbers]
            rng = [np.random.default_rng([options.seed, number]) for number in numbers]
            noisy = [
                perturb(clip["actions"], options.noise * spread, limits.low, limits.high, each)
                for clip, each in zip(clips, rng, strict=True)
            ]
            for number, record in zip(
                numbers, _generated(trained, store, clips, noisy, numbers, options, judge), strict=True
            ):
                write_atomically(_file(folder, number), encode(record))
        report(numbers[-1] + 1, options.demos)


def _generated(
    trained: TrainedModel,
    store: Store,
    clips: list[Record],
    noisy: list[tuple[Float32[np.ndarray, "T A"], int]],
    numbers: range,
    options: Synthesis,
    judge: Judge | None,
) -> Iterator[Record]:
    """Yields each generated clip as a record for :func:`rsjax.write_store`."""
    count = trained.config.prompt_frames
    prompt = Clips.stacked(clips, list(numbers)).video.frames(0, count)
    full = options.batch - len(clips)  # fills up the last batch: one program serves all
    rows = np.concatenate([np.arange(len(clips)), np.zeros(full, int)])
    actions = np.stack([actions for actions, _ in noisy])
    index = np.array(numbers)[rows] + options.seed % 2**11 * 2**20
    video = trained.model.generate(trained.params, trained.assets, prompt[rows], actions[rows], index=index)
    if judge is None:
        labelled = None
    else:
        labelled = labels(video.rgb[: len(clips)], judge)
    for row, (clip, number, (taken, clipped)) in enumerate(zip(clips, numbers, noisy, strict=True)):
        made = {
            "rgb": np.asarray(video.rgb[row]),
            "actions": taken,
            "task": clip["task"],
            "episode": f"generated-{number}",
            "fps": options.fps or frame_rate(clip, store.manifest),
        }
        metric = (store.manifest.get("depth_unit") or "metres") == "metres"  # the new store has no other unit
        if metric and video.depth is not None and not np.isnan(video.depth[row]).any():
            made["depth"] = np.maximum(np.asarray(video.depth[row], np.float32), 1e-3)
        if labelled is not None:
            made["success"] = labelled[row] == SUCCESS
        origin = clip["provenance"]
        made["provenance"] = {
            "source": GENERATED,
            "family": trained.config.model.family,
            "model": model_key(trained),
            "from": {"key": str(store.manifest.get("key")), "split": options.split, "episode": origin.get("episode")},
            "noise": options.noise,
            "seed": options.seed,
            "clipped": clipped,
            "uninterpretable": None if labelled is None else bool(labelled[row, -1] == UNINTERPRETABLE),
            "camera": str(origin.get("camera") or "image"),
            "control_steps": controls_of(clip, store.manifest),
        }
        yield made


def choose_clips(store: Store, options: Synthesis) -> list[int]:
    """Returns the numbers of at most ``demos`` clips to generate from, in an order that depends on the seed.

    Raises:
        UserError: there is no clip, or the clips differ in frame rate and ``options.fps`` is 0.
    """
    source = store.source(options.split)
    labelled = chooses(store, options.only)
    order = np.random.default_rng(options.seed).permutation(len(source)).tolist()
    chosen: list[int] = []
    fps: float | None = None
    for number, clip in readable(source, order):
        if is_demo(clip, options.only, labelled):
            chosen.append(number)
            fps = fps or frame_rate(clip, store.manifest)
            if fps and not options.fps and not keeps_rate(clip, store.manifest, fps):
                raise UserError(f"{store.path}: its clips have several frame rates, such as {fps:g} Hz; give --fps")
        if len(chosen) == options.demos:
            break
    if not chosen:
        raise UserError(
            f"{store.path}: no clip of its {options.split} split ends in success; --only all uses every clip"
        )
    return chosen


def perturb(
    actions: Float[np.ndarray, "T A"],
    spread: Float[np.ndarray, " A"],
    low: Float[np.ndarray, " A"],
    high: Float[np.ndarray, " A"],
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "T A"], int]:
    """Returns actions with Gaussian noise, clipped to their range, and how many numbers were clipped; row 0 stays zero.

    Args:
        spread: the noise's standard deviation; numbers with at most two values in these actions get no noise.
    """
    commands = np.array([len(np.unique(column)) <= 2 for column in actions[1:].T])
    noise = rng.standard_normal(actions.shape) * np.where(commands, 0, spread)
    noisy = (actions + noise).astype(np.float32)
    noisy[0] = 0
    taken = np.clip(noisy, low, high).astype(np.float32)
    taken[0] = 0
    return taken, int((taken[1:] != noisy[1:]).sum())


def labels(rgb: UInt8[np.ndarray, "B T S S 3"], judge: Judge) -> Int[np.ndarray, "B T"]:
    """Returns the index of the judge's label for each frame."""
    count = frames_of(judge)
    return np.stack([judge(last_frames(rgb[:, : frame + 1], count)).argmax(-1) for frame in range(rgb.shape[1])], 1)


def _file(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.clip"
