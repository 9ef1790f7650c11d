"""What was survived, as a table."""

from collections.abc import Sequence
from typing import Any

from rsjax.progress import duration
from rsjax.soak.disturb import KILL_BETWEEN, SHARES

HEADER = ("disturbance", "times", "survived", "steps again", "lost, s", "each, s")

Rounds = Sequence[dict[str, Any]]


def rows(rounds: Rounds) -> list[tuple[str, ...]]:
    """A row for every kind of disturbance that happened, and one for all of them."""
    events = [event for one in rounds for event in one["events"]]
    groups = {kind: [e for e in events if e["kind"] == kind] for kind in (*SHARES, KILL_BETWEEN)}
    return [_row(kind, group) for kind, group in (groups | {"all": events}).items() if group or kind == "all"]


def _row(kind: str, events: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    lost, count = sum(event["lost"] for event in events), len(events)
    return (
        kind,
        str(count),
        str(sum(event["survived"] for event in events)),
        str(sum(event["repeated"] for event in events)),
        f"{lost:.0f}",
        f"{lost / count:.1f}" if count else "–",
    )


def conclusion(result: dict[str, Any]) -> list[str]:
    """What the soak found, in a few lines: what was disturbed for how long, whether runs came out the same."""
    rounds, trial = result["rounds"], result["bad_record"]
    same = sum(not one["differences"] and not one["problem"] for one in rounds)
    seconds, starts = (sum(one[name] for one in rounds) for name in ("seconds", "starts"))
    lines = [
        f"{duration(seconds)} under disturbance, {starts} starts of the command.",
        f"{same} of {len(rounds)} runs ended bit-identical to the one that nothing disturbed: loss curve, weights, "
        f"last checkpoint.",
    ]
    for one in rounds:
        told = ([one["problem"]] if one["problem"] else []) + one["differences"]
        lines += [f"Round {one['number']}: {line}" for line in told]
    if trial is not None:
        aside = ", ".join(map(str, trial["quarantined"])) or "none"
        faults = "; ".join(filter(None, [trial["problem"], *trial["differences"]]))
        lines += [
            f"Record {trial['record']} of the training split damaged: put aside {aside}; a run killed on the way ended "
            f"{'unlike' if faults else 'as'} one that was not{': ' + faults if faults else ''}."
        ]
    return lines + list(result["notes"])


def passed(result: dict[str, Any]) -> bool:
    """Whether every disturbance was survived and nothing differed."""
    trial = result["bad_record"]
    return bool(
        result["rounds"]
        and all(not one["differences"] and not one["problem"] for one in result["rounds"])
        and all(event["survived"] for one in result["rounds"] for event in one["events"])
        and (trial is None or trial["passed"])
    )


def markdown(result: dict[str, Any]) -> str:
    """All of it as a page."""
    lines = [f"# Soak of `{result['of']['arguments'][0]}`", "", f"`{result['command']}`", ""]
    lines += ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(result["rounds"])]
    lines += ["", *(f"- {line}" for line in conclusion(result)), "", f"Made with {result['made_with']}.", ""]
    return "\n".join(lines)
