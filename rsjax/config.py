"""Every setting of the project: frozen dataclasses, checked where they are made, hashable, serialisable.

A :class:`Config` names everything that one run depends on. Presets live in :mod:`rsjax.presets`.
The loss weights λ₁, λ₂, λ₃ and γ of the paper live in :class:`LossConfig` and nowhere else.

A field made with :func:`runtime` changes how fast or how talkatively a run goes but not what it makes;
it is left out of content keys, so changing it never invalidates finished work.
"""

import dataclasses
import hashlib
import json
import typing
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from rsjax.errors import UserError

T = TypeVar("T")


class ConfigError(UserError):
    """A configuration that cannot run. The message names the field and the cure."""


def runtime(default: Any) -> Any:
    """A dataclass field that does not change results and is left out of content keys."""
    return field(default=default, metadata={"runtime": True})


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


@dataclass(frozen=True)
class SimConfig:
    """Lift episodes collected in the simulator (:mod:`rsjax.sim`)."""

    episodes: int = 200
    test_episodes: int = 20  # the last ones of the collection, never seen in training
    frames: int = 16
    control_steps: int = 4  # 20 Hz control steps between frames; a frame's action is their concatenation
    image_size: int = 64
    camera: str = "agentview"
    tracks: int = 256  # N₀: dense keypoint tracks per clip
    seed: int = 0
    workers: int = runtime(0)  # 0: one process per core

    def __post_init__(self) -> None:
        _require(self.frames >= 2, f"sim.frames is {self.frames}; a clip needs at least 2 frames")
        _require(
            0 < self.test_episodes < self.episodes,
            f"sim.test_episodes is {self.test_episodes}; it must lie between 1 and sim.episodes - 1 "
            f"({self.episodes - 1}), so that both splits have clips",
        )
        for name in ("control_steps", "image_size", "tracks"):
            _require(getattr(self, name) > 0, f"sim.{name} is {getattr(self, name)}; it must be positive")

    @property
    def action_dim(self) -> int:
        """Width of one frame's action: ``control_steps`` controls of 7 (6-D pose delta, gripper)."""
        return 7 * self.control_steps


@dataclass(frozen=True)
class TokenizerConfig:
    """MAGVIT-2 encoder and decoder with lookup-free quantisation (reference: Open-MAGVIT2)."""

    image_size: int = 256
    patch_size: int = 1  # space-to-depth before the first convolution; 1 is MAGVIT-2, more is cheap on CPUs
    channels: int = 128
    channel_multipliers: tuple[int, ...] = (1, 1, 2, 2, 4)  # one level each; every level but the last halves
    res_blocks: int = 2
    norm_groups: int = 32
    code_bits: int = 18  # D: one token is D bits, a vocabulary of 2^D
    vocabularies: int = 2  # the 2^D vocabulary is factorised into this many of 2^(D/n)
    # Paper: depth is tokenized by the same MAGVIT-2; its colour map is unpublished (see tokenizer/depth_color).
    depth_scale: Literal["linear", "inverse"] = "inverse"

    def __post_init__(self) -> None:
        _require(
            self.image_size % self.downsampling == 0,
            f"tokenizer.image_size {self.image_size} is not divisible by the downsampling {self.downsampling} "
            f"(patch_size × 2^(levels - 1)); change image_size, patch_size or channel_multipliers",
        )
        _require(
            self.code_bits % self.vocabularies == 0,
            f"tokenizer.code_bits {self.code_bits} does not divide into {self.vocabularies} vocabularies; "
            f"make code_bits a multiple of tokenizer.vocabularies",
        )
        for multiplier in self.channel_multipliers:
            _require(
                (self.channels * multiplier) % self.norm_groups == 0,
                f"tokenizer.norm_groups {self.norm_groups} does not divide {self.channels * multiplier} channels; "
                f"change tokenizer.channels or tokenizer.norm_groups",
            )

    @property
    def downsampling(self) -> int:
        """α: pixels of the image per token cell, along each side."""
        return self.patch_size * 2 ** (len(self.channel_multipliers) - 1)

    @property
    def grid(self) -> int:
        """H' = W': token cells along each side."""
        return self.image_size // self.downsampling


@dataclass(frozen=True)
class OptimizerConfig:
    """Linear warm-up, a cosine to ``final_share`` of the peak, and clipping by the global norm.

    ``muon`` orthogonalises the updates of the blocks' matrices (at AdamW's scale) and leaves the rest to AdamW with
    Nesterov momentum. The paper does not name its optimizer; the public Genie uses AdamW.
    """

    kind: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    warmup_steps: int = 50
    final_share: float = 0.05
    beta1: float = 0.9
    beta2: float = 0.95
    weight_decay: float = 0.0
    grad_clip: float = 1.0


