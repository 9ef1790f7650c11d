"""TFRecord files and RLDS episodes made by hand; pictures say which frame they are."""

import io
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from rsjax.tools.ingest.formats.tfrecord import masked_crc, message_class

Values = Sequence[bytes] | Sequence[int] | Sequence[float] | np.ndarray


def example(features: Mapping[str, Values]) -> bytes:
    """A ``tf.train.Example``: floats, ints or bytes by the type of the first value."""
    message = message_class()()
    for name, values in features.items():
        listed = values.reshape(-1).tolist() if isinstance(values, np.ndarray) else list(values)
        kind = {bytes: "bytes_list", float: "float_list", int: "int64_list", bool: "int64_list"}[type(listed[0])]
        getattr(message.features.feature[name], kind).value.extend(listed)
    return message.SerializeToString()


def frame(payload: bytes) -> bytes:
    """A record of a TFRecord file."""
    head = struct.pack("<Q", len(payload))
    return b"".join(
        [head, struct.pack("<I", masked_crc(head)), payload, struct.pack("<I", masked_crc(payload))],
    )


def write_records(path: Path, payloads: Iterable[bytes]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(map(frame, payloads)))
    return path


def picture(value: int, side: int = 8) -> np.ndarray:
    """A picture that is ``value`` but for one dark corner, so that it is not taken for a placeholder."""
    pixels = np.full((side, side, 3), value, np.uint8)
    pixels[0, 0] = 0
    return pixels


def encoded(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def step(t: int) -> int:
    """The picture of frame ``t``."""
    return 10 + 20 * t


def bridge_episode(count: int = 5, task: str = "put it down", changes: Mapping[str, Values] | None = None) -> bytes:
    """An episode with one true and three placeholder cameras; action t is t + 1, in every dimension."""
    black = encoded(np.zeros((8, 8, 3), np.uint8))
    features: dict[str, Values] = {
        "steps/observation/image_0": [encoded(picture(step(t))) for t in range(count)],
        "steps/action": np.repeat(np.arange(count) + 1.0, 7),
        "steps/observation/state": np.repeat(np.arange(count) * 10.0, 7),
        "steps/language_instruction": [task.encode()] * count,
        "episode_metadata/episode_id": [3],
    }
    features |= {f"steps/observation/image_{camera}": [black] * count for camera in (1, 2, 3)}
    return example(features | dict(changes or {}))


def write_bridge(folder: Path, payloads: Sequence[bytes], promised: int | None = None) -> Path:
    """A data set like the one on BridgeData's site; returns the shard."""
    folder.mkdir(parents=True, exist_ok=True)
    lengths = [str(len(payloads) if promised is None else promised)]
    info: dict[str, Any] = {"name": "bridge_dataset", "splits": [{"name": "train", "shardLengths": lengths}]}
    (folder / "dataset_info.json").write_text(json.dumps(info))
    image = {"image": {"encodingFormat": "png"}}
    observed = {f"image_{camera}": image for camera in range(4)} | {"state": {"tensor": {}}}
    steps = {"observation": features(observed), "action": {"tensor": {}}, "language_instruction": {"text": {}}}
    tree = features({"steps": {"sequence": {"feature": features(steps)}}})
    (folder / "features.json").write_text(json.dumps(tree))
    return write_records(folder / "bridge_dataset-train.tfrecord-00000-of-00001", payloads)


def features(children: Mapping[str, Any]) -> dict[str, Any]:
    return {"featuresDict": {"features": dict(children)}}
