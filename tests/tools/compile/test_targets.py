"""Clusters by name, and what the command says where they or the compilers are missing."""

from importlib.util import find_spec
from pathlib import Path

import jax
import pytest

from rsjax.config import ConfigError, presets
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.tools.commands.compile import enter_environment
from rsjax.tools.compile.cards import CARDS
from rsjax.tools.compile.programs import train_tokenizer
from rsjax.tools.compile.report import largest_batch
from rsjax.tools.compile.targets import find


@pytest.mark.parametrize(
    ("name", "hosts", "local", "shape"),
    [
        ("h100", 1, 1, ""),
        ("h100x8", 1, 8, ""),
        ("h100x64", 8, 8, ""),
        ("rtx4090x2", 1, 2, ""),
        ("v5e-8", 1, 8, "2x4"),
        ("v5e-16", 4, 4, "4x4"),
        ("v5p-512", 64, 4, "4x8x8"),  # cores: 256 chips
        ("v4", 1, 4, "2x2x1"),
    ],
)
def test_a_target_is_hosts_with_devices(name: str, hosts: int, local: int, shape: str) -> None:
    target = find(name)
    assert (target.hosts, target.local, target.shape) == (hosts, local, shape)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("h10", ["did you mean 'h100'", "rtx4090, rtx4090xN", "v5p-8 to -2048"]),
        ("h100x12", ["up to 8 cards", "'h100x8'"]),
        ("v5e-7", ["not a slice of TPU v5e", "v5e-1, v5e-4, v5e-8"]),
        ("h100x0", ["'h100x1'"]),
    ],
)
def test_an_unknown_target_brings_the_known_ones(name: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        find(name)
    assert all(word in str(error.value) for word in words)


def test_every_card_has_its_figures_and_their_source() -> None:
    for card in CARDS.values():
        assert card.source.startswith("https://")
        assert card.highest <= card.float32 <= card.peak
        assert (card.platform == "cuda") == bool(card.description)


def test_the_largest_batch_lies_on_the_line_through_two() -> None:
    assert largest_batch({8: 18, 16: 34}, room=82, step=1) == 40
    assert largest_batch({8: 18, 16: 34}, room=82, step=16) == 32
    assert largest_batch({8: 18, 16: 34}, room=3, step=1) == 0


def test_a_tokenizer_of_two_views_has_a_program() -> None:
    config = with_values(presets.debug(), {"sim.second_view": "wrist"})
    program = train_tokenizer(config, jax.devices()[:1])
    assert program.title == f"tokenizer's training step on {config.tokenizer_train.batch_size} clips"


def test_without_compilers_the_command_names_what_installs_them(tmp_path: Path) -> None:
    if find_spec("jax_cuda13_plugin"):
        pytest.skip("the compilers are here")
    with pytest.raises(UserError) as error:
        enter_environment("cuda", prefix=str(tmp_path))
    assert "make accelerators" in str(error.value)
