"""Judges policies in world models: does success there follow success in the true simulator (Fig. 5)?"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.clip import GENERATED_MARK
from rsjax.errors import UserError
from rsjax.evaluation.coverage import UNSEEN
from rsjax.evaluation.prediction_powered import corrected_rate
from rsjax.evaluation.statistics import Estimate, wilson
from rsjax.files import write_file, write_json
from rsjax.progress import note, stage
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.judges.validation import markdown, summary
from rsjax.tools.policies.policy import Policy, load_policy
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.studies.agreement import agreement, inner, middle, over_trainings
from rsjax.tools.policies.studies.figures import scatter, side_by_side
from rsjax.tools.policies.studies.policy_learning import interval_text, percent
from rsjax.tools.policies.studies.trials import (
    FPS,
    TrialResult,
    Trials,
    episode_file,
    first_frames,
    replayed,
    try_policy,
)
from rsjax.tools.policies.worlds.world import FIRST_SEED, World
from rsjax.tools.studies.report.video import write_mp4
from rsjax.tools.studies.tables import ABSENT, Table, as_markdown, number_text

SHARES = (0.01, 0.03, 0.06, 0.12, 0.25, 0.5, 0.75)  # of the training after which policies are saved, before its end

NUMBERS = {
    "r2_line": "R² of the line",
    "r2_identity": "R² of y = x",
    "r2_prediction": "R² of y for x",
    "spearman": "Spearman",
    "mmrv": "MMRV",
}
AGREEMENT_HEAD = ("run", "Pearson r", "95 %", *NUMBERS.values(), "bias", "same outcome", "uninterpretable")
MIDDLE_HEAD = ("run", "r without 0 and 100 %", "95 %", "policies", "bias at 10 to 90 %")
TRAININGS_HEAD = ("runs", "trainings of policies", "r", "95 %", "r without 0 and 100 %", "95 %")
SUCCESS_HEAD = ("policy", "in", "success", "95 %", "corrected", "95 %", "trials saved", "uninterpretable", "clipped")
FORMULAS = (
    "x: success in the simulator, y: in the world model. R² of y = x is 1 - Σ(y - x)² / Σ(y - ȳ)²; R² of y for x, a "
    "prediction of x, is 1 - Σ(y - x)² / Σ(x - x̄)². Where y spreads more than x, the first is higher; signs may differ."
)
CORRECTED = (
    "Corrected: the rate in the world model, corrected by the trials that are paired with true ones. Trials saved: how "
    "many more trials in the simulator alone would give an interval as narrow (docs/policy_learning.md)."
)
COVERAGE_HEAD = ("run", "not seen in training", "95 %", "same outcome where seen", "where not seen")
COVERAGE = (
    "Not seen in training: imagined episodes that are farther from the training clips than 99 % of these are from one "
    "another (docs/coverage.md)."
)
TRAININGS = (
    "Over trainings: r is the mean over the runs that differ in their seeds alone. Its interval is for other trainings "
    "of policies, of which it takes two at least, and, with two runs or more, of the world model."
)
REPLAYS_HEAD = (
    "run", "policies", "in the model", "its actions in the simulator", "in the simulator", "by the outcome", "by acting"
)  # fmt: skip
REPLAYS = (
    "In episodes that start alike, the bias is the sum of two: the simulator ends otherwise under the same actions (by "
    "the outcome), and the policy acts otherwise there (by acting). The actions of each episode in the model are "
    "replayed from its start."
)
FIRST_TRAINING = "policy"
REPLAYED = "replayed"  # in the folder of a policy's trials in a world model


def checkpoints(
    config: PolicyConfig, demos: Demos, directory: Path, count: int = 8, seed: int = 0
) -> dict[str, Policy]:
    """Trains one policy and returns it at ``count`` stages of its training, from useless to good, by name.

    A very short training has fewer stages; a note then says so.
    """
    steps = config.train.steps
    shares = np.interp(np.linspace(0, 1, count - 1), np.linspace(0, 1, len(SHARES)), SHARES)
    stops = sorted({max(1, round(share * steps)) for share in shares} - {steps})
    if len(stops) < count - 1:
        note(f"{steps} training steps have {len(stops) + 1} stages, not {count}; more steps, or fewer checkpoints")
    last = train_policy(config, demos, directory, name=directory.name, seed=seed, stops=stops)
    return {f"step-{stop}": load_policy(directory / f"at-{stop}") for stop in stops} | {f"step-{steps}": last}


def trained_policies(
    config: PolicyConfig, demos: Demos, out: Path, count: int, trainings: int
) -> tuple[dict[str, Policy], dict[str, str]]:
    """Trains a policy with several seeds, and returns all its stages by name, and the name of each one's training.

    Args:
        count: stages of each training, as in :func:`checkpoints`.
        trainings: number of seeds; each trains in a folder of ``out``.
    """
    policies: dict[str, Policy] = {}
    training: dict[str, str] = {}
    for seed in range(trainings):
        name = FIRST_TRAINING
        if seed:
            name = f"{FIRST_TRAINING}-seed{seed}"
        for stage_name, policy in checkpoints(config, demos, out / name, count, seed).items():
            full = stage_name
            if seed:
                full = f"seed{seed}-{stage_name}"
            policies[full] = policy
            training[full] = name
    return policies, training


def compare(
    policies: Mapping[str, Policy],
    simulator: World,
    models: Mapping[str, Callable[[], World]],
    trials: Trials,
    out: Path,
    *,
    imagined: int = 0,
    training: Mapping[str, str] | None = None,
    replicates: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Runs each policy from the same first frames in the simulator and in each world model; keeps finished results.

    Args:
        policies: by name.
        simulator: the true simulator.
        models: functions that make the world of each run, by the run's name.
        out: the folder of all rollouts, ``results.json`` (null: undefined, such as a correlation without variation),
            ``results.md``, ``scatter.png`` and videos (left: simulator, right: world model).
        imagined: episodes of each policy in a world model. Those beyond ``trials.episodes`` start from first frames of
            their own, and nobody runs them in the simulator. 0: as many as there.
        training: the name of the training that each policy is from, for intervals over trainings; None: one training.
        replicates: for each run, the name of the first run that differs from it in seeds alone; None: each its own.

    Returns:
        The content of ``results.json``.

    Raises:
        UserError: fewer episodes are to be imagined than simulated.
    """
    imagined = imagined or trials.episodes
    check_imagined(imagined, trials)
    seeds = [FIRST_SEED + number for number in range(imagined)]
    frames = first_frames(simulator, seeds, out / "starts.npz")
    true: dict[str, TrialResult] = {}
    for name, policy in policies.items():
        true[name] = try_policy(
            policy,
            simulator,
            trials.seeds,
            trials,
            out / "simulator" / name,
            f"{name} in simulator",
            save_frames=trials.episodes,
        )
    rows: list[dict[str, Any]] = []
    for number, (run, make) in enumerate(models.items(), 1):
        stage(number, len(models), run, "rolling policies out in this world model")
        world = make()
        made = {}
        again = {}
        for name, policy in policies.items():
            folder = out / run / name
            made[name] = try_policy(
                policy, world, frames, trials, folder, f"{name} in {run}", save_frames=trials.episodes
            )
            _videos(out, run, name, trials)
            again[name] = replayed(simulator, folder, trials, folder / REPLAYED, f"{name} in {run}")
        row = compared(run, true, made, again, training or {})
        rows.append(row | {"like": (replicates or {}).get(run, run), "judge": summary(world.validation)})
        write_results(out, rows, trials)
    return results_of(rows, trials)


