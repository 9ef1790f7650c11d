import json
import os
import pickle
import struct
import sys
from argparse import Namespace
from collections import defaultdict
from pathlib import Path, PurePath
from types import ModuleType
from typing import Any

import ml_dtypes
import numpy as np
import pytest

from rsjax.tools.convert.files import PICKLED, ConvertError, Tensors, read_tensors, write_safetensors


def omega(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A value with the types that OmegaConf.create({"lr": 1}) pickles, under their names; OmegaConf is not needed."""
    for name in ("omegaconf", "omegaconf.base", "omegaconf.dictconfig", "omegaconf.listconfig", "omegaconf.nodes"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))

    def made(module: str, name: str, **state: Any) -> Any:
        kind = type(name, (), {"__module__": f"omegaconf.{module}"})
        monkeypatch.setattr(sys.modules[kind.__module__], name, kind, raising=False)
        value = kind()
        value.__dict__.update(state)
        return value

    cache = defaultdict(dict, {"now": {"x": 1}})
    metadata = made("base", "ContainerMetadata", ref_type=Any, object_type=dict, key_type=int, resolver_cache=cache)
    inner = made("base", "Metadata", ref_type=list, resolver_cache=defaultdict(dict))
    content = {"lr": made("nodes", "AnyNode", _metadata=inner, _val=1), "of": made("listconfig", "ListConfig")}
    return made("dictconfig", "DictConfig", _metadata=metadata, _content=content)


class Evil:
    """Runs a command in the process that unpickles it."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.marker}",)


def test_reading_inverts_writing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "new" / "x.safetensors"
    whole = rng.normal(size=(3, 4, 5)).astype(np.float32)
    tensors: Tensors = {"a.weight": whole.transpose(2, 0, 1), "b": whole[:, 1:3, ::2], "n": np.array(7, np.int64)}
    tensors["c"] = rng.normal(size=6).astype(ml_dtypes.bfloat16)
    write_safetensors(path, tensors, {"net": "x"})
    read, metadata, _, others, key = read_tensors(path)
    assert not others and key == ""
    assert metadata == {"net": "x"}
    assert read.keys() == tensors.keys()
    for name in tensors:
        assert read[name].dtype == tensors[name].dtype
        np.testing.assert_array_equal(read[name], tensors[name])


def test_what_pytorch_refuses_is_named_without_its_advice(tmp_path: Path) -> None:
    """PyTorch's own message advises to load such a file without protection."""
    torch = pytest.importorskip("torch")
    path = tmp_path / "x.pt"
    torch.save({"state_dict": {"a": torch.zeros(2)}, "run": eval}, path)
    with pytest.raises(ConvertError, match=r"refused: it holds eval, which could run code.*\.safetensors") as caught:
        read_tensors(path)
    path.write_bytes(b"anything")
    with pytest.raises(ConvertError, match=r"refused: it is damaged.*\.safetensors") as again:
        read_tensors(path)
    for message in map(str, (caught.value, again.value)):
        assert message.startswith(f"{path}: ")
        assert "weights_only" not in message


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "legacy"])
def test_what_training_scripts_save_beside_tensors_is_left_out(tmp_path: Path, zipped: bool) -> None:
    torch = pytest.importorskip("torch")
    beside = {
        "hyper_parameters": {"out": Path("runs/a"), "args": Namespace(lr=1e-4, path=PurePath("x"))},
        "best": np.float64(0.25),
        "numbers": [np.int64(3), np.bool_(True), np.random.get_state()],
        "optimizer": {"state": {0: {"moment": torch.zeros(2), "step": 4}}, "groups": [(torch.ones(1), 1e-4)]},
        "other": {"a": torch.arange(2.0)},
    }
    state = {"module._orig_mod.a": torch.arange(2.0), "block._orig_mod.b": torch.tensor(3.0), "epoch": 3}
    for holder in ("state_dict", "model_state_dict", "model"):
        path = tmp_path / "x.ckpt"
        inner = {"count": np.int64(1), "nested": {"c": torch.zeros(1)}}
        torch.save({holder: state | inner} | beside, path, _use_new_zipfile_serialization=zipped)
        read = read_tensors(path)
        assert read.names == {"a": "module._orig_mod.a", "block.b": "block._orig_mod.b"}
        np.testing.assert_array_equal(read.tensors["a"], [0.0, 1.0])
        assert read.tensors["block.b"] == 3
        counts = {"optimizer": 2, "other": 1, holder: 1}
        assert read.others == {f"the file's key {key}": number for key, number in counts.items()}


