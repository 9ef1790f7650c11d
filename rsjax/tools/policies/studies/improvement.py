"""Improves a policy in imagination: it learns from episodes in the world model that the judge calls a success.

The policy itself acts in them, or they follow its demonstrations from new first frames.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.artifact import make_once
from rsjax.config import content_key
from rsjax.data.codec import Record, decode, encode
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.evaluation.statistics import Estimate, share_difference, verdict, wilson
from rsjax.files import write_file, write_json
from rsjax.progress import Progress, note, stage
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.judges.validation import markdown, summary
from rsjax.tools.policies.planning.proposals import SimilarClips, similar_demos
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.studies.figures import success_curves
from rsjax.tools.policies.studies.policy_learning import interval_text, percent
from rsjax.tools.policies.studies.trials import Trials, try_policy
from rsjax.tools.policies.worlds.model_world import FirstFrame
from rsjax.tools.policies.worlds.world import World, run_episodes
from rsjax.tools.studies.tables import Table, as_markdown

OTHERS = (
    "holds imagined episodes of other settings, starts, policies, models or judges; choose another --out, or delete it"
)
HEADINGS = (
    "round",
    "imagined",
    "judged a success",
    "uninterpretable",
    "policy",
    "success in the simulator",
    "95 %",
)


@dataclass(frozen=True)
class Improvement:
    """The settings for improving a policy.

    Attributes:
        rounds: rounds of imagining and fine-tuning.
        imagined: episodes in the world model in each round.
        max_steps: steps of an episode, at most.
        steps: fine-tuning steps in each round.
        share: share of old demonstrations in the data for fine-tuning, at least 0 and below 1.
        learning_rate: learning rate of fine-tuning, as a share of the training's.
        follow_demos: whether imagined episodes follow, at every frame, the old demonstration that looks most alike,
            instead of the policy (docs/results/practice.md).
    """

    rounds: int = 2
    imagined: int = 200
    max_steps: int = 30
    steps: int = 500
    share: float = 0.5
    learning_rate: float = 0.3
    follow_demos: bool = False

    def __post_init__(self) -> None:
        for name in ("rounds", "imagined", "max_steps", "steps"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least 1")
        if not 0 < self.learning_rate < math.inf:
            raise UserError(f"--learning-rate is {self.learning_rate}; it is a share of the training's, above 0")
        if not 0 <= self.share < 1:
            raise UserError(f"--share is {self.share}; it is a share of old demonstrations, 0 to below 1")


def improve(
    policy: Policy,
    demos: Demos,
    starts: Sequence[FirstFrame],
    model: World,
    simulator: World,
    settings: Improvement,
    trials: Trials,
    out: Path,
) -> dict[str, Any]:
    """Improves a policy, and trains a control for as many steps on the old demonstrations alone.

    Args:
        policy: the policy to begin with.
        demos: the demonstrations that the policy was trained on.
        starts: first frames for imagined episodes; each round continues in this list where the last one ended. Those of
            demonstrations that are followed are left out.
        model: the world model.
        simulator: the true simulator, in which success is measured before and after each round.
        out: the folder for policies, imagined successes, ``results.json``, ``results.md`` and ``success.png``.

    Returns:
        The content of ``results.json``. An interrupted call resumes.

    Raises:
        UserError: ``out`` has results of other settings or inputs, or all starts are those of followed demonstrations.
    """
    if settings.follow_demos:
        starts = new_starts(starts, demos)
    rows: list[dict[str, Any]] = []
    arms = {"imagined": policy, "control": policy}
    config = policy.model.config  # changed once: the policies of later rounds have these settings already
    optimizer = config.train.optimizer
    rate = settings.learning_rate * optimizer.learning_rate
    optimizer = replace(optimizer, learning_rate=rate, warmup_steps=min(optimizer.warmup_steps, settings.steps // 10))
    config = replace(config, train=replace(config.train, steps=settings.steps, optimizer=optimizer))
    before = try_policy(policy, simulator, trials.seeds, trials, out / "before", "before")
    for number in range(1, settings.rounds + 1):
        stage(
            number, settings.rounds, f"round {number}", f"{settings.imagined} imagined episodes, {settings.steps} steps"
        )
        actors: Policy | SimilarClips = arms["imagined"]
        if settings.follow_demos:
            actors = similar_demos(demos)
        made, counts = imagine(actors, starts, model, settings, number, out / f"round-{number}" / "episodes")
        row: dict[str, Any] = {"round": number, "episodes": settings.imagined, "kept": len(made), "demos": len(demos)}
        row |= {"uninterpretable": counts["uninterpretable"], "clipped": {"imagining": counts["clipped"]}}
        for arm, old in arms.items():
            if arm == "imagined" and made:
                learns = mixed(demos, made, settings.share, number)
            else:
                learns = demos
            folder = out / f"round-{number}" / arm
            arms[arm] = train_policy(config, learns, folder, name=f"round {number} {arm}", seed=number, start=old)
            tried = try_policy(arms[arm], simulator, trials.seeds, trials, folder / "trials", f"round {number} {arm}")
            row[arm] = tried.success
            row["clipped"][arm] = tried.clipped
        if not made:
            note("the judge called no imagined episode a success: this round learns from the old demonstrations")
        rows.append(row)
        about = {"settings": asdict(settings), "trials": asdict(trials), "judge": summary(model.validation)}
        results = about | {"before": before.success, "clipped": before.clipped, "rounds": rows}
        results["differences"] = differences(results)
        write_json(out / "results.json", results)
        write_file(out / "results.md", rounds_table(results).encode())
        begin = (0.0, _share(before.success))
        series = {arm: [begin, *[(float(each["round"]), _share(each[arm])) for each in rows]] for arm in arms}
        write_file(out / "success.png", success_curves(series, "rounds"))
    return results


def new_starts(starts: Sequence[FirstFrame], demos: Demos) -> list[FirstFrame]:
    """Returns the starts that are no demonstration's first frame.

    Raises:
        UserError: there is none.
    """
    known = {record["rgb"][0].tobytes() for record in demos.records}
    found = [start for start in starts if start.rgb.tobytes() not in known]
    if not found:
        raise UserError("all first frames are those of demonstrations; --follow-demos needs others: use fewer --demos")
    return found


def imagine(
    actors: Policy | SimilarClips,
    starts: Sequence[FirstFrame],
    model: World,
    settings: Improvement,
    number: int,
    folder: Path,
) -> tuple[list[Record], dict[str, int]]:
    """Imagines the episodes of a round, except those that an interrupted call left in ``folder``.

    Args:
        actors: who acts in them.

    Returns:
        The episodes that the judge calls successes, as demonstrations; and over all episodes, how many end in a frame
        that the judge calls uninterpretable, and how many numbers of actions were clipped.

    Raises:
        UserError: ``folder`` holds other episodes.
    """
    begins = (number - 1) * settings.imagined
    # A start that is used again gets different draws.
    chosen = [replace(starts[place % len(starts)], draw=place) for place in range(begins, begins + settings.imagined)]
    first_frames = fingerprint([(start.rgb, start.depth, start.draw) for start in chosen])
    key = content_key("imagined", actors.key, model.key, model.count, settings.max_steps, first_frames)
    made: list[Record] = []
    uninterpretable = 0
    clipped = 0
    with (
        make_once(folder, key, refuse=OTHERS),
        Progress(f"round {number}: imagining", len(chosen), "episodes") as progress,
    ):
        for first in range(0, len(chosen), model.count):
            group = chosen[first : first + model.count]
            file = folder / f"{first:05d}.clips"
            if not file.exists():
                episodes = run_episodes(model, actors.actor(begins + first), group, settings.max_steps)
                good = [{"rgb": one.rgb, "actions": one.actions} for one in episodes if one.success.any()]
                content = {
                    "clips": [encode(one) for one in good],
                    "uninterpretable": sum(one.uninterpretable for one in episodes),
                    "clipped": sum(one.clipped for one in episodes),
                }
                write_file(file, encode(content))
            kept = decode(file.read_bytes())
            made += [decode(payload) for payload in kept["clips"]]
            uninterpretable += kept["uninterpretable"]
            clipped += kept["clipped"]
            progress.update(first + len(group), kept=len(made))
    return made, {"uninterpretable": uninterpretable, "clipped": clipped}


def mixed(demos: Demos, made: Sequence[Record], share: float, seed: int) -> Demos:
    """Returns imagined successes with random old demonstrations, which make up ``share`` of the result."""
    wanted = round(share / (1 - share) * len(made))
    rng = np.random.default_rng(seed)
    chosen = np.concatenate(
        [rng.permutation(len(demos)) for _ in range(-(-wanted // len(demos)))] or [np.zeros(0, int)]
    )
    return Demos((*made, *(demos.records[int(place)] for place in chosen[:wanted])), demos.controls)


def differences(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Returns the gain after the last round, compared with before and with the control."""
    last = {name: np.array([results["rounds"][-1][name]], float) for name in ("imagined", "control")}
    last["before"] = np.array([results["before"]], float)
    rows = []
    for one, other in (("imagined", "before"), ("imagined", "control"), ("control", "before")):
        gap = share_difference(last[one], last[other])
        rows.append({"compares": [one, other], **asdict(gap), "verdict": verdict(gap)})
    return rows


def rounds_table(results: dict[str, Any]) -> str:
    """Returns the results in Markdown."""
    share = _share(results["before"])
    rows = [["0", "", "", "", "before", percent(share), interval_text(share)]]
    for row in results["rounds"]:
        for arm in ("imagined", "control"):
            share = _share(row[arm])
            counts = ["", "", ""]
            if arm == "imagined":
                unclear = wilson(row["uninterpretable"], row["episodes"])
                counts = [str(row["episodes"]), str(row["kept"]), percent(unclear)]
            rows.append([str(row["round"]), *counts, arm, percent(share), interval_text(share)])
    differences = []
    for gap in results["differences"]:
        estimate = Estimate(gap["value"], gap["low"], gap["high"])
        names = " - ".join(gap["compares"])
        differences.append([names, percent(estimate), interval_text(estimate), gap["verdict"]])
    lines = [
        as_markdown(Table(HEADINGS, rows)),
        "",
        as_markdown(Table(("last round", "difference", "95 %", "better?"), differences)),
    ]
    return "\n".join([*lines, *markdown(results["judge"]), ""])


def _share(success: Sequence[bool]) -> Estimate:
    return wilson(sum(success), len(success))
