"""Settings of iVideoGPT: the conditional VQ tokenizer and the LLaMA on its tokens."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from rsjax.config.data import ClipShape
from rsjax.config.fields import fitting_sizes, require, require_range, runtime, sampling
from rsjax.config.model import ModelConfig, register_family


@dataclass(frozen=True)
class ConditionalVQConfig:
    """The conditional VQ tokenizer; the defaults are the public network for 64² pixels."""

    context_frames: int = 1  # the first frames of a clip, which keep all their tokens
    patch_size: int = 1  # space-to-depth before the first convolution; 1 as in the public network, larger is cheaper
    widths: tuple[int, ...] = (128, 256, 512)  # one per level; every level but the last halves the grid
    res_blocks: int = 2  # of a level in the encoder; the decoder has one more
    norm_groups: int = 32  # of each group norm; smaller where it has to divide fewer channels
    latent: int = 64  # numbers of a code
    codes: int = 8192  # in each of the two codebooks
    future_patch: int = 4  # a later frame's token covers this many cells along each side
    attention_size: int = 16  # levels of at most this many cells a side attend to the context
    heads: int = 4  # of the attention to the context
    dropout: float = 0.1  # of weights and output of the attention to the context
    # Codes are initialised between ± this; 0: ± 1/codes, as in the public code, but a short training moves few of them.
    codebook_scale: float = 0.0
    codebook_weight: float = 1.0  # of the term that pulls codes towards the encoder's output
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # of the operands of 3×3 convolutions

    def __post_init__(self) -> None:
        sizes = ("context_frames", "patch_size", "res_blocks", "norm_groups", "latent", "codes", "future_patch")
        require_range(self, "model.autoencoder", 1, float("inf"), *sizes, "attention_size", "heads")
        require(
            0 <= self.dropout < 1,
            f"model.autoencoder.dropout is {self.dropout}; it is a share, at least 0 and below 1",
        )
        require(
            bool(self.widths) and all(w > 0 and w % self.norm_groups == 0 == w % self.heads for w in self.widths),
            f"model.autoencoder.widths are {self.widths}; give one for each level, divisible by norm_groups "
            f"{self.norm_groups} and heads {self.heads}",
        )

    @property
    def downsampling(self) -> int:
        """Pixels per cell along each side."""
        return self.patch_size * 2 ** (len(self.widths) - 1)

    def grid(self, image_size: int) -> int:
        """Returns the cells along each side of an image, which are the tokens of a context frame.

        Raises:
            ConfigError: the image does not divide into cells, or its cells do not divide into a later frame's tokens.
        """
        pixels = self.downsampling * self.future_patch
        most = self.attention_size // self.future_patch
        require(
            image_size % pixels == 0,
            f"images have {image_size} pixels a side, which {pixels} does not divide (model.autoencoder.patch_size × "
            f"2^(levels - 1) × future_patch); take clips of {fitting_sizes(image_size, pixels, most=most)} pixels, or "
            f"change widths, patch_size or future_patch",
        )
        grid = image_size // self.downsampling
        require(
            grid <= self.attention_size,
            f"model.autoencoder.attention_size is {self.attention_size}; it must be at least the grid of {grid} cells",
        )
        return grid

    def future_tokens(self, image_size: int) -> int:
        """Returns the number of tokens of a later frame."""
        return (self.grid(image_size) // self.future_patch) ** 2


@dataclass(frozen=True)
class TopKConfig:
    """Settings of sampling token by token."""

    temperature: float = 1.0  # logits are divided by it; 0 takes the most probable token
    top_k: int = 100  # draw from the k most probable tokens; 0: from all
    cache_dtype: Literal["float32", "bfloat16"] = "float32"  # of keys and values
    seed: int = 0  # of the draws; another one gives other videos of the same clips

    def __post_init__(self) -> None:
        require_range(self, "model.sample", 0, float("inf"), "temperature", "top_k")


@register_family("ivideogpt")
@dataclass(frozen=True)
class IVideoGPTConfig(ModelConfig):
    """A LLaMA on the tokens of :class:`ConditionalVQConfig`; the defaults are the public network."""

    uses_tokenizer: ClassVar[bool] = True
    autoencoder: ConditionalVQConfig = ConditionalVQConfig()  # trained first, or converted
    width: int = 768  # channels of the LLaMA
    blocks: int = 12  # of the LLaMA
    heads: int = 12  # of each attention; the width is theirs together
    mlp_width: int = 3072  # of an MLP's hidden layer
    # Tokens in one sequence. A longer rollout takes its last frames as the context of a new sequence.
    positions: int = 1024
    use_actions: bool = True  # False: the public action-free models
    integrate_actions: bool = False  # also the sum of all actions so far; see TransformerConfig
    dropout: float = 0.1  # of attention weights
    compute_dtype: Literal["float32", "bfloat16"] = "float32"  # bfloat16: operands of linear layers and attention
    unroll: int = runtime(1)  # blocks per iteration of the scan
    remat: Literal["none", "blocks"] = runtime("none")  # blocks: the backward pass keeps only the blocks' inputs
    sample: TopKConfig = sampling(TopKConfig())  # how tokens are drawn; may change after training

    def __post_init__(self) -> None:
        require_range(self, "model", 1, float("inf"), "width", "blocks", "heads", "mlp_width", "positions", "unroll")
        require(
            0 <= self.dropout < 1,
            f"model.dropout is {self.dropout}; it is a share, at least 0 and below 1",
        )
        require(
            self.width % (2 * self.heads) == 0,
            f"model.width {self.width} is not divisible by 2 × model.heads ({self.heads}), whose channels rotate in "
            f"pairs; change one of them",
        )
        require(
            self.use_actions or not self.integrate_actions,
            "model.use_actions is False, so there are none for model.integrate_actions; set it to False",
        )

    @property
    def own_autoencoder(self) -> ConditionalVQConfig:
        return self.autoencoder

    @property
    def takes_actions(self) -> bool:
        return self.use_actions

    @property
    def scanned(self) -> int:
        return self.blocks

    @property
    def loss_weights(self) -> dict[str, float]:
        return {"token": 1.0}

    def check(self, clips: ClipShape) -> None:
        context = self.autoencoder.context_frames
        cells = self.autoencoder.grid(clips.image_size) ** 2
        require(
            clips.frames > context,
            f"clips have {clips.frames} frames, of which model.autoencoder.context_frames {context} are context; at "
            f"least one must be left to predict",
        )
        per_frame = self.autoencoder.future_tokens(clips.image_size) + 1
        tokens = (cells + 1) * context - 1 + per_frame * (clips.frames - context)
        require(
            tokens <= self.positions,
            f"a clip of {clips.frames} frames has {tokens} tokens, but model.positions is {self.positions}; raise it, "
            f"or shorten the clips",
        )
