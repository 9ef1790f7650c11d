"""Demonstrations of the tabletop in LeRobot's and openpi's own code, where these are installed."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.tools.export.demonstrations import DemonstrationOptions, export_libero

HORIZON = 8
RENAMED = {  # what LeRobot's policies call openpi's keys
    "image": "observation.images.image",
    "wrist_image": "observation.images.wrist_image",
    "state": "observation.state",
    "actions": "action",
}


def opened(folder: Path) -> Any:
    """The demonstrations as LeRobot opens them, in the version that it reads."""
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="LeRobot is missing (docs/lerobot.md)")
    root = folder / "libero"
    export_libero(root, DemonstrationOptions(demos=1, size=64, version=datasets.CODEBASE_VERSION))
    later = {"actions": [step / 20 for step in range(HORIZON)]}
    return datasets.LeRobotDataset("local/libero", root=root, delta_timestamps=later, video_backend="pyav")


def test_a_policy_of_lerobot_takes_a_training_step(gl: str, tmp_path: Path) -> None:
    dataset = opened(tmp_path)
    import torch
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4)))
    assert batch["image"].shape == batch["wrist_image"].shape == (4, 3, 64, 64)
    assert batch["state"].shape == (4, 8) and batch["actions"].shape == (4, HORIZON, 7)
    assert batch["task"][0].startswith("pick up the")
    info = json.loads((tmp_path / "libero" / "meta" / "info.json").read_text())
    assert len(dataset) == info["total_frames"]
    kinds = {"image": FeatureType.VISUAL, "wrist_image": FeatureType.VISUAL, "state": FeatureType.STATE}
    config = ACTConfig(
        input_features={
            RENAMED[name]: PolicyFeature(kind, tuple(batch[name].shape[1:])) for name, kind in kinds.items()
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        normalization_mapping=dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY),
        chunk_size=HORIZON,
        n_action_steps=HORIZON,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        pretrained_backbone_weights=None,
        device="cpu",
    )
    policy = ACTPolicy(config)
    optimizer = torch.optim.AdamW(policy.parameters(), 1e-3)
    inputs = {RENAMED.get(name, name): value for name, value in batch.items()}
    inputs["action_is_pad"] = batch["actions_is_pad"]
    before = [x.detach().clone() for x in policy.parameters()]
    loss, _ = policy.forward(inputs)
    loss.backward()
    optimizer.step()
    assert np.isfinite(loss.item())
    assert any((x != old).any() for x, old in zip(policy.parameters(), before, strict=True))


def test_openpi_reads_them_by_its_configuration_of_libero(gl: str, tmp_path: Path) -> None:
    """openpi's own transforms, with the keys of its LeRobotLiberoDataConfig, up to its tokenizer, a download."""
    libero_policy = pytest.importorskip("openpi.policies.libero_policy", reason="openpi is not installed")
    from openpi.models.model import ModelType
    from openpi.transforms import PromptFromLeRobotTask, RepackTransform

    item = opened(tmp_path)[0]
    keys = {
        "observation/image": "image",
        "observation/wrist_image": "wrist_image",
        "observation/state": "state",
        "actions": "actions",
        "prompt": "prompt",
    }
    asked = PromptFromLeRobotTask({int(item["task_index"]): item["task"]})(item)
    inputs = libero_policy.LiberoInputs(model_type=ModelType.PI0)(RepackTransform(keys)(asked))
    assert inputs["prompt"] == item["task"]
    assert inputs["image"]["base_0_rgb"].shape == inputs["image"]["left_wrist_0_rgb"].shape == (64, 64, 3)
    assert inputs["actions"].shape == (HORIZON, 7)
