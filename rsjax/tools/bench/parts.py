"""The parts of a benchmark.

Each part takes a configuration, a batch size and a time budget per quantity, and returns numbers by name: seconds
(``_s``), rates (``_per_s``) and floating-point operations (``_flops``, per second for ceiling and achieved rate).
"""

import dataclasses
import math
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.config import Config
from rsjax.config.config_fields import with_values
from rsjax.data import loader
from rsjax.data.curriculum import loader_factory
from rsjax.data.loader import Prefetch
from rsjax.data.store import open_store, write_store
from rsjax.devices import on_cpu
from rsjax.errors import UserError
from rsjax.models.base import create_autoencoder, create_model
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.sample import rollout
from rsjax.models.trained import TrainedModel
from rsjax.tools.bench import inputs
from rsjax.tools.bench.timing import median_seconds
from rsjax.tools.policies.worlds.environments import MOST_STEPS, WorldModelVectorEnv
from rsjax.training.sharding import Sharding
from rsjax.training.state import create_state
from rsjax.training.step import train_step

Numbers = dict[str, Any]

# (N, K, M) of the measured products, the fastest of which is the ceiling: layers of the 32×256 model, and larger ones.
CPU_PRODUCTS = ((4096, 256, 1024), (4096, 1024, 256), (2048, 2048, 2048))
ACCELERATOR_PRODUCTS = ((4096, 256, 1024), (8192, 8192, 8192), (16384, 4096, 16384))
PRODUCTS_PER_RUN = 10  # to hide the cost of a launch
PROMPT_FRAMES = 1  # of each rollout, as in the paper, for every preset
UNCACHED_FRAMES = 2  # frames decoded without the cache; all cost the same, so few are enough
LOADER_CLIPS = 64
LOADER_BATCHES = 16
FEED_CLIPS = 256
ENVIRONMENTS = (1, 64)  # numbers of environments that are stepped at once
WARM_UP = 3
LEAST = 10
MOST = 200  # steps of the part "feed"


def matmul(dtype: str, budget: float) -> Numbers:
    """Measures matrix products with float32 accumulation; the ceiling is the fastest rate in operations a second."""
    shapes = ACCELERATOR_PRODUCTS
    if on_cpu():
        shapes = CPU_PRODUCTS
    product = jax.jit(lambda x, w: jnp.matmul(x, w, preferred_element_type=jnp.float32))
    rates = {}
    for n, k, m in shapes:
        x, w = (jax.random.normal(jax.random.key(0), shape).astype(dtype) for shape in ((n, k), (k, m)))
        seconds = median_seconds(lambda x=x, w=w: [product(x, w) for _ in range(PRODUCTS_PER_RUN)], budget)  # type: ignore[misc]
        rates[f"{n}x{k}x{m}"] = 2 * n * k * m * PRODUCTS_PER_RUN / seconds
    best = max(rates, key=lambda name: rates[name])
    return {"matmul_ceiling_flops": rates[best], "matmul_ceiling_shape": best} | {
        f"matmul_flops_{name}": rate for name, rate in rates.items()
    }


def train_adamw(config: Config, batch: int, budget: float) -> Numbers:
    """Measures the training step with AdamW, the PyTorch baseline's optimizer, if the preset has another one."""
    if config.train.optimizer.kind == "adamw":
        return {}
    config = with_values(config, {"train.optimizer": "adamw"})
    return {"train_step_s_adamw": train(config, batch, budget)["train_step_s"]}


