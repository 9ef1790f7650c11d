import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.data.merge import into_parts, merge, split
from rsjax.data.store import open_store
from rsjax.errors import UserError
from rsjax.files import FileError, making
from rsjax.tools.policies import policy as policy_module
from rsjax.tools.policies import policy_training as training
from rsjax.tools.policies.config import PolicyConfig, policy_preset, public, toy
from rsjax.tools.policies.ddpm import add_noise, cosine_schedule
from rsjax.tools.policies.demos import Demos, load_demos
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy, Range, Windows, scaled
from rsjax.tools.policies.policy import Policy, load_policy
from rsjax.tools.policies.policy_training import train_policy
from rsjax.tools.policies.studies.trials import Trials, try_policy
from rsjax.tools.policies.unet1d import Conv, Double, spatial_softmax, step_embedding
from rsjax.trainable import StepContext
from tests.tools.policies.toy import CONTROLS, SIZE, WIDTH, demo_store, demos, picture
from tests.tools.policies.toy_worlds import simulated

CONTEXT = StepContext(jnp.int32(0), None, None)


def model(**fields: Any) -> DiffusionPolicy:
    return DiffusionPolicy(replace(toy(), **fields), SIZE, CONTROLS, WIDTH)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Policy, Path]:
    directory = tmp_path_factory.mktemp("policy") / "whole"
    return train_policy(toy(), demos(), directory, stops=(2,)), directory


def test_the_public_size_is_the_public_one() -> None:
    """Diffusion Policy's own count for its image U-Net of Lift's 7-D controls with these conditions, by hand."""
    config = public()
    net = DiffusionPolicy(config, 84, 1, 7)
    assert net.cropped == 76
    assert (config.observations, config.horizon, config.execute) == (2, 16, 8)
    assert (config.noise_steps, config.sample_steps, config.keypoints) == (100, 100, 32)
    optimizer = config.train.optimizer
    assert (optimizer.learning_rate, *optimizer.betas, optimizer.weight_decay) == (1e-4, 0.95, 0.999, 1e-6)
    assert (optimizer.schedule, optimizer.warmup_steps, config.train.ema) == ("cosine", 500, 0.9999)
    shapes = jax.eval_shape(net.init, jax.random.key(0))
    condition, kernel, total = 128 + 2 * 64, 5, 0

    def block(a: int, b: int) -> int:
        convs = a * b * kernel + b * b * kernel + 2 * b + 4 * b  # two convolutions, biases, two normalisations
        return convs + (condition + 1) * 2 * b + ((a + 1) * b if a != b else 0)

    total += 128 * 512 + 512 + 512 * 128 + 128
    for a, b in ((7, 256), (256, 512), (512, 1024)):
        total += block(a, b) + block(b, b) + (b * b * 3 + b if b < 1024 else 0)
    total += 2 * block(1024, 1024)
    for a, b in ((2048, 512), (1024, 256)):
        total += block(a, b) + block(b, b) + b * b * 4 + b
    total += 256 * 256 * kernel + 3 * 256 + 257 * 7
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes["unet"])) == total


