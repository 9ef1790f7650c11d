"""Stand-ins for the repositories that trackers and Video Depth Anything are run from.

They have the modules, constructors and calls of the real ones, and random or simple insides, and check what they are
handed: ranges, axes, types.
"""

from pathlib import Path

SPATIAL = """
import torch

class SpaTrackerPredictor(torch.nn.Module):
    def __init__(self, checkpoint="", interp_shape=(384, 512), seq_length=16):
        super().__init__()
        self.shift = torch.load(checkpoint, weights_only=True)["shift"]
        self.seq_length = seq_length

    @torch.no_grad()
    def forward(self, video, video_depth=None, queries=None, grid_size=0, wind_length=8, **more):
        _, T, C, H, W = video.shape
        assert C == 3 and video.dtype == torch.float32 and 1 < video.max() <= 255
        assert video_depth.shape == (T, 1, H, W) and wind_length == self.seq_length
        assert (queries[0, :, 0] == 0).all()
        times = torch.arange(T)[None, :, None, None]
        places = queries[:, None, :, 1:] + times * self.shift
        deep = torch.ones_like(places[..., :1])
        seen = torch.ones(places.shape[:3], dtype=torch.bool)
        if T <= wind_length // 2:
            places, seen = places * 0, ~seen
        return torch.cat([places, deep], -1), seen, queries[..., 0].byte()
"""

TAPIR = """
import torch

class TAPIR(torch.nn.Module):
    def __init__(self, pyramid_level=1, **more):
        super().__init__()
        self.shift = torch.nn.Parameter(torch.zeros(2))

    def forward(self, video, query_points):
        assert video.shape[2:] == (256, 256, 3) and -1 <= video.min() < 0 < video.max() <= 1
        assert (query_points[..., 0] == 0).all()
        times = torch.arange(video.shape[1])[None, None, :, None]
        tracks = query_points[:, :, None, [2, 1]] + times * self.shift
        logits = torch.full(tracks.shape[:3], -5.0)
        far = logits.clone()
        far[:, 0, -1] = 5.0
        return {"tracks": tracks, "occlusion": logits, "expected_dist": far}
"""

VIDEO_DEPTH = """
import numpy as np
import torch

class VideoDepthAnything(torch.nn.Module):
    def __init__(self, encoder="vitl", features=256, out_channels=(), metric=False):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(features))

    def infer_video_depth(self, frames, target_fps, input_size=518, device="cuda", fp32=False):
        assert frames.dtype == np.uint8 and frames.ndim == 4 and frames.shape[-1] == 3
        assert fp32 == (device == "cpu")
        return frames.mean(-1).astype(np.float32) * float(self.scale[0].detach()), target_fps
"""

FILES = {
    "models/spatracker/predictor.py": SPATIAL,
    "tapnet/torch/tapir_model.py": TAPIR,
    "video_depth_anything/video_depth.py": VIDEO_DEPTH,
}


def check_out(folder: Path, module: str) -> Path:
    """Writes one of ``FILES`` and the packages around it."""
    file = folder / module
    file.parent.mkdir(parents=True)
    file.write_text(FILES[module])
    return folder
