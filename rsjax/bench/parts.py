"""What is measured, part by part. Each part takes a configuration, a batch size and a time budget for each of its
quantities, and gives flat keys: seconds (``_s``), rates (``_per_s``) and floating-point operations (``_flops``, per
second for the ceiling and for what is achieved).
"""

import dataclasses
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.bench import inputs
from rsjax.bench.timing import median_seconds
from rsjax.config import Config
from rsjax.data import loader
from rsjax.data.normalization import Normalization
from rsjax.data.store import open_store, write_store
from rsjax.models.roboscape.flops import train_flops
from rsjax.models.roboscape.rollout import rollout
from rsjax.models.roboscape.world_model import branches
from rsjax.pipeline.generator import Codec
from rsjax.pipeline.transforms import token_batch
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training.objectives import WorldModelObjective
from rsjax.training.placement import Placement
from rsjax.training.state import create_state

Numbers = dict[str, Any]

# (N, K, M) of the products that stand for the machine's ceiling: the layers of the 32×256 model, and larger ones.
CPU_PRODUCTS = ((4096, 256, 1024), (4096, 1024, 256), (2048, 2048, 2048))
ACCELERATOR_PRODUCTS = ((4096, 256, 1024), (8192, 8192, 8192), (16384, 4096, 16384))
PRODUCTS_PER_RUN = 10  # more than one, so that a launch does not count
PROMPT_FRAMES = 1  # of the rollouts, as the paper gives: then their cost does not depend on the preset's training
UNCACHED_FRAMES = 2  # that are decoded by recomputing all frames; each costs the same, so few are enough
LOADER_CLIPS, LOADER_BATCHES = 64, 16


def matmul(dtype: str, budget: float, shapes: tuple[tuple[int, int, int], ...] | None = None) -> Numbers:
    """The rate of the fastest of some matrix products, float32 accumulation, in operations a second."""
    if shapes is None:
        shapes = CPU_PRODUCTS if jax.default_backend() == "cpu" else ACCELERATOR_PRODUCTS
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


def train(config: Config, batch: int, budget: float) -> Numbers:
    """The world model's training step on one device: compilation from nothing, and the step itself."""
    objective = WorldModelObjective.create(config)
    loop = dataclasses.replace(config.train, batch_size=batch, placement="jit")
    state = jax.jit(partial(create_state, objective, loop))()
    clips = inputs.batch(config, batch)
    began = time.perf_counter()
    step = Placement.create(loop).compile(objective, loop).lower(state, clips).compile()
    compile_s = time.perf_counter() - began

    def run() -> Any:
        nonlocal state
        state, metrics = step(state, clips)
        return state, metrics

    seconds = median_seconds(run, budget)
    frames, cells = config.clips.frames, config.model.grid**2
    flops = train_flops(config.model, frames, batch)
    return {
        "train_step_s": seconds,
        "train_tokens_per_s": batch * frames * cells * len(branches(config.model)) / seconds,
        "train_step_flops": flops,
        "train_flops": flops / seconds,
        "compile_s": compile_s,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
    }


def sample(config: Config, batch: int, budget: float, horizons: tuple[int, ...]) -> Numbers:
    """Seconds for each generated frame of a batch, by rollouts' length, with the temporal cache and without.

    Without it, the last frames of a rollout are measured: each frame costs a pass over all of them, whichever it is.
    """
    model, key = config.model, jax.random.key(0)
    params = inputs.world_model_params(model)
    numbers: Numbers = {"sample_steps": config.sample.steps, "sample_prompt_frames": PROMPT_FRAMES}
    for frames in horizons:
        actions, late = inputs.actions(model, batch, frames), max(PROMPT_FRAMES, frames - UNCACHED_FRAMES)
        for name, given, cached in (("cached", PROMPT_FRAMES, True), ("uncached", late, False)):
            prompt = inputs.prompt(model, batch, given)
            run = partial(rollout, model, config.sample, params, prompt, actions, key, cached=cached)
            numbers[f"sample_s_per_frame_{name}_{frames}"] = median_seconds(run, budget) / (frames - given)
        numbers[f"sample_uncached_frames_measured_{frames}"] = frames - late
    first, last = horizons[0], horizons[-1]
    for name in ("s_per_frame_cached", "s_per_frame_uncached", "uncached_frames_measured"):
        numbers[f"sample_{name}"] = numbers[f"sample_{name}_{first}"]
    if last != first:
        cost = numbers[f"sample_s_per_frame_cached_{last}"] / numbers["sample_s_per_frame_cached"]
        numbers[f"sample_cost_ratio_{last}_over_{first}"] = cost
    return numbers


def tokenizer(config: Config, batch: int, budget: float) -> Numbers:
    """Frames a second into tokens and back, images from and to the host, for as many frames as the clips have."""
    params = jax.jit(Tokenizer(config.tokenizer).init_params)(jax.random.key(0))
    units = Normalization((0.0,), (1.0,), (0.1, 1.0))  # of depth and actions, which are not coded here
    codec = Codec(config, params, units)
    size, rng = config.tokenizer.image_size, np.random.default_rng(0)
    images = rng.integers(0, 256, (batch * config.clips.frames, size, size, 3), np.uint8)
    tokens = codec.encode_rgb(images)
    return {
        "tokenizer_encode_frames_per_s": len(images) / median_seconds(lambda: codec.encode_rgb(images), budget),
        "tokenizer_decode_frames_per_s": len(images) / median_seconds(lambda: codec.decode_rgb(tokens), budget),
        "tokenizer_frames": len(images),
    }


def load(config: Config, batch: int, budget: float) -> Numbers:
    """Clips a second from a store of tokens to batches on the host, through the loader that training uses."""
    rng = np.random.default_rng(0)
    records = [inputs.record(config, rng) for _ in range(LOADER_CLIPS)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store"
        write_store(path, "tokens", {"train": records}, {})
        source = open_store(path).source("train")
        with loader.batches(source, inputs.transform(config), batch, config.train.seed) as clips:
            seconds = median_seconds(lambda: [token_batch(next(clips)) for _ in range(LOADER_BATCHES)], budget)
    return {"loader_clips_per_s": batch * LOADER_BATCHES / seconds}
