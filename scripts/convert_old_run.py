"""Upgrades the config.json of runs that were trained before the settings were restructured.

``python scripts/convert_old_run.py runs/*``. A file that is up to date stays as it is; the old one is kept as
config.old.json. Stages of the run get new keys, so that ``experiments.train`` asks for --overwrite; generating and
evaluating work as before. Weights of LPIPS and FVD now lie in one directory: name it with --eval.weights.
"""

import json
import sys
from pathlib import Path
from typing import Any

SHARED = (
    *("log_every", "checkpoint_every", "eval_every", "sharding", "fsdp"),
    *("workers", "max_damaged", "wandb", "profile"),
)
DROPPED = ("skip_budget", "keep_last", "keep_every", "keep_best", "restarts")
DEPARTURES = (
    *("integrate_actions", "read_previous", "whole_frames", "action_dropout", "temporal_norm", "final_norm"),
    *("shifts", "shift_pixels"),
)


def upgraded(config: dict[str, Any]) -> dict[str, Any]:
    """Returns the configuration with today's fields."""
    if "runtime" not in config:
        config["runtime"] = {name: config["train"][name] for name in SHARED if name in config["train"]}
        for section in ("tokenizer_train", "train"):
            upgrade_training(config[section])
    if config.get("data") and not config["data"]["key"]:
        config["data"] = None
    config["sim"].pop("workers", None)  # of the run now, not of the simulator
    config["eval"].pop("report_clips", None)
    model = config["model"]
    if model["family"] in ("roboscape", "genie") and "departures" not in model:
        upgrade_model(model)
    if "mask" in model:
        split_model(model)
    if "use_keypoints" in model.get("loss", {}):
        choose_keypoints(model)
    if "adversarial_weight" in config["tokenizer_train"]:
        split_tokenizer_train(config["tokenizer_train"])
        gather_weights(config["eval"])
        for section in ("tokenizer_train", "train"):
            split_optimizer(config[section]["optimizer"])
    if "use_depth" in model:
        model["depth"] = {"kind": "branch" if model.pop("use_depth") else "none"}
    return config


def upgrade_training(train: dict[str, Any]) -> None:
    """Removes what both trainings share or nobody sets, and joins the optimizer's betas."""
    for name in (*SHARED, *DROPPED):
        train.pop(name, None)
    optimizer = train["optimizer"]
    optimizer["betas"] = [optimizer.pop("beta1"), optimizer.pop("beta2")]
    optimizer.pop("decay_share", None)


def upgrade_model(model: dict[str, Any]) -> None:
    """Gathers the departures from the paper."""
    departures = {name: model.pop(name) for name in DEPARTURES if name in model}
    departures["rotary"] = model.pop("positions", "learned") == "rotary"
    mask = model["mask"]
    departures["visible_prefix"] = mask.pop("visible_prefix", 0.0)
    departures["self_conditioning"] = mask.pop("own_frames", 0.0)
    departures["self_conditioning_after"] = mask.pop("own_frames_after", 0)
    if "loss" in model:
        departures["observed_anchor"] = model["loss"].pop("keypoint_target", "observed") == "observed"
        model["loss"].pop("keypoint_masked_only", None)
        departures["visible_keypoints"] = True
    model["departures"] = departures


def split_model(model: dict[str, Any]) -> None:
    """Makes sections of the settings of RoboScape or Genie that can be off, and drops constants."""
    mask = model.pop("mask")
    corruption = {"random_token_rate": mask["random_token_rate"], "probability": mask["corruption_probability"]}
    model["corruption"] = corruption if any(corruption.values()) else None
    public = {name: model.pop(name) for name in ("qk_norm", "mup", "mlp_ratio")}
    model["public_code"] = public if public != {"qk_norm": False, "mup": False, "mlp_ratio": 4} else None
    departures = model["departures"]
    if departures["temporal_norm"] != departures["final_norm"]:
        raise SystemExit("the model has one of the norms temporal_norm and final_norm, not both; train it again")
    departures["more_norms"] = departures.pop("temporal_norm")
    departures["embedding_std"] = model.pop("position_std")
    for section, name in ((departures, "final_norm"), (departures, "shift_pixels"), (model, "embed_std")):
        del section[name]
    if "loss" in model:
        del model["loss"]["rgb_weight"]


def choose_keypoints(model: dict[str, Any]) -> None:
    """Replaces the switch of the keypoint terms by the choice of one, and drops what had no effect."""
    words = {True: "printed", False: "none"}
    loss = model["loss"]
    loss["keypoints"] = words[loss.pop("use_keypoints")]
    model["departures"].pop("masked_keypoints", None)


def split_tokenizer_train(train: dict[str, Any]) -> None:
    """Makes sections of the perceptual and the adversarial terms, which can be off, and drops constants."""
    perceptual = {"weight": train.pop("perceptual_weight"), "lpips": train.pop("lpips_weights")}
    train["perceptual"] = perceptual if perceptual["weight"] else None
    names = {"adversarial_weight": "weight", "disc_start": "start"}
    names |= {"lecam_weight": "lecam_weight", "lecam_decay": "lecam_decay"}
    adversarial = {new: train.pop(name) for name, new in names.items()}
    train["adversarial"] = adversarial if adversarial["weight"] else None
    for name in ("hinge_weight", "entropy_temperature"):
        del train[name]


def split_optimizer(optimizer: dict[str, Any]) -> None:
    """Leaves Muon the settings that it has."""
    if optimizer["kind"] == "muon":
        for name in ("drop_at", "betas", "weight_decay", "grad_clip"):
            del optimizer[name]


def gather_weights(evaluation: dict[str, Any]) -> None:
    """Drops the paths of the metrics' files, which now lie in one directory."""
    for name in ("loss_clips", "lpips_alex_weights", "lpips_vgg_weights", "fvd_weights"):
        del evaluation[name]


def main() -> None:
    """Upgrades every run directory of the command line."""
    for directory in map(Path, sys.argv[1:]):
        path = directory / "config.json"
        text = path.read_text()
        config = upgraded(json.loads(text))
        new = json.dumps(config, indent=1) + "\n"
        if json.loads(text) == config:
            print(f"{path}: up to date")
            continue
        (directory / "config.old.json").write_text(text)
        path.write_text(new)
        print(f"{path}: upgraded")


if __name__ == "__main__":
    main()
