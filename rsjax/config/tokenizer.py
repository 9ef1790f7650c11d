"""Settings of the tokenizer and its training."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

from rsjax.config.fields import fitting_sizes, require, require_range
from rsjax.config.train import TrainConfig

HINGE = 0.5  # weight of the discriminator's hinge loss, as in the reference


@dataclass(frozen=True)
class TokenizerConfig:
    """MAGVIT-2 encoder and decoder with lookup-free quantisation (reference: Open-MAGVIT2)."""

    patch_size: int = 1  # space-to-depth before the first convolution; 1 as in MAGVIT-2, larger is cheaper
    channels: int = 128  # of the first level; times its multiplier, of each other one
    channel_multipliers: tuple[int, ...] = (1, 1, 2, 2, 4)  # one per level; every level but the last halves the grid
    res_blocks: int = 2  # of each level, in the encoder and in the decoder
    norm_groups: int = 32  # of each group norm; smaller where it has to divide fewer channels
    # Normalises each level of the decoder by the codes' statistics. The older public generation has 2 residual blocks
    # per level and False, the newer 4 and True.
    adaptive_norm: bool = False
    # A cell's code depends on its own pixels alone: the encoder has convolutions of one cell, and norms of one cell
    # instead of the whole image. Otherwise a moving arm changes codes far from it, which the world model has to predict
    # too. Not in MAGVIT-2.
    local_codes: bool = False
    code_bits: int = 18  # D: one token is D bits, a vocabulary of 2^D; fewer are easier to predict, and coarser
    vocabularies: int = 2  # n: the vocabulary of 2^D is factorised into n of 2^(D/n)
    # The paper tokenizes depth with the same MAGVIT-2; its colour map is unpublished (see rsjax/data/depth_color.py).
    depth_scale: Literal["linear", "inverse"] = "inverse"

    # bfloat16: operands of convolutions, and on an accelerator the features between layers; norms, latents and losses
    # stay float32. CPUs without bf16 units still convolve in float32, which is faster there. The public code trains in
    # mixed half precision and is used in float32.
    compute_dtype: Literal["float32", "bfloat16"] = "float32"

    def __post_init__(self) -> None:
        sizes = ("patch_size", "channels", "res_blocks", "norm_groups", "code_bits", "vocabularies")
        require_range(self, "tokenizer", 1, math.inf, *sizes)
        require(
            bool(self.channel_multipliers) and min(self.channel_multipliers) >= 1,
            f"tokenizer.channel_multipliers are {self.channel_multipliers}; give one for each level, at least 1",
        )
        require(
            self.code_bits % self.vocabularies == 0,
            f"tokenizer.code_bits {self.code_bits} does not divide into {self.vocabularies} vocabularies; "
            f"make code_bits a multiple of tokenizer.vocabularies",
        )
        for multiplier in self.channel_multipliers:
            require(
                (self.channels * multiplier) % self.norm_groups == 0,
                f"tokenizer.norm_groups {self.norm_groups} does not divide {self.channels * multiplier} channels; "
                f"change tokenizer.channels or tokenizer.norm_groups",
            )

    @property
    def downsampling(self) -> int:
        """α: pixels per token cell along each side."""
        return self.patch_size * 2 ** (len(self.channel_multipliers) - 1)

    def grid(self, image_size: int) -> int:
        """Returns H' = W', the token cells along each side of an image.

        Raises:
            ConfigError: the downsampling does not divide the image size.
        """
        require(
            image_size % self.downsampling == 0,
            f"images have {image_size} pixels a side, which the downsampling {self.downsampling} of the tokenizer "
            f"(patch_size × 2^(levels - 1)) does not divide; take clips of "
            f"{fitting_sizes(image_size, self.downsampling, least=1 + self.adaptive_norm)} pixels, or change "
            f"tokenizer.patch_size or tokenizer.channel_multipliers",
        )
        grid = image_size // self.downsampling
        require(
            not self.adaptive_norm or grid > 1,
            "tokenizer.adaptive_norm needs a grid of more than one cell, for a variance; take larger images",
        )
        return grid

    @property
    def vocabulary_size(self) -> int:
        """Codes of each factorised vocabulary: 2^(D/n)."""
        return 2 ** (self.code_bits // self.vocabularies)


@dataclass(frozen=True)
class PerceptualConfig:
    """The LPIPS term, as in the reference."""

    weight: float = 1.0  # of the term; 1 as in the reference
    # A safetensors file of rsjax convert lpips; empty: the term is skipped, with a note.
    lpips: str = ""

    def __post_init__(self) -> None:
        require_range(self, "tokenizer_train.perceptual", 0, math.inf, "weight")


@dataclass(frozen=True)
class AdversarialConfig:
    """A discriminator beside the tokenizer, as in the reference. It needs images of a certain size."""

    weight: float = 0.1  # of the generator's term
    lecam_weight: float = 0.005  # of the discriminator's regulariser; 0.05 in the newer generation
    lecam_decay: float = 0.999  # of the regulariser's averages of the logits
    start: int = 0  # the first step with adversarial terms; later where reconstruction should settle first

    def __post_init__(self) -> None:
        require_range(self, "tokenizer_train.adversarial", 0, math.inf, "weight", "lecam_weight", "start")
        require_range(self, "tokenizer_train.adversarial", 0, 1, "lecam_decay")


@dataclass(frozen=True)
class TokenizerTrainConfig(TrainConfig):
    """Settings of the tokenizer's training. The defaults are the reference's, without LPIPS and discriminator.

    ``batch_size`` counts clips; ``frames_per_clip`` frames are drawn from each. A field ``NAME_weight`` weighs the
    loss term NAME.
    """

    section: ClassVar[str] = "tokenizer_train"

    # Not a runtime field here: the entropy, the discriminator's batch norm and LeCAM are computed for each part.
    accumulate: int = 1
    frames_per_clip: int = 4  # fewer make a batch of more clips, which differ more than frames of one clip do
    depth_share: float = 0.25  # share of the drawn frames that are replaced by their colourised depth map
    flip: bool = False  # mirror half of the images
    l1_weight: float = 1.0  # mean absolute error
    l2_weight: float = 0.0  # mean squared error; not in the reference; raises the PSNR of small models without LPIPS
    perceptual: PerceptualConfig | None = None  # on in the reference
    entropy_weight: float = 0.1  # higher spreads codes further, at the cost of reconstruction
    # Added to the average code's probabilities p in log p, as in the reference; 0: the true entropy.
    entropy_offset: float = 1e-5
    # Images that share an average code; 0: all of the batch, on all devices. 8 in the reference: those of one device.
    entropy_group: int = 0
    commitment_weight: float = 0.25  # pulls the encoder's output towards its codes
    adversarial: AdversarialConfig | None = None  # on in the reference

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range(self, "tokenizer_train", 0, math.inf, "entropy_group")
        require_range(self, "tokenizer_train", 1, math.inf, "frames_per_clip")
        require_range(self, "tokenizer_train", 0, 1, "depth_share")
        require(
            all(part.annotations == "own" for stage in self.curriculum for part in stage.components),
            "tokenizer_train.curriculum has estimated annotations, which only a world model can learn from; write them "
            "into train.curriculum",
        )
        images = self.batch_size // self.accumulate * self.frames_per_clip
        require(
            self.entropy_group == 0 or images % self.entropy_group == 0,
            f"tokenizer_train.entropy_group is {self.entropy_group}; it must divide the {images} images of a batch "
            f"(batch_size / accumulate × frames_per_clip), or be 0 for one average over all of them",
        )

    @property
    def lpips_missing(self) -> bool:
        """Whether the LPIPS term is on but has no file of weights, so that it is skipped."""
        return self.perceptual is not None and not self.perceptual.lpips

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weight of each active loss term by name; 0 for the discriminator's mean logits, which are only logged."""
        names = ["l1", "l2", "entropy", "commitment"]
        weights = {name: getattr(self, f"{name}_weight") for name in names}
        if self.perceptual is not None and self.perceptual.lpips:
            weights["perceptual"] = self.perceptual.weight
        if self.adversarial is not None:
            weights |= {"adversarial": self.adversarial.weight, "hinge": HINGE, "lecam": self.adversarial.lecam_weight}
            weights |= {"real_logit": 0.0, "fake_logit": 0.0}
        return weights
