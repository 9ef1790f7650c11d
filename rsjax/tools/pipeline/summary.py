"""The last stage: writes ``report.html``, ``metrics.json`` and ``curves.json``."""

from typing import Any

import numpy as np

from rsjax.config import Config, to_dict
from rsjax.evaluation.results import Evaluation, load_evaluation
from rsjax.files import write_json
from rsjax.models.roboscape.objective import motion_magnitude
from rsjax.tools.pipeline.provenance import read_starts
from rsjax.tools.pipeline.run import TRAINED, Run
from rsjax.tools.studies.report.figures import ClipFigure
from rsjax.tools.studies.report.page import RunReport, write_report
from rsjax.training.log import read_log

LIBRARIES = ("rsjax", "jax", "flax", "optax", "orbax-checkpoint", "grain", "numpy", "robosuite", "mujoco")


def write_summary(run: Run, command: str) -> None:
    """Writes the three files from the outputs of the previous stages.

    Args:
        command: the command that repeats the run.
    """
    result = load_evaluation(run.output("evaluation"))
    seconds = {stage: run.seconds(stage) for stage in run.stages[:-1] if run.mark(stage)}
    metrics = result.metrics | {"seconds_total": round(sum(seconds.values()), 1)}
    cfg = run.config
    start = read_starts(run.directory)[-1]
    machine = start["machine"]
    versions = {name: start["packages"][name] for name in LIBRARIES if name in start["packages"]}
    versions |= {
        "python": machine["python"],
        "system": machine["system"],
        "device": f"{machine['local_devices']} × {machine['device_kind']}, {machine['cpu_cores']} CPU cores",
    }
    report = RunReport(
        preset=cfg.name,
        metrics=metrics,
        reasons=result.reasons,
        clips=[_figure(result, i, cfg) for i in range(len(result.shown["clip"]))],
        curves=result.curves,
        per_clip=result.per_clip,
        logs={stage.replace("_", " "): read_log(run.directory / stage) for stage in TRAINED},
        config=to_dict(cfg),
        versions=versions,
        seconds=seconds,
        command=command,
        show_targets=cfg.name == "tiny" and cfg.data is None,  # the targets hold for simulated clips
    )
    write_report(run.output("report"), report)
    write_json(run.directory / "metrics.json", metrics | dict.fromkeys(result.reasons) | {"reasons": result.reasons})
    write_json(run.directory / "curves.json", result.curves)


def _figure(result: Evaluation, row: int, config: Config) -> ClipFigure:
    shown = result.shown
    names = ["truth", "prediction", "reconstruction", "other_actions"]
    names += ["true_depth", "predicted_depth"] if shown["has_depth"][row] else []
    arrays: dict[str, Any] = {name: shown[name][row] for name in names if name in shown}
    if config.model.marked_keypoints:
        tracks = shown["tracks"][row]
        visible = shown["visible"][row]
        chosen = np.argsort(-np.asarray(motion_magnitude(tracks, visible)))[: config.model.marked_keypoints]
        arrays |= {"tracks": tracks, "visible": visible, "selected": chosen}
    label = f"test clip {int(shown['clip'][row])}"
    title = f"{label}: {shown['task'][row] or 'no task named'}"
    if shown["success"].any():  # otherwise it may be unknown
        title += " (success)" if shown["success"][row] else " (failure)"
    rank = _rank(int(shown["rank"][row]), int(result.metrics["clips"]))
    score = f"{shown['psnr'][row]:.1f} dB"
    title = f"{title}, {rank}: {score}"
    label = f"{rank.split(' of ')[0]}, {score}"
    unit = "metres" if shown.get("metric", shown["has_depth"])[row] else "relative"
    return ClipFigure(title=title, prompt_frames=config.prompt_frames, depth_unit=unit, label=label, **arrays)


def _rank(rank: int, clips: int) -> str:
    """Describes a clip's rank, counted from the worst, in words; 0 means a typical clip."""
    if not rank:
        return "typical"
    ending = {1: "st ", 2: "nd ", 3: "rd "}.get(rank % 10 * (rank // 10 % 10 != 1), "th ")
    return f"{'' if rank == 1 else f'{rank}{ending}'}worst of {clips}"
