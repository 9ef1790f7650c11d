"""Trains policies on synthetic and on real demonstrations, and compares their success in the simulator."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.errors import UserError
from rsjax.evaluation.statistics import Estimate, can_lose, share_difference, verdict, welch, wilson
from rsjax.files import write_file, write_json
from rsjax.progress import stage
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.studies.figures import success_curves
from rsjax.tools.policies.studies.trials import Trials, try_policy
from rsjax.tools.policies.worlds.world import World
from rsjax.tools.studies.tables import Table, as_markdown

SAME = 0.1  # "as good as real demonstrations" allows a success rate that is lower by this much


@dataclass(frozen=True)
class PolicyTraining:
    """One policy to train: the numbers of real and synthetic demonstrations, and a multiple of the usual steps."""

    name: str
    real: int
    synthetic: int
    steps: int = 1


@dataclass(frozen=True)
class Learning:
    """The settings of a comparison.

    Attributes:
        counts: numbers of demonstrations; the paper's are 50, 100, 150, 200.
        seeds: trainings of each cell.
        cells: names of the cells to run; empty: all.
    """

    counts: tuple[int, ...] = (50, 100, 150, 200)
    seeds: int = 1
    cells: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.counts or min(self.counts) < 1 or self.seeds < 1:
            raise UserError(f"--counts {self.counts} and --seeds {self.seeds} must be 1 at least")

    def chosen(self) -> list[PolicyTraining]:
        """Returns the cells to run.

        For each number of ``counts`` there is a cell with that many synthetic demonstrations and, as a control of equal
        size, one with that many real ones. The largest number of both together trains for twice the steps; its control
        is the largest number of real ones for twice the steps, which repeats the data.

        Raises:
            UserError: a name is unknown.
        """
        counts = sorted(set(self.counts))
        most = max(self.counts)
        cells = [PolicyTraining(f"synthetic-{count}", 0, count) for count in counts]
        cells += [PolicyTraining(f"real-{count}", count, 0) for count in counts]
        cells.append(PolicyTraining(f"real-{most}-repeated", most, 0, 2))
        cells.append(PolicyTraining(f"real-{most}-synthetic-{most}", most, most, 2))
        if unknown := set(self.cells) - {cell.name for cell in cells}:
            names = ", ".join(map(repr, sorted(unknown)))
            raise UserError(f"--cells: no cell {names}; there are {', '.join(cell.name for cell in cells)}")
        return [cell for cell in cells if not self.cells or cell.name in self.cells]


def learn(
    settings: Learning, config: PolicyConfig, real: Demos, synthetic: Demos, world: World, trials: Trials, out: Path
) -> dict[str, Any]:
    """Trains and tests every cell that is not finished; writes ``results.json``, a table and a figure.

    Args:
        real, synthetic: the demonstrations; each cell takes as many as it needs, from the first on.
        world: the simulator.
        out: the directory of the results, with a folder for each cell and seed.

    Returns:
        The content of ``results.json``.

    Raises:
        UserError: there are too few demonstrations, or ``out`` holds others.
    """
    cells = settings.chosen()
    rows = []
    for cell in cells:  # raises before hours of training if there are too few
        _demos(cell, real, synthetic)
    for number, cell in enumerate(cells, 1):
        stage(number, len(cells), cell.name, f"{cell.real} real and {cell.synthetic} synthetic demonstrations")
        success = []
        clipped = []
        for seed in range(settings.seeds):
            folder = out / f"{cell.name}-seed{seed}"
            loop = replace(config.train, steps=config.train.steps * cell.steps)
            name = f"{cell.name} seed {seed}"
            policy = train_policy(
                replace(config, train=loop), _demos(cell, real, synthetic), folder, seed=seed, name=name
            )
            tried = try_policy(policy, world, trials.seeds, trials, folder / "trials", name)
            success.append(tried.success)
            clipped.append(tried.clipped)
        rows.append(asdict(cell) | {"success": success, "clipped": clipped})
        results: dict[str, Any] = {"trials": asdict(trials), "rows": rows, "claims": claims(rows, max(settings.counts))}
        write_json(out / "results.json", results)
        write_file(out / "results.md", learning_tables(rows, results["claims"]).encode())
        series: dict[str, list[tuple[float, Estimate]]] = {}
        for row in rows:
            if row["real"] and row["synthetic"]:
                kind = "both"
            elif row["steps"] > 1:
                kind = "repeated"
            elif row["real"]:
                kind = "real"
            else:
                kind = "synthetic"
            series.setdefault(kind, []).append((row["real"] + row["synthetic"], pooled(row)))
        write_file(out / "success.png", success_curves(series))
    return results


def _demos(cell: PolicyTraining, real: Demos, synthetic: Demos) -> Demos:
    parts = [source.first(count) for source, count in ((real, cell.real), (synthetic, cell.synthetic)) if count]
    if len(parts) == 1:
        return parts[0]
    return parts[0] + parts[1]


def pooled(row: dict[str, Any]) -> Estimate:
    """Returns a row's share of successes over all seeds and episodes, with its Wilson interval."""
    flat = np.ravel(row["success"])
    return wilson(int(flat.sum()), len(flat))