@dataclass(frozen=True)
class LoopConfig:
    """A training loop: what the tokenizer's and the world model's have in common."""

    steps: int = 1000
    batch_size: int = 8  # over all devices
    optimizer: OptimizerConfig = OptimizerConfig()
    ema: float = 0.0  # decay of the averaged weights that later stages use; 0: none are kept
    seed: int = 0
    log_every: int = runtime(20)
    checkpoint_every: int = runtime(200)
    # jit: one device. pmap: data parallel over all local ones. auto: over as many of them as divide the batch.
    placement: Literal["auto", "jit", "pmap"] = runtime("auto")

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "log_every", "checkpoint_every"):
            value = getattr(self, name)
            _require(value > 0, f"{name} of a training loop is {value}; it must be positive")


@dataclass(frozen=True)
class TokenizerTrainConfig(LoopConfig):
    """How the tokenizer is trained. The adversarial and LPIPS terms join with the full-size presets.

    ``batch_size`` counts clips, of which ``frames_per_clip`` frames each are drawn. Weights are named as their terms.
    """

    frames_per_clip: int = 4
    depth_share: float = 0.25  # of the drawn frames: their colourised depth map is taken instead
    l1: float = 1.0
    l2: float = 0.0  # not in the reference, which has LPIPS; small models reach a higher PSNR with it
    entropy: float = 0.1
    entropy_temperature: float = 0.01
    commitment: float = 0.25

    @property
    def weights(self) -> dict[str, float]:
        """The weights of the loss terms, by term name."""
        return {name: getattr(self, name) for name in ("l1", "l2", "entropy", "commitment")}


