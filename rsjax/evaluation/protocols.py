"""Protocols: how a model is evaluated, as data. Published ones differ in every field, so results record every field."""

from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from rsjax.config import Config, require, to_dict
from rsjax.config.fields import check_numbers, require_range
from rsjax.errors import UserError, did_you_mean

LEAST_RESOLUTION = 16
OWN = "run"  # the protocol of a run's own configuration, which its evaluation stage uses
# Fields that replace those of model.sample.
SAMPLING = ("steps", "temperature", "top_k", "unmask", "mean_codes", "guidance")


@dataclass(frozen=True)
class Protocol:
    """The settings of an evaluation: what is generated, and which of its frames are scored.

    Attributes:
        name: one of :data:`PROTOCOLS`, or "run".
        prompt_frames: recorded frames that generation starts from.
        horizon: predicted frames; 0: up to the end of the clips.
        resolution: pixels per side of the frames that are scored; 0: those of the run's clips.
        steps, temperature, top_k, unmask, mean_codes, guidance: settings of sampling; None: the run's own.
        samples: videos per clip. The scores are those of the first video. With several, each clip's best score of each
            pixel metric is added as ``NAME_bestN_incl_ctx``; it covers all frames, including the prompt as the model
            sees it.
        clips: how many of the split's clips are scored, spread evenly; all if the split has fewer.
        repetitions: evaluations with different random draws; a clip's score is the mean over them.
        action_draws: random action sequences per clip and kind of ΔPSNR; 0: no ΔPSNR.
        teacher_forced: whether each frame is predicted from the recorded frames before it, not from generated ones.
        reference: what predictions are compared with: recorded frames, or the tokenizer's reconstruction of them.
        depth_alignment, depth_source: which depth scores the tables show.
        as_published: whether Physics-IQ's masks go through a lossy video, as in its public code.
        splits: the splits whose clips are scored, each split separately; ``NAME*`` stands for all that start with NAME.
        origin: who evaluates in this way.
    """

    name: str
    prompt_frames: int = 1
    horizon: int = 15
    resolution: int = 0
    steps: int | None = None
    temperature: float | None = None
    top_k: int | None = None
    unmask: Literal["random", "greedy"] | None = None
    mean_codes: bool | None = None
    guidance: float | None = None
    samples: int = 1
    clips: int = 100
    repetitions: int = 1
    action_draws: int = 3
    teacher_forced: bool = False
    reference: Literal["recorded", "reconstruction"] = "recorded"
    depth_alignment: Literal["none", "median", "affine_disparity", "l1_scale"] = "median"
    depth_source: Literal["branch", "estimator"] = "branch"
    as_published: bool = False
    splits: tuple[str, ...] = ("test",)
    origin: str = ""

    def __post_init__(self) -> None:
        check_numbers(self, "--", dash=True)
        low = {
            "prompt_frames": 1,
            "horizon": 0,
            "resolution": 0,
            "samples": 1,
            "clips": 2,
            "repetitions": 1,
            "action_draws": 0,
        }
        for name, least in low.items():
            require_range(self, f"protocol {self.name}", least, 2**31, name)
        require(
            self.resolution == 0 or self.resolution >= LEAST_RESOLUTION,
            f"protocol {self.name}: resolution is {self.resolution}; frames have at least {LEAST_RESOLUTION} pixels "
            f"per side, as metrics look at windows; 0 scores the clips' own",
        )
        require(bool(self.splits), f"protocol {self.name}: name a split, such as test")

    @property
    def sampling(self) -> dict[str, Any]:
        """The settings of sampling that the protocol fixes."""
        return {name: value for name in SAMPLING if (value := getattr(self, name)) is not None}

    @property
    def depth_suffix(self) -> str:
        """The suffix after ``depth_absrel`` in the names of the depth scores that tables show."""
        return "" if self.depth_alignment == "none" else f"_{self.depth_alignment}_{self.depth_source}"

    def described(self) -> dict[str, Any]:
        """Returns the fields, JSON-ready, and in words the frames that are scored."""
        frames = {
            "scores": "predicted frames",
            "best of samples": "all frames, the prompt as the model sees it included",
        }
        return to_dict(self) | {"frames": frames if self.samples > 1 else {"scores": frames["scores"]}}


