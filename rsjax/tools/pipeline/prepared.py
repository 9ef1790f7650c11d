"""Prepares clips of any store for a run's model: tokens or latents, beside the clips."""

from pathlib import Path

from rsjax.config import Config
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.models.base import Assets, create_model
from rsjax.models.load_run import load_tokenizer


def prepare_store(run: Path, config: Config, clips: Store) -> Store:
    """Makes what the run's model trains on instead of these clips, such as tokens, and returns it, or the clips.

    Depth is read in the range of these clips.

    Args:
        run: the run directory, with the tokenizer.
        config: its configuration.
    """
    assets = Assets(Normalization.create(clips), load_tokenizer(config, run))
    folder = clips.path / "tokens"
    return create_model(config).prepare(clips, assets, folder, config.runtime.max_damaged) or clips
