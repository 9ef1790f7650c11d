"""Stores into one, and one into several. Records are copied one at a time; what is replaced is replaced whole.

A store is moved by moving its directory: its manifest names its files without their place.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rsjax.config import content_key
from rsjax.data.codec import Record
from rsjax.data.labels import Labels
from rsjax.data.store import MANIFEST, Store, StoreError, open_store, write_store
from rsjax.data.token_sets import FOLDER, token_sets, tokens_key
from rsjax.ingest.actions import Statistics
from rsjax.ingest.episode import safe_id

UNITS = ("action_mean", "action_std", "depth_range")  # what a store's numbers are told in
LEFT_OUT = ("filtered", "quarantine")  # by episode, why
OF_ALL = ("format", "splits", "key", "counts", "episodes", "success_share")  # of a manifest: not true of a part
Words = dict[str, str]
Chosen = Callable[[str, int, Words], bool]


def merge(paths: Sequence[Path], out: Path) -> Store:
    """One store of all records of several, split by split, in the order given.

    Units that differ are made those of all train records together; records say their depth range, so that is set anew.
    Tokens that lie beside all of the clips come along, unless depth ranges differ, on which depth tokens depend.

    Raises:
        StoreError: fewer than two, one twice, stores of other kinds or shapes, tokens of another tokenizer or depth
            range, or ``out`` cannot be written or is one of them.
    """
    stores = [open_store(path) for path in paths]
    _check_mergeable(stores, out)
    key = content_key("merge", *(store.manifest.get("key") or str(store.path) for store in stores))
    merged = _write_merged(stores, out, key)
    if all(_depth_range(store) == _depth_range(merged) for store in stores):
        sets = [token_sets(store) for store in stores]
        for tokenizer in set.intersection(*(set(one) for one in sets)):
            _write_merged([one[tokenizer] for one in sets], out / FOLDER / tokenizer, tokens_key(key, tokenizer))
    return merged


def _left_out(stores: Sequence[Store], name: str) -> dict[str, str]:
    """What the stores left out; an episode of the same name in two of them is told with its store."""
    told: dict[str, str] = {}
    for store in stores:
        for episode, why in store.manifest.get(name, {}).items():
            told[f"{episode} ({store.path})" if episode in told else episode] = why
    return told


def _episodes(stores: Sequence[Store]) -> dict[str, list[str]]:
    """Of each split."""
    told: dict[str, list[str]] = {}
    for store in stores:
        for split, episodes in store.manifest["episodes"].items():
            told.setdefault(split, []).extend(episodes)
    return told


def _depth_range(store: Store) -> Any:
    return store.manifest.get("depth_range")


def _write_merged(stores: Sequence[Store], out: Path, key: str) -> Store:
    first = stores[0].manifest
    meta = {name: value for name, value in first.items() if name not in OF_ALL}
    meta |= (
        _units(stores)
        | {
            "key": key,
            "merged": [{"path": str(store.path), "key": store.manifest.get("key")} for store in stores],
        }
        | {name: _left_out(stores, name) for name in LEFT_OUT if any(name in store.manifest for store in stores)}
    )
    if all("episodes" in store.manifest for store in stores):
        meta["episodes"] = _episodes(stores)
    if all(store.manifest.get("success_share") is not None for store in stores):
        meta["success_share"] = _weighted(stores, "success_share")
    stamp = meta["depth_range"]
    restamp = first["kind"] == "clips" and any(_depth_range(store) != stamp for store in stores)
    writer = _Copy(labels=all(_labelled(store, split) for store in stores for split in store.splits))
    splits = {}
    for split in dict.fromkeys(split for store in stores for split in store.splits):
        parts = [(store, split, None) for store in stores if split in store.splits]
        splits[split] = writer.records(parts, stamp if restamp else _KEEP)
    write_store(out, first["kind"], splits, meta, writer.label if writer.labels else None)
    return open_store(out)


def split(path: Path, outs: Mapping[Path, Chosen]) -> dict[Path, Store]:
    """Stores of chosen records of one, which keep its units: what was learnt on the whole can read the parts.

    Tokens that lie beside the clips are split with them.

    Args:
        outs: for each new store, whether it takes a record: of (split, number there, words of its labels).

    Raises:
        StoreError: nothing is chosen for one of them, or it cannot be written.
    """
    store = open_store(path)
    sets = token_sets(store)
    parts = {out: {name: _chosen(store, name, chosen) for name in store.splits} for out, chosen in outs.items()}
    for out, numbers in parts.items():
        _check_free(out, [store])
        if not any(numbers.values()):
            raise StoreError(f"{out}: no record of {path} is chosen for it; choose otherwise")
    for out, numbers in parts.items():
        key = content_key("split", store.manifest.get("key") or str(path), *(f"{n}{v}" for n, v in numbers.items()))
        _write_part(store, numbers, out, key)
        for tokenizer, tokens in sets.items():
            _write_part(tokens, numbers, out / FOLDER / tokenizer, tokens_key(key, tokenizer))
    return {out: open_store(out) for out in outs}


def _write_part(store: Store, numbers: Mapping[str, list[int]], out: Path, key: str) -> None:
    meta = {name: value for name, value in store.manifest.items() if name not in (*OF_ALL, "action_count")}
    writer = _Copy(labels=all(_labelled(store, name) for name in store.splits))
    splits = {name: writer.records([(store, name, numbers[name])], _KEEP) for name in store.splits}
    write_store(out, store.manifest["kind"], splits, meta | {"key": key}, writer.label if writer.labels else None)


def by_label(path: Path, column: str, folder: Path) -> dict[Path, Chosen]:
    """For :func:`split`: a store in ``folder`` for each word of a column, such as ``difficulty``, named by it.

    Raises:
        StoreError: the store has no such labels.
    """
    store = open_store(path)
    found: dict[str, None] = {}
    for name in store.splits:
        if len(store.source(name)):
            words = store.labels(name).words
            if column not in words:
                raise StoreError(f"{path / MANIFEST}: no label {column!r}; it has {', '.join(words)}")
            found |= dict.fromkeys(words[column])
    return {folder / safe_id(word): _is(column, word) for word in found}


def into_parts(count: int, folder: Path) -> dict[Path, Chosen]:
    """For :func:`split`: ``count`` stores in ``folder`` of as many records each, as nearly as it goes."""
    return {folder / f"part-{part:03d}": _every(count, part) for part in range(count)}


def _is(column: str, word: str) -> Chosen:
    return lambda split, number, words: words[column] == word


def _every(count: int, part: int) -> Chosen:
    return lambda split, number, words: number % count == part


NONE = "none"  # the shape of an array that is left out
_KEEP = object()  # a depth range that is not to be changed


@dataclass
class _Copy:
    """Hands records on, and remembers the labels of the one that was handed on last.

    Attributes:
        labels: whether the sources have them.
    """

    labels: bool
    _words: Words = field(default_factory=dict)

    def records(self, parts: Sequence[tuple[Store, str, list[int] | None]], depth_range: Any) -> Iterator[Record]:
        """Of (store, split, numbers or None for all), with this depth range in their provenance."""
        for store, name, numbers in parts:
            source = store.source(name)
            labels = store.labels(name) if self.labels and len(source) else None
            for number in range(len(source)) if numbers is None else numbers:
                self._words = _words(labels, number)
                record = source[number]
                if depth_range is not _KEEP:
                    record = record | {"provenance": record["provenance"] | {"depth_range": depth_range}}
                yield record

    def label(self, record: Record) -> Words:
        return self._words


def _words(labels: Labels | None, number: int) -> Words:
    return {} if labels is None else {name: words[labels.codes[name][number]] for name, words in labels.words.items()}


def _labelled(store: Store, name: str) -> bool:
    return not len(store.source(name)) or store.labelled(name)


def _chosen(store: Store, name: str, chosen: Chosen) -> list[int]:
    count = len(store.source(name))
    labels = store.labels(name) if count and store.labelled(name) else None
    return [number for number in range(count) if chosen(name, number, _words(labels, number))]


def _check_mergeable(stores: Sequence[Store], out: Path) -> None:
    if len(stores) < 2:
        raise StoreError("merging takes two stores or more")
    if len({store.path.resolve() for store in stores}) < len(stores):
        raise StoreError("a store cannot be merged with itself; name each once")
    _check_free(out, stores)
    one = stores[0]
    tokens = one.manifest.get("kind") == "tokens"
    columns = _columns(one)
    told = {store.manifest["depth_unit"]: store.path for store in stores if store.manifest.get("depth_unit")}
    if len(told) > 1:
        units = "; ".join(f"{unit} in {path}" for unit, path in told.items())
        raise StoreError(f"depth_unit: {units}; such depth does not mix: ingest one of them with --depth none")
    for other in stores[1:]:
        for name in ("kind", "tokenizer", *(("depth_range",) if tokens else ())):
            if other.manifest.get(name) != one.manifest.get(name):
                raise StoreError(
                    f"{other.path}: its {name} is {other.manifest.get(name)}, that of {one.path} is "
                    f"{one.manifest.get(name)}; such stores can be mixed in training (docs/training.md), not merged"
                )
        there, here = shapes(other), shapes(one)
        differing = next((name for name in here | there if _differ(here.get(name), there.get(name))), None)
        if differing:
            raise StoreError(
                f"{other.path}: {differing} is {there.get(differing)}, in {one.path} {here.get(differing)}; make both "
                f"with the same settings"
            )
        if columns is not None and _columns(other) not in (None, columns):
            raise StoreError(f"{other.path}: its labels are {_columns(other)}, those of {one.path} {columns}")


def _check_free(out: Path, stores: Sequence[Store]) -> None:
    """Raises :class:`StoreError` where something is already, or a store that is read would be written into."""
    if out.exists():
        raise StoreError(f"{out}: is there already; choose another place, or delete it")
    for store in stores:
        if store.path.resolve() in out.resolve().parents:
            raise StoreError(f"{out}: lies in {store.path}, which is read; choose another place")


def _differ(here: str | None, there: str | None) -> bool:
    """Whether two shapes of one array cannot be in one store. Depth may be missing from any clip."""
    return here != there and NONE not in (here, there)


def _columns(store: Store) -> list[str] | None:
    """The names of a store's labels; None where it has none."""
    entries = [entry["labels"] for entry in store.manifest["splits"].values() if "labels" in entry]
    return sorted(entries[0]["words"]) if entries else None


