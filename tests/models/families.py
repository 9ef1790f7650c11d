"""Each family with its networks so small that a whole run of them takes no time, on the toy clips."""

from dataclasses import replace
from typing import Any

from rsjax.config import Config, GenieConfig, LoopConfig
from tests.models.cogvideox import toy as toy_cogvideox
from tests.models.irasim import toy as toy_irasim
from tests.models.ivideogpt import toy as toy_ivideogpt
from tests.pipeline import toy

LOOP: dict[str, Any] = {"steps": 4, "batch_size": 2, "checkpoint_every": 2, "log_every": 1, "ema": 0.9, "eval_every": 4}


def engine(config: Config) -> Config:
    """The configuration with two short trainings."""
    tokenizer = replace(config.tokenizer_train, **LOOP, frames_per_clip=3, depth_share=0.0)
    return replace(config, tokenizer_train=tokenizer, train=LoopConfig(**LOOP))


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
    """IRASim with an autoencoder of its own."""
    return engine(toy_irasim.config(integrate_actions=True))


def cogvideox() -> Config:
    """CogVideoX with an autoencoder of its own and learned texts."""
    base = engine(toy_cogvideox.config())
    return replace(base, tokenizer_train=replace(base.tokenizer_train, frames_per_clip=base.sim.frames))


FAMILIES = {"genie": genie, "ivideogpt": ivideogpt, "irasim": irasim, "cogvideox": cogvideox}
