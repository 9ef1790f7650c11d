"""Judges policies in world models: does success there follow success in the true simulator (Fig. 5)?"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.evaluation.statistics import Estimate, wilson
from rsjax.files import write_file, write_json
from rsjax.progress import note, stage
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.judges.validation import markdown, summary
from rsjax.tools.policies.policy import Policy, load_policy
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.studies.agreement import agreement
from rsjax.tools.policies.studies.figures import scatter, side_by_side
from rsjax.tools.policies.studies.policy_learning import interval_text, percent
from rsjax.tools.policies.studies.trials import FPS, Result, Trials, first_frames, try_policy
from rsjax.tools.policies.worlds.world import World
from rsjax.tools.studies.report.video import write_mp4
from rsjax.tools.studies.tables import ABSENT, Table, as_markdown

SHARES = (0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 0.75)  # of the training after which policies are saved, before its end

NUMBERS = {
    "r2_line": "R² of the line",
    "r2_identity": "R² of y = x",
    "r2_prediction": "R² of y for x",
    "spearman": "Spearman",
    "mmrv": "MMRV",
}
AGREEMENT_HEAD = ("run", "Pearson r", "95 %", *NUMBERS.values(), "bias", "same outcome", "uninterpretable")
SUCCESS_HEAD = ("policy", "in", "success", "95 %", "uninterpretable", "numbers clipped")
FORMULAS = (
    "x: success in the simulator, y: in the world model. R² of y = x is 1 - Σ(y - x)² / Σ(y - ȳ)²; R² of y for x, a "
    "prediction of x, is 1 - Σ(y - x)² / Σ(x - x̄)². Where y spreads more than x, the first is higher; signs may differ."
)


def checkpoints(config: PolicyConfig, demos: Demos, directory: Path, count: int = 8) -> dict[str, Policy]:
    """Trains one policy and returns it at ``count`` stages of its training, from useless to good, by name.

    A very short training has fewer stages; a note then says so.
    """
    steps = config.train.steps
    shares = np.interp(np.linspace(0, 1, count - 1), np.linspace(0, 1, len(SHARES)), SHARES)
    stops = sorted({max(1, round(share * steps)) for share in shares} - {steps})
    if len(stops) < count - 1:
        note(f"{steps} training steps have {len(stops) + 1} stages, not {count}; more steps, or fewer checkpoints")
    last = train_policy(config, demos, directory, name="policy", stops=stops)
    return {f"step-{stop}": load_policy(directory / f"at-{stop}") for stop in stops} | {f"step-{steps}": last}


def compare(
    policies: Mapping[str, Policy],
    simulator: World,
    models: Mapping[str, Callable[[], World]],
    trials: Trials,
    out: Path,
) -> dict[str, Any]:
    """Runs each policy from the same first frames in the simulator and in each world model; keeps finished results.

    Args:
        policies: by name.
        simulator: the true simulator.
        models: functions that make the world of each run, by the run's name.
        out: the folder of all rollouts, ``results.json`` (null: undefined, such as a correlation without variation),
            ``results.md``, ``scatter.png`` and videos (left: simulator, right: world model).

    Returns:
        The content of ``results.json``.
    """
    frames = first_frames(simulator, trials.seeds, out / "starts.npz")
    true: dict[str, Result] = {}
    for name, policy in policies.items():
        folder = out / "simulator" / name
        true[name] = try_policy(
            policy, simulator, trials.seeds, trials, folder, f"{name} in simulator", save_frames=True
        )
    rows: list[dict[str, Any]] = []
    for number, (run, make) in enumerate(models.items(), 1):
        stage(number, len(models), run, "rolling policies out in this world model")
        world = make()
        imagined = {}
        for name, policy in policies.items():
            folder = out / run / name
            imagined[name] = try_policy(policy, world, frames, trials, folder, f"{name} in {run}", save_frames=True)
            _videos(out, run, name, trials)
        rows.append(compared(run, true, imagined) | {"judge": summary(world.validation)})
        write_results(out, rows, trials)
    return {"trials": asdict(trials), "runs": rows}


def _videos(out: Path, run: str, name: str, trials: Trials) -> None:
    """Writes videos of the first episodes: simulator and world model side by side."""
    for number in range(min(trials.videos, trials.episodes)):
        files = [out / world / name / f"episode-{number:02d}.npz" for world in ("simulator", run)]
        if all(file.exists() for file in files):
            sides = [np.load(file)["rgb"] for file in files]
            write_mp4(out / "videos" / f"{run}-{name}-{number:02d}.mp4", side_by_side(sides), FPS, 4)


def compared(run: str, true: Mapping[str, Result], imagined: Mapping[str, Result]) -> dict[str, Any]:
    """Returns a run's entry in ``results.json``: success in both worlds by policy, and how well they agree."""
    x, y = (np.array([np.mean(results[name].success) for name in true]) for results in (true, imagined))
    policies: dict[str, dict[str, Any]] = {
        name: {
            "simulator": true[name].success,
            "world_model": made.success,
            "uninterpretable": made.uninterpretable,
            "clipped": {"simulator": true[name].clipped, "world_model": made.clipped},
        }
        for name, made in imagined.items()
    }
    same = np.mean([np.equal(each["simulator"], each["world_model"]) for each in policies.values()])
    spoilt = np.mean([each["uninterpretable"] for each in policies.values()])
    if len(true) > 1:
        found = _defined(asdict(agreement(x, y)))
    else:
        found = {}
    return {"run": run, "policies": policies, "same_outcome": float(same), "uninterpretable": float(spoilt), **found}


