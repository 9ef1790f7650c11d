"""The token grids that lie beside a store's clips, one set for each tokenizer that ever made them."""

from rsjax.config import Config, content_key
from rsjax.data.store import Store, StoreError, open_store

FOLDER = "tokens"  # in the store of clips


def tokenizer_key(config: Config, weights: str) -> str:
    """What decides which tokens an image has: the tokenizer's weights, and how depth becomes an image.

    Args:
        weights: their fingerprint.
    """
    return content_key("tokenizer", weights, config.tokenizer.depth_scale)


def tokens_key(clips: str, tokenizer: str) -> str:
    """The content key of a set.

    Args:
        clips: the content key of the clips.
        tokenizer: what the set is called by.
    """
    return content_key("tokens", clips, tokenizer)


def token_sets(clips: Store) -> dict[str, Store]:
    """The whole sets of a store of clips by tokenizer: those with a record for every clip."""
    found = {}
    for place in sorted((clips.path / FOLDER).glob("*")):
        try:
            tokens = open_store(place)
        except StoreError:
            continue  # half made, or damaged; it is made again when it is needed
        made_of = tokens.manifest.get("key") == tokens_key(str(clips.manifest.get("key")), place.name)
        if made_of and counts(tokens) == counts(clips):
            found[place.name] = tokens
    return found


def counts(store: Store) -> dict[str, int]:
    """Records by split."""
    return {split: len(store.source(split)) for split in store.splits}
