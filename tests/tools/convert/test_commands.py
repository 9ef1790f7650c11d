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


def test_both_networks_come_back_to_the_bit_through_one_directory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rest = {"loss.discriminator.main.0.bias": np.zeros(64, np.float32)}
    load: dict[str, Any] = {"tokenizer": load_tokenizer, "genie": load_world_model}
    for kind, tensors, beside, options, aside in (
        ("tokenizer", TOKENIZER, rest, [], "1 tensor of loss.discriminator"),
        ("genie", GENIE, {}, ["--heads", 2], "no tensors"),
    ):
        source = _written(tmp_path / f"{kind}.safetensors", tensors | beside)
        out = tmp_path / kind / "x.safetensors"
        for replaces in (False, True):
            convert(kind, source, tmp_path / "own", *options)
            made, left, *_ = capsys.readouterr().out.splitlines()
            assert f"{len(tensors)} " in made
            assert left == f"left aside: {aside}"
            convert(kind, "--export", tmp_path / "own", out)
            for said in (made, capsys.readouterr().out):
                assert ("it replaces the one that was there" in said) == replaces
        assert_same(out, tensors)
    for kind in load:
        convert(kind, tmp_path / kind / "x.safetensors", tmp_path / "again")
        (config, params), (config_again, params_again) = (load[kind](tmp_path / name) for name in ("own", "again"))
        assert config == config_again
        jax.tree.map(np.testing.assert_array_equal, params, params_again)


def test_an_exported_tokenizer_carries_its_configuration(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "in.safetensors", TOKENIZER, {})
    convert("tokenizer", tmp_path / "in.safetensors", tmp_path / "own")
    config, params = load_tokenizer(tmp_path / "own")
    other = replace(config, norm_groups=8, depth_scale="linear")
    save(tmp_path / "other", other, params)
    convert("tokenizer", "--export", tmp_path / "other", tmp_path / "x.safetensors")
    convert("tokenizer", tmp_path / "x.safetensors", tmp_path / "again")
    assert load_tokenizer(tmp_path / "again")[0] == other


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
