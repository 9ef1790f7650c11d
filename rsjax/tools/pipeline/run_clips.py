"""Configures a run that trains on a store of ingested clips."""

from dataclasses import replace
from pathlib import Path

from rsjax.config import Config, DataConfig
from rsjax.data.clips import first_clip
from rsjax.data.store import MANIFEST, StoreError, open_store


def on_store(config: Config, path: Path) -> Config:
    """Returns the configuration with its training data replaced by a store made by ``rsjax ingest``.

    Image size, token grid and action width follow from the store's clips.

    Raises:
        StoreError: the store is missing, is not of clips, or has no content key.
        ConfigError: the model or the tokenizer does not fit the clips; the message names the fields.
    """
    store = open_store(path)
    manifest = store.manifest
    where = store.path / MANIFEST
    if manifest.get("kind") != "clips" or not manifest.get("key"):
        raise StoreError(
            f"{where}: is of {manifest.get('kind')}, key {manifest.get('key')}; name a store of clips that "
            f"rsjax ingest or rsjax.write_store made"
        )
    counts = {split: len(store.source(split)) if split in store.splits else 0 for split in ("train", "test")}
    if not counts["train"] or counts["test"] < 2:
        raise StoreError(
            f"{where}: {counts['train']} train and {counts['test']} test clips; training takes one and two at least: "
            f"make it with a larger --test-share (test_share of rsjax.write_store), or more episodes"
        )
    clip = first_clip(store)
    data = DataConfig(
        store=str(store.path.absolute()),
        key=manifest["key"],
        frames=len(clip["rgb"]),
        image_size=clip["rgb"].shape[1],
        tracks=len(clip["tracks"]),
        action_dim=clip["actions"].shape[1],
        test_clips=counts["test"],
    )
    return replace(config, data=data)


def relocated(config: Config, path: Path) -> Config:
    """Returns the configuration of a run with the new path of its store that was moved.

    Raises:
        StoreError: the store is missing, or the run's clips were simulated.
    """
    if config.data is None:
        raise StoreError(f"{path}: this run's clips were simulated; name their directory with --data-dir")
    return replace(config, data=replace(config.data, store=str(open_store(path).path.absolute())))
