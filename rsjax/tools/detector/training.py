"""Trains the detector on the frames that evaluations of runs kept, and measures it on clips and models left out.

A finished run keeps the true frames, and those that its model generated, of some held-out clips. Runs on the same clips
keep the same true frames, so runs are left out by their clips: no frame of a test is in the training.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from rsjax.config import Config, require
from rsjax.evaluation.results import read_frames
from rsjax.files import write_file
from rsjax.models.load_run import load_config
from rsjax.progress import Progress
from rsjax.tools.detector.spectra import Detector, video_features
from rsjax.tools.logistic_regression import fit
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper.result_files import as_text, provenance
from rsjax.tools.studies.report.video import mp4, webp
from rsjax.tools.studies.tables import Table, as_markdown

Treatment = Callable[[UInt8[np.ndarray, "T H W 3"]], UInt8[np.ndarray, "T H W 3"]]


KIND = "detector"  # of a file of results
HEAD = ("runs", "AUC ↑", "lowest run's", "generated videos caught ↑", "real ones called generated ↓")


def h264(crf: int) -> Treatment:
    """Returns the encoding as H.264 with a constant rate factor, and decoding."""

    def treat(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
        with av.open(io.BytesIO(mp4(frames, 5.0, crf)), "r") as container:
            return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])

    return treat


def as_webp(quality: int) -> Treatment:
    """Returns the encoding of each frame as lossy WebP, and decoding."""

    def treat(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
        return np.stack([np.asarray(Image.open(io.BytesIO(webp(frame, quality)))) for frame in frames])

    return treat


def enlarged(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns frames of 1.5 times the side, by bilinear interpolation."""
    size = (frames.shape[2] * 3 // 2, frames.shape[1] * 3 // 2)
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_LINEAR) for frame in frames])


