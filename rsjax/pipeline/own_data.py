"""A store of clips that was not simulated, as what a run learns from."""

from dataclasses import replace
from pathlib import Path

from rsjax.config import Config, DataConfig
from rsjax.data.store import MANIFEST, Store, StoreError, open_store
from rsjax.pipeline.clips import readable


def on_store(config: Config, path: Path) -> Config:
    """A configuration that learns from a store of clips, as ``experiments.ingest`` makes it.

    ``data`` says what its clips are like, and what has to fit them is made so: the size of the tokenizer's images, and
    the model's grid, width of actions, positions and keypoints. All else stays.

    Raises:
        StoreError: there is no such store, it holds no clips, or was made without a content key.
        ConfigError: pictures of this size have no whole number of tokens; the message names the fields.
    """
    data = _data(open_store(path))
    tokenizer = replace(config.tokenizer, image_size=data.image_size)
    width = data.action_dim * (2 if config.model.integrate_actions else 1)
    model = replace(
        config.model,
        grid=tokenizer.grid,
        frames=max(config.model.frames, data.frames),
        action_dim=width if config.model.action_dim else 0,
    )
    loss = replace(config.loss, num_keypoints=min(config.loss.num_keypoints, data.tracks))
    return replace(config, data=data, tokenizer=tokenizer, model=model, loss=loss)


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
    clip = next((record for _, record in readable(store.source("train"), tell=lambda _: None)), None)
    if clip is None:
        raise StoreError(f"{store.path}: no clip of its train split can be read; get it again")
    return DataConfig(
        store=str(store.path.absolute()),
        key=manifest["key"],
        frames=len(clip["rgb"]),
        image_size=clip["rgb"].shape[1],
        tracks=len(clip["tracks"]),
        action_dim=clip["actions"].shape[1],
        test_clips=counts["test"],
    )
