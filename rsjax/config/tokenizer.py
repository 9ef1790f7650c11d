"""Settings of the tokenizer and of its training."""

from dataclasses import dataclass
from typing import Literal

from rsjax.config.fields import require
from rsjax.config.train import LoopConfig


@dataclass(frozen=True)
class TokenizerConfig:
    """MAGVIT-2 encoder and decoder with lookup-free quantisation (reference: Open-MAGVIT2)."""

    image_size: int = 256
    patch_size: int = 1  # space-to-depth before the first convolution; 1 is MAGVIT-2, more is cheap on CPUs
    channels: int = 128
    channel_multipliers: tuple[int, ...] = (1, 1, 2, 2, 4)  # one level each; every level but the last halves
    res_blocks: int = 2
    norm_groups: int = 32
    # Both public generations: the older has 2 residual blocks a level and False, the newer 4 and True.
    adaptive_norm: bool = False  # normalise each level of the decoder by the codes' statistics
    code_bits: int = 18  # D: one token is D bits, a vocabulary of 2^D
    vocabularies: int = 2  # the 2^D vocabulary is factorised into this many of 2^(D/n)
    # Paper: depth is tokenized by the same MAGVIT-2; its colour map is unpublished (see tokenizer/depth_color).
    depth_scale: Literal["linear", "inverse"] = "inverse"

    def __post_init__(self) -> None:
        require(
            self.image_size % self.downsampling == 0,
            f"tokenizer.image_size {self.image_size} is not divisible by the downsampling {self.downsampling} "
            f"(patch_size × 2^(levels - 1)); change image_size, patch_size or channel_multipliers",
        )
        require(
            self.code_bits % self.vocabularies == 0,
            f"tokenizer.code_bits {self.code_bits} does not divide into {self.vocabularies} vocabularies; "
            f"make code_bits a multiple of tokenizer.vocabularies",
        )
        require(
            not self.adaptive_norm or self.grid > 1,
            "tokenizer.adaptive_norm needs a grid of more than one cell, for a variance; enlarge tokenizer.image_size",
        )
        for multiplier in self.channel_multipliers:
            require(
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
class TokenizerTrainConfig(LoopConfig):
    """How the tokenizer is trained. The defaults are the reference's reconstruction, without its networks that judge.

    ``batch_size`` counts clips, of which ``frames_per_clip`` frames each are drawn. Weights are named as their terms.
    """

    # Not a runtime field here: the codes' entropy, the discriminator's normalisation and LeCAM go by each part.
    accumulate: int = 1
    frames_per_clip: int = 4
    depth_share: float = 0.25  # of the drawn frames: their colourised depth map is taken instead
    flip: bool = False  # mirror half of the images
    l1: float = 1.0
    l2: float = 0.0  # not in the reference, which has LPIPS; small models reach a higher PSNR with it
    perceptual: float = 0.0  # LPIPS, 1.0 in the reference; off where lpips_weights is empty
    lpips_weights: str = ""  # a safetensors file as rsjax.tokenizers.lpips.load_lpips reads it
    entropy: float = 0.1
    entropy_temperature: float = 0.01
    commitment: float = 0.25
    adversarial: float = 0.0  # the generator's term, 0.1 in the reference; 0: there is no discriminator at all
    hinge: float = 0.5  # the discriminator's loss
    lecam: float = 0.005  # its regulariser; 0.05 for the newer generation
    lecam_decay: float = 0.999  # of the averages of its logits
    disc_start: int = 0  # the step from which the adversarial terms count

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.adversarial >= 0, f"tokenizer_train.adversarial is {self.adversarial}; it cannot be negative")

    @property
    def lpips_missing(self) -> bool:
        """Whether the LPIPS term is asked for but has no weights, and so is off."""
        return self.perceptual > 0 and not self.lpips_weights

    @property
    def weights(self) -> dict[str, float]:
        """The weights of the loss terms that are on, by term name. The logits are logged, not minimised."""
        names = ["l1", "l2", "entropy", "commitment"]
        if self.perceptual > 0 and self.lpips_weights:
            names.append("perceptual")
        if not self.adversarial:
            return {name: getattr(self, name) for name in names}
        names += ["adversarial", "hinge", "lecam"]
        return {name: getattr(self, name) for name in names} | {"real_logit": 0.0, "fake_logit": 0.0}