def softened(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns frames blurred a little, by a Gaussian of 0.8 pixels."""
    return np.stack([cv2.GaussianBlur(frame, (0, 0), 0.8) for frame in frames])


def noisy(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns frames with Gaussian noise of 4 levels, the same for every video."""
    noise = np.random.default_rng(0).normal(0, 4, frames.shape)
    return np.clip(frames + noise, 0, 255).astype(np.uint8)


def unchanged(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns the frames as they are."""
    return frames


def halved(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns frames of half the side, each pixel the mean of four."""
    size = (frames.shape[2] // 2, frames.shape[1] // 2)
    return np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])


def sharpened(frames: UInt8[np.ndarray, "T H W 3"]) -> UInt8[np.ndarray, "T H W 3"]:
    """Returns frames with twice their difference from a Gaussian blur of one pixel."""
    blurred = np.stack([cv2.GaussianBlur(frame, (0, 0), 1.0) for frame in frames]).astype(float)
    return np.clip(2 * frames.astype(float) - blurred, 0, 255).astype(np.uint8)


AS_IT_IS = "as it is"
TREATMENTS: dict[str, Treatment] = {
    AS_IT_IS: unchanged,
    "MP4, CRF 18": h264(18),
    "MP4, CRF 28": h264(28),
    "MP4, CRF 35": h264(35),
    "WebP, quality 80": as_webp(80),
    "WebP, quality 30": as_webp(30),
    "1.5 times as large": enlarged,
    "softened": softened,
    "noise": noisy,
    "half as large": halved,
    "sharpened": sharpened,
}
LEARNED = (AS_IT_IS, "MP4, CRF 18", "MP4, CRF 28", "WebP, quality 80", "1.5 times as large", "softened", "noise")


@dataclass(frozen=True)
class RunFeatures:
    """The features of a run's real and generated videos.

    Attributes:
        name: of the run's directory.
        family: of its model.
        clips: what its clips are; runs with the same ones may have the same real videos.
        real, generated: the features of N videos each, by treatment.
    """

    name: str
    family: str
    clips: str
    real: Mapping[str, Float[np.ndarray, "N F"]]
    generated: Mapping[str, Float[np.ndarray, "N F"]]


def read_footage(run: Path) -> RunFeatures:
    """Reads the predicted frames that the run's evaluation kept, and the true ones beside them.

    Raises:
        UserError: the run is not finished, or its frames are damaged.
    """
    config = load_config(run)
    kept = read_frames(Run(config, run, Path("data")).output("evaluation").parent)
    first = config.prompt_frames
    return RunFeatures(
        run.name,
        config.model.family,
        clips_name(config),
        treated_features(kept["truth"][:, first:]),
        treated_features(kept["prediction"][:, first:]),
    )


def clips_name(config: Config) -> str:
    """Returns a name of a run's clips: equal seeds of a simulator give equal episodes, whatever their number."""
    if config.data is not None:
        return str(config.data.key)
    return f"{config.sim.env}, seed {config.sim.seed}"


def treated_features(videos: UInt8[np.ndarray, "N T H W 3"]) -> dict[str, Float[np.ndarray, "N F"]]:
    """Returns the features of videos after each treatment."""
    return {name: np.stack([video_features(treat(video)) for video in videos]) for name, treat in TREATMENTS.items()}


def train(footage: Sequence[RunFeatures]) -> Detector:
    """Trains a detector on runs' real and generated videos, as they are and re-encoded."""
    real = [each.real[name] for each in footage for name in LEARNED]
    generated = [each.generated[name] for each in footage for name in LEARNED]
    labels = np.repeat([False, True], [sum(map(len, real)), sum(map(len, generated))])
    return Detector(fit(np.concatenate(real + generated), labels))


def measure(footage: Sequence[RunFeatures]) -> list[dict[str, Any]]:
    """Tests detectors on runs whose clips, and then also whose family of models, are left out of the training.

    Returns:
        A row for each run, treatment and kind of training: ``without`` is "clips", or "clips and family".

    Raises:
        ConfigError: all runs have the same clips.
    """
    kinds = sorted({each.clips for each in footage})
    require(len(kinds) > 1, f"all runs are on the same clips ({kinds[0]}); to measure, give runs on others as well")
    rows = []
    with Progress("detector", len(footage), "runs") as progress:
        for number, left_out in enumerate(footage):
            others = [each for each in footage if each.clips != left_out.clips]
            rows += tested(train(others), left_out, "clips")
            strangers = [each for each in others if each.family != left_out.family]
            if strangers:
                rows += tested(train(strangers), left_out, "clips and family")
            progress.update(number + 1)
    return rows


def tested(detector: Detector, left_out: RunFeatures, without: str) -> list[dict[str, Any]]:
    """Returns a row for each treatment: how a detector does on a run."""
    about = {"run": left_out.name, "family": left_out.family, "clips": left_out.clips, "without": without}
    return [
        about | {"treatment": name} | scores(detector(left_out.real[name]), detector(left_out.generated[name]))
        for name in TREATMENTS
    ]


def scores(real: Float[np.ndarray, " N"], generated: Float[np.ndarray, " M"]) -> dict[str, float]:
    """Returns how well probabilities tell generated videos from real ones.

    Returns:
        ``auc``, the share of pairs in which the generated video has the higher one; ``caught``, the share of generated
        videos, and ``false_alarms``, that of real ones, above 0.5; and the counts of both.
    """
    above = (generated[:, None] > real).mean() + (generated[:, None] == real).mean() / 2
    return {
        "auc": round(float(above), 4),
        "caught": round(float((generated > 0.5).mean()), 4),
        "false_alarms": round(float((real > 0.5).mean()), 4),
        "real": len(real),
        "generated": len(generated),
    }


def tables(rows: Sequence[Mapping[str, Any]]) -> dict[str, Table]:
    """Returns the tables of a measurement: "treatments", over all runs, and "families", for frames as they are."""
    treatments = []
    for name in TREATMENTS:
        label = name
        if name not in LEARNED:
            label = f"{name} (not in the training)"
        chosen = [row for row in rows if (row["treatment"], row["without"]) == (name, "clips")]
        treatments.append(summary(label, chosen))
    families = []
    for family in sorted({row["family"] for row in rows}):
        for without in ("clips", "clips and family"):
            chosen = [row for row in rows if (row["family"], row["without"]) == (family, without)]
            chosen = [row for row in chosen if row["treatment"] == AS_IT_IS]
            if chosen:
                families.append(summary(f"{family}, without its {without}", chosen))
    return {
        "treatments": Table(["frames", *HEAD], treatments),
        "families": Table(["tested on, trained", *HEAD], families),
    }


def summary(name: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns a row of a table: means over runs, and the worst run's AUC."""
    mean = {key: np.mean([row[key] for row in rows]) for key in ("auc", "caught", "false_alarms")}
    worst = min(row["auc"] for row in rows)
    shares = [f"{100 * mean[key]:.0f} %" for key in ("caught", "false_alarms")]
    return [name, str(len(rows)), f"{mean['auc']:.3f}", f"{worst:.3f}", *shares]


def make_detector(runs: Sequence[Path], out: Path, measured: Path | None) -> Iterator[str]:
    """Trains a detector on finished runs and writes it; with ``measured``, tests it first.

    Yields:
        Lines to print.

    Raises:
        UserError: a run is not finished; or, with ``measured``, all runs are on the same clips.
    """
    footage = []
    with Progress("frames", len(runs), "runs") as progress:
        for run in runs:
            footage.append(read_footage(run))
            progress.update(len(footage))
    about = {"runs": [each.name for each in footage]}
    about |= provenance([Run(load_config(run), run, Path("data")) for run in runs])
    if measured is not None:
        rows = measure(footage)
        write_file(measured, as_text({"kind": KIND} | about | {"rows": rows}).encode())
        for table in tables(rows).values():
            yield f"{as_markdown(table)}\n"
    detector = train(footage)
    replace(detector, about=about).save(out)
    yield str(out)
