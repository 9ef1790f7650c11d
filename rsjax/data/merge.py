"""Merges stores into one, and splits a store into several. Records are copied one at a time.

Training can mix stores as it reads (:mod:`rsjax.data.curriculum`). A merged store is for everything else: one set of
statistics, one validation split, one directory to inspect, evaluate or send elsewhere. The directory can be moved,
because its manifest names files by relative paths.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from operator import attrgetter
from pathlib import Path
from typing import Any

from rsjax.config import content_key
from rsjax.data.labels import Words
from rsjax.data.normalization import Statistics
from rsjax.data.store import MANIFEST, NO_ARRAY, Store, StoreError, open_store, write_store
from rsjax.data.token_sets import FOLDER, token_sets, tokens_key
from rsjax.files import making, safe_id

UNITS = ("action_mean", "action_std", "depth_range")  # fields of a manifest that normalization reads
LEFT_OUT = ("filtered", "quarantine")  # fields with a reason for each episode that was left out
OF_WHOLE = ("format", "splits", "key", "counts", "episodes", "success_share")  # fields that do not hold for a part

Numbers = dict[str, list[int]]  # numbers of the chosen records, by split


def merge(paths: Sequence[Path], out: Path) -> Store:
    """Writes all records of several stores into one, split by split, in the order of the stores.

    If the stores differ in action statistics or depth ranges, the new store has those of all train records together,
    also in the provenance of its records. Token sets that all stores have are merged too, unless depth ranges differ,
    because depth tokens depend on them.

    Raises:
        StoreError: there are fewer than two stores, a store is named twice, the stores differ in kind, shapes, or (for
            tokens) tokenizer or depth range, or ``out`` exists or is inside one of them.
        FileError: ``out`` cannot be written, or another process is making it.
    """
    if len(paths) < 2:
        raise StoreError("merging takes two stores or more")
    stores = [open_store(path) for path in paths]
    _check_mergeable(stores, out)
    key = content_key("merge", *(store.manifest.get("key") or str(store.path) for store in stores))
    with making(out, wait=False):
        merged = _write_merged(stores, out, key)
        if all(store.manifest.get("depth_range") == merged.manifest.get("depth_range") for store in stores):
            sets = [token_sets(store) for store in stores]
            for tokenizer in set.intersection(*map(set, sets)):
                _write_merged([one[tokenizer] for one in sets], out / FOLDER / tokenizer, tokens_key(key, tokenizer))
    return merged


def split(path: Path, parts: Mapping[Path, Numbers]) -> dict[Path, Store]:
    """Writes chosen records of a store into new stores.

    The new stores keep its statistics, so that models trained on the whole can read the parts. Its token sets are
    split too.

    Args:
        parts: the records of each new store, from :func:`by_label` or :func:`into_parts`.

    Raises:
        StoreError: no record is chosen for a new store, or the new store's path exists or is inside the old store.
        FileError: a new store cannot be written, or another process is making it.
    """
    store = open_store(path)
    sets = token_sets(store)
    for out, numbers in parts.items():
        _check_free(out, [store])
        if not any(numbers.values()):
            raise StoreError(f"{out}: no record of {path} is chosen for it; choose otherwise")
    for out, numbers in parts.items():
        key = content_key("split", store.manifest.get("key") or str(path), *(f"{n}{v}" for n, v in numbers.items()))
        with making(out, wait=False):
            _write_part(store, numbers, out, key)
            for tokenizer, tokens in sets.items():
                _write_part(tokens, numbers, out / FOLDER / tokenizer, tokens_key(key, tokenizer))
    return {out: open_store(out) for out in parts}


def by_label(path: Path, column: str, folder: Path) -> dict[Path, Numbers]:
    """Returns parts for :func:`split`: a store in ``folder`` for each word of a column, such as ``difficulty``.

    Raises:
        StoreError: the store has no such labels.
    """
    store = open_store(path)
    parts: dict[Path, Numbers] = {}
    for name, count in store.counts().items():
        if not count:
            continue
        labels = store.labels(name)
        if column not in labels.words:
            raise StoreError(f"--by: {path / MANIFEST}: no label {column!r}; it has {', '.join(labels.words)}")
        for code, word in enumerate(labels.words[column]):
            numbers = parts.setdefault(folder / safe_id(word), {split: [] for split in store.splits})
            numbers[name] = (labels.codes[column] == code).nonzero()[0].tolist()
    return parts


def into_parts(path: Path, count: int, folder: Path) -> dict[Path, Numbers]:
    """Returns parts for :func:`split`: ``count`` stores in ``folder``, whose splits differ by at most one record."""
    sizes = open_store(path).counts()
    return {
        folder / f"part-{part:03d}": {name: list(range(part, size, count)) for name, size in sizes.items()}
        for part in range(count)
    }


class _Copy(dict[str, Any]):
    """A record with its labels in the store that it is copied from."""

    words: Words


_words = attrgetter("words")  # the label of a copy


def _copies(
    parts: Iterable[tuple[Store, str, Iterable[int]]], labelled: bool, changes: dict[str, Any]
) -> Iterator[_Copy]:
    """Yields the records of (store, split, numbers), with changes to their provenance."""
    for store, name, numbers in parts:
        source = store.source(name)
        labels = store.labels(name) if labelled and len(source) else None
        for number in numbers:
            record = _Copy(source[number])
            if changes:
                record["provenance"] = record["provenance"] | changes
            if labels is not None:
                record.words = labels.of(number)
            yield record


def _write_part(store: Store, numbers: Numbers, out: Path, key: str) -> None:
    meta = {name: value for name, value in store.manifest.items() if name not in (*OF_WHOLE, "action_count")}
    if store.manifest.get("success_share") is not None:
        sources = {name: store.source(name) for name in store.splits}
        ends = [source[number]["success"][-1] for name, source in sources.items() for number in numbers[name]]
        meta["success_share"] = sum(map(bool, ends)) / len(ends)
    labelled = _labelled([store])
    splits = {name: _copies([(store, name, numbers[name])], labelled, {}) for name in store.splits}
    write_store(out, store.manifest["kind"], splits, meta | {"key": key}, _words if labelled else None)


def _write_merged(stores: Sequence[Store], out: Path, key: str) -> Store:
    first = stores[0].manifest
    meta = {name: value for name, value in first.items() if name not in OF_WHOLE} | _statistics(stores)
    meta |= {"key": key, "merged": [{"path": str(one.path), "key": one.manifest.get("key")} for one in stores]}
    for name in LEFT_OUT:
        reasons: dict[str, str] = {}
        holders = [store for store in stores if name in store.manifest]
        for store in holders:
            for episode, why in (store.manifest[name] or {}).items():
                reasons[f"{episode} ({store.path})" if episode in reasons else episode] = why
        if holders:
            meta[name] = reasons
    if all("episodes" in store.manifest for store in stores):
        meta["episodes"] = {}
        for split_name, ids in (entry for store in stores for entry in store.manifest["episodes"].items()):
            meta["episodes"].setdefault(split_name, []).extend(ids)
    if all(store.manifest.get("success_share") is not None for store in stores):
        sizes = [sum(store.counts().values()) for store in stores]
        shares = [store.manifest["success_share"] * size for store, size in zip(stores, sizes, strict=True)]
        meta["success_share"] = sum(shares) / max(1, sum(sizes))
    stamp = {"depth_range": meta["depth_range"]}
    changed = first["kind"] == "clips" and any(one.manifest.get("depth_range") != meta["depth_range"] for one in stores)
    labelled = _labelled(stores)
    splits = {
        name: _copies(
            [(store, name, range(store.counts()[name])) for store in stores if name in store.splits],
            labelled,
            stamp if changed else {},
        )
        for name in dict.fromkeys(name for store in stores for name in store.splits)
    }
    write_store(out, first["kind"], splits, meta, _words if labelled else None)
    return open_store(out)


def _labelled(stores: Sequence[Store]) -> bool:
    return all(store.labelled(name) for store in stores for name, count in store.counts().items() if count)


def _statistics(stores: Sequence[Store]) -> dict[str, Any]:
    """Returns the statistics of all train records together; fields that all stores agree on stay as they are."""
    manifests = [store.manifest for store in stores]
    units = {name: manifests[0].get(name) for name in UNITS}
    alike = all({name: manifest.get(name) for name in UNITS} == units for manifest in manifests)
    if alike and not all("action_count" in manifest for manifest in manifests):
        return units
    actions = []
    for store in stores:
        if "action_count" in store.manifest:
            actions.append(Statistics.from_json(store.manifest))
            continue
        source = store.source("train")
        if not len(source):
            raise StoreError(
                f"{store.path}: its train split has no records, so its actions have no statistics; leave it out"
            )
        own = (Statistics.of(source[n]["actions"][1:]) for n in range(len(source)))
        actions.append(reduce(Statistics.merged, own))
    total = reduce(Statistics.merged, actions)
    ranges = [manifest["depth_range"] for manifest in manifests if manifest.get("depth_range")]
    merged = [min(near for near, _ in ranges), max(far for _, far in ranges)] if ranges else None
    unit = next((manifest["depth_unit"] for manifest in manifests if manifest.get("depth_unit")), None)
    return total.to_json() | {"depth_range": merged, "depth_unit": unit} | (units if alike else {})


def _check_mergeable(stores: Sequence[Store], out: Path) -> None:
    if len({store.path.resolve() for store in stores}) < len(stores):
        raise StoreError("a store cannot be merged with itself; name each once")
    _check_free(out, stores)
    depths = {store.manifest["depth_unit"]: store.path for store in stores if store.manifest.get("depth_unit")}
    if len(depths) > 1:
        units = "; ".join(f"{unit} in {path}" for unit, path in depths.items())
        raise StoreError(f"depth_unit: {units}; such depth does not mix: ingest one of them with --depth none")
    one = stores[0]
    fields = ("kind", "tokenizer", *(("depth_range",) if one.manifest.get("kind") == "tokens" else ()))
    columns = _columns(one)
    ours = one.shapes()
    for other in stores[1:]:
        for name in fields:
            if other.manifest.get(name) != one.manifest.get(name):
                raise StoreError(
                    f"{other.path}: its {name} is {other.manifest.get(name)}, that of {one.path} is "
                    f"{one.manifest.get(name)}; such stores can be mixed in training (docs/training.md), not merged"
                )
        theirs = other.shapes()
        for name in ours | theirs:
            shapes = theirs.get(name), ours.get(name)
            if shapes[0] != shapes[1] and NO_ARRAY not in shapes:  # depth may be missing from any clip
                raise StoreError(
                    f"{other.path}: {name} is {shapes[0]}, in {one.path} {shapes[1]}; make both with the same settings"
                )
        if columns is not None and _columns(other) not in (None, columns):
            raise StoreError(f"{other.path}: its labels are {_columns(other)}, those of {one.path} {columns}")


def _check_free(out: Path, stores: Sequence[Store]) -> None:
    """Raises :class:`StoreError` if ``out`` exists or is inside a store that is read."""
    if out.exists():
        raise StoreError(f"{out}: is there already; choose another place, or delete it")
    for store in stores:
        if store.path.resolve() in out.resolve().parents:
            raise StoreError(f"{out}: lies in {store.path}, which is read; choose another place")


def _columns(store: Store) -> list[str] | None:
    """Returns the names of a store's label columns, or None if it has none."""
    entries = [entry["labels"] for entry in store.manifest["splits"].values() if "labels" in entry]
    return sorted(entries[0]["words"]) if entries else None
