"""Reads the groups of a comparison: runs that differ only in their seed, with their results under one protocol."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import require
from rsjax.config.config_fields import config_fields
from rsjax.config.model import families
from rsjax.errors import UserError, did_you_mean
from rsjax.evaluation.protocols import OWN
from rsjax.evaluation.results import NAME, Result, read_result
from rsjax.tools.pipeline.evaluations import FOLDER

# What results must have in common, by field of :class:`Result`. Differences in NOTED are reported, not refused.
ALIKE = {
    "protocol": None,
    "settings": None,
    "data": ("key", "split", "frames", "image_size", "fps"),
}
MAYBE_UNKNOWN = ("fps", "second_take_jitter")  # None, as for clips without times or second takes, fits any value
SEEDED = ("family", "preset", "settings", "training")  # fields of a result's model that are equal within a group
NOTED = {"sampling": None, "model": ("trained_on",), "code": ("revision", "diff_sha256")}


@dataclass(frozen=True)
class Group:
    """Runs that differ only in their seed, with one result for each.

    Attributes:
        results: one for each run.
        folders: the folders of the results, in the same order.
    """

    name: str
    results: tuple[Result, ...]
    folders: tuple[Path, ...]


def parse_group(text: str) -> tuple[str, tuple[Path, ...]]:
    """Returns the name and the run directories of ``NAME=RUN,RUN…``, or of one ``RUN``, whose directory is the name.

    A run may be a pattern such as ``runs/grid/model.depth=head,*``. Directories may have commas in their names.

    Raises:
        ConfigError: a directory does not exist or is named twice, or a pattern matches no directory.
    """
    if Path(text).is_dir():
        return Path(text).resolve().name, (Path(text),)
    name, separator, runs = text.partition("=")
    require(bool(separator and name), f"{text}: no run directory; write RUN, or NAME=RUN,RUN for several seeds")
    pieces = runs.split(",")
    folders = list[Path]()
    while pieces:
        whole = [",".join(pieces[:count]) for count in range(len(pieces), 0, -1)]
        fitting = next(((each, paths) for each in whole if (paths := _directories(each))), None)
        require(fitting is not None, f"{name}={runs}: no run directory {pieces[0]!r}; mend the path")
        assert fitting is not None
        folders += fitting[1]
        pieces = pieces[fitting[0].count(",") + 1 :]
    repeated = [str(path) for path, count in Counter(path.resolve() for path in folders).items() if count > 1]
    require(not repeated, f"{name}: {', '.join(repeated)} is named twice; a group takes each run once")
    return name, tuple(folders)


def _directories(pattern: str) -> list[Path]:
    if not any(letter in pattern for letter in "*?["):
        return [Path(pattern)] if pattern and Path(pattern).is_dir() else []
    base = Path(pattern).anchor or "."
    return sorted(path for path in Path(base).glob(str(Path(pattern).relative_to(base))) if path.is_dir())


def read_groups(texts: Sequence[str], label: str | None) -> list[Group]:
    """Reads the groups' results.

    Args:
        texts: groups as :func:`parse_group` takes them.
        label: the results' label, such as ``paper``; None: the only label that all runs have in common, where "run"
            counts only if there is no other.

    Raises:
        UserError: two groups have the same name, a run has no such result, results cannot be put side by side, or runs
            of a group differ in more than their seed or are the same training.
    """
    named = [parse_group(text) for text in texts]
    for name, count in Counter(name for name, _ in named).items():
        require(count == 1, f"{count} groups are named {name}; name them: first=RUN second=RUN")
    runs = [run for _, paths in named for run in paths]
    if not label:
        common = set.intersection(*(set(results_of(run)) for run in runs))
        chosen = sorted(common - {OWN} or common)
        commands = f"rsjax evaluate {' '.join(map(str, runs))} does, or training (evaluation/result.json)"
        require(bool(chosen), f"no protocol has evaluated all of them; {commands}")
        require(len(chosen) == 1, f"all of them have results of {' and of '.join(chosen)}; choose one with --protocol")
        label = chosen[0]
    groups = []
    for name, paths in named:
        folders = []
        for run in paths:
            results = results_of(run)
            if label not in results:
                parts = [each for each in results if each.startswith(f"{label},")]
                if parts:
                    raise UserError(
                        f"{run}: no result {label}, but {' and '.join(parts)}; choose one of them with --protocol"
                    )
                has = f"it has {', '.join(results)}" if results else "it has none"
                raise UserError(
                    f"{run}: no result of protocol {label}{did_you_mean(label, results)} ({has}); "
                    f"rsjax evaluate {run} --protocol {label.partition(',')[0]}"
                )
            folders.append(results[label])
        groups.append(Group(name, tuple(map(read_result, folders)), tuple(folders)))
    for group in groups:
        check_seeds(group)
    check_alike(groups)
    return groups


def results_of(run: Path) -> dict[str, Path]:
    """Returns the folders of a run's results by label; "run" is the label of its evaluation stage."""
    own = {OWN: run / "evaluation"} if (run / "evaluation" / NAME).exists() else {}
    return own | {path.parent.name: path.parent for path in sorted((run / FOLDER).glob(f"*/{NAME}"))}