@pytest.mark.parametrize(("kernel", "stride"), [(5, 1), (3, 2)])
def test_convolution_equals_flax(kernel: int, stride: int) -> None:
    x: Any = jax.random.normal(jax.random.key(0), (2, 8, 3))
    own: Any = Conv(4, kernel, stride)
    params = own.init(jax.random.key(1), x)
    dense = params["params"]["Dense_0"]
    theirs = {"kernel": dense["kernel"].reshape(kernel, 3, 4), "bias": dense["bias"] + 0.5}
    dense["bias"] = theirs["bias"]
    pad = [((kernel - 1) // 2, kernel // 2)]
    expected: Any = nn.Conv(4, (kernel,), (stride,), padding=pad).apply({"params": theirs}, x)
    np.testing.assert_allclose(own.apply(params, x), expected, rtol=1e-5, atol=1e-6)


def test_doubling_is_the_transpose_of_halving() -> None:
    """<halve(x), y> = <x, double(y)> for a convolution of kernel 4, stride 2, one zero at each end, as in PyTorch."""
    y = jax.random.normal(jax.random.key(0), (1, 4, 1))
    params = Double().init(jax.random.key(1), y)
    taps = params["params"]["Conv_0"]["Dense_0"]["kernel"].reshape(4)

    def halve(x: Any) -> Any:
        wide = jnp.pad(x[0, :, 0], (1, 1))
        return jnp.stack([wide[2 * i : 2 * i + 4] @ taps[::-1] for i in range(4)])

    back = jax.vjp(halve, jnp.zeros((1, 8, 1)))[1](y[0, :, 0])[0]
    made: Any = Double().apply(params, y)
    np.testing.assert_allclose(made, back, atol=1e-6)


def test_keypoints_are_where_the_mass_is() -> None:
    maps = np.full((1, 5, 9, 2), -50.0)
    maps[0, 4, 0, 0] = maps[0, 2, 4, 1] = 50
    np.testing.assert_allclose(spatial_softmax(jnp.asarray(maps)), [[-1, 0, 1, 0]], atol=1e-6)
    assert step_embedding(jnp.array([0]), 8).tolist() == [[0] * 4 + [1] * 4]


def test_the_loss_is_the_error_of_the_drawn_noise() -> None:
    net = model()
    params = jax.jit(net.init)(jax.random.key(0))
    rng, key = np.random.default_rng(0), jax.random.key(5)
    frames = rng.integers(0, 256, (3, 2, net.cropped, net.cropped, 3), np.uint8)
    batch: Any = {
        "frames": frames,
        "controls": rng.uniform(-1, 1, (3, 4, WIDTH)).astype(np.float32),
        "index": np.arange(3),
    }
    value, weight = jax.jit(lambda params: net.loss_terms(params, batch, key, CONTEXT))(params)["noise"]
    apply = jax.jit(net.net.apply)
    total = 0.0
    for row in range(3):
        one, two = jax.random.split(jax.random.fold_in(key, row))
        noise, step = jax.random.normal(one, (1, 4, WIDTH)), jax.random.randint(two, (1,), 0, 4)
        noisy = add_noise(batch["controls"][row : row + 1], noise[0][None], step, cosine_schedule(4))
        predicted: Any = apply({"params": params}, noisy, step, scaled(jnp.asarray(frames[row : row + 1])))
        total += float(jnp.sum((predicted - noise) ** 2))
    assert float(value) == pytest.approx(total, rel=1e-4) and weight == 3 * 4 * WIDTH


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_windows_are_frames_and_the_controls_that_follow(seed: int, observations: int) -> None:
    net = model(observations=observations, crop=1.0)
    source = demos()
    window = Windows(net, Range((-2.0,) * 3, (2.0,) * 3))(source[1], np.random.default_rng(seed))
    frames, actions = source[1]["rgb"], source[1]["actions"]
    (now,) = [t for t in range(7) if np.array_equal(frames[t], window["frames"][-1])]
    for back in range(observations):
        np.testing.assert_array_equal(window["frames"][-1 - back], frames[max(0, now - back)])
    controls = actions[1:].reshape(-1, WIDTH)
    for place in range(4):
        expected = controls[min(now * CONTROLS + place, len(controls) - 1)]
        np.testing.assert_allclose(2 * window["controls"][place], expected, atol=1e-6)


def test_a_range_is_undone_and_constant_numbers_stay() -> None:
    span = Range.of(np.array([[0.0, 5, -1], [1, 5, 3]]))
    rows = np.array([[0.25, 5, 3]])
    np.testing.assert_allclose(span.scale(rows), [[-0.5, 0, 1]])
    np.testing.assert_allclose(span.unscale(span.scale(rows)), rows)
    np.testing.assert_allclose(span.unscale(np.full((1, 3), 9.0)), [[1, 5, 3]])


def test_training_stopped_and_resumed_is_the_same(policy: tuple[Policy, Path], tmp_path: Path) -> None:
    whole, directory = policy
    straight = train_policy(toy(), demos(), tmp_path / "straight")
    for a, b, c in zip(
        *map(jax.tree.leaves, (whole.params, straight.params, load_policy(directory).params)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
    early = load_policy(directory / "at-2")
    assert any(
        not np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (early.params, whole.params)), strict=True)
    )
    assert whole.key == load_policy(directory).key == straight.key != early.key
    last = Demos((*demos(3).records, demos(5).records[4]), CONTROLS)
    for others, start in ((demos(3), None), (last, None), (demos(), early)):
        with pytest.raises(UserError, match="holds a policy of other settings or data"):
            train_policy(toy(), others, directory, start=start)
    assert train_policy(toy(), demos(), tmp_path / "straight").key == whole.key


def test_a_policy_whose_saving_was_interrupted_is_saved_again(
    policy: tuple[Policy, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, source = policy
    shutil.copytree(source, tmp_path / "cut")
    for name in ("policy.json", "weights"):
        place = tmp_path / "cut" / name
        shutil.rmtree(place) if place.is_dir() else place.unlink()

    def killed(path: Path, params: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(policy_module, "save_weights", killed)
        with pytest.raises(KeyboardInterrupt):
            train_policy(toy(), demos(), tmp_path / "cut", stops=(2,))
    again = train_policy(toy(), demos(), tmp_path / "cut", stops=(2,))
    assert again.key == whole.key == load_policy(tmp_path / "cut").key


def test_a_training_that_kept_other_stops_is_named(policy: tuple[Policy, Path], tmp_path: Path) -> None:
    cut = Path(shutil.copytree(policy[1], tmp_path / "cut"))
    (cut / "policy.json").unlink()
    for directory in (policy[1], cut):  # finished, or interrupted after its last step
        with pytest.raises(UserError, match=r"this training is beyond step 1, .* choose another --out"):
            train_policy(toy(), demos(), directory, stops=(1, 2))


def test_one_process_trains_and_tries_a_policy_at_a_time(policy: tuple[Policy, Path], tmp_path: Path) -> None:
    for folder, act in (
        (policy[1], lambda: train_policy(toy(), demos(), policy[1], stops=(2,))),
        (tmp_path / "tries", lambda: try_policy(policy[0], simulated(1), [0], Trials(1), tmp_path / "tries", "tries")),
    ):
        with making(folder, wait=False), pytest.raises(FileError, match=f"{folder.name}: process .* is making it"):
            act()


def test_going_on_from_a_policy_starts_with_its_weights(
    policy: tuple[Policy, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "fit", lambda *_, start, **__: SimpleNamespace(weights=start({})))
    others = Demos(demos().records[2:], CONTROLS)
    again = train_policy(toy(), others, tmp_path / "more", start=policy[0])
    for a, b in zip(*map(jax.tree.leaves, (policy[0].params, again.params)), strict=True):
        np.testing.assert_array_equal(a, b)
        assert a is not b  # steps donate theirs
    assert again.range == policy[0].range != others.range


def test_actions_and_plans_follow_from_the_seed_and_stay_in_the_demonstrations_range(
    policy: tuple[Policy, Path],
) -> None:
    made, _ = policy
    frames = np.stack([picture(2), picture(9)])
    one, same, other = (made.actor(seed)({"rgb": frames}) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert one.shape == (2, CONTROLS * WIDTH) and np.abs(one - other).max() > 0
    videos = frames[None, -1:].repeat(2, axis=0)
    plans = made.plans(videos, seed=0)
    config = made.model.config
    assert plans.shape == (2, config.horizon // CONTROLS, CONTROLS * WIDTH)
    assert not np.array_equal(plans[0], plans[1]), "each video has its own draws"
    assert not np.array_equal(plans, made.plans(videos, seed=1))
    np.testing.assert_array_equal(plans, made.plans(videos.repeat(config.observations, axis=1), seed=0))
    for found in (one, plans):
        controls = found.reshape(-1, WIDTH)
        assert (controls >= np.array(made.range.low) - 1e-6).all()
        assert (controls <= np.array(made.range.high) + 1e-6).all()


class Recall(DiffusionPolicy):
    """Plans controls that tell which frames it saw, and the place of each control."""

    def plan(self, params: Any, frames: Any, key: Any) -> Any:
        older, newest = frames[:, 0, 0, 0, 0], frames[:, 1, 0, 0, 0]
        numbers = (0.2 * older + 0.1 * newest)[:, None, None] + 0.01 * jnp.arange(4)[None, :, None]
        return 2 * jnp.broadcast_to(numbers, (len(frames), 4, WIDTH)) - 1


def test_an_actor_plans_every_few_frames(policy: tuple[Policy, Path]) -> None:
    net = Recall(replace(toy(), execute=4), SIZE, CONTROLS, WIDTH)
    actor = Policy(net, policy[0].params, Range((0.0,) * 3, (1.0,) * 3)).actor()
    frames = [np.full((2, SIZE, SIZE, 3), number, np.uint8) for number in range(4)]
    rows = [actor({"rgb": each}) for each in frames]
    for row, first in zip(rows, (0.0, 0.02, 0.4, 0.42), strict=True):  # it sees frame 0 twice, then 1 and 2
        np.testing.assert_allclose(row, np.repeat([first, first + 0.01], WIDTH)[None].repeat(2, 0), atol=1e-6)
    with pytest.raises(UserError, match=r"sees frames \(B, 16, 16, 3\), not \(2, 8, 8, 3\)"):
        actor({"rgb": np.zeros((2, 8, 8, 3), np.uint8)})


@given(st.integers(1, 20), st.integers(1, 40), st.integers(1, 40))
def test_plans_are_rounded_up_to_whole_frames(controls: int, horizon: int, execute: int) -> None:
    config = replace(public(), horizon=4 * horizon, execute=min(execute, 4 * horizon))
    fitted = config.fitted(controls)
    DiffusionPolicy(fitted, SIZE, controls, WIDTH)  # raises if they are not whole
    assert 0 <= fitted.execute - config.execute < controls and 0 <= fitted.horizon - config.horizon < 4 * controls
    assert public().fitted(1) == public().fitted(4) == public()


def test_impossible_settings_are_named() -> None:
    refused: dict[str, Callable[[], object]] = {
        "policy.horizon is 6; a U-Net of 3 levels takes multiples of 4": lambda: PolicyConfig(horizon=6, execute=4),
        "policy.execute is 2; it is a multiple of the 4 controls of a frame": lambda: DiffusionPolicy(
            replace(toy(), execute=2), SIZE, 4, WIDTH
        ),
        "no policy size 'tinyy'; did you mean 'tiny'": lambda: policy_preset("tinyy"),
    }
    for message, make in refused.items():
        with pytest.raises(ConfigError, match=message):
            make()


def test_demos_that_succeed_are_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = demo_store(tmp_path / "store")
    found = load_demos(store, store.splits)
    assert (len(found), len(load_demos(store, store.splits, "all"))) == (4, 6)
    assert (found.controls, found.width, found.image_size) == (CONTROLS, WIDTH, SIZE)
    refused: dict[str, Callable[[], object]] = {
        "9 demonstrations are asked for, there are 4": lambda: found.first(9),
        "0 demonstrations are asked for; it takes 1 at least": lambda: found.first(0),
        "cannot be mixed": lambda: found + Demos(found.records, 1),
    }
    for message, make in refused.items():
        with pytest.raises(UserError, match=message):
            make()
    parts = split(store.path, into_parts(store.path, 2, tmp_path)).values()
    assert sum(len(load_demos(part, part.splits)) for part in parts) == 4
    assert not capsys.readouterr().out
    place = store.path / "manifest.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {"success_share": None}))
    unlabelled = open_store(store.path)
    merged = merge([unlabelled.path, *(part.path for part in parts)], tmp_path / "merged")
    assert len(load_demos(merged, merged.splits)) == 12
    assert "merged: does not say which of its clips end in success, so all that begin" in capsys.readouterr().out
