from dataclasses import replace
from functools import partial
from typing import Literal, get_args

import jax
import numpy as np
import optax
import pytest

from rsjax.config import AdamW, ConfigError, LoopConfig, Muon
from rsjax.training.state import create_state, learning_rate, make_optimizer
from rsjax.training.step import train_step
from tests.training import devices
from tests.training.toy import Regression, records

OPTIMIZER = AdamW(learning_rate=0.1, warmup_steps=4, final_share=0.2, weight_decay=0.03, grad_clip=0.5)
LOOP = LoopConfig(steps=20, optimizer=OPTIMIZER)
AVERAGED = replace(LOOP, ema=0.15)
BATCH = {name: np.stack([record[name] for record in records()]) for name in ("x", "y")}

take_step = jax.jit(train_step, static_argnums=(0, 1))


def test_the_learning_rate_rises_to_its_peak_and_falls_to_its_final_share() -> None:
    rates = np.array([learning_rate(LOOP)(step) for step in range(21)])
    np.testing.assert_allclose(rates[[0, 2, 4, 12, 20]], [0.0, 0.05, 0.1, 0.1 * (0.2 + 0.8 / 2), 0.02], atol=1e-8)
    assert np.all(np.diff(rates[:5]) > 0)
    assert np.all(np.diff(rates[4:]) < 0)