def _defined(numbers: dict[str, Any]) -> dict[str, Any]:
    """Replaces NaN, which JSON does not have, by None."""
    parts = {name: _defined(value) if isinstance(value, dict) else value for name, value in numbers.items()}
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in parts.items()}


def write_results(out: Path, rows: Sequence[dict[str, Any]], trials: Trials) -> None:
    """Writes ``results.json``, ``results.md`` and ``scatter.png`` of the runs that are finished."""
    write_json(out / "results.json", {"trials": asdict(trials), "runs": list(rows)})
    write_file(out / "results.md", table(rows).encode())
    points = {row["run"]: _shares(row) for row in rows}
    titles = {row["run"]: _title(row) for row in rows}
    write_file(out / "scatter.png", scatter(points, titles))


def _shares(row: Mapping[str, Any]) -> tuple[list[Estimate], list[Estimate]]:
    sides = [[each[world] for each in row["policies"].values()] for world in ("simulator", "world_model")]
    true, imagined = [[wilson(sum(one), len(one)) for one in side] for side in sides]
    return true, imagined


def _title(row: Mapping[str, Any]) -> str:
    if "pearson" not in row:
        return ""
    value, low, high = (row["pearson"][name] for name in ("value", "low", "high"))
    if value is None:
        r = "no variation"
    else:
        r = f"r = {value:.2f}"
    if low is None or high is None:
        bounds = ""
    else:
        bounds = f" [{low:.2f}, {high:.2f}]"
    return f"{r}{bounds}, MMRV {row['mmrv']:.2f}, bias {row['bias']:+.2f}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the results in Markdown: agreement, success, and the judges that decided success."""
    agreements = []
    for row in rows:
        if "pearson" in row:
            value, low, high = (row["pearson"][name] for name in ("value", "low", "high"))
            if value is None:
                bounds = "no variation"
            elif low is None or high is None:
                bounds = ""
            else:
                bounds = f"{low:.2f} … {high:.2f}"
            numbers = [value, *(row[name] for name in NUMBERS)]
            r, *others = [ABSENT if number is None else f"{number:.3f}" for number in numbers]
            shares = [f"{100 * row[name]:.0f} %" for name in ("same_outcome", "uninterpretable")]
            agreements.append([row["run"], r, bounds, *others, f"{row['bias']:+.3f}", *shares])
    successes = []  # the simulator's are the same for all runs
    for number, row in enumerate(rows):
        for world in ("simulator", "world_model") if not number else ("world_model",):
            for name, each in row["policies"].items():
                share = wilson(sum(each[world]), len(each[world]))
                place = "the simulator"
                unclear = ""
                if world == "world_model":
                    place = row["run"]
                    unclear = percent(wilson(sum(each["uninterpretable"]), len(each["uninterpretable"])))
                clipped = str(each["clipped"][world])
                successes.append([name, place, percent(share), interval_text(share), unclear, clipped])
    lines = [
        as_markdown(Table(AGREEMENT_HEAD, agreements)),
        "",
        FORMULAS,
        "",
        as_markdown(Table(SUCCESS_HEAD, successes)),
    ]
    for number, row in enumerate(rows):
        if row["judge"] not in [before["judge"] for before in rows[:number]]:
            lines += markdown(row["judge"])
    return "\n".join([*lines, ""])
