"""Settings of the families that predict tokens, RoboScape and Genie: masking, sampling, losses and the network."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import loss_weights, require, require_range, runtime, sampling
from rsjax.config.model import ModelConfig, register_family

ActionEncoder = Literal["linear", "mlp", "norms", "none"]
SHIFT_PIXELS = 4  # how far the copies of Departures.shifts are moved at most: the side of a token in ``tiny``


@dataclass(frozen=True)
class CorruptionConfig:
    """Random codes among the training tokens, as in the public Genie (:mod:`rsjax.models.roboscape.masking`)."""

    random_token_rate: float = 0.2  # step 1: u·rate of all sub-tokens are replaced, u ~ U(0, 1)
    probability: float = 0.5  # step 2 applies to this share of the batches

    def __post_init__(self) -> None:
        require_range(self, "model.corruption", 0, 1, "random_token_rate", "probability")


@dataclass(frozen=True)
class BackwardsConfig:
    """Lets training clips run backwards, with the actions that lead back.

    :mod:`rsjax.models.roboscape.departures.backwards` says how. It is only for actions of one step each: those of
    several in a row (``sim.control_steps``) do not lead back.
    """

    share: float = 0.5  # of the clips that are drawn
    # Dimensions of an action that are states, such as a gripper's opening; the others are steps, whose sign changes.
    held: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        require_range(self, "model.backwards", 0, 1, "share")


@dataclass(frozen=True)
class PublicCodeConfig:
    """Options of the public Genie that published weights may use; ``rsjax convert`` sets them."""

    qk_norm: bool = False  # one LayerNorm normalises each head's queries and keys, in place of norm1 and norm2
    mup: bool = False  # attention scale 8/head width instead of 1/√(head width); the heads' input ÷ (width/256)
    mlp_ratio: int = 4  # width of an MLP's hidden layer, in widths of the model

    def __post_init__(self) -> None:
        require_range(self, "model.public_code", 1, math.inf, "mlp_ratio")


@dataclass(frozen=True)
class StateHeadsConfig:
    """Heads that read success, the object's height and the gripper's opening from the network's features.

    :mod:`rsjax.models.roboscape.departures.state_heads` defines them and their losses, of which a field ``NAME_weight``
    weighs the loss NAME; 0 switches it off.
    """

    success_weight: float = 1.0  # of the cross-entropy of success
    height_weight: float = 1.0  # of the error of the object's height
    opening_weight: float = 1.0  # of the error of the gripper's opening

    def __post_init__(self) -> None:
        names = ("success_weight", "height_weight", "opening_weight")
        require_range(self, "model.state_heads", 0, math.inf, *names)
        require(
            bool(loss_weights(self)),
            "model.state_heads is on, but all its weights are 0, so nothing would train the heads; set one above 0, or "
            "state_heads to off",
        )


@dataclass(frozen=True)
class Departures:
    """What the paper does not have. All are off by default; :mod:`rsjax.models.roboscape.departures` implements them.

    Others are values of fields that the method has anyway, off by default too: those of sampling in
    :class:`SampleConfig` (``mean_codes``, ``read_means``, ``guidance``, ``keep_still``), the keypoint terms in
    :class:`LossConfig`, and ``model.action_encoder`` "norms".
    """

    # Input of the network.
    # The action encoder also reads the sum of all actions so far, which doubles its input. For small models whose
    # actions are pose deltas: the sum is the pose, which a large model finds by temporal attention.
    integrate_actions: bool = False
    # Every frame's input also contains the tokens of the frame before it, cell by cell, embedded by a separate table.
    # In training these are visible even where that frame is masked, as past frames are in sampling.
    read_previous: bool = False
    # With read_previous: all cells of every frame but a clip's first stay masked, so that each frame is predicted as a
    # whole and decoded in one pass instead of two; further decoding steps gain nothing.
    whole_frames: bool = False
    # The share of training clips whose actions are replaced by a learned null action, for guidance in sampling.
    action_dropout: float = 0.0

    # The network.
    # Temporal queries and keys are rotated, and a rollout can go on beyond the trained frames with a rolling cache;
    # positions within a frame stay learned.
    rotary: bool = False
    # Norms before temporal attention and before the heads: small models trained for few steps learn faster with them.
    more_norms: bool = False
    # Token, position and mask embeddings begin as N(0, this²); 0: tokens as N(0, 1), the others at 0, as in the public
    # code.
    embedding_std: float = 0.0

    # Training.
    # Copies of each training clip, moved by a few pixels. A step draws one of them or the clip. Few clips last longer
    # with copies: a scene that is moved by less than a token has new tokens everywhere.
    shifts: int = 0
    # The share of the clips in which all frames before a random one stay visible, as past frames are in sampling.
    visible_prefix: float = 0.0
    # With whole_frames: after self_conditioning_after steps, in this share of the steps, every frame is predicted from
    # the model's own prediction of the frame before (its mean codes), as in a rollout. Such a step takes a third more
    # work.
    self_conditioning: float = 0.0
    self_conditioning_after: int = 0  # steps; later where the model's own predictions are useless at first

    # The keypoint terms.
    # The anchor of Eq. 5 is the code of the true first frame, not ŝ₁, the output at frame 1: this is the prompt, which
    # is never masked, so no cross-entropy trains ŝ₁.
    observed_anchor: bool = False
    # M_i, Eq. 5 and Eq. 6 leave out the frames in which a point is hidden or outside the picture.
    visible_keypoints: bool = False

    def __post_init__(self) -> None:
        require_range(self, "model.departures", 0, 1, "visible_prefix", "self_conditioning")
        require_range(self, "model.departures", 0, math.inf, "shifts", "embedding_std", "self_conditioning_after")
        require(
            0 <= self.action_dropout < 1,
            f"model.departures.action_dropout is {self.action_dropout}; it is a share of the clips, at least 0 and "
            f"below 1",
        )
        require(
            self.read_previous or not self.whole_frames,
            "model.departures.whole_frames masks all frames but the first, and read_previous is off, so the model "
            "would see no other frame; switch it on",
        )
        require(
            self.whole_frames or not self.self_conditioning,
            f"model.departures.self_conditioning is {self.self_conditioning}, but without whole_frames no single pass "
            f"predicts all frames; switch that on, or set self_conditioning to 0",
        )
        require(
            not (self.whole_frames and self.visible_prefix),
            f"model.departures.visible_prefix is {self.visible_prefix}, but whole_frames leaves no frame visible after "
            f"the first; set one of them to 0 or False",
        )


@dataclass(frozen=True)
class KeepStillConfig:
    """Mixes generated frames with the prompt's last one (:mod:`rsjax.models.roboscape.departures.keep_still`)."""

    noise: float = 10.0  # σ, the error of decoded frames, in grey levels; more keeps more of the prompt
    blur: float = 0.25  # standard deviation of the Gaussian over changes, in widths of a token

    def __post_init__(self) -> None:
        require(self.noise > 0, f"model.sample.keep_still.noise is {self.noise}; it must be above 0")
        require_range(self, "model.sample.keep_still", 0, math.inf, "blur")


