"""Both token grids of every clip, kept beside the clips and named by the tokenizer, for every run that has it.

They lie in ``tokens/KEY`` of the store's directory, so they move with it. A token record is its clip's, with tokens in
place of pixels; actions stay in the data's units. Clips that cannot be read have none, and are named in the manifest.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsjax.config import Config
from rsjax.data.codec import Record
from rsjax.data.normalization import Normalization
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.quarantine import Quarantine
from rsjax.data.store import Store, StoreError, open_store, write_store
from rsjax.data.token_sets import FOLDER, tokenizer_key, tokens_key
from rsjax.files import lock
from rsjax.pipeline.clips import readable
from rsjax.pipeline.feeding import fingerprint
from rsjax.pipeline.generator import Codec
from rsjax.progress import Progress, note
from rsjax.sim.expert import difficulty

UNITS = ("action_mean", "action_std", "action_count", "depth_range", "depth_unit")  # of a manifest
_LEFT_OUT = "left_out"  # of a manifest: the numbers of the clips that have no tokens, by split


def tokenize_store(clips: Store, config: Config, params: Any, place: Path) -> Path:
    """Makes the tokens of every clip, unless they are there.

    Args:
        params: the tokenizer's.
        place: a directory for the list of damaged clips, and for the tokens too where the store is write-protected.

    Returns:
        The store of tokens.

    Raises:
        StoreError: clips of another size than the tokenizer's, too many that are damaged, or a full disk.
    """
    _check_size(clips, config)
    (place / QUARANTINE).unlink(missing_ok=True)  # all are looked at again
    tokenizer = tokenizer_key(config, fingerprint(params))
    key = tokens_key(str(clips.manifest.get("key")), tokenizer)
    out = beside = clips.path.resolve() / FOLDER / tokenizer
    if _is_made(beside, key, clips):
        _list_left_out(beside, clips, config, place)
        return beside
    if not _writable(beside):
        out = place.resolve() / "own" / tokenizer
    with lock(_lock_of(out), wait=f"waiting for another process that makes {out}"):
        if not _is_made(out, key, clips):
            _write(out, clips, Codec(config, params, Normalization.create(clips)), key)
    _list_left_out(out, clips, config, place)
    return out


def _check_size(clips: Store, config: Config) -> None:
    found = next((record for _, record in readable(clips.source("train"), tell=lambda _: None)), None)
    if found is None:
        raise StoreError(f"{clips.path}: no clip of its train split can be read; get it again")
    side, size = found["rgb"].shape[1], config.tokenizer.image_size
    if side != size:
        raise StoreError(f"{clips.path}: its pictures have {side} pixels a side, the tokenizer takes {size}")


def _is_made(out: Path, key: str, clips: Store) -> bool:
    """Whether these tokens are there and whole, and none is missing of a clip that can be read by now."""
    try:
        manifest = open_store(out).manifest
    except StoreError:
        return False
    missing = manifest.get(_LEFT_OUT, {})
    mended = (readable(clips.source(split), numbers, lambda _: None) for split, numbers in missing.items())
    return manifest.get("key") == key and not any(next(found, None) for found in mended)


def _writable(out: Path) -> bool:
    """Whether a set can be made at ``out``; a store may be another user's."""
    there = next(place for place in (out.parent, *out.parents) if place.exists())
    held = _lock_of(out)
    return os.access(there, os.W_OK) and (not held.exists() or os.access(held, os.W_OK))


def _lock_of(out: Path) -> Path:
    return out.with_name(f".{out.name}.lock")


def _write(out: Path, clips: Store, codec: Codec, key: str) -> None:
    total = sum(len(clips.source(split)) for split in clips.splits)
    left_out: dict[str, list[int]] = {split: [] for split in clips.splits}
    with Progress("tokens", total, "clips") as progress:
        done = 0

        def tokenized(split: str) -> Iterator[Record]:
            nonlocal done
            source = clips.source(split)
            missing = set(range(len(source)))
            for number, clip in readable(source, tell=lambda _: None):
                missing.remove(number)
                yield token_record(codec, clip)
                done += 1
                progress.update(done)
            left_out[split] = sorted(missing)

        meta = {name: clips.manifest[name] for name in UNITS if name in clips.manifest}
        meta |= {"key": key, "source": str(clips.path), "tokenizer": fingerprint(codec.params), _LEFT_OUT: left_out}
        write_store(out, "tokens", {split: tokenized(split) for split in clips.splits}, meta, labels)


def _list_left_out(tokens: Path, clips: Store, config: Config, place: Path) -> None:
    """Lists the clips that have no tokens, for this run; too many, or one that scores are made of, is an error."""
    for split, numbers in open_store(tokens).manifest.get(_LEFT_OUT, {}).items():
        source = clips.source(split)
        quarantine = Quarantine(place / QUARANTINE, len(source), config.train.max_damaged)
        for number in numbers:
            try:
                source[number]
            except StoreError as error:
                if split != "train":
                    raise
                quarantine.note(source.locate(number), error, instead="it has no tokens")
        if numbers:
            note(f"{len(numbers)} of {len(source)} clips cannot be read and have no tokens: {place / QUARANTINE}")


def token_record(codec: Codec, clip: Record) -> Record:
    """A clip's tokens; of depth None where it has none."""
    return {
        "rgb": codec.encode_rgb(clip["rgb"]),
        "depth": None if clip["depth"] is None else codec.encode_depth(clip["depth"]),
        "actions": clip["actions"],
        "tracks": clip["tracks"],
        "visible": clip["visible"],
        "task": clip["task"],
        "difficulty": clip["provenance"].get("difficulty") or difficulty(clip["provenance"]),
        "provenance": clip["provenance"],
    }


def labels(record: Record) -> dict[str, str]:
    """The words by which a curriculum chooses among token records."""
    return {name: record[name] for name in ("task", "difficulty")}


def link(target: Path, at: Path) -> None:
    """Makes ``at`` lead to ``target``, whatever was there; it appears whole."""
    temporary = at.with_name(f"{at.name}.{os.getpid()}.tmp")
    temporary.unlink(missing_ok=True)
    if at.is_dir() and not at.is_symlink():  # a run that was copied has the tokens themselves
        shutil.rmtree(at)
    temporary.symlink_to(target)
    os.replace(temporary, at)