def test_omegaconfs_settings_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")
    path = tmp_path / "x.pt"
    more = defaultdict(list, {"moments": [torch.zeros(1)]})
    content = {"ema": {"a": torch.arange(2.0)}, "args": omega(monkeypatch), "more": more}
    torch.save(content, path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "omegaconf"]:
        monkeypatch.delitem(sys.modules, name)
    read = read_tensors(path, ("ema",))
    np.testing.assert_array_equal(read.tensors["a"], [0.0, 1.0])
    assert read.others == {"the file's key more": 1}


def test_a_default_that_could_run_code_is_refused(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    torch.save({"a": torch.zeros(1), "more": defaultdict(breakpoint)}, tmp_path / "x.pt")
    with pytest.raises(ConvertError, match="refused: it holds breakpoint, which could run code"):
        read_tensors(tmp_path / "x.pt")


@pytest.mark.parametrize("kind", ["float8_e4m3fn", "conjugate", "sparse", "meta"])
def test_pytorchs_tensors_that_numpy_lacks_are_named(tmp_path: Path, kind: str) -> None:
    torch = pytest.importorskip("torch")
    tensors = {
        "float8_e4m3fn": lambda: torch.zeros(2).to(torch.float8_e4m3fn),
        "conjugate": lambda: torch.zeros(2, dtype=torch.complex64).conj(),
        "sparse": lambda: torch.zeros(2, 2).to_sparse(),
        "meta": lambda: torch.zeros(2, device="meta"),
    }
    torch.save({"model": {"module.a": tensors[kind]()}}, tmp_path / "x.pt")
    with pytest.raises(ConvertError, match=r"x\.pt: module\.a is of type"):
        read_tensors(tmp_path / "x.pt")


@pytest.mark.parametrize("suffix", PICKLED)
def test_a_malicious_pickle_is_refused_and_does_not_run(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("torch")
    path = tmp_path / f"x{suffix}"
    marker = tmp_path / "ran"
    path.write_bytes(pickle.dumps({"state_dict": {"a": Evil(marker)}}, protocol=2))
    with pytest.raises(ConvertError, match=r"\.safetensors") as caught:
        read_tensors(path)
    assert str(path) in str(caught.value)
    assert not marker.exists()
    pickle.loads(path.read_bytes())
    assert marker.exists()  # it would have


def test_a_pickle_named_safetensors_does_not_run(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    marker = tmp_path / "ran"
    path.write_bytes(pickle.dumps(Evil(marker)))
    with pytest.raises(ConvertError, match="not a safetensors file"):
        read_tensors(path)
    assert not marker.exists()


def test_without_pytorch_its_files_are_refused_with_a_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.ckpt"
    path.write_bytes(b"anything")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConvertError, match=r"pip install .*torch.*\.safetensors"):
        read_tensors(path)


def test_errors_name_what_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_bytes(b"")
    write_safetensors(tmp_path / "twice.safetensors", {"a": np.zeros(1), "module.a": np.zeros(1)}, {})
    header = json.dumps({"a.w": {"dtype": "F8_E4M3", "shape": [2], "data_offsets": [0, 2]}}).encode()
    (tmp_path / "float8.safetensors").write_bytes(struct.pack("<Q", len(header)) + header + bytes(2))
    for name, message in (
        ("nowhere.safetensors", "no such file"),
        ("x.npz", "unknown kind of file"),
        ("twice.safetensors", "a occurs twice, as a and as module.a"),
        ("float8.safetensors", "a.w is of type F8_E4M3"),
    ):
        with pytest.raises(ConvertError, match=rf"{name}: .*{message}"):
            read_tensors(tmp_path / name)


def test_pytorchs_tensors_are_read_bare_or_as_a_state_dict(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    parameter = torch.nn.Parameter(torch.arange(2.0))
    state = {
        "p": parameter,
        "a.weight": torch.arange(6.0).reshape(2, 3).T,
        "half": torch.tensor([0.1, 3.0], dtype=torch.bfloat16),
    }
    for name, content in (("bare.pt", state), ("whole.ckpt", {"state_dict": state, "epoch": 3})):
        torch.save(content, tmp_path / name)
        read, metadata, _, others, key = read_tensors(tmp_path / name)
        assert metadata == others == {} and key == ("" if name == "bare.pt" else "state_dict")
        np.testing.assert_array_equal(read["a.weight"], np.arange(6.0, dtype=np.float32).reshape(2, 3).T)
        np.testing.assert_array_equal(read["p"], [0.0, 1.0])
        np.testing.assert_array_equal(read["half"], np.array([0.1, 3.0], ml_dtypes.bfloat16).astype(np.float32))
    for other in ([state], {"state_dict": [1]}, {"state_dict": {"a": 3}}):
        torch.save(other, tmp_path / "other.pt")
        with pytest.raises(ConvertError, match="other.pt: holds no tensors by name"):
            read_tensors(tmp_path / "other.pt")
