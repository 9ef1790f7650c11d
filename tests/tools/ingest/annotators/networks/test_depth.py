import numpy as np
import pytest

from rsjax.data.depth_color import RELATIVE_FAR
from rsjax.tools.ingest.annotators.depth import DepthAnything, VideoDepthAnything, inverse_of
from rsjax.tools.ingest.annotators.protocols import AnnotationError
from tests.tools.ingest.annotators.networks.checkouts import check_out
from tests.tools.ingest.videos import episode, sliding

torch = pytest.importorskip("torch")
FRAMES = sliding(5, (1, 0), (30, 42))
EPISODE = episode(FRAMES)


@pytest.fixture
def checkout(tmp_path):
    torch.save({"scale": torch.full((64,), 2.0)}, tmp_path / "w")
    return check_out(tmp_path, "video_depth_anything/video_depth.py")


@pytest.fixture(scope="module")
def depth_anything(tmp_path_factory):
    """Saves a small random DepthAnything, of a kind, in a folder."""
    transformers = pytest.importorskip("transformers")

    def save(kind):
        torch.manual_seed(0)
        sizes = {
            "hidden_size": 16,
            "num_hidden_layers": 4,
            "num_attention_heads": 2,
            "image_size": 28,
            "patch_size": 14,
        }
        stages = {"out_features": ["stage1", "stage2", "stage3", "stage4"], "reshape_hidden_states": False}
        config = transformers.DepthAnythingConfig(
            backbone_config=transformers.Dinov2Config(**sizes, **stages, apply_layernorm=True),
            reassemble_hidden_size=16,
            neck_hidden_sizes=[8, 8, 8, 8],
            fusion_hidden_size=8,
            head_hidden_size=8,
            depth_estimation_type=kind,
            max_depth=20 if kind == "metric" else 1,
        )
        folder = tmp_path_factory.mktemp(kind)
        model = transformers.DepthAnythingForDepthEstimation(config)
        for weight in (*model.neck.parameters(), *model.head.parameters()):
            weight.data.normal_(0, 0.3)
        model.head.conv3.weight.data.abs_()  # behind a ReLU and before one: not zero everywhere
        model.head.conv3.bias.data.zero_()
        model.save_pretrained(folder)
        size = {"height": 28, "width": 28}
        transformers.DPTImageProcessor(size=size, keep_aspect_ratio=True, ensure_multiple_of=14).save_pretrained(folder)
        return folder

    return save


def test_video_depth_is_relative_and_can_be_undone(checkout):
    depth = VideoDepthAnything(checkout, checkout / "w", device="cpu")(EPISODE, "top")
    output = FRAMES.pictures.mean(-1) * 2.0
    maps = depth.maps.read(range(5))
    assert depth.unit == "relative" and depth.extent == pytest.approx((output.min(), output.max()))
    assert maps.min() == pytest.approx(1) and maps.max() == pytest.approx(RELATIVE_FAR)
    np.testing.assert_allclose(inverse_of(depth, range(5)), output, atol=1e-2)


def test_metric_video_depth_stays_in_metres(checkout):
    depth = VideoDepthAnything(checkout, checkout / "w", metric=True, device="cpu")(EPISODE, "top")
    assert depth.unit == "metres"
    np.testing.assert_allclose(depth.maps.read([3]), np.maximum(FRAMES.pictures[3:4].mean(-1) * 2, 1e-3), rtol=1e-6)


def test_weights_of_another_encoder_are_refused(checkout):
    with pytest.raises(AnnotationError, match="not the weights of Video Depth Anything"):
        VideoDepthAnything(checkout, checkout / "w", encoder="vitl", device="cpu")(EPISODE, "top")


def test_an_episode_too_long_for_memory_is_refused(checkout):
    with pytest.raises(AnnotationError, match="5 frames, more than most_frames 4"):
        VideoDepthAnything(checkout, checkout / "w", most_frames=4, device="cpu")(EPISODE, "top")


@pytest.mark.parametrize(("kind", "unit"), [("relative", "relative"), ("metric", "metres")])
def test_depth_anything_gives_maps_of_the_pictures_size(depth_anything, kind, unit):
    folder = depth_anything(kind)
    depth = DepthAnything(folder, batch=2)(EPISODE, "top")
    maps = depth.maps.read(range(5))
    assert depth.unit == unit and maps.shape == (5, 30, 42) and maps.dtype == np.float32
    assert (maps > 0).all() and len(depth.maps) == 5
    assert np.ptp(maps) > 0
    if kind == "relative":
        assert maps.min() == pytest.approx(1) and maps.max() == pytest.approx(RELATIVE_FAR, rel=1e-5)
    else:
        assert maps.max() <= 20
    np.testing.assert_allclose(DepthAnything(folder, batch=5)(EPISODE, "top").maps.read(range(5)), maps, rtol=1e-3)


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_depth_anything_gives_the_librarys_own_numbers(depth_anything, kind):
    transformers = pytest.importorskip("transformers")
    folder = depth_anything(kind)
    frames = sliding(3, (1, 0), (28, 28))
    depth = DepthAnything(folder, batch=2)(episode(frames), "top")
    model = transformers.DepthAnythingForDepthEstimation.from_pretrained(folder)
    inputs = transformers.DPTImageProcessor.from_pretrained(folder)(list(frames.pictures), return_tensors="pt")
    with torch.no_grad():
        output = model(**inputs).predicted_depth.numpy()
    assert np.ptp(output) > 0
    if kind == "relative":
        np.testing.assert_allclose(inverse_of(depth, range(3)), output, atol=1e-4 * np.ptp(output))
        nearest = np.unravel_index(output.argmax(), output.shape)  # what it gives is 1/depth
        assert depth.maps.read(range(3))[nearest] == pytest.approx(1)
    else:
        np.testing.assert_allclose(depth.maps.read(range(3)), np.maximum(output, 1e-3), rtol=1e-4)


def test_weights_that_give_nan_are_named(checkout, tmp_path):
    torch.save({"scale": torch.full((64,), float("nan"))}, tmp_path / "w")
    with pytest.raises(AnnotationError, match="e0: video-depth-anything: depth is not finite"):
        VideoDepthAnything(checkout, tmp_path / "w", device="cpu")(EPISODE, "top")