@dataclass(frozen=True)
class ModelConfig:
    """The dual-branch spatial-temporal transformer (paper §2.3)."""

    frames: int = 16
    grid: int = 16
    code_bits: int = 18
    vocabularies: int = 2
    action_dim: int = 28  # of what the action encoder sees
    # The encoder also sees the sum of all actions so far (action_dim doubles). Where actions are pose deltas, that is
    # the pose: a large model finds it by temporal attention, a small one on few steps need not. Not in the paper.
    integrate_actions: bool = False
    width: int = 256
    blocks: int = 32
    heads: int = 8
    mlp_ratio: int = 4
    depth: bool = True  # False: the second branch and the projections do not exist at all
    # The public Genie normalises before spatial attention and the MLP, not before temporal attention and
    # not at the end; small models on few steps learn faster with both.
    temporal_norm: bool = False
    final_norm: bool = False
    embed_std: float = 1.0  # token embeddings ~ N(0, std²); 1 is torch's default and so the public code's
    position_std: float = 0.0  # position and mask embeddings likewise; the public code starts them at zero
    compute_dtype: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        _require(
            self.width % self.heads == 0,
            f"model.width {self.width} is not divisible by model.heads {self.heads}; change one of them",
        )
        _require(
            self.code_bits % self.vocabularies == 0,
            f"model.code_bits {self.code_bits} does not divide into {self.vocabularies} vocabularies; "
            f"make it a multiple of model.vocabularies",
        )

    @property
    def vocabulary_size(self) -> int:
        """Codes per factorised vocabulary: 2^(D/n)."""
        return 2 ** (self.code_bits // self.vocabularies)


@dataclass(frozen=True)
class MaskConfig:
    """Masked training with corruption, after the public Genie (reference: 1xgpt).

    Rates are probabilities; see :mod:`rsjax.objective.masking` for the recipe's three steps.
    """

    prompt_frames: int = 1  # frames given at generation; the paper gives one
    random_token_rate: float = 0.2  # step 1: u·rate of all sub-tokens are replaced, u ~ U(0, 1)
    corruption_probability: float = 0.5  # step 2 happens to this share of the batches
    corruption_keep: float = 0.25  # step 2: r ~ U(keep, 1) of a frame's sub-tokens survive …
    corruption_decay: float = 0.9  # … and r shrinks by U(decay, 1) with every frame

    def __post_init__(self) -> None:
        _require(self.prompt_frames >= 1, f"mask.prompt_frames is {self.prompt_frames}; at least 1 frame is given")


@dataclass(frozen=True)
class LossConfig:
    """Eq. 8: L = rgb·L_RGB + λ₁·L_Depth + λ₂·L_Keypoint + λ₃·L_Attention. Field names are term names."""

    rgb: float = 1.0
    depth: float = 1.0  # λ₁
    keypoint: float = 0.01  # λ₂
    attention: float = 1.0  # λ₃
    gamma: float = 5.0  # γ of Eq. 6
    keypoints: bool = True  # False: neither the keypoint nor the attention term exists
    num_keypoints: int = 32  # K of the top-K; the paper does not give its K

    def terms(self, depth_branch: bool) -> dict[str, float]:
        """The weights of the terms that are on, by term name."""
        weights = {"rgb": self.rgb}
        if depth_branch:
            weights["depth"] = self.depth
        if self.keypoints:
            weights |= {"keypoint": self.keypoint, "attention": self.attention}
        return weights


@dataclass(frozen=True)
class SampleConfig:
    """MaskGIT decoding within a frame."""

    steps: int = 2
    temperature: float = 0.0  # logits are divided by it; 0 takes the most probable code
    unmask: Literal["random", "greedy"] = "random"  # greedy tends to copy the frame before
    seed: int = 0

    def __post_init__(self) -> None:
        _require(self.steps >= 1, f"sample.steps is {self.steps}; a frame needs at least 1 decoding step")
        _require(self.temperature >= 0, f"sample.temperature is {self.temperature}; it cannot be negative")


@dataclass(frozen=True)
class EvalConfig:
    """Evaluation on held-out clips."""

    clips: int = 20
    batch_size: int = 10
    action_draws: int = 3  # random action sequences per clip and kind, for ΔPSNR
    report_clips: int = 4  # clips shown in the report

    def __post_init__(self) -> None:
        for name in ("batch_size", "action_draws", "report_clips"):
            _require(getattr(self, name) > 0, f"eval.{name} is {getattr(self, name)}; it must be positive")


@dataclass(frozen=True)
class Config:
    """One run. Built from a preset; never changed while it runs."""

    name: str
    sim: SimConfig = SimConfig()
    tokenizer: TokenizerConfig = TokenizerConfig()
    tokenizer_train: TokenizerTrainConfig = TokenizerTrainConfig()
    model: ModelConfig = ModelConfig()
    mask: MaskConfig = MaskConfig()
    loss: LossConfig = LossConfig()
    train: LoopConfig = LoopConfig()
    sample: SampleConfig = SampleConfig()
    eval: EvalConfig = EvalConfig()

    def __post_init__(self) -> None:
        _require(
            self.sim.frames <= self.model.frames,
            f"sim.frames is {self.sim.frames} but model.frames holds positions for {self.model.frames}; "
            f"shorten the clips or enlarge model.frames",
        )
        _require(
            self.mask.prompt_frames < self.sim.frames,
            f"mask.prompt_frames is {self.mask.prompt_frames} of {self.sim.frames} frames; "
            f"at least one frame must be left to predict",
        )
        _require(
            min(self.eval.clips, self.sim.test_episodes) >= 2,
            f"eval.clips is {self.eval.clips} of sim.test_episodes {self.sim.test_episodes}; both must be at least 2, "
            f"so that a clip can be generated under another one's actions",
        )
        pairs = (
            ("sim.image_size", self.sim.image_size, "tokenizer.image_size", self.tokenizer.image_size),
            ("tokenizer grid", self.tokenizer.grid, "model.grid", self.model.grid),
            ("tokenizer.code_bits", self.tokenizer.code_bits, "model.code_bits", self.model.code_bits),
            ("tokenizer.vocabularies", self.tokenizer.vocabularies, "model.vocabularies", self.model.vocabularies),
            ("what the action encoder sees", self.action_inputs, "model.action_dim", self.model.action_dim),
        )
        for left, left_value, right, right_value in pairs:
            _require(left_value == right_value, f"{left} is {left_value} but {right} is {right_value}; make them equal")
        _require(
            not self.loss.keypoints or self.loss.num_keypoints <= self.sim.tracks,
            f"loss.num_keypoints is {self.loss.num_keypoints} but only sim.tracks = {self.sim.tracks} are tracked",
        )

    @property
    def action_inputs(self) -> int:
        """Width of what the action encoder sees: 7 × control_steps, and as much again for their sums if given."""
        return self.sim.action_dim * (2 if self.model.integrate_actions else 1)


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON-ready values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(kind: type[T], values: dict[str, Any]) -> T:
    """The inverse of :func:`to_dict`.

    Raises:
        ConfigError: a field is unknown or missing, as in a file written by another version.
    """
    hints = typing.get_type_hints(kind)
    unknown = set(values) - set(hints)
    _require(not unknown, f"{kind.__name__} has no field {', '.join(sorted(unknown))}; the file is of another version")
    fields = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(hints[name], value)
        fields[name] = tuple(value) if isinstance(value, list) else value
    return kind(**fields)


def content_key(*parts: Any) -> str:
    """16 hex digits that change exactly when the results of ``parts`` would.

    Args:
        parts: config dataclasses (runtime fields are left out), strings or numbers.
    """
    return hashlib.sha256(json.dumps([_content(p) for p in parts], sort_keys=True).encode()).hexdigest()[:16]


def _content(part: Any) -> Any:
    if not dataclasses.is_dataclass(part):
        return part
    kept = [f.name for f in dataclasses.fields(part) if not f.metadata.get("runtime")]
    return {"": type(part).__name__} | {name: _content(getattr(part, name)) for name in kept}
