"""The last stage: writes ``report.html`` and ``metrics.json``."""

import importlib.metadata
import json
import os
import platform
from typing import Any

import jax
import numpy as np

from rsjax.config import to_dict
from rsjax.evaluation import evaluate as evaluation
from rsjax.files import disk_guard, write_atomically
from rsjax.models.roboscape.keypoints import motion_magnitude
from rsjax.pipeline.run import STAGES, Run
from rsjax.report.figures import ClipFigure
from rsjax.report.page import Report, write_report
from rsjax.training.log import read_log

LIBRARIES = ("rsjax", "jax", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "robosuite", "mujoco")


def write_summary(run: Run, command: str) -> None:
    """Writes both files from the outputs of the previous stages.

    Args:
        command: the command that repeats the run.
    """
    result = evaluation.load(run.output("evaluation"))
    seconds = {stage: run.mark(stage)["seconds"] for stage in STAGES[:-1] if run.mark(stage)}
    metrics = result.metrics | {"seconds_total": round(sum(seconds.values()), 1)}
    cfg = run.config
    report = Report(
        preset=cfg.name,
        metrics=metrics,
        clips=[
            _figure(result.shown, i, cfg.prompt_frames, cfg.model.marked_keypoints)
            for i in range(len(result.shown["clip"]))
        ],
        logs={
            "tokenizer": read_log(run.directory / "tokenizer"),
            "world model": read_log(run.directory / "world_model"),
        },
        config=to_dict(cfg),
        versions=_versions(),
        seconds=seconds,
        command=command,
        show_targets=cfg.name == "tiny" and not cfg.data.key,  # targets are for the simulated clips
    )
    with disk_guard(run.directory):
        write_report(run.output("report"), report)
        write_atomically(run.directory / "metrics.json", json.dumps(metrics, indent=1).encode())


def _figure(shown: dict[str, np.ndarray], row: int, prompt_frames: int, keypoints: int) -> ClipFigure:
    names = ["truth", "prediction", "reconstruction", "other_actions"]
    names += ["true_depth", "predicted_depth"] if shown["has_depth"][row] else []
    arrays: dict[str, Any] = {name: shown[name][row] for name in names if name in shown}
    if keypoints:
        tracks, visible = shown["tracks"][row], shown["visible"][row]
        motion = np.asarray(motion_magnitude(tracks, visible))
        chosen = np.argsort(-motion)[:keypoints]
        arrays |= {"tracks": tracks, "visible": visible, "selected": chosen}
    title = f"test clip {int(shown['clip'][row])}: {shown['task'][row] or 'no task named'}"
    if shown["success"].any():  # otherwise success may be unknown
        title += " (success)" if shown["success"][row] else " (failure)"
    return ClipFigure(title=title, prompt_frames=prompt_frames, **arrays)


def _versions() -> dict[str, str]:
    device = jax.local_devices()[0]
    machine = {
        "python": platform.python_version(),
        "system": platform.platform(),
        "device": f"{jax.local_device_count()} × {device.device_kind}, {os.cpu_count()} CPU cores",
    }
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue  # without the simulator, for example
    return versions | machine
