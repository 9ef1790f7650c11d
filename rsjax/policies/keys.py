"""Keys of what results depend on: equal in any process exactly when weights, settings and judges are equal."""

from typing import Any

from rsjax.config import content_key
from rsjax.evaluation.results import fingerprint
from rsjax.models.trained import TrainedModel
from rsjax.policies.verdicts import Judge


def arrays_key(*trees: Any) -> str:
    """Returns 16 hex digits that change with any name, type, shape or number of these trees of arrays."""
    return fingerprint(trees)


def model_key(trained: TrainedModel) -> str:
    """Returns the key of what a world model generates: its weights, its tokenizer's, and their settings."""
    config, assets = trained.config, trained.assets
    settings = (config.prompt_frames, config.clips, config.tokenizer, config.model)
    return content_key("model", str(settings), str(assets.normalization), arrays_key(trained.params, assets.tokenizer))


def judge_key(judge: Judge | None) -> str:
    """Returns a judge's attribute ``key``; the name of a judge without one, such as a function; "" for None."""
    if judge is None:
        return ""
    return str(getattr(judge, "key", "")) or str(getattr(judge, "__qualname__", type(judge).__qualname__))
