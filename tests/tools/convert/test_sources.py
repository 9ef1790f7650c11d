"""What a hub publishes, as the command takes it: directories, indices of several files, whole pipelines."""

import json
from pathlib import Path
from typing import Any

import pytest

from rsjax.models.cogvideox.config import CogVideoXConfig
from rsjax.models.ivideogpt.config import IVideoGPTConfig
from rsjax.models.network_settings import read_model
from rsjax.tools.convert import cogvideox
from rsjax.tools.convert.directory import load_world_model
from rsjax.tools.convert.files import Tensors, write_safetensors
from tests.tools.convert.test_cogvideox import NET, autoencoder, transformer
from tests.tools.convert.test_commands import GENIE, assert_same, convert, refused
from tests.tools.convert.test_ivideogpt import TOKENIZER, TRANSFORMER


def published(folder: Path, tensors: Tensors, settings: dict[str, Any], stem: str = "model", files: int = 1) -> Path:
    """Writes a network as ``save_pretrained`` does; returns its folder."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(settings))
    if files == 1:
        write_safetensors(folder / f"{stem}.safetensors", tensors, {})
        return folder
    names = sorted(tensors)
    weight_map: dict[str, str] = {}
    for i in range(files):
        file = f"{stem}-{i + 1:05d}-of-{files:05d}.safetensors"
        write_safetensors(folder / file, {name: tensors[name] for name in names[i::files]}, {})
        weight_map |= dict.fromkeys(names[i::files], file)
    index = {"metadata": {"total_size": 0}, "weight_map": weight_map}
    (folder / f"{stem}.safetensors.index.json").write_text(json.dumps(index))
    return folder


def test_a_directory_is_taken_for_the_network_in_it(tmp_path: Path) -> None:
    folder = published(tmp_path / "hub", GENIE, {"num_heads": 2, "use_mup": False}, files=3)
    sources = [folder, *folder.glob("*.index.json"), *folder.glob("*-00002-of-*")]
    for number, source in enumerate(sources):
        convert("genie", source, tmp_path / str(number))
        assert load_world_model(tmp_path / str(number))[0].heads == 2
        convert("genie", "--export", tmp_path / str(number), tmp_path / f"out{number}" / "x.safetensors")
        assert_same(tmp_path / f"out{number}" / "x.safetensors", GENIE)


def test_directories_and_indices_that_do_not_fit_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = published(tmp_path / "hub", GENIE, {"num_heads": 2}, files=2)
    index = folder / "model.safetensors.index.json"
    whole = json.loads(index.read_text())
    lacking = dict(list(whole["weight_map"].items())[1:])
    wrong: dict[str, Any] = {
        "is not in the files beside it, and in the index": {
            **whole["weight_map"],
            "x": "model-00001-of-00002.safetensors",
        },
        "is in the files beside it, and not in the index": lacking,
        "has no weight_map from tensors to files beside it": {"x": "../model.safetensors"},
        "has no weight_map": {},
    }
    for message, weight_map in wrong.items():
        index.write_text(json.dumps({"weight_map": weight_map}))
        assert message in refused(capsys, "genie", folder, tmp_path / "o")
    (tmp_path / "empty").mkdir()
    assert "is a directory without weights" in refused(capsys, "genie", tmp_path / "empty", tmp_path / "o")
    write_safetensors(folder / "model.safetensors", GENIE, {})
    convert("genie", folder, tmp_path / "own")  # the one file precedes the index, as in from_pretrained
    own = refused(capsys, "genie", tmp_path / "own", tmp_path / "o")
    assert "holds networks of this project; add --export to export one" in own
    file = refused(capsys, "genie", "--export", folder / "model.safetensors", tmp_path / "x.safetensors")
    assert "is not a directory made here, to export from; leave out --export to import a file" in file
    write_safetensors(folder / "diffusion_pytorch_model.safetensors", GENIE, {})
    assert "name one of them" in refused(capsys, "genie", folder, tmp_path / "o")


def test_a_whole_ivideogpt_comes_with_the_heads_that_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published(tmp_path / "hub" / "tokenizer", TOKENIZER, {}, "diffusion_pytorch_model")
    published(tmp_path / "hub" / "transformer", TRANSFORMER, {"num_attention_heads": 2})
    convert("ivideogpt", tmp_path / "hub", tmp_path / "own")
    saved = read_model(tmp_path / "own", IVideoGPTConfig, "world_model")
    assert saved.heads == 2 and saved.autoencoder.codes == 16 and saved.autoencoder.widths == (32, 32)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "a transformer of" in line]
    assert "heads 2" in line and "ConditionalVQConfig" not in line
    convert("ivideogpt", tmp_path / "hub", tmp_path / "one", "--part", "tokenizer")
    assert not (tmp_path / "one" / "world_model").exists()


def test_a_pipeline_of_cogvideox_comes_with_its_forward_process(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vae, settings = autoencoder()
    hub = tmp_path / "hub"
    published(hub / "vae", vae, settings, "diffusion_pytorch_model")
    published(hub / "transformer", transformer(NET), cogvideox.transformer_settings(NET), "diffusion_pytorch_model", 2)
    convert("cogvideox", hub, tmp_path / "plain")
    assert "no scheduler_config.json of a pipeline: snr_shift_scale 1 is taken" in capsys.readouterr().out
    (hub / "scheduler").mkdir()
    schedule = {"snr_shift_scale": 3.0, "beta_start": 0.00085, "prediction_type": "v_prediction"}
    (hub / "scheduler" / "scheduler_config.json").write_text(json.dumps(schedule))
    convert("cogvideox", hub, tmp_path / "own")
    assert read_model(tmp_path / "own", CogVideoXConfig, "tokenizer").noise.snr_shift == 3
    convert("cogvideox", "--export", tmp_path / "own", tmp_path / "out" / "x.safetensors", "--part", "world_model")
    convert("cogvideox", tmp_path / "out", tmp_path / "again")
    noise = [read_model(tmp_path / name, CogVideoXConfig, "world_model").noise for name in ("own", "again")]
    assert noise[0] == noise[1]
    wrong = {"snr_shift_scale": -1, "prediction_type": "sample", "beta_end": 2}
    for name, value in wrong.items():
        (hub / "scheduler" / "scheduler_config.json").write_text(json.dumps(schedule | {name: value}))
        assert "scheduler_config.json" in refused(capsys, "cogvideox", hub, tmp_path / "o")
