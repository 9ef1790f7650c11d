"""Lowers the programs that training and generation run, for devices that are not here."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import SingleDeviceSharding

from rsjax.config import Config, LoopConfig
from rsjax.errors import UserError
from rsjax.layers.unstacked_params import unstack_params
from rsjax.models.base import create_autoencoder, create_model
from rsjax.models.roboscape.departures import guidance
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.sample import for_many_passes, start, step, written_out
from rsjax.tokenizers.codec import PIXELS
from rsjax.tokenizers.magvit2 import run_tokenizer
from rsjax.tools.bench import inputs
from rsjax.trainable import Trainable
from rsjax.training.sharding import Sharding
from rsjax.training.step import train_step

Part = Literal["train", "sample", "tokenizer"]
PROMPT_FRAMES = 1


@dataclasses.dataclass(frozen=True)
class Program:
    """A program to compile.

    Attributes:
        title: what it does.
        unit: what it processes, in the plural.
        count: how many of them, on all devices.
        devices: the number of devices that run it.
        model_flops: operations that the model needs for them, by the model's own formula; 0 without one.
        steps: how often a training runs it; 0: it is not a training.
        state_bytes: of parameters and optimizer on each device.
        lower: traces the program and returns ``jax.stages.Lowered``.
        notes: what a reader should know.
    """

    title: str
    unit: str
    count: int
    devices: int
    model_flops: float
    steps: int
    state_bytes: int
    lower: Callable[[], Any]
    notes: tuple[str, ...] = ()


def programs(config: Config, part: Part, devices: Sequence[Any], clips: int) -> list[Program]:
    """Returns the programs of a part.

    Args:
        devices: jax's descriptions of the devices.
        clips: for the part "sample", which generates one clip and as many as this, on one device.

    Raises:
        ConfigError: the devices or the batch cannot be divided as the settings require.
        UserError: the family has no such part.
    """
    if part == "train":
        return [train(config, devices)]
    if part == "sample":
        return [frame(config, devices[0], number) for number in dict.fromkeys((1, clips))]
    if not config.model.uses_tokenizer:
        raise UserError(f"a model of family {config.model.family!r} has no tokenizer; leave out --part tokenizer")
    encoders = []
    if config.autoencoder is config.tokenizer:
        encoders = [encode(config, devices[0])]
    return [train_tokenizer(config, devices), *encoders]


def train(config: Config, devices: Sequence[Any]) -> Program:
    """Returns the world model's training step."""
    model = create_model(config)
    loop = config.loop("world_model")
    with inputs.random_files(config) as readable:
        one = inputs.batch_shapes(create_model(readable), readable)
    flops = loop.batch_size * model.flops(config.clips.frames).get("train", 0)
    return _training("training step", model, loop, devices, one, flops)


def train_tokenizer(config: Config, devices: Sequence[Any]) -> Program:
    """Returns the training step of the tokenizer or of the model's own autoencoder."""
    model = create_autoencoder(config)
    loop = config.loop("tokenizer")
    frames = config.tokenizer_train.frames_per_clip
    size = config.clips.image_size
    rng = np.random.default_rng(0)
    record: Any = {
        "rgb": np.zeros((config.clips.frames, size, size, 3), np.uint8),
        "depth": None,
        "actions": np.zeros((config.clips.frames, config.clips.action_dim), np.float32),
    }
    if config.second_view:
        record["second"] = record["rgb"]
    arrays = {name: x[None] for name, x in model.transform()(record, rng).items()}
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), model.batch(arrays))
    flops = 3 * loop.batch_size * frames * sum(model.flops().values())
    return _training("tokenizer's training step", model, loop, devices, one, flops)