@dataclass(frozen=True)
class SampleConfig:
    """Settings of MaskGIT decoding within a frame, and of the memory from frame to frame."""

    steps: int = 2  # decoding steps per frame; each is a pass of the network
    # Logits are divided by it; 0 takes the most probable code. The public Genie divides probabilities, which are then
    # normalised again, so that every temperature above 0 samples as 1 does here.
    temperature: float = 0.0
    top_k: int = 0  # draw from the k most probable codes of each vocabulary; 0: from all
    unmask: Literal["random", "greedy"] = "random"  # greedy tends to copy the previous frame
    # Frames are decoded from each cell's mean code under the model's probabilities, not from its most probable one.
    # They are closer to the truth, and blurred where the model is unsure. Only at temperature 0.
    mean_codes: bool = False
    # With mean_codes: later frames read the mean codes too, not the most probable ones, so that they know where the
    # model was unsure.
    read_means: bool = False
    # g in logits = without + g·(with - without the actions). 1: no guidance. Other values need
    # model.departures.action_dropout and double the work.
    guidance: float = 1.0
    # Learned positions only: when the window is full, its first window_stride frames are dropped and the others encoded
    # again from position 0. A smaller stride gives a longer memory and more work. 0: half of the positions.
    window_stride: int = 0
    cache_dtype: Literal["float32", "bfloat16"] = "float32"  # of temporal keys and values; bfloat16 halves the memory
    seed: int = 0  # of the draws; another one gives other videos of the same clips
    keep_still: KeepStillConfig | None = None  # on for fixed cameras and tokenizers that blur

    def __post_init__(self) -> None:
        require(self.steps >= 1, f"model.sample.steps is {self.steps}; a frame needs at least 1 decoding step")
        for name in ("temperature", "top_k", "window_stride"):
            value = getattr(self, name)
            require(value >= 0, f"model.sample.{name} is {value}; it cannot be negative")

    @property
    def compiled(self) -> "SampleConfig":
        """The settings without those that change no compiled program."""
        return replace(self, seed=0, keep_still=None)

    @property
    def shows_means(self) -> bool:
        """Whether frames are decoded from mean codes."""
        return self.mean_codes and self.temperature == 0

    @property
    def reads_means(self) -> bool:
        """Whether later frames read mean codes."""
        return self.read_means and self.shows_means