def claims(rows: Sequence[dict[str, Any]], most: int) -> list[dict[str, Any]]:
    """Returns the verdicts on the paper's claims that follow from differences between rows."""
    success = {row["name"]: np.array(row["success"], float) for row in rows}
    least = min((row["synthetic"] for row in rows if row["synthetic"] and not row["real"]), default=0)
    wanted = [
        (f"{count} synthetic as good as {count} real", f"synthetic-{count}", f"real-{count}", -SAME)
        for count in sorted({row["real"] for row in rows if row["real"]})
    ]
    wanted += [
        ("more synthetic is better", f"synthetic-{most}", f"synthetic-{least}", 0.0),
        ("synthetic on top of real helps", f"real-{most}-synthetic-{most}", f"real-{most}-repeated", 0.0),
    ]
    verdicts = []
    for claim, one, other, margin in wanted:
        if one != other and one in success and other in success:
            interval = difference(success[one], success[other])
            if can_lose(success[other], -margin):
                holds = verdict(interval, "higher", margin)
            else:
                holds = "cannot tell"
            verdicts.append(
                {"claim": claim, "compares": [one, other], **asdict(interval), "margin": margin, "verdict": holds}
            )
    return verdicts


def difference(one: Float[np.ndarray, "seeds episodes"], other: Float[np.ndarray, "seeds episodes"]) -> Estimate:
    """Returns the difference of two rates of success: with the interval over trials or over trainings, the wider one.

    More trials of one training do not tell how another training would end, so with two seeds or more the interval over
    the seeds' rates (Welch's) counts too. With one seed, the interval is about this training alone.
    """
    trials = share_difference(one, other)
    trainings = welch(one.mean(1), other.mean(1))
    if trainings is None:
        return trials
    over = trainings.difference
    assert trials.low is not None and trials.high is not None and over.low is not None and over.high is not None
    return Estimate(trials.value, min(trials.low, over.low), max(trials.high, over.high))


def learning_tables(rows: Sequence[dict[str, Any]], verdicts: Sequence[dict[str, Any]]) -> str:
    """Returns the results in Markdown."""
    policies = []
    for row in rows:
        share = pooled(row)
        demos = " + ".join(f"{row[kind]} {kind}" for kind in ("real", "synthetic") if row[kind])
        policies.append([row["name"], demos, percent(share), interval_text(share), str(np.size(row["success"]))])
    lines = [as_markdown(Table(("policy", "demonstrations", "success", "95 %", "episodes"), policies))]
    differences = []
    for claim in verdicts:
        gap = Estimate(claim["value"], claim["low"], claim["high"])
        margin = f" (margin {100 * claim['margin']:g})" if claim["margin"] else ""
        differences.append([f"{claim['claim']}{margin}", percent(gap), interval_text(gap), claim["verdict"]])
    if differences:
        lines += ["", as_markdown(Table(("claim", "difference", "95 %", ""), differences))]
    return "\n".join([*lines, ""])


def percent(share: Estimate) -> str:
    return f"{100 * share.value:.0f} %"


def interval_text(share: Estimate) -> str:
    if share.low is None or share.high is None:
        return ""
    return f"{100 * share.low:.0f} … {100 * share.high:.0f} %"