def train(config: Config, batch: int, budget: float) -> Numbers:
    """Measures the world model's training step on one device, and its compilation without caches."""
    model = create_model(config)
    loop = config.loop("world_model")
    accumulate = math.gcd(loop.accumulate, batch)  # a smaller batch has fewer parts
    loop = dataclasses.replace(loop, batch_size=batch, accumulate=accumulate, sharding="jit", fsdp=1)
    state = jax.jit(lambda: create_state(model, loop))()
    clips = inputs.batch(model, config, batch)
    began = time.perf_counter()
    compiled: Any = Sharding.create(loop).compile(train_step, model, loop)
    step = compiled.lower(state, clips).compile()
    compile_s = time.perf_counter() - began

    def run() -> Any:
        nonlocal state
        state, metrics = step(state, clips)
        return state, metrics

    seconds = median_seconds(run, budget)
    numbers: Numbers = {
        "train_step_s": seconds,
        "train_frames_per_s": batch * config.clips.frames / seconds,
        "compile_s": compile_s,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
    }
    if isinstance(model, RoboScape):
        tokens = batch * config.clips.frames * config.grid**2 * len(model.architecture.modalities)
        numbers["train_tokens_per_s"] = tokens / seconds
    if flops := batch * model.flops(config.clips.frames).get("train", 0):
        numbers |= {"train_step_flops": flops, "train_flops": flops / seconds}
    return numbers


def sample(config: Config, batch: int, budget: float, horizons: tuple[int, ...]) -> Numbers:
    """Measures seconds per generated frame of a batch for each rollout length, with and without the temporal cache.

    Without the cache, only the last frames of a rollout are decoded, since each step on each of them passes over all
    frames. Families other than RoboScape and Genie are measured from pixels to pixels.
    """
    model = create_model(config)
    key = jax.random.key(0)
    params = jax.jit(model.init)(key)
    numbers: Numbers = {}
    if not isinstance(model, RoboScape):
        assets = inputs.assets(config)
        numbers["sample_prompt_frames"] = PROMPT_FRAMES
        for frames in horizons:
            video = inputs.prompt_video(config, batch, PROMPT_FRAMES)
            rows = np.random.default_rng(1).normal(size=(batch, frames, config.clips.action_dim)).astype(np.float32)
            generate = partial(model.generate, params, assets, video, rows)
            numbers[f"sample_s_per_frame_{frames}"] = median_seconds(generate, budget) / (frames - PROMPT_FRAMES)
        return numbers | {"sample_s_per_frame": numbers[f"sample_s_per_frame_{horizons[0]}"]}
    arch = model.architecture
    settings = model.config.sample
    numbers |= {"sample_steps": settings.steps, "sample_prompt_frames": PROMPT_FRAMES}
    for frames in horizons:
        actions = inputs.actions(arch, batch, frames)
        late = max(PROMPT_FRAMES, frames - UNCACHED_FRAMES)
        for name, start, cached in (("cached", PROMPT_FRAMES, True), ("uncached", late, False)):
            prompt = inputs.prompt(arch, batch, start)
            run = partial(rollout, arch, settings, params, prompt, actions, key, cached=cached)
            numbers[f"sample_s_per_frame_{name}_{frames}"] = median_seconds(run, budget) / (frames - start)
        numbers[f"sample_uncached_frames_measured_{frames}"] = frames - late
    first = horizons[0]
    last = horizons[-1]
    for name in ("s_per_frame_cached", "s_per_frame_uncached", "uncached_frames_measured"):
        numbers[f"sample_{name}"] = numbers[f"sample_{name}_{first}"]
    if last != first:
        cost = numbers[f"sample_s_per_frame_cached_{last}"] / numbers["sample_s_per_frame_cached"]
        numbers[f"sample_cost_ratio_{last}_over_{first}"] = cost
    return numbers


def tokenizer(config: Config, batch: int, budget: float) -> Numbers:
    """Measures encoded and decoded frames a second, with images on the host, for all frames of a batch of clips."""
    if not config.model.uses_tokenizer:
        return {}
    assets = inputs.assets(config)
    assert assets.tokenizer is not None
    codec = create_autoencoder(config).codec(assets.tokenizer, assets.normalization)
    video = inputs.video(config, batch, config.clips.frames)
    no_depth = np.zeros(batch, bool)
    tokens = codec.encode(video)
    frames = batch * config.clips.frames
    return {
        "tokenizer_encode_frames_per_s": frames / median_seconds(lambda: codec.encode(video), budget),
        "tokenizer_decode_frames_per_s": frames / median_seconds(lambda: codec.decode(tokens, no_depth).rgb, budget),
        "tokenizer_frames": frames,
    }