def _training(
    title: str,
    model: Trainable[Any],
    loop: LoopConfig,
    devices: Sequence[Any],
    one: Any,
    flops: float,
) -> Program:
    """Returns a training step with the sharding that training chooses.

    Args:
        one: shapes of a batch of one clip.
    """
    sharding = Sharding.create(loop, devices)
    notes = []
    if sharding.kind == "pmap" and len({device.process_index for device in devices}) > 1:
        # pmap is given each process's own rows, for which a description of all devices has no place.
        loop = dataclasses.replace(loop, sharding="mesh")
        sharding = Sharding.create(loop, devices)
        notes.append("pmap over several hosts is compiled as the mesh without fsdp, which is the same step")
    used = sharding.mesh.size
    if used < len(devices):
        notes.append(
            f"runtime.sharding {loop.sharding} uses {used} of {len(devices)} devices for a batch of {loop.batch_size}"
        )
    state = sharding.template(model, loop)
    rows = jax.tree.map(lambda x: jax.ShapeDtypeStruct((x.shape[0] * loop.batch_size, *x.shape[1:]), x.dtype), one)
    batch = sharding.batch_template(rows)
    compiled: Any = sharding.compile(train_step, model, loop)
    each = (np.prod(x.sharding.shard_shape(x.shape)) * x.dtype.itemsize for x in jax.tree.leaves(state))
    return Program(
        title=f"{title} on {loop.batch_size} clips",
        unit="clips",
        count=loop.batch_size,
        devices=used,
        model_flops=flops,
        steps=loop.steps,
        state_bytes=int(sum(each)),
        lower=partial(compiled.lower, state, batch),
        notes=tuple(notes),
    )


def frame(config: Config, device: Any, clips: int) -> Program:
    """Returns the program of one generated frame, as a rollout repeats it, with all passes of the network.

    Raises:
        UserError: the family does not generate tokens frame by frame.
    """
    model = create_model(config)
    if not isinstance(model, RoboScape):
        raise UserError(
            f"--part sample compiles the frames of the families roboscape and genie; this is {config.model.family!r}"
        )
    arch = model.architecture
    if device.platform == "gpu" and arch.compute_dtype == "bfloat16":
        arch = written_out(arch)
    sample = dataclasses.replace(model.config.sample, seed=0)

    def first(params: Any) -> Any:
        tokens = dict.fromkeys(arch.modalities, jnp.zeros((clips, PROMPT_FRAMES, config.grid**2), jnp.int32))
        actions = jnp.zeros((clips, PROMPT_FRAMES, arch.action_inputs))
        state = start(arch, sample, params, tokens, actions, jax.random.split(jax.random.key(0), clips), None)
        cache = unstack_params(state.cache, arch.groups, arch.unroll)
        return for_many_passes(arch, params), dataclasses.replace(state, cache=cache)

    def generate(params: Any, state: Any, actions: Any) -> Any:
        return step(arch, sample, params, state, actions, beyond=False)

    weights = jax.eval_shape(model.init, jax.random.key(0))
    place = SingleDeviceSharding(device)
    shapes = (*jax.eval_shape(first, weights), jax.ShapeDtypeStruct((clips, arch.action_inputs), "float32"))
    arguments = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), shapes)
    # The first pass also covers the frame before, each other pass this frame alone; a frame attends to a full window.
    passes = (sample.steps + arch.uncommitted) * guidance.copies(sample)
    flops = clips * passes * model.flops(arch.frames)["forward"] // arch.frames
    return Program(
        title=f"generating a frame of {clips} clip" + "s" * (clips > 1),
        unit="frames",
        count=clips,
        devices=1,
        model_flops=flops,
        steps=0,
        state_bytes=_bytes(shapes[0]),
        lower=partial(jax.jit(generate, donate_argnums=1).lower, *arguments),
    )


def encode(config: Config, device: Any) -> Program:
    """Returns the program that encodes images, in passes as before the world model's training."""
    size = config.clips.image_size
    images = max(1, PIXELS // size**2)
    place = SingleDeviceSharding(device)
    params = create_autoencoder(config).shapes()
    arguments = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place),
        (params, jax.ShapeDtypeStruct((images, size, size, 3), "uint8")),
    )

    def run(params: Any, images: Any) -> Any:
        return run_tokenizer(config.tokenizer, params, images, "encode")

    return Program(
        title=f"encoding {images} images",
        unit="images",
        count=images,
        devices=1,
        model_flops=images * create_autoencoder(config).flops().get("encoder", 0),
        steps=0,
        state_bytes=_bytes(params),
        lower=partial(jax.jit(run).lower, *arguments),
    )


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))