PAPER = Protocol(
    "paper",
    origin="RoboScape, Table 1: 16-frame clips at 2 Hz, one given; resolution, sampling and alignment are not stated",
)
PROTOCOLS = {
    each.name: each
    for each in (
        PAPER,
        Protocol(
            "1xgpt",
            prompt_frames=8,
            horizon=8,
            steps=2,
            temperature=0.0,
            unmask="random",
            mean_codes=False,
            guidance=1.0,
            action_draws=0,
            teacher_forced=True,
            reference="reconstruction",
            origin="1xgpt evaluate.py: 8 of 16 frames given, each frame from true ones, against decoded true tokens",
        ),
        Protocol(
            "ivideogpt-bair",
            resolution=64,
            temperature=1.0,
            top_k=100,
            samples=100,
            clips=256,
            action_draws=0,
            origin="iVideoGPT on BAIR: one frame given, best of 100 samples per metric, the context frame included",
        ),
        replace(PAPER, name="horizon48", horizon=48, origin="RoboScape: rollouts to 48 frames"),
        replace(
            PAPER, name="unseen", splits=("unseen*",), origin="RoboScape: tasks, cameras or objects never trained on"
        ),
        replace(
            PAPER,
            name="contacts",
            splits=("contacts_*",),
            origin="here: held-out grasps, pushes, slips, free driving, bad policies and clips from the middle",
        ),
    )
}


def of_run(config: Config) -> Protocol:
    """Returns the protocol of a run's own configuration: the run's prompt and sampling settings, and whole clips."""
    settings = config.eval
    return Protocol(
        OWN,
        prompt_frames=config.prompt_frames,
        horizon=0,
        clips=settings.clips,
        repetitions=settings.repetitions,
        action_draws=settings.action_draws,
        depth_alignment="none",
        origin="the run's configuration",
    )


def find(name: str, config: Config) -> Protocol:
    """Returns the named protocol; its clips and repetitions are raised to the configuration's if these are larger.

    A protocol with several samples keeps its own counts, which are part of what was published.

    Raises:
        UserError: there is no protocol of this name.
    """
    if name == OWN:
        return of_run(config)
    if name not in PROTOCOLS:
        known = (*PROTOCOLS, OWN)
        raise UserError(f"unknown protocol {name!r}{did_you_mean(name, known)} (protocols: {', '.join(known)})")
    protocol = PROTOCOLS[name]
    settings = config.eval
    if protocol.samples > 1:
        return protocol
    repetitions = max(protocol.repetitions, settings.repetitions)
    return replace(protocol, clips=max(protocol.clips, settings.clips), repetitions=repetitions)


def label(protocol: Protocol, standard: Protocol) -> str:
    """Returns the protocol's name with the fields in which it differs from the standard one: ``paper,clips=20``."""
    changed = [
        f"{field.name}={value}"
        for field in fields(Protocol)
        if field.name != "splits" and (value := getattr(protocol, field.name)) != getattr(standard, field.name)
    ]
    return ",".join([protocol.name, *changed])


def check(protocol: Protocol, frames: int, image_size: int, where: str) -> Protocol:
    """Returns the protocol with its horizon and resolution as numbers, for clips of this shape.

    Args:
        where: the name of the store, for error messages.

    Raises:
        UserError: the protocol predicts more frames than the clips have, or scores more pixels.
    """
    horizon = protocol.horizon or frames - protocol.prompt_frames
    needed = protocol.prompt_frames + max(horizon, 1)
    if frames < needed:
        raise UserError(
            f"protocol {protocol.name} predicts {horizon if protocol.horizon else 'some'} frames after "
            f"{protocol.prompt_frames}, so it takes clips of {needed} frames; those of {where} have {frames}: lower "
            f"--horizon, or name a store of longer clips with --data"
        )
    if protocol.resolution > image_size:
        raise UserError(
            f"protocol {protocol.name} scores frames of {protocol.resolution} pixels per side; those of {where} have "
            f"{image_size}: set --resolution {image_size} or less, and say so beside the numbers"
        )
    return replace(protocol, horizon=horizon, resolution=protocol.resolution or image_size)
