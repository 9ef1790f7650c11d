"""What cannot fit is refused with the figure; what is close to the limit is not."""

from dataclasses import replace
from pathlib import Path

import pytest

from rsjax.config import Config, ConfigError, TrainConfig, presets
from rsjax.errors import UserError
from rsjax.tools.pipeline import limits
from rsjax.tools.pipeline.limits import (
    GIB,
    check_batch,
    check_episodes,
    check_rollout,
    check_together,
    device_memory,
    host_memory,
)
from tests.models.toy_family import ToyConfig

TINY = presets.tiny()


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of 16 GiB."""
    monkeypatch.setattr(limits, "host_memory", lambda: 16 * GIB)
    monkeypatch.setattr(limits, "device_memory", lambda: 16 * GIB)


def of(config: Config, size: int, accumulate: int = 1) -> TrainConfig:
    return replace(config.train, batch_size=size, accumulate=accumulate)


def test_a_batch_beyond_the_devices_memory_is_refused_unless_it_is_accumulated() -> None:
    for config in (TINY, replace(TINY, model=ToyConfig())):
        check_batch(config, of(config, 100), "world_model")
        with pytest.raises(UserError, match=r"train.batch_size is 100000000, .* more than [\d,]+ GiB .* with 16 GiB"):
            check_batch(config, of(config, 10**8), "world_model")
        check_batch(config, of(config, 10**8, accumulate=10**6), "world_model")
    with pytest.raises(UserError, match="tokenizer_train.batch_size is 100000000"):
        check_batch(TINY, replace(TINY.tokenizer_train, batch_size=10**8), "tokenizer")


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_no_preset_is_refused_on_its_accelerator(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "device_memory", lambda: 80 * GIB)
    config = presets.get(name)
    check_batch(config, config.train, "world_model")
    if config.model.uses_tokenizer:
        check_batch(config, config.tokenizer_train, "tokenizer")


def test_clips_at_once_beyond_memory_are_refused_and_longer_ones_take_that_of_their_window() -> None:
    check_together(TINY, 100, 10**6, "--batch 100")
    for config in (TINY, replace(TINY, model=ToyConfig())):
        with pytest.raises(UserError) as error:
            check_together(config, 10**8, 6, "--candidates 100000000")
        assert "--candidates 100000000: so much at once takes more than" in str(error.value)


def test_a_rollout_beyond_memory_is_refused() -> None:
    check_rollout(TINY, 100_000)
    with pytest.raises(UserError, match=r"--frames is 1000000000, a video of [\d,]+ GiB; this machine has 16 GiB"):
        check_rollout(TINY, 10**9)


def test_episodes_beyond_the_disk_are_refused(tmp_path: Path) -> None:
    check_episodes(TINY.sim, tmp_path / "data" / "lift")
    with pytest.raises(UserError, match=rf"sim.episodes is 1000000000000, .* GiB; {tmp_path} has [\d,]+ GiB free"):
        check_episodes(replace(TINY.sim, episodes=10**12), tmp_path / "data" / "lift")


def test_steps_end_with_their_counter() -> None:
    TrainConfig(steps=2**31 - 1)
    with pytest.raises(ConfigError, match="train.steps is 10000000000; it must be 1 … 2147483647"):
        TrainConfig(steps=10**10)


def test_memory_is_that_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert GIB / 4 < device_memory() <= host_memory() < 2**50
