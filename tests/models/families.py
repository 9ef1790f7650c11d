"""Each family with its networks so small that a whole run of them takes no time, on the toy clips."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from rsjax.config import ComponentConfig, Config, CurriculumStageConfig, GenieConfig, RuntimeConfig, TrainConfig
from rsjax.config.config_fields import with_values
from rsjax.models.base import create_autoencoder, create_model
from rsjax.tools.bench import inputs
from tests.models.cogvideox import toy as toy_cogvideox
from tests.models.irasim import toy as toy_irasim
from tests.models.ivideogpt import toy as toy_ivideogpt
from tests.tools.pipeline import toy

TRAIN: dict[str, Any] = {"steps": 4, "batch_size": 2, "ema": 0.9}
RUNTIME = RuntimeConfig(log_every=1, checkpoint_every=4, eval_every=4)


def engine(config: Config) -> Config:
    """The configuration with two short trainings and a short evaluation."""
    tokenizer = replace(config.tokenizer_train, **TRAIN, frames_per_clip=3, depth_share=0.0)
    scored = replace(config.eval, clips=2, action_draws=1)
    return replace(config, tokenizer_train=tokenizer, train=TrainConfig(**TRAIN), runtime=RUNTIME, eval=scored)


def genie() -> Config:
    """Genie, which reads actions."""
    base = toy.config()
    fields = {name: getattr(base.model, name) for name in ("width", "blocks", "heads", "sample")}
    return engine(replace(base, model=GenieConfig(**fields)))


def ivideogpt() -> Config:
    """iVideoGPT, with dropout in both networks."""
    vq = replace(toy_ivideogpt.VQ, patch_size=8, widths=(8,), dropout=0.1)
    model = replace(toy_ivideogpt.MODEL, autoencoder=vq, dropout=0.1)
    base = engine(replace(toy.config(), model=model))
    return replace(base, tokenizer_train=replace(base.tokenizer_train, l2_weight=1.0))


def irasim() -> Config:
    """IRASim on RGB and depth with an autoencoder of its own."""
    base = engine(toy_irasim.config(integrate_actions=True))
    return with_values(base, {"model.autoencoder.depth": "inverse", "tokenizer_train.depth_share": 0.5})


def cogvideox() -> Config:
    """CogVideoX with an autoencoder of its own and learned texts, whose clips come in two stages."""
    base = engine(toy_cogvideox.config())
    stages = [CurriculumStageConfig((ComponentConfig(tasks=("drift",), clips=clips),), 4 / clips) for clips in (1, 2)]
    tokenizer = replace(base.tokenizer_train, frames_per_clip=base.sim.frames)
    return replace(base, tokenizer_train=tokenizer, train=replace(base.train, curriculum=tuple(stages)))


FAMILIES = {"genie": genie, "ivideogpt": ivideogpt, "irasim": irasim, "cogvideox": cogvideox}


def autoencoder_batch(config: Config, clips: int) -> tuple[Any, Any, Any]:
    """The family's own autoencoder, with shapes of its parameters and a batch of clips."""
    autoencoder = create_autoencoder(config)
    rng = np.random.default_rng(0)
    transform = autoencoder.transform()
    rows = [transform({"rgb": toy.clip(i).rgb, "depth": None}, rng) for i in range(clips)]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]} | {"index": np.arange(clips)}
    return autoencoder, autoencoder.shapes(), autoencoder.batch(arrays)


def model_batch(config: Config, clips: int) -> tuple[Any, Any, Any]:
    """The world model, with shapes of its parameters and a batch of clips."""
    model = create_model(config)
    return model, jax.eval_shape(model.init, jax.random.key(0)), inputs.batch(model, config, clips)
