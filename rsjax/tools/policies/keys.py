"""Hash keys of what results depend on: two keys are equal, in any process, if weights, settings and judges are."""

from typing import Any

from rsjax.config import content_key
from rsjax.evaluation.results import fingerprint
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.verdicts import Judge


def arrays_key(*trees: Any) -> str:
    """Returns 16 hex digits that change with any name, type, shape or value in these trees of arrays."""
    return fingerprint(trees)


def model_key(trained: TrainedModel) -> str:
    """Returns the key of all that a world model's videos depend on: weights, tokenizer, normalization and settings."""
    config, assets = trained.config, trained.assets
    settings = (config.prompt_frames, config.clips, config.tokenizer, config.model)
    return content_key("model", str(settings), str(assets.normalization), arrays_key(trained.params, assets.tokenizer))


def judge_key(judge: Judge | None) -> str:
    """Returns a judge's attribute ``key``, its name if it has no ``key`` (such as a function), or "" for None."""
    if judge is None:
        return ""
    return str(getattr(judge, "key", "")) or str(getattr(judge, "__qualname__", type(judge).__qualname__))
