"""HDF5 files in robomimic's and LIBERO's layout; pictures say which frame they are and which way is up."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

SIDE = 6


def pictures(count: int, bottom_first: bool = False) -> np.ndarray:
    """Frame t is ``10 + t``, with a bright pixel in the upper left corner of the upright picture."""
    frames = np.broadcast_to(10 + np.arange(count, dtype=np.uint8)[:, None, None, None], (count, SIDE, SIDE, 3)).copy()
    frames[:, 0, 0] = 255
    return frames[:, ::-1] if bottom_first else frames


def demo(count: int = 4, bottom_first: bool = False, ending: str = "_image") -> dict[str, np.ndarray]:
    """Action t is t + 1 in every dimension; the state t is 10 t."""
    return {
        "actions": np.repeat(np.arange(count) + 1.0, 7).reshape(count, 7),
        f"obs/agentview{ending}": pictures(count, bottom_first),
        "obs/robot0_eef_pos": np.repeat(np.arange(count) * 10.0, 3).reshape(count, 3),
        "obs/ee_states": np.repeat(np.arange(count) * 10.0, 6).reshape(count, 6),
    }


def write_demos(
    path: Path,
    demos: Mapping[str, Mapping[str, np.ndarray]],
    masks: Mapping[str, list[str]] | None = None,
    **attributes: Any,
) -> Path:
    """Args: attributes: of the group ``data``, JSON-ready."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update({name: json.dumps(value) for name, value in attributes.items()})
        for name, arrays in demos.items():
            group = data.create_group(name)
            group.attrs["num_samples"] = len(arrays["actions"]) if "actions" in arrays else 0
            for key, array in arrays.items():
                group.create_dataset(key, data=array)
        for name, listed in (masks or {}).items():
            file.create_dataset(f"mask/{name}", data=np.array(listed, dtype="S16"))
    return path
