"""Generation from held-out first frames, its scores, and the arrays that the report shows.

Axes: B clips, T frames, H×W pixels, A action dimensions, R draws of random actions.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Num, UInt8

from rsjax.data.store import Store, StoreError, decode, encode
from rsjax.evaluation import control, pixels
from rsjax.evaluation.depth import depth_scores, result_key
from rsjax.evaluation.statistics import bootstrap, over_predicted_frames
from rsjax.files import write_atomically
from rsjax.pipeline.clips import Clips, readable, spread
from rsjax.pipeline.generator import Generated, Generator, Tokens
from rsjax.progress import Progress

RANGE_CLIPS = 1000  # of the train split, out of whose actions the range of uniform random ones is taken


@dataclass(frozen=True)
class Evaluation:
    """Flat scores, and arrays of the clips that the report shows (each with a leading axis over them)."""

    metrics: dict[str, float]
    shown: dict[str, np.ndarray]


@dataclass(frozen=True)
class HeldOut:
    """Held-out clips, their tokens, and what those keep of them."""

    clips: Clips
    tokens: Tokens
    reconstruction: UInt8[np.ndarray, "B T H W 3"]
    depth_reconstruction: Float32[np.ndarray, "D T H W"]  # of the clips that have depth

    @classmethod
    def load(cls, generator: Generator, store: Store) -> "HeldOut":
        """``eval.clips`` of the test split.

        Raises:
            StoreError: one of them is damaged.
        """
        source, codec = store.source("test"), generator.codec
        numbers = spread(source, generator.config.eval.clips)
        clips = Clips.stacked([source[number] for number in numbers], numbers)
        tokens = clips.tokens(codec)
        depth = codec.decode_depth(tokens["depth"][clips.has_depth]) if "depth" in tokens else clips.depth[:0]
        return cls(clips, tokens, codec.decode_rgb(tokens["rgb"]), depth)

    def prompt(self, frames: int) -> Tokens:
        """The first frames' tokens."""
        return {name: grid[:, :frames] for name, grid in self.tokens.items()}


def evaluate(generator: Generator, clips: Store) -> Evaluation:
    """Scores the generator on the test split, beside repeat-the-first-frame and the tokenizer's reconstruction.

    Args:
        clips: the store that the generator was trained on; its test split is scored, its train split gives the range of
            uniform random actions.
    """
    held = HeldOut.load(generator, clips)
    given, truth = generator.config.mask.prompt_frames, held.clips.rgb
    plans = _plans(generator, held.clips.actions, clips)
    results: dict[str, list[Generated]] = {}
    rollouts = sum(len(draws) for draws in plans.values())
    with Progress("evaluation", rollouts * len(truth), "rollouts") as progress:
        done = 0
        for kind, draws in plans.items():
            for actions in draws:
                results.setdefault(kind, []).append(_generate(generator, held, actions, depth=kind == "own"))
                progress.update(done := done + len(truth))
    own = results["own"][0]

    metrics = _pixel_metrics(held, own.rgb, given)
    for kind, suffix in (("other", ""), ("uniform", "_uniform")):
        delta = np.stack([control.delta_psnr(truth, own.rgb, drawn.rgb) for drawn in results[kind]])
        for name, per_clip in control.clip_means(delta, given).items():
            metrics |= bootstrap(per_clip).flat(f"delta_psnr{suffix}" + ("" if name == "mean" else f"_{name}"))
        metrics[f"delta_psnr{suffix}_repeat_first"] = 0.0  # it does not look at the actions
    if own.depth is not None and held.clips.metric.any():
        metrics |= _depth_metrics(held, own.depth, given)
    metrics["clips"] = float(len(truth))
    if (share := clips.manifest.get("success_share")) is not None:
        metrics["success_share"] = float(share)
    return Evaluation(metrics, _shown(generator, held, own, results["other"][0]))


def _plans(generator: Generator, actions: Float[np.ndarray, "B T A"], clips: Store) -> dict[str, np.ndarray]:
    """The actions to generate under, by kind, each (R, B, T, A)."""
    draws = generator.config.eval.action_draws
    train = clips.source("train")
    low, high = control.action_range(
        np.stack([clip["actions"] for _, clip in readable(train, spread(train, RANGE_CLIPS))])
    )
    return {
        "own": actions[None],
        "other": actions[control.other_clips(len(actions), draws, seed=0)],
        "uniform": control.uniform_actions(actions, low, high, draws, seed=0),
    }


