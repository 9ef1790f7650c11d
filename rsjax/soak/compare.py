"""Whether two runs came to the same: what they logged, what they weigh, their last checkpoint, bit for bit."""

import contextlib
import json
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp

from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import Store, encode, open_store
from rsjax.soak.watch import checkpoints
from rsjax.training.log import read_curve
from rsjax.training.skipped import NAME as SKIPPED

LISTS = (SKIPPED, QUARANTINE)  # that a stage may leave, one JSON object a line


def compare_stages(here: Path, there: Path) -> list[str]:
    """Differences between two finished training stages, one line each; none where they are bit-identical.

    Compared are the loss curve (every logged step and scalar that is no measurement), the steps that were skipped,
    the records that were put aside, the final weights, and the newest checkpoint: parameters, optimizer, averages,
    step and place in the data.
    """
    found = compare_logs(here, there)
    for name in LISTS:
        lines, others = (listed(folder, name) for folder in (here, there))
        if lines != others:
            found.append(f"{name}: {len(lines - others)} lines only here, {len(others - lines)} only there")
    found += compare_arrays(here / "weights", there / "weights")
    step, other = (max(checkpoints(folder), default=0) for folder in (here, there))
    if step != other:
        return [*found, f"the newest checkpoint is of step {step} here, of {other} there"]
    if step:
        found += _compare_checkpoints(*(folder / "checkpoints" / str(step) for folder in (here, there)))
    return found


def _compare_checkpoints(here: Path, there: Path) -> list[str]:
    places = [json.loads((checkpoint / "data" / "metadata").read_text()) for checkpoint in (here, there)]
    moved = [] if places[0] == places[1] else [f"the place in the data is {places[0]} here, {places[1]} there"]
    return compare_arrays(here / "state", there / "state") + moved


def compare_logs(here: Path, there: Path) -> list[str]:
    """The first difference between two loss curves, in words."""
    one, two = read_curve(here), read_curve(there)
    for row, other in zip(one, two, strict=False):
        names = [name for name in row | other if repr(row.get(name)) != repr(other.get(name))]  # repr: NaN is NaN
        if names:
            told = ", ".join(f"{name} {row.get(name)} against {other.get(name)}" for name in names)
            return [f"the log differs from step {row['step']} on: {told}"]
    if len(one) != len(two):
        return [f"the log has {len(one)} steps here, {len(two)} there"]
    return []


def compare_arrays(here: Path, there: Path) -> list[str]:
    """Which arrays of two saved trees differ in any bit, shape or type."""
    missing = [f"{path}: missing" for path in (here, there) if not path.exists()]
    if missing:
        return missing
    one, two = read_arrays(here), read_arrays(there)
    found = [f"{here.name}: {name} is only in one of them" for name in sorted(one.keys() ^ two.keys())]
    for name in sorted(one.keys() & two.keys()):
        if not same_bits(one[name], two[name]):
            found.append(f"{here.name}: {name} differs")
    return found


def same_bits(one: np.ndarray, two: np.ndarray) -> bool:
    """Whether two arrays are the same, NaN and the sign of zero included."""
    return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a tree that orbax saved, by name, on the host and untouched by any device."""
    with ocp.PyTreeCheckpointer() as checkpointer:
        tree = checkpointer.metadata(path.absolute()).item_metadata.tree
        wanted = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), tree)
        saved = checkpointer.restore(path.absolute(), restore_args=wanted)
    return {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in jax.tree.leaves_with_path(saved)}


def compare_stores(here: Path, there: Path) -> list[str]:
    """Differences between the records of two stores."""
    one, two = open_store(here), open_store(there)
    if one.splits != two.splits:
        return [f"{here.name}: splits {one.splits} against {two.splits}"]
    return [f"{here.name}: {split} differs" for split in one.splits if _payloads(one, split) != _payloads(two, split)]


def _payloads(store: Store, split: str) -> list[bytes]:
    source = store.source(split)
    return [encode(source[index]) for index in range(len(source))]


def listed(folder: Path, name: str) -> set[str]:
    """The lines of one of a stage's lists, with the run's own place left out; torn and repeated ones do not count."""
    path, lines = folder / name, set()
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(ValueError):
            lines.add(json.dumps(json.loads(line)).replace(str(folder.parent), "RUN"))
    return lines
