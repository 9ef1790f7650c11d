"""Predicts from a world model's features whether an object is soft. ``python -m rsjax.tools.studies.softness RUN``

The simulator ``rope`` has a rope and a rod that differ in nothing but stiffness: the same geometry, colours, starting
bends and scripted behaviours, so that only how the object answers to the fingers tells them apart. A logistic
regression with an L2 penalty reads each clip's features, pooled over its frames, and is cross-validated by episode:
each clip is an episode of its own start. The baselines read pixels, and the controls what should tell little or
nothing: the first frame, the actions, and the same network before training.

Axes: N clips, T frames, K features, S×S pixels.
"""

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float, Int, UInt8

import rsjax
from rsjax.config import SimConfig, require
from rsjax.config.sim import ROPE_TASKS
from rsjax.data.clips import Clips
from rsjax.data.store import open_store
from rsjax.evaluation.coverage import features_of
from rsjax.evaluation.statistics import bootstrap
from rsjax.files import write_json
from rsjax.models.trained import TrainedModel
from rsjax.progress import Progress
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.logistic_regression import fit
from rsjax.tools.pipeline.limits import check_episodes
from rsjax.tools.sim.collect import collect, collection_key
from rsjax.tools.studies.tables import Table, as_markdown

PROG = "python -m rsjax.tools.studies.softness"
KIND = "softness"  # of a file of results
SEED = 71_000  # of the episodes, which no training uses
FOLDS = 10
INNER = 5  # folds within a training fold, which choose the penalty
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
CELLS = 8  # of the pictures' grid along each side
LEVELS = 4  # of each colour in a histogram


@dataclass(frozen=True)
class Options:
    """Predicts rope or rod from a model's features and from pixels, over new episodes of the simulator "rope"."""

    run: tyro.conf.Positional[str] = tyro.MISSING
    """A run directory or a saved model, trained on clips of the simulators lift or rope."""
    episodes: int = 300
    """Episodes to simulate, half of them of each object."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    json: Path | None = None
    """Write the numbers to this file."""


@dataclass(frozen=True)
class ShareRight:
    """The share of clips classified correctly, and its 95 % interval over clips.

    Attributes:
        lifted: the same over the clips in which the object leaves the table.
    """

    accuracy: float
    low: float
    high: float
    lifted: float


def clip_features(trained: TrainedModel, clips: Clips) -> dict[str, Float[np.ndarray, "N K"]]:
    """Returns every set of features by name: the model's, the baselines' and the controls'.

    Raises:
        ConfigError: the model's family returns no features.
    """
    first = trained.config.prompt_frames
    untrained = replace(trained, params=jax.jit(trained.model.init)(jax.random.key(0)))
    models = {}
    for name, model in {"model": trained, "untrained network": untrained}.items():
        features = features_of(model, clips.video, clips.actions, first)
        require(features is not None, f"a model of family {trained.config.model.family} returns no features")
        models[name] = pooled(features)  # type: ignore[arg-type]
    small = shrunk(clips.rgb)
    pictures = small[:, first:].reshape(len(small), -1, 3 * CELLS**2)
    motion = np.abs(np.diff(small, axis=1)).reshape(len(small), -1, 3 * CELLS**2)[:, first - 1 :]
    return models | {
        "pixels and their motion": pooled(np.concatenate([pictures, motion], axis=-1)),
        "colour histogram": pooled(histograms(clips.rgb[:, first:])),
        "first frame": small[:, 0].reshape(len(small), -1),
        "actions": pooled(clips.actions[:, first:]),
    }


def pooled(frames: Float[np.ndarray, "N T K"]) -> Float[np.ndarray, "N 2K"]:
    """Returns mean and standard deviation over a clip's frames."""
    return np.concatenate([frames.mean(1), frames.std(1)], axis=-1).astype(np.float64)


def shrunk(rgb: UInt8[np.ndarray, "N T S S 3"]) -> Float[np.ndarray, "N T 8 8 3"]:
    """Returns the means of ``CELLS``² parts of each picture, 0 to 1."""
    side = rgb.shape[2] // CELLS
    cut = rgb[:, :, : side * CELLS, : side * CELLS]
    return cut.reshape(*rgb.shape[:2], CELLS, side, CELLS, side, 3).mean((3, 5)) / 255


def histograms(rgb: UInt8[np.ndarray, "N T S S 3"]) -> Float[np.ndarray, "N T 64"]:
    """Returns the share of a picture's pixels in each of ``LEVELS``³ colours."""
    levels = rgb.astype(int) * LEVELS // 256
    colours = levels @ np.array([LEVELS**2, LEVELS, 1])
    flat = colours.reshape(*rgb.shape[:2], -1)
    return np.stack([(flat == colour).mean(-1) for colour in range(LEVELS**3)], axis=-1)