def environment(config: Config, budget: float) -> Numbers:
    """Measures steps a second of 1 and of 64 environments in the world model, summed over them, without a judge.

    A step goes from an action on the host to a frame on the host, with depth if the model has it, in windows that are
    on average half full. The result is empty for a model that takes no actions or cannot generate frame by frame.
    """
    model = create_model(config)
    size = config.clips.image_size
    trained = TrainedModel(config, model, jax.jit(model.init)(jax.random.key(0)), inputs.assets(config))
    first = {"rgb": np.zeros((size, size, 3), np.uint8), "depth": np.ones((size, size), np.float32)}
    numbers: Numbers = {}
    for count in ENVIRONMENTS:
        try:
            env = WorldModelVectorEnv(trained, count, max_steps=MOST_STEPS)
        except UserError:
            return {}
        env.reset(seed=0, options=first if config.model.uses_depth else {"rgb": first["rgb"]})
        steps = config.clips.frames
        actions = np.zeros((count, config.clips.action_dim), np.float32)
        seconds = median_seconds(lambda: [env.step(actions)[0]["rgb"] for _ in range(steps)], budget)  # noqa: B023
        numbers[f"environment_steps_per_s_{count}"] = count * steps / seconds
    return numbers


def load(config: Config, batch: int, budget: float) -> Numbers:
    """Measures clips a second from a store to batches on the host, through the loader that training uses."""
    model = create_model(config)
    rng = np.random.default_rng(0)
    records = [model.example(rng) for _ in range(LOADER_CLIPS)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        write_store(path, "tokens", {"train": records}, {})
        source = open_store(path).source("train")
        transform = model.transform(inputs.normalization(config))
        with loader.batches(source, transform, batch, config.train.seed) as clips:
            seconds = median_seconds(lambda: [model.batch(next(clips)) for _ in range(LOADER_BATCHES)], budget)
    return {"loader_clips_per_s": batch * LOADER_BATCHES / seconds}


def feed(config: Config, budget: float) -> Numbers:
    """Measures the share of time that training steps on one device wait for their batch.

    It uses the preset's batch size and workers, and random clips from a store on disk. Each step finishes before the
    next batch is requested, so the time until the batch arrives is the time that the device waits.

    Args:
        budget: seconds after which no further step begins, but at least ``LEAST`` steps are run.
    """
    loop = dataclasses.replace(config.loop("world_model"), sharding="jit", fsdp=1, curriculum=())
    model = create_model(config)
    transform = model.transform(inputs.normalization(config))
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        write_store(path, "tokens", {"train": (model.example(rng) for _ in range(FEED_CLIPS))}, {})
        make = loader_factory(loop, open_store(path), transform, Path(folder))
        loop = make.loop
        sharding = Sharding.create(loop)
        step = sharding.compile(train_step, model, loop)
        state = jax.jit(lambda: create_state(model, loop))()
        with Prefetch(make(None), model.batch, sharding.put_batch) as batches:
            steps = 0
            began = 0.0
            waited = 0.0
            while steps < WARM_UP + MOST:
                if steps == WARM_UP:
                    began = time.monotonic()
                    waited = batches.waited
                state, metrics = step(state, next(batches).batch)
                jax.block_until_ready(metrics)
                steps += 1
                if steps >= WARM_UP + LEAST and time.monotonic() - began > budget:
                    break
            seconds = time.monotonic() - began
            waited = batches.waited - waited
    return {
        "feed_batch": loop.batch_size,
        "feed_workers": loop.workers,
        "feed_steps": steps - WARM_UP,
        "feed_step_s": seconds / (steps - WARM_UP),
        "data_wait_s": waited / (steps - WARM_UP),
        "data_wait_share": waited / seconds,
    }