def test_the_learning_rate_of_steps_falls_to_a_tenth_at_each_share_of_the_run() -> None:
    optimizer = AdamW(learning_rate=0.1, warmup_steps=2, schedule="steps", drop_at=(200 / 270, 250 / 270))
    rate = learning_rate(LoopConfig(steps=27, optimizer=optimizer))
    np.testing.assert_allclose([rate(step) for step in (0, 1, 2, 19)], [0.0, 0.05, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose([rate(step) for step in (20, 24, 25, 27)], [0.01, 0.01, 0.001, 0.001], rtol=1e-6)
    assert learning_rate(LoopConfig(steps=27, optimizer=replace(optimizer, warmup_steps=0)))(0) == np.float32(0.1)


def test_linear_falls_all_the_way_and_wsd_only_at_the_end() -> None:
    linear, wsd = (
        learning_rate(LoopConfig(steps=30, optimizer=replace(OPTIMIZER, schedule=schedule)))
        for schedule in get_args(Literal["linear", "wsd"])
    )
    np.testing.assert_allclose([linear(step) for step in (0, 2, 4, 17, 30)], [0, 0.05, 0.1, 0.06, 0.02], rtol=1e-5)
    np.testing.assert_allclose([wsd(s) for s in (0, 2, 4, 24, 27, 30)], [0, 0.05, 0.1, 0.1, 0.06, 0.02], rtol=1e-5)


def test_a_restart_runs_the_schedule_again_over_what_is_left() -> None:
    whole = learning_rate(LoopConfig(steps=30, restarts=(10,), optimizer=OPTIMIZER))
    first, second = (learning_rate(LoopConfig(steps=steps, optimizer=OPTIMIZER)) for steps in (10, 20))
    np.testing.assert_allclose([whole(s) for s in range(10)], [first(s) for s in range(10)], rtol=1e-6)
    np.testing.assert_allclose([whole(s) for s in range(10, 31)], [second(s) for s in range(21)], rtol=1e-6)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_drops_outside_the_run_are_refused(share: float) -> None:
    with pytest.raises(ConfigError, match="optimizer.drop_at is .*shares of the run"):
        AdamW(schedule="steps", drop_at=(0.5, share))


def test_without_clipping_a_large_gradient_counts_in_full() -> None:
    params = {"w": jax.numpy.zeros(2)}
    moments = {}
    for clip in (0.0, 0.5):
        tx = make_optimizer(replace(LOOP, optimizer=replace(OPTIMIZER, grad_clip=clip)))
        _, state = jax.jit(tx.update)({"w": jax.numpy.array([30.0, 40.0])}, tx.init(params), params)
        moments[clip] = optax.tree_utils.tree_get(state, "mu")["w"]
    np.testing.assert_allclose(moments[0.0], 0.1 * np.array([30.0, 40.0]), rtol=1e-5)
    np.testing.assert_allclose(moments[0.5], 0.1 * np.array([0.3, 0.4]), rtol=1e-5)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_run_shorter_than_its_warm_up_has_a_schedule(steps: int) -> None:
    rates = [float(learning_rate(LoopConfig(steps=steps))(step)) for step in range(steps + 1)]
    assert 0 < max(rates) <= LoopConfig().optimizer.learning_rate * (1 + 1e-6)


def test_steps_are_clipped_adamw_and_the_average_follows() -> None:
    """Three steps once more in numpy, after Loshchilov & Hutter's algorithm 2, with the clipping before it."""
    loop, model = AVERAGED, Regression()
    state = create_state(model, loop)
    opt, theta = OPTIMIZER, np.concatenate([state.params["w"], state.params["b"][None]]).astype(np.float64)
    average, m, v = theta.copy(), np.zeros(4), np.zeros(4)
    b1, b2 = opt.betas
    for t in range(1, 4):
        noise = 0.1 * float(jax.random.normal(jax.random.fold_in(jax.random.key(loop.seed + 1), t - 1)))
        inputs = np.concatenate([BATCH["x"], np.ones((len(BATCH["y"]), 1))], axis=1)
        error = inputs @ theta + noise - BATCH["y"]
        gradient = 2.0 * 2 * error @ inputs / len(error)  # the term's weight is 2
        norm = np.linalg.norm(gradient)
        clipped = gradient * min(1, opt.grad_clip / norm)
        m = b1 * m + (1 - b1) * clipped
        v = b2 * v + (1 - b2) * clipped**2
        rate = opt.learning_rate * (t - 1) / opt.warmup_steps
        direction = m / (1 - b1**t) / (np.sqrt(v / (1 - b2**t)) + 1e-8)
        update = -rate * (direction + opt.weight_decay * theta)
        theta = theta + update
        decay = min(loop.ema, t / (9 + t))
        average = decay * average + (1 - decay) * theta

        state, metrics = take_step(model, loop, state, BATCH)
        assert int(state.step) == t
        assert norm > opt.grad_clip
        expected = {
            "loss": 2 * np.mean(error**2),
            "error": np.mean(error**2),
            "grad_norm": norm,
            "param_norm": np.linalg.norm(theta),
            "update_norm": np.linalg.norm(update),
            "learning_rate": rate,
            "skipped": 0.0,
        }
        assert metrics.keys() == expected.keys()
        for name, value in expected.items():
            np.testing.assert_allclose(metrics[name], value, rtol=1e-4, atol=1e-7, err_msg=name)
    np.testing.assert_allclose(np.concatenate([state.params["w"], state.params["b"][None]]), theta, rtol=1e-5)
    np.testing.assert_allclose(np.concatenate([state.weights["w"], state.weights["b"][None]]), average, rtol=1e-5)


def test_without_an_average_later_stages_use_the_parameters() -> None:
    state = create_state(Regression(), LOOP)
    assert state.ema is None
    assert state.extra is None
    assert state.weights is state.params


def test_a_fresh_state_follows_from_the_seed() -> None:
    one, same, other = (create_state(Regression(), replace(LOOP, seed=seed)).params["w"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_muon_orthogonalises_blocks_and_convolutions_and_leaves_the_rest_to_adamw() -> None:
    rng = np.random.default_rng(0)
    normal = lambda *shape: jax.numpy.asarray(rng.normal(size=shape), "float32")  # noqa: E731
    params = {
        "blocks": {"kernel": normal(2, 6, 4), "bias": normal(2, 4)},
        "embed": {"embedding": normal(5, 4)},
        "head": {"kernel": normal(4, 3)},
        "conv1": {"kernel": normal(3, 3, 2, 4)},
        "conv_out": {"kernel": normal(3, 3, 4, 2)},
    }
    grads = jax.tree.map(lambda x: normal(*x.shape), params)
    for name in ("blocks", "conv1"):
        grads[name]["kernel"] *= np.logspace(0, -1.5, 4)  # badly conditioned
    loop = LoopConfig(steps=20, optimizer=Muon(learning_rate=0.1, warmup_steps=4, final_share=0.2))
    adam = optax.nadamw(learning_rate(loop), *loop.optimizer.betas, weight_decay=0.0)
    updates = {}
    for kind, tx in {
        "muon": make_optimizer(loop),
        "adamw": optax.chain(optax.clip_by_global_norm(loop.optimizer.grad_clip), adam),
    }.items():
        update = jax.jit(tx.update)
        _, state = update(grads, tx.init(params), params)  # the learning rate of the first step is 0
        updates[kind], _ = update(grads, state, params)
    pairs = list(zip(updates["muon"]["blocks"]["kernel"], grads["blocks"]["kernel"], strict=True))
    pairs.append((updates["muon"]["conv1"]["kernel"].reshape(-1, 4), grads["conv1"]["kernel"].reshape(-1, 4)))
    for step, gradient in pairs:
        assert np.linalg.cond(gradient) > 10
        assert np.linalg.cond(step) < 2.5  # Newton–Schulz brings singular values near one another, not together
        assert np.sum(step * gradient) < 0
    for path in (("blocks", "bias"), ("embed", "embedding"), ("head", "kernel"), ("conv_out", "kernel")):
        ours, adamw = (updates[kind][path[0]][path[1]] for kind in ("muon", "adamw"))
        np.testing.assert_allclose(ours, adamw, rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_step_that_is_not_finite_is_left_out_and_counted(bad: float) -> None:
    loop, model = AVERAGED, Regression()
    before, _ = take_step(model, loop, create_state(model, loop), BATCH)
    after, metrics = take_step(model, loop, before, BATCH | {"y": np.full_like(BATCH["y"], bad)})
    assert int(after.step) == 2 and int(after.skipped) == 1 and float(metrics["skipped"]) == 1
    for name in ("params", "ema"):
        jax.tree.map(np.testing.assert_array_equal, getattr(before, name), getattr(after, name))
    for name in ("mu", "nu"):
        moments = (optax.tree_utils.tree_get(state.opt_state, name) for state in (before, after))
        jax.tree.map(np.testing.assert_array_equal, *moments)
    onwards, metrics = take_step(model, loop, after, BATCH)
    assert int(onwards.skipped) == 1 and np.isfinite(float(metrics["loss"]))
    assert float(metrics["learning_rate"]) == np.float32(learning_rate(loop)(2))
    assert np.any(np.asarray(onwards.params["w"]) != np.asarray(before.params["w"]))


@pytest.mark.parametrize("loop", [devices.LOOP, devices.MUON], ids=["adamw", "muon"])
def test_a_step_that_is_left_out_counts_in_the_schedule(loop: LoopConfig) -> None:
    model, batch = devices.Small(), devices.batch(0)
    state = jax.jit(partial(create_state, model, loop))()
    bad = batch.replace(actions=np.full_like(batch.actions, np.nan))  # type: ignore[attr-defined]
    for arrays in (batch, bad):
        state, _ = take_step(model, loop, state, arrays)
    counts = [
        int(x)
        for x in jax.tree.leaves(state.opt_state, is_leaf=lambda x: isinstance(x, optax.ScaleByScheduleState))
        if isinstance(x, optax.ScaleByScheduleState)
        for x in x
    ]
    assert counts and set(counts) == {2} and int(state.skipped) == 1