def check_imagined(imagined: int, trials: Trials) -> None:
    """Raises :class:`UserError` if fewer episodes are to be imagined than simulated."""
    if imagined < trials.episodes:
        raise UserError(f"--imagined is {imagined}; it must be at least --episodes, which is {trials.episodes}")


def _videos(out: Path, run: str, name: str, trials: Trials) -> None:
    """Writes videos of the first episodes: simulator and world model side by side."""
    for number in range(min(trials.videos, trials.episodes)):
        files = [episode_file(out / world / name, number) for world in ("simulator", run)]
        if all(file.exists() for file in files):
            sides = [np.load(file)["rgb"] for file in files]
            path = out / "videos" / f"{run}-{name}-{number:02d}.mp4"
            write_mp4(path, side_by_side(sides), FPS, 4, f"Left: the simulator. Right: {GENERATED_MARK}")


def compared(
    run: str,
    true: Mapping[str, TrialResult],
    imagined: Mapping[str, TrialResult],
    again: Mapping[str, Sequence[bool]],
    training: Mapping[str, str],
) -> dict[str, Any]:
    """Returns a run's entry in ``results.json``: success in both worlds by policy, and how well they agree.

    Args:
        true: by policy; its episodes start as the first ones of ``imagined`` do.
        again: by policy, whether the actions of the first imagined episodes succeed in the simulator.
        training: the name of each policy's training.
    """
    x, y = (np.array([np.mean(results[name].success) for name in true]) for results in (true, imagined))
    policies: dict[str, dict[str, Any]] = {}
    same: list[bool] = []
    for name, made in imagined.items():
        real = true[name].success
        paired = made.success[: len(real)]
        same += np.equal(real, paired).tolist()
        policies[name] = {
            "training": training.get(name, FIRST_TRAINING),
            "simulator": real,
            "world_model": made.success,
            "replayed": list(again[name]),
            "corrected": asdict(corrected_rate(real, paired, made.success[len(real) :])),
            "uninterpretable": made.uninterpretable,
            "unfamiliarity": made.unfamiliarity,
            "clipped": {"simulator": true[name].clipped, "world_model": made.clipped},
        }
    uninterpretable = np.mean([each["uninterpretable"] for each in policies.values()])
    if len(true) > 1:
        agreed = _defined(asdict(agreement(x, y)))
    else:
        agreed = {}
    return {
        "run": run,
        "policies": policies,
        "same_outcome": float(np.mean(same)),
        "uninterpretable": float(uninterpretable),
        "coverage": covered(policies.values()),
        **agreed,
    }


