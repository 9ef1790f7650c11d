"""Genie (reference: 1xgpt's STMaskGIT): RoboScape's RGB branch, trained with cross-entropy only."""

from dataclasses import dataclass

from rsjax.config import GenieConfig
from rsjax.models.base import implements
from rsjax.models.roboscape.model import RoboScape


@implements(GenieConfig)
@dataclass(frozen=True)
class Genie(RoboScape):
    """The paper's baseline (with actions through an MLP) or the public model (without actions).

    Its settings switch off the depth branch and the keypoint terms.
    """