def shapes(store: Store) -> dict[str, str]:
    """Type and shape of each array of the store's first record; ``NONE`` for one that is left out."""
    for name in store.splits:
        source = store.source(name)
        if len(source):
            record = source[0]
            return {
                key: f"{value.dtype} {value.shape}" if hasattr(value, "dtype") else NONE
                for key, value in record.items()
                if hasattr(value, "dtype") or value is None
            }
    return {}


def _units(stores: Sequence[Store]) -> dict[str, Any]:
    """Of all train records together, each as they stand where all stores agree."""
    manifests = [store.manifest for store in stores]
    units = {name: manifests[0].get(name) for name in UNITS}
    alike = all({name: manifest.get(name) for name in UNITS} == units for manifest in manifests)
    if alike and not all("action_count" in manifest for manifest in manifests):
        return units
    total: Statistics | None = None
    for store in stores:
        one = Statistics.from_json(store.manifest) if "action_count" in store.manifest else _measured(store)
        total = one if total is None else total.merged(one)
    assert total is not None
    ranges = [manifest["depth_range"] for manifest in manifests if manifest.get("depth_range")]
    merged = [min(near for near, _ in ranges), max(far for _, far in ranges)] if ranges else None
    unit = next((manifest["depth_unit"] for manifest in manifests if manifest.get("depth_unit")), None)
    return total.to_json() | {"depth_range": merged, "depth_unit": unit} | (units if alike else {})


def _measured(store: Store) -> Statistics:
    source = store.source("train")
    total: Statistics | None = None
    for number in range(len(source)):
        one = Statistics.of(source[number]["actions"][1:])
        total = one if total is None else total.merged(one)
    if total is None:
        raise StoreError(
            f"{store.path}: its train split has no records, so its actions have no statistics; leave it out"
        )
    return total


def _weighted(stores: Sequence[Store], name: str) -> float:
    sizes = [sum(len(store.source(part)) for part in store.splits) for store in stores]
    return sum(s.manifest[name] * size for s, size in zip(stores, sizes, strict=True)) / max(1, sum(sizes))
