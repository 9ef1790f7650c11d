"""A store of clips that was not simulated, as what a run learns from."""

from dataclasses import replace
from pathlib import Path

from rsjax.config import Config, DataConfig
from rsjax.data.store import MANIFEST, Store, StoreError, open_store


def on_store(config: Config, path: Path) -> Config:
    """A configuration that learns from a store of clips, as ``experiments.ingest`` makes it.

    ``data`` says what its clips are like, and the model takes actions of their width; all else stays, and has to fit.

    Raises:
        StoreError: there is no such store, it holds no clips, or was made without a content key.
        ConfigError: the clips do not fit the model; the message names both fields.
    """
    store = open_store(path)
    data = _data(store)
    if not config.model.action_dim:
        return replace(config, data=data)
    width = data.action_dim * (2 if config.model.integrate_actions else 1)
    return replace(config, data=data, model=replace(config.model, action_dim=width))


def relocated(config: Config, path: Path) -> Config:
    """The configuration of a run whose store was moved to ``path``.

    Raises:
        StoreError: there is no such store, or the run was not made on one.
    """
    if not config.data.key:
        raise StoreError(f"{path}: this run's clips were simulated; say where they lie with --data-dir")
    return replace(config, data=replace(config.data, store=str(open_store(path).path.absolute())))


def _data(store: Store) -> DataConfig:
    manifest, where = store.manifest, store.path / MANIFEST
    if manifest.get("kind") != "clips" or not manifest.get("key"):
        raise StoreError(
            f"{where}: is of {manifest.get('kind')}, key {manifest.get('key')}; name a store of clips that "
            f"experiments.ingest made"
        )
    counts = {split: len(store.source(split)) if split in store.splits else 0 for split in ("train", "test")}
    if not counts["train"] or counts["test"] < 2:
        raise StoreError(
            f"{where}: {counts['train']} train and {counts['test']} test clips; training takes one and two at least: "
            f"ingest it with a larger --test-share, or more episodes"
        )
    clip = store.source("train")[0]
    return DataConfig(
        store=str(store.path.absolute()),
        key=manifest["key"],
        frames=len(clip["rgb"]),
        image_size=clip["rgb"].shape[1],
        tracks=len(clip["tracks"]),
        action_dim=clip["actions"].shape[1],
        test_clips=counts["test"],
    )