def predicted(
    features: Float[np.ndarray, "N K"], soft: Bool[np.ndarray, " N"], folds: int = FOLDS
) -> Bool[np.ndarray, " N"]:
    """Returns what the probe predicts for each clip when the clips of its fold are left out.

    The penalty is chosen within the other folds.
    """
    fold = np.random.default_rng(0).permutation(len(soft)) % folds
    out = np.zeros(len(soft), bool)
    for number in range(folds):
        rest = np.flatnonzero(fold != number)
        inner = np.arange(len(rest)) % INNER
        right = []
        for penalty in PENALTIES:
            asked = np.zeros(len(rest), bool)
            for part in range(INNER):
                asked[inner == part] = answers(features, soft, rest[inner != part], rest[inner == part], penalty)
            right.append((asked == soft[rest]).sum())
        best = PENALTIES[int(np.argmax(right))]
        out[fold == number] = answers(features, soft, rest, np.flatnonzero(fold == number), best)
    return out


def answers(
    features: Float[np.ndarray, "N K"],
    soft: Bool[np.ndarray, " N"],
    learned: Int[np.ndarray, " L"],
    asked: Int[np.ndarray, " M"],
    penalty: float,
) -> Bool[np.ndarray, " M"]:
    """Returns what a probe that has learned from some clips says of others; the penalty is beside the mean loss."""
    return fit(features[learned], soft[learned], penalty * len(learned))(features[asked]) > 0.5


def study(trained: TrainedModel, clips: Clips) -> dict[str, Any]:
    """Returns the score of each set of features, and by how much the model's beats the best baseline from pixels."""
    soft = np.array([task == ROPE_TASKS[0] for task in clips.task])
    lifted = clips.success.any(1)
    right = {name: predicted(rows, soft) == soft for name, rows in clip_features(trained, clips).items()}
    scores = {}
    for name, hits in right.items():
        estimate = bootstrap(hits.astype(float))
        assert estimate.low is not None and estimate.high is not None
        scores[name] = ShareRight(estimate.value, estimate.low, estimate.high, float(hits[lifted].mean()))
    baseline = max(("pixels and their motion", "colour histogram"), key=lambda name: scores[name].accuracy)
    gain = bootstrap(right["model"].astype(float) - right[baseline])
    return {
        "clips": len(soft),
        "soft": int(soft.sum()),
        "lifted": int(lifted.sum()),
        "scores": {name: asdict(score) for name, score in scores.items()},
        "baseline": baseline,
        **gain.flat("gain"),
    }


def tables(numbers: Mapping[str, Any]) -> dict[str, Table]:
    """Returns the table "scores"."""
    rows = []
    for name, score in numbers["scores"].items():
        share = f"{score['accuracy']:.1%} ({score['low']:.1%} … {score['high']:.1%})"
        rows.append([name, share, f"{score['lifted']:.1%}"])
    return {"scores": Table(["features", "told right, 95 % interval", "where the object is lifted"], rows)}


def summary(numbers: Mapping[str, Any]) -> str:
    """Returns what stands below the table."""
    gain = f"{100 * numbers['gain']:+.1f} ({100 * numbers['gain_low']:+.1f} … {100 * numbers['gain_high']:+.1f})"
    return (
        f"{numbers['run']}; {numbers['clips']} clips, {numbers['soft']} of them soft, the object lifted in "
        f"{numbers['lifted']}. The model's features over {numbers['baseline']}: {gain} points."
    )


def episodes_like(sim: SimConfig, episodes: int) -> SimConfig:
    """Returns the configuration of new episodes of rope and rod, of the shape of a model's clips.

    Raises:
        ConfigError: the model's clips are of another arm, or there are too few episodes.
    """
    require(sim.env != "metaworld", "the run's clips are of Meta-World, whose actions a rope's episodes do not have")
    require(episodes >= 4 * FOLDS, f"--episodes is {episodes}; cross-validation takes {4 * FOLDS} at least")
    return replace(
        sim,
        env="rope",
        tasks=(),
        unseen_tasks=(),
        recipe=("expert",),
        camera="near",
        episodes=episodes,
        test_episodes=episodes - 1,
        seed=SEED,
    )


@main_errors()
def main() -> None:
    """Simulates the episodes unless they exist, and prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    trained = rsjax.load(options.run)
    sim = episodes_like(trained.config.sim, options.episodes)
    out = options.data_dir / f"rope-{collection_key(sim)}"
    check_episodes(sim, out, "--episodes")
    with Progress("collect", sim.episodes, "episodes") as progress:
        collect(sim, out, lambda done, total: progress.update(done))
    store = open_store(out)
    sources = [store.source(split) for split in store.splits]
    records = [source[number] for source in sources for number in range(len(source))]
    numbers = study(trained, Clips.stacked(records, range(len(records))))
    numbers = {"kind": KIND, "run": options.run} | numbers
    print(as_markdown(tables(numbers)["scores"]), summary(numbers), sep="\n\n")
    if options.json:
        write_json(options.json, numbers)


if __name__ == "__main__":
    main()
