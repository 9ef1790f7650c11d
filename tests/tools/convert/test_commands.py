"""The command, from files to files."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.errors import UserError
from rsjax.tokenizers.lpips import load_lpips
from rsjax.tools.commands.convert import main
from rsjax.tools.convert import files
from rsjax.tools.convert.directory import load_tokenizer, load_world_model, save
from rsjax.tools.convert.files import read_tensors, write_safetensors
from tests.tools.convert.public import Tensors, genie_shapes, random_tensors, tokenizer_shapes
from tests.tools.convert.test_lpips import backbone, heads

GENIE = random_tensors(genie_shapes(2, 16, 2, 3, 4, 8, False))
TOKENIZER = random_tensors(tokenizer_shapes(32, (1, 2), 1, 6, True))


def convert(*arguments: object) -> None:
    main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()  # of commands before
    with pytest.raises(SystemExit) as stop:
        convert(*arguments)
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    return message


def assert_same(path: Path, expected: Tensors) -> None:
    tensors = read_tensors(path).tensors
    assert tensors.keys() == expected.keys()
    for name, x in expected.items():
        assert tensors[name].tobytes() == x.tobytes(), name


@pytest.mark.parametrize("kind", ["tokenizer", "genie"])
def test_import_and_export_are_inverse_to_the_bit(kind: str, tmp_path: Path) -> None:
    kinds: dict[str, tuple[Tensors, Any]] = {
        "tokenizer": (TOKENIZER, load_tokenizer),
        "genie": (GENIE, load_world_model),
    }
    tensors, load = kinds[kind]
    write_safetensors(tmp_path / "in.safetensors", tensors, {})
    convert(kind, tmp_path / "in.safetensors", tmp_path / "own", *(["--heads", 2] if kind == "genie" else []))
    convert(kind, "--export", tmp_path / "own", tmp_path / "out" / "x.safetensors")
    assert_same(tmp_path / "out" / "x.safetensors", tensors)
    convert(kind, tmp_path / "out" / "x.safetensors", tmp_path / "again")
    (config, params), (config_again, params_again) = (load(tmp_path / d) for d in ("own", "again"))
    assert config == config_again
    jax.tree.map(np.testing.assert_array_equal, params, params_again)


def test_one_directory_holds_a_tokenizer_and_a_model(tmp_path: Path) -> None:
    for kind, tensors in (("tokenizer", TOKENIZER), ("genie", GENIE)):
        write_safetensors(tmp_path / f"{kind}.safetensors", tensors, {})
        convert(kind, tmp_path / f"{kind}.safetensors", tmp_path / "both", *(["--heads", 2] if kind == "genie" else []))
    assert load_tokenizer(tmp_path / "both")[0].adaptive_norm
    assert load_world_model(tmp_path / "both")[0].heads == 2


def test_an_exported_tokenizer_carries_its_configuration(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "in.safetensors", TOKENIZER, {})
    convert("tokenizer", tmp_path / "in.safetensors", tmp_path / "own")
    config, params = load_tokenizer(tmp_path / "own")
    other = replace(config, norm_groups=8, depth_scale="linear")
    save(tmp_path / "other", other, params)
    convert("tokenizer", "--export", tmp_path / "other", tmp_path / "x.safetensors")
    convert("tokenizer", tmp_path / "x.safetensors", tmp_path / "again")
    assert load_tokenizer(tmp_path / "again")[0] == other


def test_the_command_prints_its_output_and_what_it_left_aside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rest = {"loss.discriminator.main.0.bias": np.zeros(64, np.float32)}
    write_safetensors(tmp_path / "in.safetensors", TOKENIZER | rest, {})
    convert("tokenizer", tmp_path / "in.safetensors", tmp_path / "own")
    made, aside = capsys.readouterr().out.splitlines()
    assert f"{len(TOKENIZER)} raw tensors" in made
    assert aside == "left aside: 1 tensor of loss.discriminator"
    convert("genie", _written(tmp_path / "genie.safetensors", GENIE), tmp_path / "own", "--heads", 2)
    assert capsys.readouterr().out.splitlines()[1] == "left aside: no tensors"


@pytest.mark.parametrize(
    ("settings", "expected"), [(None, True), ({"num_heads": 2}, True), ({"num_heads": 2, "use_mup": False}, False)]
)
def test_the_command_says_when_it_assumes_no_mup(
    settings: dict[str, Any] | None, expected: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_safetensors(tmp_path / "in.safetensors", GENIE, {})
    if settings:
        (tmp_path / "config.json").write_text(json.dumps(settings))
    convert("genie", tmp_path / "in.safetensors", tmp_path / "own", "--heads", 2)
    assert ("no use_mup in a config.json beside in.safetensors" in capsys.readouterr().out) == expected


def test_replacing_an_output_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_safetensors(tmp_path / "in.safetensors", GENIE, {})
    for expected in (False, True):
        convert("genie", tmp_path / "in.safetensors", tmp_path / "own", "--heads", 2)
        convert("genie", "--export", tmp_path / "own", tmp_path / "out" / "x.safetensors")
        convert("tokenizer", _written(tmp_path / "t.safetensors", TOKENIZER), tmp_path / "own")
        assert capsys.readouterr().out.count("it replaces the one that was there") == 3 * expected


def test_an_export_that_stops_leaves_no_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    convert("genie", _written(tmp_path / "in.safetensors", GENIE), tmp_path / "own", "--heads", 2)

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files, "write_safetensors", stop)
    monkeypatch.setattr("rsjax.command.exit_now", sys.exit)  # which would end the tests
    with pytest.raises(SystemExit) as stopped:
        convert("genie", "--export", tmp_path / "own", tmp_path / "out" / "x.safetensors")
    assert stopped.value.code == 130
    assert not (tmp_path / "out" / "config.json").exists()


def _written(path: Path, tensors: Tensors) -> Path:
    write_safetensors(path, tensors, {})
    return path


def test_load_lpips_reads_what_two_files_are_converted_to(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "net.safetensors", backbone("alexnet"), {})
    write_safetensors(tmp_path / "heads.safetensors", heads("alexnet"), {})
    out = tmp_path / "lpips.safetensors"
    convert("lpips", tmp_path / "net.safetensors", out, "--heads-file", tmp_path / "heads.safetensors")
    params = load_lpips(out)
    assert set(params["backbone"]) == {"0", "3", "6", "8", "10"}
    assert np.all(params["head"]["3"]["weight"] == 3)
    content = bytearray(out.read_bytes())
    content[-1] ^= 1
    out.write_bytes(content)
    with pytest.raises(UserError) as changed:
        load_lpips(out)
    assert "its digest is wrong" in str(changed.value)


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_safetensors(tmp_path / "in.safetensors", GENIE, {})
    assert "no such file" in refused(capsys, "tokenizer", tmp_path / "none.ckpt", tmp_path / "own")
    assert "--heads" in refused(capsys, "genie", tmp_path / "in.safetensors", tmp_path / "own")
    convert("genie", tmp_path / "in.safetensors", tmp_path / "own", "--heads", 2)
    assert ".safetensors" in refused(capsys, "genie", "--export", tmp_path / "own", tmp_path / "other")
    assert "holds no tokenizer/weights" in refused(
        capsys, "tokenizer", "--export", tmp_path / "own", tmp_path / "x.safetensors"
    )
    assert "settings" in refused(capsys, "genie", "--export", tmp_path / "own", tmp_path / "own" / "x.safetensors")
    (tmp_path / "x" / "config.json").mkdir(parents=True)
    assert "config.json: cannot be read" in refused(
        capsys, "genie", "--export", tmp_path / "own", tmp_path / "x" / "x.safetensors"
    )
    assert "holds networks of this project" in refused(capsys, "lpips", tmp_path / "own", tmp_path / "x.safetensors")
    assert "is a pipe or device" in refused(capsys, "lpips", "/dev/zero", tmp_path / "x.safetensors")
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"name": "tiny", "model": {}}))
    assert "is a run directory" in refused(capsys, "genie", tmp_path / "in.safetensors", run, "--heads", 2)
