"""A soak's result as a table and a page."""

from collections.abc import Sequence
from typing import Any

from benchmarks.soak.faults import KILL_BETWEEN, SHARES
from rsjax.progress import duration

HEADER = ("fault", "times", "survived", "steps again", "lost, s", "each, s")

Rounds = Sequence[dict[str, Any]]


def rows(rounds: Rounds) -> list[tuple[str, ...]]:
    """Returns a row for every kind of fault that happened, and one for all of them."""
    events = [event for one in rounds for event in one["events"]]
    groups = {kind: [e for e in events if e["kind"] == kind] for kind in (*SHARES, KILL_BETWEEN)}
    return [_row(kind, group) for kind, group in (groups | {"all": events}).items() if group or kind == "all"]


def _row(kind: str, events: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    count = len(events)
    survived, repeated, lost = (sum(event[name] for event in events) for name in ("survived", "repeated", "lost"))
    return (kind, str(count), str(survived), str(repeated), f"{lost:.0f}", f"{lost / count:.1f}" if count else "–")


def conclusion(result: dict[str, Any]) -> list[str]:
    """Returns the result in a few sentences: the time under faults, and whether the runs ended the same."""
    rounds = result["rounds"]
    trial = result["bad_record"]
    seconds, starts = (sum(one[name] for one in rounds) for name in ("seconds", "starts"))
    lines = [
        f"{duration(seconds)} with faults, {starts} starts of the command.",
        f"{sum(not failed(one) for one in rounds)} of {len(rounds)} runs ended bit-identical to the one without faults "
        f"(loss curve, weights, last checkpoint).",
    ]
    lines += [f"Round {one['number']}: {line}" for one in rounds for line in _failures(one)]
    if trial is not None:
        quarantined = ", ".join(map(str, trial["quarantined"])) or "none"
        failures = "; ".join(_failures(trial))
        lines += [
            f"Record {trial['record']} of the training split damaged: quarantined {quarantined}; a run that was killed "
            f"ended {'unlike' if failures else 'as'} one that was not{': ' + failures if failures else ''}."
        ]
    return lines + list(result["notes"])


def _failures(one: dict[str, Any]) -> list[str]:
    return [line for line in (one["problem"], *one["differences"]) if line]


def failed(one: dict[str, Any]) -> bool:
    """Whether a round's run failed or differs."""
    return bool(_failures(one))


def passed(result: dict[str, Any]) -> bool:
    """Whether every fault was survived and nothing differed."""
    rounds = result["rounds"]
    trial = result["bad_record"]
    survived = all(event["survived"] for one in rounds for event in one["events"])
    return bool(rounds) and survived and not any(map(failed, rounds)) and (trial is None or trial["passed"])


def markdown(result: dict[str, Any]) -> str:
    """Returns the whole page."""
    table = [HEADER, ("---",) * len(HEADER), *rows(result["rounds"])]
    lines = [f"# Soak of `{result['of']['arguments'][0]}`", "", f"`{result['command']}`", ""]
    lines += ["| " + " | ".join(row) + " |" for row in table]
    lines += ["", *(f"- {line}" for line in conclusion(result)), "", f"Made with {result['made_with']}.", ""]
    return "\n".join(lines)
