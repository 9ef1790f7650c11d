"""World models: their interface (:mod:`rsjax.models.base`), and one package per family."""

from rsjax.models.base import Assets, WorldModel, create_model, implements
from rsjax.models.cogvideox.model import CogVideoX
from rsjax.models.genie import Genie
from rsjax.models.irasim.model import IRASim
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.models.roboscape.model import RoboScape

__all__ = [
    "Assets",
    "CogVideoX",
    "Genie",
    "IRASim",
    "IVideoGPT",
    "RoboScape",
    "WorldModel",
    "create_model",
    "implements",
]