def check_sampling(sample: SampleConfig, positions: int, action_dropout: float) -> None:
    """Raises :class:`rsjax.config.ConfigError` if a model with this many positions does not support these settings."""
    require(
        sample.guidance == 1 or action_dropout > 0,
        f"model.sample.guidance is {sample.guidance} but the model never saw clips without actions; "
        f"set it to 1, or train with model.departures.action_dropout above 0",
    )
    require(
        sample.window_stride < positions,
        f"model.sample.window_stride is {sample.window_stride} of {positions} positions; "
        f"at least one frame must stay in the window",
    )


@dataclass(frozen=True)
class LossConfig:
    """Eq. 8: L = L_RGB + λ₁·L_Depth + λ₂·L_Keypoint + λ₃·L_Attention.

    A field ``NAME_weight`` weighs the term NAME; 0 switches it off. L_RGB has the weight 1.
    """

    depth_weight: float = 1.0  # λ₁
    keypoint_weight: float = 0.01  # λ₂
    attention_weight: float = 1.0  # λ₃
    gamma: float = 5.0  # γ of Eq. 6
    # How Eq. 6 weighs cells. printed: Eq. 7, a second cross-entropy beside L_RGB. normalised: weights of the mean 1 on
    # the one cross-entropy, whose weight is 1; contact: the same, spent on points that rest before they move instead of
    # on those that move most (rsjax.models.roboscape.departures.normalised_attention).
    attention: Literal["printed", "normalised", "contact"] = "printed"
    # The keypoint term. printed: Eq. 5, whose minimum is not the truth. Not in the paper, each in a file of
    # rsjax.models.roboscape.departures: difference (keypoint_difference), the change of a point's code from frame to
    # frame; motion (motion_head), where each point goes; feature (keypoint_features), the network's features along a
    # track. none: neither a keypoint term nor Eq. 7.
    keypoints: Literal["none", "printed", "difference", "motion", "feature"] = "printed"
    num_keypoints: int = 32  # K of the top-K, at most all tracks; the paper does not give its K

    def __post_init__(self) -> None:
        require_range(self, "model.loss", 0, math.inf, "depth_weight", "keypoint_weight", "attention_weight", "gamma")
        require(self.num_keypoints >= 1, f"model.loss.num_keypoints is {self.num_keypoints}; it must be at least 1")


