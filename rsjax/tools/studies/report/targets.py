"""Quality targets of the ``tiny`` preset on test episodes, judged from a run's flat metrics."""

from collections.abc import Callable, Mapping
from operator import itemgetter
from typing import NamedTuple


class MetricBound(NamedTuple):
    """A lower (or upper) bound on a quantity computed from metrics."""

    name: str
    measure: Callable[[Mapping[str, float]], float]
    bound: float
    at_least: bool = True
    unit: str = "dB"


class Verdict(NamedTuple):
    """A target and its measurement. A negative ``margin`` is the amount by which the target was missed."""

    target: MetricBound
    measured: float
    margin: float


TARGETS = (
    MetricBound("prediction above repeating the first frame", lambda m: m["psnr"] - m["psnr_repeat_first"], 5.0),
    MetricBound(
        "prediction below the tokenizer's reconstruction", lambda m: m["psnr_tokenizer"] - m["psnr"], 3.0, False
    ),
    MetricBound(
        "the same, second half of the predicted frames",
        lambda m: m["psnr_tokenizer_second_half"] - m["psnr_second_half"],
        4.0,
        False,
    ),
    MetricBound("cube's place in the last frame, median error", itemgetter("cube_error_widths"), 0.3, False, "widths"),
    MetricBound("gripper's place, likewise", itemgetter("gripper_error_widths"), 0.3, False, "widths"),
    MetricBound("lifted or not, share read right", itemgetter("lifted_accuracy"), 0.9, unit=""),
    MetricBound(
        "grasps that fail in the simulator, share that succeed in the model",
        itemgetter("contact_false_success"),
        0.2,
        False,
        "",
    ),
    MetricBound(
        "gripper's place in frame 48 of a drive, median error",
        itemgetter("drive_gripper_error_widths"),
        0.5,
        False,
        "widths",
    ),
    MetricBound(
        "frames of drives worse than the first repeated, share", itemgetter("drive_worse_frames"), 0.0, False, ""
    ),
    MetricBound("ΔPSNR, another clip's actions", itemgetter("delta_psnr"), 7.0),
    MetricBound(
        "depth AbsRel, relative to repeating the first frame",
        lambda m: m["depth_absrel"] / m["depth_absrel_repeat_first"],
        0.2,
        False,
        "×",
    ),
    MetricBound("whole run", lambda m: m["seconds_total"] / 60, 30.0, False, "min"),
)


def judge(metrics: Mapping[str, float]) -> list[Verdict]:
    """Judges the targets whose metrics were measured."""
    verdicts = []
    for target in TARGETS:
        try:
            measured = float(target.measure(metrics))
        except KeyError:
            continue  # not measured: a model without depth, for example
        margin = measured - target.bound if target.at_least else target.bound - measured
        verdicts.append(Verdict(target, measured, margin))
    return verdicts
