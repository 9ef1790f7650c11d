"""Every setting of the project: frozen dataclasses, checked where they are made, hashable, serialisable.

A :class:`Config` names everything that one run depends on. Presets live in :mod:`rsjax.config.presets`.
The loss weights λ₁, λ₂, λ₃ and γ of the paper live in :class:`LossConfig` and nowhere else.

A field made with :func:`runtime` changes how fast or how talkatively a run goes but not what it makes;
it is left out of content keys, so changing it never invalidates finished work.
"""

from rsjax.config.data import ClipShape, DataConfig
from rsjax.config.fields import ConfigError, content_key, from_dict, require, runtime, to_dict
from rsjax.config.model import LossConfig, MaskConfig, ModelConfig
from rsjax.config.run import Config, EvalConfig, SampleConfig
from rsjax.config.sim import SimConfig
from rsjax.config.tokenizer import TokenizerConfig, TokenizerTrainConfig
from rsjax.config.train import LoopConfig, OptimizerConfig, PartConfig, StageConfig

__all__ = [
    "ClipShape",
    "Config",
    "ConfigError",
    "DataConfig",
    "EvalConfig",
    "LoopConfig",
    "LossConfig",
    "MaskConfig",
    "ModelConfig",
    "OptimizerConfig",
    "PartConfig",
    "SampleConfig",
    "SimConfig",
    "StageConfig",
    "TokenizerConfig",
    "TokenizerTrainConfig",
    "content_key",
    "from_dict",
    "require",
    "runtime",
    "to_dict",
]