@dataclass(frozen=True)
class TransformerConfig:
    """A spatial-temporal transformer on token grids, with one branch or two."""

    # linear: one linear layer, added to the features (RoboScape). mlp: an MLP, added too (the paper's Genie with
    # actions), whose last layer starts at zero, so that public weights keep their logits. norms: one linear layer, from
    # which every block's adaptive norms are read (rsjax.models.roboscape.departures.adaptive_norms). none: no actions
    # (the public Genie).
    action_encoder: ActionEncoder = "linear"
    width: int = 256  # channels; the size of a model in the paper: 256, 512 or 1024
    blocks: int = 32  # of each branch
    heads: int = 8  # of each attention; more where a head would be wider than 64 channels
    # bfloat16: operands of linear layers (accumulated in float32) and of attention within frames of 128 cells or more;
    # on an accelerator also the features between layers. Parameters, norms' statistics, logits, softmaxes and the loss
    # stay float32. CPUs without bf16 units still multiply linear layers in float32, which is faster there.
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    unroll: int = runtime(1)  # blocks per iteration of the scan; more are faster on a CPU and compile longer
    # What the backward pass recomputes. none: nothing. blocks: everything but each block's inputs and a depth block's
    # output. products: the same, but linear layers' outputs are kept too (less work, more memory).
    remat: Literal["none", "products", "blocks"] = runtime("none")
    public_code: PublicCodeConfig | None = None  # on only for published weights
    departures: Departures = Departures()  # what the paper does not have

    def __post_init__(self) -> None:
        for name in ("width", "blocks", "heads", "unroll"):
            require(getattr(self, name) >= 1, f"model.{name} is {getattr(self, name)}; it must be at least 1")
        require(
            self.width % self.heads == 0,
            f"model.width {self.width} is not divisible by model.heads {self.heads}; change one of them",
        )
        departures = self.departures
        require(
            not departures.rotary or self.head_width % 2 == 0,
            f"model.departures.rotary turns pairs of channels, but a head has {self.head_width} "
            f"(model.width / model.heads); change one of them",
        )
        require(
            self.action_encoder != "none" or not (departures.integrate_actions or departures.action_dropout),
            "model.action_encoder is none, so there are no actions for model.departures.integrate_actions or "
            "model.departures.action_dropout; set them to False and 0",
        )
        require(
            self.action_encoder != "norms" or not self.public.qk_norm,
            "model.action_encoder is norms, but model.public_code.qk_norm leaves the blocks without norms; change one",
        )

    @property
    def head_width(self) -> int:
        """Channels of one attention head."""
        return self.width // self.heads

    @property
    def public(self) -> PublicCodeConfig:
        """The options of the public code, which are all off without ``public_code``."""
        return self.public_code or PublicCodeConfig()


@dataclass(frozen=True)
class TokenModelConfig(TransformerConfig, ModelConfig):
    """Settings that RoboScape and Genie share: a transformer trained on masked tokens and sampled with MaskGIT.

    Attributes:
        max_frames: positions in time, and how many frames temporal attention covers; 0: the clips' frames.
    """

    uses_tokenizer: ClassVar[bool] = True
    max_frames: int = 0
    corruption: CorruptionConfig | None = CorruptionConfig()  # off: models of few steps lose more than they gain
    state_heads: StateHeadsConfig | None = None  # on where a model is to judge success itself
    backwards: BackwardsConfig | None = None  # on for few clips, in which a scene seldom moves both ways
    sample: SampleConfig = sampling(SampleConfig())  # how frames are generated; may change after training

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.backwards is None or self.state_heads is None,
            "model.backwards and model.state_heads are on, but a clip that runs backwards has no labels of the state; "
            "switch one off",
        )

    @property
    def takes_actions(self) -> bool:
        return self.action_encoder != "none"

    @property
    def scanned(self) -> int:
        return self.blocks

    @property
    def keypoint_term(self) -> str:
        """The keypoint term that the model trains with (:attr:`LossConfig.keypoints`); "none" also if λ₂ is 0."""
        return "none"

    @property
    def state_weights(self) -> dict[str, float]:
        """The weights of the losses of the state heads by name; empty without heads."""
        if self.state_heads is None:
            return {}
        return loss_weights(self.state_heads)

    def frames(self, clips: ClipShape) -> int:
        """Returns the number of positions in time for such clips."""
        return self.max_frames or clips.frames

    @property
    def token_shifts(self) -> tuple[int, ...]:
        if not self.departures.shifts:
            return ()
        return self.departures.shifts, SHIFT_PIXELS

    def check(self, clips: ClipShape) -> None:
        require(
            clips.frames <= self.frames(clips),
            f"clips have {clips.frames} frames but model.max_frames is {self.max_frames}; shorten the clips, or set "
            f"it to 0 (as many as the clips have)",
        )
        check_sampling(self.sample, self.frames(clips), self.departures.action_dropout)
        held = self.backwards.held if self.backwards else ()
        require(
            all(0 <= number < clips.action_dim for number in held),
            f"model.backwards.held is {held}, but actions have the dimensions 0 to {clips.action_dim - 1}",
        )


@dataclass(frozen=True)
class DepthBranch:
    """The paper's way: a second branch of blocks predicts depth (Eq. 2), and its features join RGB's (Eq. 3)."""

    kind: ClassVar[Literal["branch"]] = "branch"


