"""What the ``tiny`` preset is held to on held-out episodes, judged from a run's flat metrics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """One promise: ``measure`` of the metrics is at least (or at most) ``bound``."""

    name: str
    measure: Callable[[Mapping[str, float]], float]
    bound: float
    at_least: bool = True
    unit: str = "dB"


@dataclass(frozen=True)
class Verdict:
    """A target beside what was measured; ``margin`` is negative by how much it was missed."""

    target: Target
    measured: float

    @property
    def margin(self) -> float:
        difference = self.measured - self.target.bound
        return difference if self.target.at_least else -difference

    @property
    def met(self) -> bool:
        return self.margin >= 0


TARGETS = (
    Target("tokenizer reconstruction, PSNR", lambda m: m["psnr_tokenizer"], 27.0),
    Target("prediction above repeat-the-first-frame", lambda m: m["psnr"] - m["psnr_repeat_first"], 5.0),
    Target("prediction below the tokenizer's reconstruction", lambda m: m["psnr_tokenizer"] - m["psnr"], 2.0, False),
    Target("ΔPSNR, another clip's actions", lambda m: m["delta_psnr"], 3.0),
    Target(
        "depth AbsRel, as a share of repeat-the-first-frame's",
        lambda m: m["depth_absrel"] / m["depth_absrel_repeat_first"],
        0.5,
        False,
        "×",
    ),
    Target("whole run", lambda m: m["seconds_total"] / 60, 30.0, False, "min"),
)


def judge(metrics: Mapping[str, float]) -> list[Verdict]:
    """The verdicts on those targets whose metrics were measured."""
    verdicts = []
    for target in TARGETS:
        try:
            verdicts.append(Verdict(target, float(target.measure(metrics))))
        except KeyError:
            continue  # not measured in this run: no depth branch, say
    return verdicts