def check_alike(groups: Sequence[Group]) -> None:
    """Raises :class:`UserError` if numbers must not be put side by side; the message names the fields that differ."""
    every = [(group.name, result) for group in groups for result in group.results]
    name, first = every[0]
    for other, result in every[1:]:
        lines = differing(first, result, ALIKE)
        if not lines and [clip["sha256"] for clip in first.clips] != [clip["sha256"] for clip in result.clips]:
            lines = ["the scored clips differ in their content"]
        if not lines and first.protocol["reference"] == "reconstruction" and not same_truth(first, result):
            lines = ["the protocol compares with a tokenizer's reconstruction, and the tokenizers differ"]
        if lines:
            raise UserError(
                f"{name} ({first.model['run']}) and {other} ({result.model['run']}) were not evaluated alike: "
                f"{'; '.join(lines)}; evaluate both by one protocol on the same clips (rsjax evaluate)"
            )


def same_truth(one: Result, other: Result) -> bool:
    """Returns whether two results have the same scores of the repeated first frame, which depend on the truth alone."""
    ours = np.asarray(one.per_clip["psnr_repeat_first"])
    theirs = np.asarray(other.per_clip["psnr_repeat_first"])
    return ours.shape == theirs.shape and np.allclose(ours, theirs, atol=1e-3)


def check_seeds(group: Group) -> None:
    """Raises :class:`UserError` if a group's runs differ in more than their seed, or two are the same training."""
    first = group.results[0].model
    trained = dict[str, str]()
    for model in (result.model for result in group.results):
        there = _deciding(first)
        here = _deciding(model)
        pairs = {name: (there.get(name, "not set"), here.get(name, "not set")) for name in here | there}
        lines = [f"model.{name} is {a} in the first, {b} in the other" for name, (a, b) in pairs.items() if a != b]
        runs = f"{group.name}: {first['run']} and {model['run']}"
        require(not lines, f"{runs} differ in more than their seed: {'; '.join(lines)}; make them groups of their own")
        weights = str(model.get("weights_sha256") or len(trained))
        same = f"{group.name}: {trained.get(weights)} and {model['run']} have the same weights"
        require(weights not in trained, f"{same}; a group takes each training once")
        trained[weights] = model["run"]


def _deciding(model: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the :data:`SEEDED` fields of a result's model that affect scores, by dotted name."""
    kind = families().get(model["family"])
    runtime = {f"settings.{name}" for name, field in config_fields(kind()).items() if field.runtime} if kind else set()
    named = _flat({name: model[name] for name in SEEDED if name in model})
    return {name: value for name, value in named.items() if name not in runtime}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in values.items():
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return out


def differing(first: Result, other: Result, wanted: Mapping[str, tuple[str, ...] | None]) -> list[str]:
    """Returns a line for each of the wanted fields in which two results are known to differ."""
    lines = []
    for section, names in wanted.items():
        there = getattr(first, section)
        here = getattr(other, section)
        for name in names or dict.fromkeys((*there, *here)):
            values: tuple[Any, Any] = there.get(name), here.get(name)
            unknown = name in MAYBE_UNKNOWN and None in values
            if values[0] != values[1] and not unknown:
                lines.append(f"{section}.{name} is {values[0]} in the first, {values[1]} in the other")
    return lines


def noted(groups: Sequence[Group]) -> list[str]:
    """Returns the differences between results that do not forbid a comparison, one per line."""
    first = groups[0].results[0]
    lines = []
    for group in groups:
        differing_lines = dict.fromkeys(line for result in group.results for line in differing(first, result, NOTED))
        lines += [f"{groups[0].name} and {group.name}: {line}" for line in differing_lines]
    return lines
