import os
import pickle
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import ml_dtypes
import numpy as np
import pytest

from rsjax.convert.files import PICKLED, ConvertError, Tensors, read_tensors, write_safetensors


class Evil:
    """Runs a command in the process that unpickles it."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.marker}",)


def test_reading_inverts_writing(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "new" / "x.safetensors"
    whole = rng.normal(size=(3, 4, 5)).astype(np.float32)
    tensors: Tensors = {"a.weight": whole.transpose(2, 0, 1), "b": whole[:, 1:3, ::2], "n": np.array(7, np.int64)}
    tensors["c"] = rng.normal(size=6).astype(ml_dtypes.bfloat16)
    write_safetensors(path, tensors, {"net": "x"})
    read, metadata = read_tensors(path)
    assert metadata == {"net": "x"}
    assert read.keys() == tensors.keys()
    for name in tensors:
        assert read[name].dtype == tensors[name].dtype
        np.testing.assert_array_equal(read[name], tensors[name])


class FakeTensor:
    """Behaves like torch's: a tensor that requires a gradient refuses numpy()."""

    dtype = "float32"

    def __init__(self, values: np.ndarray, wants_gradient: bool = True) -> None:
        self.values, self.wants_gradient = values, wants_gradient

    def detach(self) -> "FakeTensor":
        return FakeTensor(self.values, wants_gradient=False)

    def numpy(self) -> np.ndarray:
        if self.wants_gradient:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad")
        return self.values


@pytest.fixture
def fake_torch(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Replaces PyTorch, so that its calls are tested without it. Tests set ``load``."""
    fake = ModuleType("torch")
    monkeypatch.setattr(fake, "Tensor", FakeTensor, raising=False)
    monkeypatch.setattr(fake, "bfloat16", "bfloat16", raising=False)
    monkeypatch.setitem(sys.modules, "torch", fake)
    return fake


@pytest.mark.parametrize("suffix", PICKLED)
def test_pytorch_loads_weights_only(
    tmp_path: Path, fake_torch: ModuleType, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    asked: list[tuple[Any, dict[str, Any]]] = []

    def load(file: Any, **options: Any) -> Any:
        asked.append((file, options))
        return {"state_dict": {"a": FakeTensor(np.arange(3.0))}}

    monkeypatch.setattr(fake_torch, "load", load, raising=False)
    path = tmp_path / f"x{suffix}"
    path.write_bytes(b"anything")
    tensors, _ = read_tensors(path)
    [(file, options)] = asked
    assert file == path
    assert options["weights_only"] is True
    np.testing.assert_array_equal(tensors["a"], np.arange(3.0))


def test_an_error_of_pytorch_becomes_one_line_with_a_cure(
    tmp_path: Path, fake_torch: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(*_: Any, **__: Any) -> Any:
        raise pickle.UnpicklingError("Weights only load failed.\nmany more lines")

    monkeypatch.setattr(fake_torch, "load", load, raising=False)
    path = tmp_path / "x.pt"
    path.write_bytes(b"anything")
    with pytest.raises(ConvertError, match=r"refused.*\(Weights only load failed\.\).*\.safetensors") as caught:
        read_tensors(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", PICKLED)
def test_a_malicious_pickle_is_refused_and_does_not_run(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("torch")
    path, marker = tmp_path / f"x{suffix}", tmp_path / "ran"
    path.write_bytes(pickle.dumps({"state_dict": {"a": Evil(marker)}}, protocol=2))
    with pytest.raises(ConvertError, match=r"\.safetensors") as caught:
        read_tensors(path)
    assert str(path) in str(caught.value)
    assert not marker.exists()
    pickle.loads(path.read_bytes())
    assert marker.exists()  # it would have


def test_a_pickle_named_safetensors_does_not_run(tmp_path: Path) -> None:
    path, marker = tmp_path / "x.safetensors", tmp_path / "ran"
    path.write_bytes(pickle.dumps(Evil(marker)))
    with pytest.raises(ConvertError, match="not a safetensors file"):
        read_tensors(path)
    assert not marker.exists()


def test_without_pytorch_its_files_are_refused_with_a_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.ckpt"
    path.write_bytes(b"anything")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConvertError, match=r"rsjax\[torch\].*\.safetensors"):
        read_tensors(path)


def test_errors_name_a_missing_or_unknown_file(tmp_path: Path) -> None:
    with pytest.raises(ConvertError, match="nowhere.safetensors: no such file"):
        read_tensors(tmp_path / "nowhere.safetensors")
    (tmp_path / "x.npz").write_bytes(b"")
    with pytest.raises(ConvertError, match="unknown kind of file"):
        read_tensors(tmp_path / "x.npz")


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
        read, metadata = read_tensors(tmp_path / name)
        assert metadata == {}
        np.testing.assert_array_equal(read["a.weight"], np.arange(6.0, dtype=np.float32).reshape(2, 3).T)
        np.testing.assert_array_equal(read["p"], [0.0, 1.0])
        np.testing.assert_array_equal(read["half"], np.array([0.1, 3.0], ml_dtypes.bfloat16).astype(np.float32))
    for other in ([state], {"state_dict": [1]}, {"state_dict": {"a": 3}}):
        torch.save(other, tmp_path / "other.pt")
        with pytest.raises(ConvertError, match="other.pt: holds no tensors by name"):
            read_tensors(tmp_path / "other.pt")
