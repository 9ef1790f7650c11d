"""Settings of the world model, its masked training and its objective."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require, runtime


@dataclass(frozen=True)
class ModelConfig:
    """The dual-branch spatial-temporal transformer (paper §2.3)."""

    frames: int = 16
    grid: int = 16
    code_bits: int = 18
    vocabularies: int = 2
    action_dim: int = 28  # of what the action encoder sees; 0: there is no encoder, actions are not read (Genie)
    # The encoder also sees the sum of all actions so far (action_dim doubles). Where actions are pose deltas, that is
    # the pose: a large model finds it by temporal attention, a small one on few steps need not. Not in the paper.
    integrate_actions: bool = False
    width: int = 256
    blocks: int = 32
    heads: int = 8
    mlp_ratio: int = 4
    # Training shows a learned null action in place of all of this share of the clips' own, so that sampling can guide
    # (classifier-free). Not in the paper.
    action_dropout: float = 0.0
    # rotary: time enters by turning temporal queries and keys, positions within a frame stay learned. Then a rollout
    # rolls on beyond ``frames``, which is how far a frame looks back. The public code learns all positions.
    positions: Literal["learned", "rotary"] = "learned"
    depth: bool = True  # False: the second branch and the projections do not exist at all
    # The public Genie normalises before spatial attention and the MLP, not before temporal attention and
    # not at the end; small models on few steps learn faster with both.
    temporal_norm: bool = False
    final_norm: bool = False
    # Options of the public code that its published weights may have been trained with. qk_norm: queries and keys are
    # normalised per head, by one LayerNorm for both; the norms before spatial attention and the MLP then do not exist.
    qk_norm: bool = False
    mup: bool = False  # attention scale 8/head width instead of its root; the heads' input ÷ (width/256)
    embed_std: float = 1.0  # token embeddings ~ N(0, std²); 1 is torch's default and so the public code's
    position_std: float = 0.0  # position and mask embeddings likewise; the public code starts them at zero
    # bfloat16: operands of the linear layers' products (accumulated in float32) and, in frames of many cells or on an
    # accelerator, of the attention within frames. Parameters, norms and softmaxes stay float32.
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    unroll: int = runtime(1)  # blocks per turn of the scan over them: more are faster on a CPU, and compile longer
    # What the backward pass finds kept: none recomputes nothing, blocks keeps each block's input alone, products the
    # linear layers' outputs as well (less to compute again, more memory).
    remat: Literal["none", "products", "blocks"] = runtime("none")

    def __post_init__(self) -> None:
        for name in ("frames", "grid", "width", "blocks", "heads", "mlp_ratio", "unroll"):
            require(getattr(self, name) >= 1, f"model.{name} is {getattr(self, name)}; it must be at least 1")
        require(
            self.width % self.heads == 0,
            f"model.width {self.width} is not divisible by model.heads {self.heads}; change one of them",
        )
        require(
            self.code_bits % self.vocabularies == 0,
            f"model.code_bits {self.code_bits} does not divide into {self.vocabularies} vocabularies; "
            f"make it a multiple of model.vocabularies",
        )
        require(
            self.positions == "learned" or self.head_width % 2 == 0,
            f"model.positions is 'rotary', which turns pairs of channels, but a head has {self.head_width} "
            f"(model.width / model.heads); change one of them",
        )
        require(self.action_dim >= 0, f"model.action_dim is {self.action_dim}; it cannot be negative")
        require(
            self.action_dim > 0 or not (self.integrate_actions or self.action_dropout),
            "model.action_dim is 0, so there are no actions for model.integrate_actions or model.action_dropout; "
            "set them to False and 0",
        )
        require(
            0 <= self.action_dropout < 1,
            f"model.action_dropout is {self.action_dropout}; it is a share of the clips, at least 0 and below 1",
        )

    @property
    def head_width(self) -> int:
        """Channels of one attention head."""
        return self.width // self.heads

    @property
    def vocabulary_size(self) -> int:
        """Codes per factorised vocabulary: 2^(D/n)."""
        return 2 ** (self.code_bits // self.vocabularies)


@dataclass(frozen=True)
class MaskConfig:
    """Masked training with corruption, after the public Genie (reference: 1xgpt).

    Rates are probabilities; see :mod:`rsjax.models.roboscape.masking` for the recipe's three steps.
    """

    prompt_frames: int = 1  # frames given at generation; the paper gives one
    random_token_rate: float = 0.2  # step 1: u·rate of all sub-tokens are replaced, u ~ U(0, 1)
    corruption_probability: float = 0.5  # step 2 happens to this share of the batches
    corruption_keep: float = 0.25  # step 2: r ~ U(keep, 1) of a frame's sub-tokens survive …
    corruption_decay: float = 0.9  # … and r shrinks by U(decay, 1) with every frame

    def __post_init__(self) -> None:
        require(self.prompt_frames >= 1, f"mask.prompt_frames is {self.prompt_frames}; at least 1 frame is given")


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
