"""Compares two runs bit for bit: their logs, weights, last checkpoints and stores."""

import contextlib
import json
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp

from benchmarks.soak.attempt import checkpoints
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import Store, encode, open_store
from rsjax.training.log import SKIPPED, read_curve


def compare_stages(one: Path, two: Path) -> list[str]:
    """Returns the differences between two finished training stages, one line each; none if they are bit-identical.

    Compares the loss curve (every logged step and scalar that is no measurement), the skipped steps, the quarantined
    records, the final weights, and the newest checkpoint: parameters, optimizer, averages, step and data position.
    """
    differences = compare_logs(one, two)
    for name in (SKIPPED, QUARANTINE):
        lines = json_lines(one, name)
        others = json_lines(two, name)
        if lines != others:
            differences.append(f"{name}: {len(lines - others)} lines only here, {len(others - lines)} only there")
    differences += compare_arrays(one / "weights", two / "weights")
    step, other = (max(checkpoints(folder), default=0) for folder in (one, two))
    if step != other:
        return [*differences, f"the newest checkpoint is of step {step} here, of {other} there"]
    if step:
        saved = [folder / "checkpoints" / str(step) for folder in (one, two)]
        differences += compare_arrays(*(checkpoint / "state" for checkpoint in saved))
        position, other = (json.loads((checkpoint / "data" / "metadata").read_text()) for checkpoint in saved)
        if position != other:
            differences.append(f"the data position is {position} here, {other} there")
    return differences


def compare_logs(one: Path, two: Path) -> list[str]:
    """Returns the first difference between two loss curves as a sentence."""
    rows = read_curve(one)
    others = read_curve(two)
    for row, other in zip(rows, others, strict=False):
        names = [name for name in row | other if repr(row.get(name)) != repr(other.get(name))]  # repr: NaN is NaN
        if names:
            values = ", ".join(f"{name} {row.get(name)} against {other.get(name)}" for name in names)
            return [f"the log differs from step {row['step']} on: {values}"]
    if len(rows) != len(others):
        return [f"the log has {len(rows)} steps here, {len(others)} there"]
    return []


def compare_arrays(one: Path, two: Path) -> list[str]:
    """Returns which arrays of two saved trees differ in any bit, shape or type."""
    missing = [f"{path}: missing" for path in (one, two) if not path.exists()]
    if missing:
        return missing
    arrays = read_arrays(one)
    others = read_arrays(two)
    only = [f"{one.name}: {name} is only in one of them" for name in sorted(arrays.keys() ^ others.keys())]
    shared = sorted(arrays.keys() & others.keys())
    return only + [f"{one.name}: {name} differs" for name in shared if not same_bits(arrays[name], others[name])]


def same_bits(one: np.ndarray, two: np.ndarray) -> bool:
    """Whether two arrays are the same, NaN and the sign of zero included."""
    return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads all arrays of a tree that orbax saved, by name, onto the host."""
    with ocp.PyTreeCheckpointer() as checkpointer:
        tree = checkpointer.metadata(path.absolute()).item_metadata.tree
        restore_args = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        saved = checkpointer.restore(path.absolute(), restore_args=restore_args)
    return {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in jax.tree.leaves_with_path(saved)}


def compare_stores(one: Path, two: Path) -> list[str]:
    """Returns the splits of two stores whose records differ, one line each."""
    here = open_store(one)
    there = open_store(two)
    if here.splits != there.splits:
        return [f"{one.name}: splits {here.splits} against {there.splits}"]
    return [f"{one.name}: {split} differs" for split in here.splits if _records(here, split) != _records(there, split)]


def _records(store: Store, split: str) -> list[bytes]:
    source = store.source(split)
    return [encode(source[index]) for index in range(len(source))]


def json_lines(folder: Path, name: str) -> set[str]:
    """Reads one of a stage's lists, with the run's own path left out; torn and repeated lines do not count."""
    path = folder / name
    lines = set()
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            lines.add(json.dumps(json.loads(line)).replace(str(folder.parent), "RUN"))
    return lines
