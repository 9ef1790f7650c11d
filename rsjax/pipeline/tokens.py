"""Both token grids of every clip, kept beside the clips and named by the tokenizer, for every run that has it.

They lie in ``tokens/KEY`` of the store's directory, so they move with it. A token record is its clip's, with tokens in
place of pixels; actions stay in the data's units.
"""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rsjax.config import Config, content_key
from rsjax.data.codec import Record
from rsjax.data.lock import lock
from rsjax.data.store import Store, StoreError, complete_key, write_store
from rsjax.data.token_sets import FOLDER, tokens_key
from rsjax.data.units import Units
from rsjax.pipeline.feeding import fingerprint, readable
from rsjax.progress import Progress
from rsjax.sample.generator import Codec
from rsjax.sim.expert import difficulty

UNITS = ("action_mean", "action_std", "action_count", "depth_range")  # of a manifest


def tokenizer_key(config: Config, params: Any) -> str:
    """What decides which tokens an image has: the tokenizer's weights, and how depth becomes an image."""
    return content_key("tokenizer", fingerprint(params), config.tokenizer.depth_scale)


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
    side, size = clips.source("train")[0]["rgb"].shape[1], config.tokenizer.image_size
    if side != size:
        raise StoreError(f"{clips.path}: its pictures have {side} pixels a side, the tokenizer takes {size}")
    tokenizer = tokenizer_key(config, params)
    key = tokens_key(str(clips.manifest.get("key")), tokenizer)
    beside = clips.path.resolve() / FOLDER / tokenizer
    out = beside if os.access(clips.path, os.W_OK) else place.resolve() / "own"
    with lock(out.with_name(f".{out.name}.lock"), wait=f"waiting for another process that makes {out}"):
        if complete_key(out) != key:
            _write(out, clips, Codec(config, params, Units.create(clips)), place, key)
    return out


def _write(out: Path, clips: Store, codec: Codec, place: Path, key: str) -> None:
    total = sum(len(clips.source(split)) for split in clips.splits)
    with Progress("tokens", total, "clips") as progress:
        done = 0

        def tokenized(split: str) -> Iterator[Record]:
            nonlocal done
            for clip in readable(clips.source(split), split, place, codec.config.train.max_damaged):
                yield token_record(codec, clip)
                done += 1
                progress.update(done)

        meta = {name: clips.manifest[name] for name in UNITS if name in clips.manifest}
        meta |= {"key": key, "source": str(clips.path), "tokenizer": fingerprint(codec.params)}
        write_store(out, "tokens", {split: tokenized(split) for split in clips.splits}, meta, labels)


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
