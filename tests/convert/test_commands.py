"""The command, from files to files."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import ModelConfig, TokenizerConfig, to_dict
from rsjax.convert.__main__ import main
from rsjax.convert.files import read_tensors, write_safetensors
from rsjax.tokenizers.lpips import load_lpips
from rsjax.training.pretrained import load_part, save_part
from tests.convert.public import Tensors, genie_shapes, random_tensors, tokenizer_shapes
from tests.convert.test_lpips import backbone, heads

GENIE = random_tensors(genie_shapes(2, 16, 2, 3, 4, 8, False))
TOKENIZER = random_tensors(tokenizer_shapes(32, (1, 2), 1, 6, True))


def convert(*arguments: object) -> None:
    main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as stop:
        convert(*arguments)
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    return message


def assert_same(path: Path, expected: Tensors) -> None:
    found, _ = read_tensors(path)
    assert found.keys() == expected.keys()
    for name, x in expected.items():
        assert found[name].tobytes() == x.tobytes(), name


@pytest.mark.parametrize("kind", ["tokenizer", "genie"])
def test_import_and_export_are_inverse_to_the_bit(kind: str, tmp_path: Path) -> None:
    kinds: dict[str, tuple[Tensors, Any]] = {"tokenizer": (TOKENIZER, TokenizerConfig), "genie": (GENIE, ModelConfig)}
    tensors, part = kinds[kind]
    write_safetensors(tmp_path / "in.safetensors", tensors, {})
    convert(kind, tmp_path / "in.safetensors", tmp_path / "own", *(["--heads", 2] if kind == "genie" else []))
    convert(kind, tmp_path / "own", tmp_path / "out" / "x.safetensors")
    assert_same(tmp_path / "out" / "x.safetensors", tensors)
    convert(kind, tmp_path / "out" / "x.safetensors", tmp_path / "again")
    (config, params), (config_again, params_again) = (load_part(tmp_path / d, part) for d in ("own", "again"))
    assert config == config_again
    jax.tree.map(np.testing.assert_array_equal, params, params_again)


def test_one_directory_holds_a_tokenizer_and_a_model(tmp_path: Path) -> None:
    for kind, tensors in (("tokenizer", TOKENIZER), ("genie", GENIE)):
        write_safetensors(tmp_path / f"{kind}.safetensors", tensors, {})
        convert(kind, tmp_path / f"{kind}.safetensors", tmp_path / "both", *(["--heads", 2] if kind == "genie" else []))
    assert load_part(tmp_path / "both", TokenizerConfig)[0].adaptive_norm
    assert load_part(tmp_path / "both", ModelConfig)[0].heads == 2


def test_an_exported_tokenizer_carries_its_configuration(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "in.safetensors", TOKENIZER, {})
    convert("tokenizer", tmp_path / "in.safetensors", tmp_path / "own")
    config, params = load_part(tmp_path / "own", TokenizerConfig)
    other = TokenizerConfig(**to_dict(config) | {"norm_groups": 8, "image_size": 64, "channel_multipliers": (1, 2)})
    save_part(tmp_path / "other", other, params)
    convert("tokenizer", tmp_path / "other", tmp_path / "x.safetensors")
    convert("tokenizer", tmp_path / "x.safetensors", tmp_path / "again")
    assert load_part(tmp_path / "again", TokenizerConfig)[0] == other


def test_the_command_prints_its_output_and_what_it_ignored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rest = {"loss.discriminator.main.0.bias": np.zeros(64, np.float32)}
    write_safetensors(tmp_path / "in.safetensors", TOKENIZER | rest, {})
    convert("tokenizer", tmp_path / "in.safetensors", tmp_path / "own")
    made, aside = capsys.readouterr().out.splitlines()
    assert f"{len(TOKENIZER)} raw tensors" in made
    assert aside == "ignored: 1 tensors of loss.discriminator"


@pytest.mark.parametrize(
    ("settings", "told"), [(None, True), ({"num_heads": 2}, True), ({"num_heads": 2, "use_mup": False}, False)]
)
def test_the_command_says_when_it_assumes_no_mup(
    settings: dict[str, Any] | None, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_safetensors(tmp_path / "in.safetensors", GENIE, {})
    if settings:
        (tmp_path / "config.json").write_text(json.dumps(settings))
    convert("genie", tmp_path / "in.safetensors", tmp_path / "own", "--heads", 2)
    assert ("no use_mup in a config.json beside in.safetensors" in capsys.readouterr().out) == told


def test_load_lpips_reads_what_two_files_are_converted_to(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "net.safetensors", backbone("alexnet"), {})
    write_safetensors(tmp_path / "heads.safetensors", heads("alexnet"), {})
    out = tmp_path / "lpips.safetensors"
    convert("lpips", tmp_path / "net.safetensors", out, "--heads-file", tmp_path / "heads.safetensors")
    params = load_lpips(out)
    assert set(params["backbone"]) == {"0", "3", "6", "8", "10"}
    assert np.all(params["head"]["3"]["weight"] == 3)


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_safetensors(tmp_path / "in.safetensors", GENIE, {})
    assert "no such file" in refused(capsys, "tokenizer", tmp_path / "none.ckpt", tmp_path / "own")
    assert "--heads" in refused(capsys, "genie", tmp_path / "in.safetensors", tmp_path / "own")
    convert("genie", tmp_path / "in.safetensors", tmp_path / "own", "--heads", 2)
    assert ".safetensors" in refused(capsys, "genie", tmp_path / "own", tmp_path / "other")
    assert "no tokenizer" in refused(capsys, "tokenizer", tmp_path / "own", tmp_path / "x.safetensors")
    assert "settings" in refused(capsys, "genie", tmp_path / "own", tmp_path / "own" / "x.safetensors")
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"name": "tiny", "model": {}}))
    assert "is a run directory" in refused(capsys, "genie", tmp_path / "in.safetensors", run, "--heads", 2)