@dataclass(frozen=True)
class SmallDepthBranch:
    """A depth branch as in the paper, but narrower, shallower or at coarser cells, and so cheaper, than RGB's.

    With another width or coarser cells it has positions and an action encoder of its own, and W^l of Eq. 3 is
    rectangular.
    """

    kind: ClassVar[Literal["small_branch"]] = "small_branch"
    width: int = 0  # channels, a multiple of a head's, which is as wide as RGB's; 0: as many as RGB's
    # A divisor of RGB's; 0: as many. They are spread evenly: of RGB's blocks, every (blocks / these)-th, from the first
    # on, has one beside it, so that geometry joins RGB at every level (Eq. 3), and RGB blocks follow that use it.
    blocks: int = 0
    # Cells of depth are cells × cells tokens, embedded together. The features of a cell join RGB in all of them, and
    # the head predicts all of its tokens.
    cells: int = 1

    def __post_init__(self) -> None:
        require_range(self, "model.depth", 0, math.inf, "width", "blocks")
        require_range(self, "model.depth", 1, math.inf, "cells")


@dataclass(frozen=True)
class DepthHead:
    """Depth tokens are embedded beside RGB's in one branch of blocks, and a second head on its output predicts them.

    This is multi-task learning without Eq. 3. It costs two embeddings and a head, under 1 % of the operations.
    """

    kind: ClassVar[Literal["head"]] = "head"
    # Whether the network reads depth tokens, true ones in training and its own in generation. False: it reads RGB's
    # alone, and generation without depth leaves the head out, which changes no token of RGB.
    feed_back: bool = True


@dataclass(frozen=True)
class NoDepth:
    """The model neither reads nor predicts depth."""

    kind: ClassVar[Literal["none"]] = "none"


@register_family("roboscape")
@dataclass(frozen=True)
class RoboScapeConfig(TokenModelConfig):
    """RoboScape: the dual-branch transformer with the physics-informed objective (paper §2.3)."""

    depth: DepthBranch | SmallDepthBranch | DepthHead | NoDepth = DepthBranch()  # how depth is used
    loss: LossConfig = LossConfig()  # λ₁, λ₂, λ₃ and γ

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.depth, SmallDepthBranch):
            return
        require(
            self.depth.width % self.head_width == 0,
            f"model.depth.width is {self.depth.width}; make it a multiple of {self.head_width}, the channels of an "
            f"attention head (model.width / model.heads)",
        )
        require(
            self.depth.blocks == 0 or self.blocks % self.depth.blocks == 0,
            f"model.depth.blocks is {self.depth.blocks}, which does not divide model.blocks {self.blocks}; change one "
            f"of them",
        )

    @property
    def scanned(self) -> int:
        if isinstance(self.depth, SmallDepthBranch) and self.depth.blocks:
            return self.depth.blocks
        return self.blocks

    @property
    def uses_depth(self) -> bool:
        return not isinstance(self.depth, NoDepth)

    @property
    def keypoint_term(self) -> str:
        if "keypoint" in self.loss_weights:
            return self.loss.keypoints
        return "none"

    @property
    def marked_keypoints(self) -> int:
        return 0 if self.loss.keypoints == "none" else self.loss.num_keypoints

    @property
    def loss_weights(self) -> dict[str, float]:
        off = set() if self.uses_depth else {"depth"}
        off |= {"keypoint", "attention"} if self.loss.keypoints == "none" else set()
        weights = {"rgb": 1.0} | {name: x for name, x in loss_weights(self.loss).items() if name not in off}
        if "attention" in weights and self.loss.attention != "printed":
            # It takes the place of L_RGB, which is still logged.
            weights |= {"rgb": 0.0, "attention": 1.0}
        return weights | self.state_weights


@register_family("genie")
@dataclass(frozen=True)
class GenieConfig(TokenModelConfig):
    """Genie (reference: 1xgpt's STMaskGIT): RGB only, trained with cross-entropy only.

    With ``action_encoder`` "mlp" it is the paper's baseline, with "none" the public model.
    """

    action_encoder: ActionEncoder = "mlp"  # none: the public model without actions

    @property
    def loss_weights(self) -> dict[str, float]:
        return {"rgb": 1.0} | self.state_weights
