"""The token sets beside a store's clips: one store of token grids for each tokenizer that made them."""

from typing import Any

from rsjax.config import TokenizerConfig, content_key
from rsjax.data.store import Store, StoreError, open_store

FOLDER = "tokens"  # in the store of clips
OWN = "own"  # in the directory of a run's stage, if the store of clips is write-protected


def tokenizer_key(config: Any, weights: str, *shifts: int) -> str:
    """Returns the key of everything that determines an image's tokens: the tokenizer and how depth becomes an image.

    Args:
        config: settings of the tokenizer or of a family's own autoencoder (``Config.autoencoder``).
        weights: fingerprint of the tokenizer's weights.
        shifts: how many shifted copies of a clip there are and how far they are shifted, if there are any.
    """
    settings = config
    if isinstance(config, TokenizerConfig):
        settings = config.depth_scale
        if config.compute_dtype != "bfloat16":  # that of the presets
            settings += config.compute_dtype
    return content_key("tokenizer", weights, settings, *shifts)


def tokens_key(clips: str, tokenizer: str) -> str:
    """Returns the content key of a token set.

    Args:
        clips: content key of the clips.
        tokenizer: :func:`tokenizer_key`, which is also the name of the set's directory.
    """
    return content_key("tokens, labelled with scenes and success", clips, tokenizer)


def token_sets(clips: Store) -> dict[str, Store]:
    """Returns the token sets of a store of clips by tokenizer; only complete sets, with a record for every clip."""
    sets = {}
    for place in sorted((clips.path / FOLDER).glob("*")):
        try:
            tokens = open_store(place)
        except StoreError:
            continue  # incomplete or damaged; it is made again when it is needed
        key = tokens_key(str(clips.manifest.get("key")), place.name)
        if tokens.manifest.get("key") == key and tokens.counts() == clips.counts():
            sets[place.name] = tokens
    return sets
