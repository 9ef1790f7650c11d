"""Takes a few steps of one state under every sharding, on four virtual devices.

Prints, as JSON, how far the world model's parameters end from those of one device (the largest difference, and the
distance as a share of the way that training moved them), for "pmap", whose batches are accumulated in two parts, and
"fsdp" (2 × 2), and those of a smaller network by Muon for "mesh" (data alone) and "muon" (fsdp). "gradient pmap" …: how
far the gradient of the first step is from one device's, as a share, and "metrics pmap" …: its scalars; some clips have
no depth. "gradient heads": the same under fsdp of a model with depth, motion and state heads and adaptive norms; the
state heads lack labels for some clips. For the tokenizer: how far gradients and averages are from one device's
("tokenizer pmap", "tokenizer fsdp"). "checkpoint": how far two steps of one sharding, saved, and a third one of another
are from three steps; "start": whether fresh parameters are the same to the bit if they are made in parts; "cut": the
share of the fsdp state that one device holds.

"families": by network of the other families, how far the gradient of the mesh (2 × 2, every array cut) with two
accumulated parts and that of pmap are apart, as a share. The clips' weights are uneven, so that ratios of single
devices would differ. iVideoGPT's and CogVideoX's autoencoders, which take a minute each to compile, are left to

    XLA_FLAGS=--xla_force_host_platform_device_count=4 python -m tests.training.four_devices all

"in rows": by program of generation and scores, whether each of its results lies in rows on the devices.
"""

import json
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import AdamW, LoopConfig
from rsjax.training import sharding as sharding_rules
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.state import TrainState, create_state
from tests.models import divided, families
from tests.training.devices import (
    CONFIG,
    HEADS,
    IMAGES,
    LOOP,
    MODEL,
    MUON,
    STEPS,
    TOKENIZER,
    WEIGHTS,
    Small,
    Training,
    batch,
    compile_all,
    distance,
    drawn,
    metrics_apart,
    moments,
    moments_apart,
    share,
)


def same(one: Any, other: Any) -> bool:
    return all(map(np.array_equal, *map(jax.tree.leaves, (one, other))))


def first_device_share(state: TrainState) -> float:
    """The share of a state's elements that its first device holds."""
    leaves = jax.tree.leaves(state)
    return sum(x.addressable_data(0).size for x in leaves) / sum(x.size for x in leaves)


def through_checkpoints(trainings: list[Training], start: Any) -> list[TrainState]:
    """From each sharding's two steps to the next one's third, by way of the disk."""
    ends = []
    for source, sink in zip(trainings, [*trainings[1:], trainings[0]], strict=True):
        source.state = source.sharding.adopt(start)
        source.run(0, 2)
        with tempfile.TemporaryDirectory() as directory:
            checkpoints = Checkpoints(Path(directory))
            checkpoints.save(2, source.sharding.portable(source.state), {})
            checkpoints.close()
            checkpoints = Checkpoints(Path(directory))
            restored, _ = checkpoints.restore(sink.sharding.template(sink.model, sink.loop))
            checkpoints.close()
        sink.state = sink.sharding.adopt(restored)
        ends.append(sink.run(2, 3))
    return ends


def families_apart(slow: bool) -> dict[str, float]:
    """By network: how far the gradients of two shardings are apart."""
    sharding_rules.SMALL = 0
    loop = LoopConfig(batch_size=8, steps=1, optimizer=AdamW(warmup_steps=1))
    kinds = {"fsdp": replace(loop, accumulate=2), "pmap": loop}
    pairs = {}
    for name in ("ivideogpt", "irasim", "cogvideox"):
        config = families.FAMILIES[name]()
        networks = [families.model_batch(config, 8)]
        if slow or name == "irasim":
            networks.append(families.autoencoder_batch(config, 8))
        for model, shapes, given in networks:
            clips = jax.device_get(given) | ({"weight": WEIGHTS} if "weight" in given else {})
            start = drawn(model, loop, shapes)
            pairs[type(model).__name__] = [Training(kind, model, own, [clips], start) for kind, own in kinds.items()]
    compile_all(training for pair in pairs.values() for training in pair)
    return {name: share(*(moments(training.run(0, 1)) for training in pair)) for name, pair in pairs.items()}


def main(slow: bool) -> dict[str, Any]:
    clips = [batch(seed) for seed in range(STEPS)]
    start = jax.device_get(jax.jit(partial(create_state, MODEL, LOOP))())
    fresh = jax.device_get(jax.jit(partial(create_state, TOKENIZER, CONFIG.loop("tokenizer")))())
    loops = {"jit": LOOP, "pmap": replace(LOOP, accumulate=2), "fsdp": LOOP}
    trainings = {kind: Training(kind, MODEL, loop, clips, start) for kind, loop in loops.items()}
    small = {kind: Training(kind, Small(), MUON, clips, None) for kind in ("jit", "mesh", "fsdp")}
    of_heads = drawn(HEADS, LOOP, jax.eval_shape(HEADS.init, jax.random.key(0)))
    heads = {kind: Training(kind, HEADS, LOOP, clips, of_heads) for kind in ("jit", "fsdp")}
    tokenizers = {kind: Training(kind, TOKENIZER, CONFIG.loop("tokenizer"), [IMAGES], fresh) for kind in loops}
    compile_all([*trainings.values(), *heads.values(), *tokenizers.values()])

    cut = first_device_share(trainings["fsdp"].state)
    begun = {kind: training.sharding.gather(training.state) for kind, training in small.items()}
    gradients = {kind: moments(training.run(0, 1)) for kind, training in trainings.items()}
    metrics = {kind: training.metrics for kind, training in trainings.items()}
    ends = {kind: training.run(1, STEPS) for kind, training in trainings.items()}
    of_head = {kind: moments(training.run(0, 1)) for kind, training in heads.items()}
    muon = {kind: training.run(0, STEPS) for kind, training in small.items()}
    images = {kind: training.run(0, 1) for kind, training in tokenizers.items()}
    return {
        **{kind: distance(ends["jit"], ends[kind], start) for kind in ("pmap", "fsdp")},
        **{f"gradient {kind}": share(gradients["jit"], gradients[kind]) for kind in ("pmap", "fsdp")},
        **{f"metrics {kind}": metrics_apart(metrics["jit"], metrics[kind]) for kind in ("pmap", "fsdp")},
        "gradient heads": share(of_head["jit"], of_head["fsdp"]),
        "mesh": distance(muon["jit"], muon["mesh"], begun["jit"]),
        "muon": distance(muon["jit"], muon["fsdp"], begun["jit"]),
        **{f"tokenizer {kind}": moments_apart(images["jit"], images[kind]) for kind in ("pmap", "fsdp")},
        "checkpoint": [
            distance(ends["jit"], end, start) for end in through_checkpoints(list(trainings.values()), start)
        ],
        "start": same(begun["jit"], begun["fsdp"]),
        "cut": cut,
        "families": families_apart(slow),
        "in rows": divided.in_rows(),
    }


if __name__ == "__main__":
    assert jax.local_device_count() == 4
    print(json.dumps(main(slow="all" in sys.argv)))
