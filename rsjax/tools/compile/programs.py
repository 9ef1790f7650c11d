"""Lowers the programs of training for devices that are not here."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from rsjax.config import Config
from rsjax.models.base import create_model
from rsjax.tools.bench import inputs
from rsjax.training.sharding import DATA, FSDP, Sharding
from rsjax.training.step import train_step


def train(config: Config, devices: Sequence[Any]) -> Any:
    """Returns the world model's training step, lowered for the devices.

    The replicated state of pmap is lowered as a mesh without fsdp, which is the same step.
    """
    loop = config.loop("world_model")
    model = create_model(config)
    shape = (len(devices) // loop.fsdp, loop.fsdp)
    mesh = Mesh(np.array(devices).reshape(shape), (DATA, FSDP), axis_types=(AxisType.Auto,) * 2)
    sharding = Sharding("mesh", mesh)
    rows = NamedSharding(mesh, P((DATA, FSDP)))
    with inputs.random_files(config) as readable:
        one = inputs.batch_shapes(create_model(readable), readable)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((loop.batch_size, *x.shape[1:]), x.dtype, sharding=rows), one)
    step: Any = sharding.compile(train_step, model, loop)
    return step.lower(sharding.template(model, loop), batch)