def _generate(generator: Generator, held: HeldOut, actions: np.ndarray, depth: bool) -> Generated:
    """All clips, in batches of one shape (so that one program is compiled)."""
    cfg, parts = generator.config, []
    prompt = held.prompt(cfg.mask.prompt_frames)
    for start in range(0, len(actions), cfg.eval.batch_size):
        rows = np.minimum(np.arange(start, start + cfg.eval.batch_size), len(actions) - 1)
        part = {name: grid[rows] for name, grid in prompt.items()}
        index, has_depth = held.clips.index[rows], held.clips.has_depth[rows]
        parts.append(generator.generate(part, actions[rows], cfg.sample, depth, index, has_depth))
    join = lambda arrays: np.concatenate([np.asarray(a) for a in arrays])[: len(actions)]  # noqa: E731
    return Generated(
        {name: join(p.tokens[name] for p in parts) for name in parts[0].tokens},
        join(p.rgb for p in parts),
        join(_depth_of(p) for p in parts) if any(p.depth is not None for p in parts) else None,
    )


def _depth_of(made: Generated) -> np.ndarray:
    """Generated depth; nothing known where none of these clips has any."""
    return np.full(made.rgb.shape[:-1], np.nan, np.float32) if made.depth is None else made.depth


def _repeat_first(frames: Num[np.ndarray, "B T *rest"], given: int) -> Num[np.ndarray, "B T *rest"]:
    """The last given frame in place of all that follow: the baseline that nothing moves."""
    return np.repeat(frames[:, given - 1 : given], frames.shape[1], axis=1)


def _pixel_metrics(held: HeldOut, predicted: np.ndarray, given: int) -> dict[str, float]:
    metrics: dict[str, float] = {}
    truth = held.clips.rgb
    candidates = {"": predicted, "_repeat_first": _repeat_first(truth, given), "_tokenizer": held.reconstruction}
    for name, score in (("psnr", pixels.psnr), ("ssim", pixels.ssim)):
        for suffix, frames in candidates.items():
            per_clip = over_predicted_frames(np.asarray(score(truth, frames)), given)
            metrics |= bootstrap(per_clip).flat(name + suffix)
    return metrics


def _depth_metrics(held: HeldOut, predicted: np.ndarray, given: int) -> dict[str, float]:
    """Of the clips whose depth is in metres."""
    metrics: dict[str, float] = {}
    metric = held.clips.metric
    truth = held.clips.depth[metric]
    candidates = {
        "": predicted[metric],
        "_repeat_first": _repeat_first(truth, given),
        "_tokenizer": held.depth_reconstruction[metric[held.clips.has_depth]],
    }
    for suffix, depth in candidates.items():
        scores = depth_scores(truth[:, given:], depth[:, given:], alignment="none")
        metrics |= bootstrap(scores.abs_rel).flat(result_key("absrel") + suffix)
        mean = scores.mean()
        metrics |= {result_key(name) + suffix: mean[name] for name in ("delta1", "delta2")}
    return metrics


def _shown(generator: Generator, held: HeldOut, own: Generated, other: Generated) -> dict[str, np.ndarray]:
    """Arrays of the clips in the report: successes and failures by turns, in the split's order."""
    clips = held.clips
    ends = clips.success[:, -1]
    good, bad = (list(np.flatnonzero(ends == outcome)) for outcome in (True, False))
    turns = [queue.pop(0) for _ in ends for queue in (good, bad) if queue]
    rows = np.array(turns[: generator.config.eval.report_clips])
    arrays: dict[str, Any] = {
        "clip": clips.index[rows],
        "task": np.array(clips.task)[rows],
        "truth": clips.rgb[rows],
        "reconstruction": held.reconstruction[rows],
        "prediction": own.rgb[rows],
        "other_actions": other.rgb[rows],
        "has_depth": clips.has_depth[rows],
        "true_depth": clips.depth[rows],
        "tracks": clips.tracks[rows],
        "visible": clips.visible[rows],
        "success": ends[rows],
    }
    return arrays | ({} if own.depth is None else {"predicted_depth": own.depth[rows]})


def save(path: Path, result: Evaluation) -> None:
    """Writes a result; it appears whole or not at all."""
    write_atomically(path, encode({"metrics": result.metrics} | result.shown))


def load(path: Path) -> Evaluation:
    """Reads what :func:`save` wrote.

    Raises:
        StoreError: the file is damaged.
    """
    try:
        record = decode(path.read_bytes())
    except ValueError as error:
        raise StoreError(f"{path}: damaged ({error}); delete it and run again") from error
    return Evaluation(record.pop("metrics"), record)