def covered(policies: Iterable[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Returns how many imagined episodes the model has not seen the like of, and how the outcome agrees in the others.

    None if the distances from the training clips were not measured.

    Args:
        policies: their entries in ``results.json``.

    Returns:
        ``episodes``, and ``unseen``, how many of them are farther from the training clips than ``UNSEEN`` of these are
        from one another. Of the episodes that were run in the simulator too, ``same_outcome`` has the number with the
        same outcome and their number, among those ``seen`` and those ``unseen``.
    """
    policies = list(policies)
    if not policies or not all(each["unfamiliarity"] for each in policies):
        return None
    unseen = [np.array(each["unfamiliarity"]) > UNSEEN for each in policies]
    same = [np.equal(each["simulator"], each["world_model"][: len(each["simulator"])]) for each in policies]
    paired = np.concatenate([far[: len(agree)] for far, agree in zip(unseen, same, strict=True)])
    agree = np.concatenate(same)
    counts = {name: [int(agree[of].sum()), int(of.sum())] for name, of in (("seen", ~paired), ("unseen", paired))}
    every = np.concatenate(unseen)
    return {"episodes": len(every), "unseen": int(every.sum()), "same_outcome": counts}


def trainings(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns r over the runs that differ in seeds alone, with intervals for other trainings, for each such group."""
    names = []
    for like in dict.fromkeys(row["like"] for row in rows):
        group = [row for row in rows if row["like"] == like]
        policies = group[0]["policies"]
        training = np.array([each["training"] for each in policies.values()])
        x = np.array([np.mean(each["simulator"]) for each in policies.values()])
        y = np.array([[np.mean(each["world_model"]) for each in row["policies"].values()] for row in group])
        kept = inner(x)
        names.append(
            {
                "runs": [row["run"] for row in group],
                "policies": len(set(training.tolist())),
                "pearson": _defined(asdict(over_trainings(x, y, training.tolist()))),
                "pearson_inner": _defined(asdict(over_trainings(x[kept], y[:, kept], training[kept].tolist()))),
            }
        )
    return names


def _defined(numbers: dict[str, Any]) -> dict[str, Any]:
    """Replaces NaN, which JSON does not have, by None."""
    parts = {name: _defined(value) if isinstance(value, dict) else value for name, value in numbers.items()}
    return {name: None if isinstance(value, float) and np.isnan(value) else value for name, value in parts.items()}


def write_results(out: Path, rows: Sequence[dict[str, Any]], trials: Trials) -> None:
    """Writes ``results.json``, ``results.md`` and ``scatter.png`` of the runs that are finished."""
    results = results_of(rows, trials)
    write_json(out / "results.json", results)
    write_file(out / "results.md", agreement_tables(results).encode())
    points = {}
    titles = {}
    for row in rows:
        sides = [[each[world] for each in row["policies"].values()] for world in ("simulator", "world_model")]
        true, imagined = [[wilson(sum(one), len(one)) for one in side] for side in sides]
        points[row["run"]] = (true, imagined)
        titles[row["run"]] = ""
        if "pearson" in row:  # there are enough policies
            r, bounds = r_text(row["pearson"])
            correlation = f"r = {r}"
            if r == ABSENT:
                correlation = bounds
            elif bounds:
                correlation = f"r = {r} [{bounds}]"
            titles[row["run"]] = f"{correlation}, MMRV {row['mmrv']:.2f}, bias {row['bias']:+.2f}"
    write_file(out / "scatter.png", scatter(points, titles))


def results_of(rows: Sequence[dict[str, Any]], trials: Trials) -> dict[str, Any]:
    """Returns the content of ``results.json``."""
    return {"trials": asdict(trials), "runs": list(rows), "trainings": trainings(rows)}


def r_text(r: Mapping[str, float | None]) -> tuple[str, str]:
    """Returns a correlation and its interval for a table."""
    if r["value"] is None:
        return ABSENT, "no variation"
    if r["low"] is None or r["high"] is None:
        return f"{r['value']:.3f}", ""
    return f"{r['value']:.3f}", f"{r['low']:.2f} … {r['high']:.2f}"


def replay_lines(row: Mapping[str, Any]) -> list[list[str]]:
    """Returns a run's lines of the table of replays: over all policies, and over those of 10 to 90 %."""
    worlds = ("world_model", "replayed", "simulator")
    rates = np.array(
        [[np.mean(each[world][: len(each["simulator"])]) for world in worlds] for each in row["policies"].values()]
    )
    lines = []
    for title, chosen in (("all", np.ones(len(rates), bool)), ("10 to 90 %", middle(rates[:, 2]))):
        if chosen.any():
            model, again, true = rates[chosen].mean(0)
            biases = [f"{model - again:+.3f}", f"{again - true:+.3f}"]
            lines.append([row["run"], title, *(f"{100 * rate:.0f} %" for rate in (model, again, true)), *biases])
    return lines


def agreement_tables(results: Mapping[str, Any]) -> str:
    """Returns the results in Markdown: agreement, success, and the judges that decided success."""
    rows = results["runs"]
    agreements = []
    middle_rows = []
    for row in rows:
        if "pearson" in row:
            numbers = [row[name] for name in NUMBERS]
            others = [number_text(number, ".3f") for number in numbers]
            shares = [f"{100 * row[name]:.0f} %" for name in ("same_outcome", "uninterpretable")]
            agreements.append([row["run"], *r_text(row["pearson"]), *others, f"{row['bias']:+.3f}", *shares])
            bias = number_text(row["bias_middle"], "+.3f")
            middle_rows.append([row["run"], *r_text(row["pearson_inner"]), str(row["inner"]), bias])
    over = [
        [", ".join(each["runs"]), str(each["policies"]), *r_text(each["pearson"]), *r_text(each["pearson_inner"])]
        for each in results["trainings"]
    ]
    successes = []  # the simulator's are the same for all runs
    for number, row in enumerate(rows):
        for name, each in row["policies"].items():
            if not number:
                share = wilson(sum(each["simulator"]), len(each["simulator"]))
                clipped = str(each["clipped"]["simulator"])
                successes.append([name, "the simulator", percent(share), interval_text(share), "", "", "", "", clipped])
        for name, each in row["policies"].items():
            share = wilson(sum(each["world_model"]), len(each["world_model"]))
            corrected = Estimate(**each["corrected"]["rate"])
            saved = f"{each['corrected']['worth'] - each['corrected']['trials']:.0f}"
            unclear = percent(wilson(sum(each["uninterpretable"]), len(each["uninterpretable"])))
            rates = [percent(share), interval_text(share), percent(corrected), interval_text(corrected), saved]
            successes.append([name, row["run"], *rates, unclear, str(each["clipped"]["world_model"])])
    lines = [
        as_markdown(Table(AGREEMENT_HEAD, agreements)),
        "",
        FORMULAS,
        "",
        as_markdown(Table(MIDDLE_HEAD, middle_rows)),
        "",
        as_markdown(Table(REPLAYS_HEAD, [line for row in rows for line in replay_lines(row)])),
        "",
        REPLAYS,
        "",
        TRAININGS,
        "",
        as_markdown(Table(TRAININGS_HEAD, over)),
        "",
        as_markdown(Table(SUCCESS_HEAD, successes)),
        "",
        CORRECTED,
    ]
    far = []
    for row in rows:
        if row["coverage"] is not None:
            counts = [row["coverage"]["same_outcome"][name] for name in ("seen", "unseen")]
            shares = [ABSENT if not total else percent(wilson(agree, total)) for agree, total in counts]
            share = wilson(row["coverage"]["unseen"], row["coverage"]["episodes"])
            far.append([row["run"], percent(share), interval_text(share), *shares])
    if far:
        lines += ["", as_markdown(Table(COVERAGE_HEAD, far)), "", COVERAGE]
    for number, row in enumerate(rows):
        if row["judge"] not in [before["judge"] for before in rows[:number]]:
            lines += markdown(row["judge"])
    return "\n".join([*lines, ""])
