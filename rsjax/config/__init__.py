"""Every setting of the project: frozen, hashable, serialisable dataclasses that check themselves when created.

A :class:`Config` contains everything that one run depends on. Presets are in :mod:`rsjax.config.presets`.
The paper's λ₁, λ₂, λ₃ and γ are in :class:`LossConfig` and nowhere else.

A field made with :func:`runtime` changes the speed or the logging of a run, not its results. Content keys leave it
out, so changing it never invalidates finished work.
"""

from rsjax.config.data import ClipShape, DataConfig
from rsjax.config.fields import (
    ConfigError,
    check_numbers,
    content_key,
    from_dict,
    require,
    runtime,
    sampling,
    sampling_settings,
    to_dict,
)
from rsjax.config.model import ModelConfig, families, register_family
from rsjax.config.run import SIMULATOR, WEIGHTS, Config, EvalConfig
from rsjax.config.sim import SimConfig
from rsjax.config.token_model import (
    BackwardsConfig,
    CorruptionConfig,
    Departures,
    DepthBranch,
    DepthHead,
    GenieConfig,
    KeepStillConfig,
    LossConfig,
    NoDepth,
    PublicCodeConfig,
    RoboScapeConfig,
    SampleConfig,
    SmallDepthBranch,
    StateHeadsConfig,
    TokenModelConfig,
    TransformerConfig,
)
from rsjax.config.tokenizer import AdversarialConfig, PerceptualConfig, TokenizerConfig, TokenizerTrainConfig
from rsjax.config.train import (
    AdamW,
    ComponentConfig,
    CurriculumStageConfig,
    EarlyStopConfig,
    LoopConfig,
    Muon,
    OptimizerConfig,
    RuntimeConfig,
    TrainConfig,
)

__all__ = [
    "SIMULATOR",
    "WEIGHTS",
    "AdamW",
    "AdversarialConfig",
    "BackwardsConfig",
    "ClipShape",
    "ComponentConfig",
    "Config",
    "ConfigError",
    "CorruptionConfig",
    "CurriculumStageConfig",
    "DataConfig",
    "Departures",
    "DepthBranch",
    "DepthHead",
    "EarlyStopConfig",
    "EvalConfig",
    "GenieConfig",
    "KeepStillConfig",
    "LoopConfig",
    "LossConfig",
    "ModelConfig",
    "Muon",
    "NoDepth",
    "OptimizerConfig",
    "PerceptualConfig",
    "PublicCodeConfig",
    "RoboScapeConfig",
    "RuntimeConfig",
    "SampleConfig",
    "SimConfig",
    "SmallDepthBranch",
    "StateHeadsConfig",
    "TokenModelConfig",
    "TokenizerConfig",
    "TokenizerTrainConfig",
    "TrainConfig",
    "TransformerConfig",
    "check_numbers",
    "content_key",
    "families",
    "from_dict",
    "register_family",
    "require",
    "runtime",
    "sampling",
    "sampling_settings",
    "to_dict",
]
