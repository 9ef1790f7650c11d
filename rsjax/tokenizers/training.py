"""Training of the tokenizer (reference: Open-MAGVIT2): images, parameters and loss terms for the train step.

Axes: B images, H×W pixels, h×w token cells, D code bits.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, UInt8

from rsjax.config import Config, ConfigError, ModelConfig, TokenizerConfig, TokenizerTrainConfig, from_dict, require
from rsjax.config.fields import differences
from rsjax.data.codec import Record
from rsjax.data.depth_color import depth_to_color
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.model_directory import has_weights, read_settings
from rsjax.tokenizers import lfq
from rsjax.tokenizers.adversarial import adversarial_terms, initial_averages, updated_averages
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.discriminator import MIN_SIZE, Discriminator
from rsjax.tokenizers.flops import tokenizer_flops
from rsjax.tokenizers.lpips import load_lpips, lpips, min_size
from rsjax.tokenizers.magvit2 import Tokenizer, run_tokenizer, to_unit
from rsjax.trainable import Extra, Params, Scalar, StepContext, Term

Images: TypeAlias = Float[Array, "B H W 3"]
Latents: TypeAlias = Float[Array, "B h w D"]

ENTROPY_TEMPERATURE = 0.01  # of the codes' probabilities in the entropy loss, as in the reference

# Fields that may differ between the saved tokenizer and the one to train.
FREE = {"vocabularies", "depth_scale", "compute_dtype"}


@dataclass(frozen=True)
class TokenizerTraining(Autoencoder[Images]):
    """Learns to reconstruct RGB frames and colourised depth maps. A batch is images 0–255, (B, H, W, 3).

    Parameters are the tokenizer's; with an adversarial term, {"generator": the tokenizer's, "discriminator": …}.
    """

    tokenizer: TokenizerConfig
    train: TokenizerTrainConfig
    image_size: int
    second_view: bool = False

    def __post_init__(self) -> None:
        require(
            self.train.adversarial is None or self.image_size >= MIN_SIZE,
            f"clips have images of {self.image_size} pixels; the discriminator needs at least {MIN_SIZE}, "
            f"or tokenizer_train.adversarial off",
        )

    @classmethod
    def create(cls, config: Config) -> "TokenizerTraining":
        """Returns the training of a configuration's tokenizer."""
        return cls(config.tokenizer, config.tokenizer_train, config.clips.image_size, config.second_view)

    @property
    def loss_weights(self) -> dict[str, float]:
        return self.train.loss_weights

    def init(self, key: Key[Array, ""]) -> Params:
        generator = Tokenizer(self.tokenizer).init_params(key)
        if self.train.adversarial is None:
            return generator
        return {"generator": generator, "discriminator": Discriminator().init_params(jax.random.fold_in(key, 1))}

    def init_extra(self) -> Extra:
        """Returns LeCAM's averages and LPIPS's weights, which would otherwise be 59 MB of constants in the program.

        Raises:
            LpipsError: the file ``train.perceptual.lpips`` is missing or damaged.
            ConfigError: images are too small for the LPIPS network.
        """
        extra: dict[str, Any] = {}
        if "perceptual" in self.loss_weights:
            extra["lpips"] = lpips_weights(self.train, self.image_size)
        if "lecam" in self.loss_weights:
            extra["lecam"] = initial_averages()
        return extra or None

    def loss_terms(self, params: Params, batch: Images, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns the active terms of one batch of images, named as their weights.

        ``context.extra`` has "lpips", the metric's weights, and "lecam", the averages of logits, if their terms are
        active.
        """
        train = self.train
        extra = cast(dict[str, Any], context.extra)
        target = to_unit(batch)
        output, latents = run_tokenizer(self.tokenizer, self.tokenizer_params(params), target)
        count = jnp.float32(batch.shape[0])
        error = (target - output).astype(jnp.float32)
        means = {
            "l1": jnp.mean(jnp.abs(error)),
            "l2": jnp.mean(jnp.square(error)),
            "entropy": self.entropy(latents, context.axis_name),
            "commitment": lfq.commitment_loss(latents),
        }
        if "perceptual" in train.loss_weights:
            means["perceptual"] = jnp.mean(lpips(extra["lpips"], target, output))
        terms = {name: (mean * count, count) for name, mean in means.items()}
        if train.adversarial is not None:
            active = (context.step >= train.adversarial.start).astype(jnp.float32)
            discriminator = params["discriminator"]
            averages = extra["lecam"]
            terms |= adversarial_terms(
                train.adversarial, discriminator, target, output, active, averages, context.axis_name
            )
        return terms

    def entropy(self, latents: Latents, axis_name: str | None) -> Scalar:
        """Returns LFQ's entropy loss, the mean over groups of ``entropy_group`` images.

        Args:
            axis_name: pmap's axis; without groups the average code covers all devices' images.

        Raises:
            ConfigError: this device's images do not divide into groups.
        """
        offset = self.train.entropy_offset
        group = self.train.entropy_group

        def total(x: Array) -> Array:
            if axis_name is None:
                return x
            return jax.lax.psum(x, axis_name)

        if not group:
            return lfq.entropy_loss(latents, ENTROPY_TEMPERATURE, offset, total)
        images = latents.shape[0]
        require(
            images % group == 0,
            f"tokenizer_train.entropy_group is {group}, but a device computes {images} images at once; "
            f"choose a divisor, or 0 for one average over the whole batch",
        )
        groups = latents.reshape(-1, group, *latents.shape[1:])
        return jnp.mean(jax.vmap(lambda part: lfq.entropy_loss(part, ENTROPY_TEMPERATURE, offset))(groups))

    def next_extra(self, extra: Extra, means: dict[str, Scalar]) -> Extra:
        adversarial = self.train.adversarial
        if extra is None or adversarial is None:
            return extra
        averages = updated_averages(extra["lecam"], means["real_logit"], means["fake_logit"], adversarial.lecam_decay)
        return extra | {"lecam": averages}

    def transform(self) -> Transform:
        train = self.train
        scale = self.tokenizer.depth_scale
        return TokenizerImages(train.frames_per_clip, train.depth_share, scale, train.flip, self.second_view)

    def batch(self, arrays: Arrays) -> UInt8[np.ndarray, "B H W 3"]:
        return image_batch(arrays)

    def tokenizer_params(self, params: Params) -> Params:
        """Returns the tokenizer's parameters without the discriminator's."""
        if self.train.adversarial is not None:
            return params["generator"]
        return params

    def codec(self, params: Params, normalization: Normalization) -> Codec:
        return Codec(self.tokenizer, params, normalization)

    def flops(self) -> dict[str, int]:
        return tokenizer_flops(self.tokenizer, self.image_size)

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of the tokenizer's weights in a directory that training may start from.

        Raises:
            UserError: the weights are missing or of another network; the message names the differing fields.
        """
        if not has_weights(directory, "tokenizer"):
            raise UserError(f"{directory}: holds no tokenizer/weights with their settings in config.json")
        saved = read_tokenizer_config(directory)
        if differing := differences(saved, self.tokenizer, FREE):
            raise UserError(f"{directory}: holds another network ({differing}); set these fields of tokenizer alike")
        return jax.eval_shape(Tokenizer(saved).init_params, jax.random.key(0))

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        """Returns the parameters that training begins with: the saved tokenizer, and a fresh discriminator."""
        if "generator" in fresh:
            return fresh | {"generator": saved}
        return saved


def require_no_adversarial(train: TokenizerTrainConfig, network: str) -> None:
    """Raises :class:`rsjax.config.ConfigError` if a family's autoencoder is to have a discriminator."""
    require(
        train.adversarial is None,
        f"tokenizer_train.adversarial is on, but {network} has no discriminator here; switch it off",
    )


def lpips_weights(train: TokenizerTrainConfig, image_size: int) -> dict[str, Any]:
    """Returns the weights of the LPIPS term.

    Raises:
        LpipsError: the file ``train.perceptual.lpips`` is missing or damaged.
        ConfigError: images are too small for the LPIPS network.
    """
    assert train.perceptual is not None
    path = train.perceptual.lpips
    weights = load_lpips(path)
    require(
        image_size >= min_size(weights),
        f"clips have images of {image_size} pixels; the LPIPS network of {path} needs at least {min_size(weights)}, "
        f"or tokenizer_train.perceptual off",
    )
    return jax.tree.map(jnp.array, weights)


def read_tokenizer_config(directory: Path) -> TokenizerConfig:
    """Reads the settings of the tokenizer of a run or a converted public checkpoint.

    Raises:
        UserError: the settings are missing, damaged or of another version.
    """
    path = directory / "config.json"
    settings = read_settings(directory, "make it with rsjax convert")
    if "tokenizer" not in settings:
        raise UserError(f"{directory}: holds no tokenizer/weights with their settings in config.json")
    try:
        if "model" in settings and from_dict(ModelConfig, settings["model"]).own_autoencoder is not None:
            name = settings["model"]["family"]
            raise UserError(f"{directory}: its tokenizer is that of the family {name!r}; start from a MAGVIT-2's")
        return from_dict(TokenizerConfig, settings["tokenizer"])
    except (ConfigError, TypeError) as error:
        raise UserError(f"{path}: the tokenizer's settings cannot be read ({error}); make it again") from error


@dataclass(frozen=True)
class TokenizerImages:
    """The loader's transform: draws random frames of a clip, some of them as colourised depth.

    Attributes:
        count: frames per clip.
        depth_share: probability that a frame is replaced by its depth map; 0 for clips without depth.
        scale: of the depth maps' colours.
        flip: whether to mirror each image left to right with probability ½.
        second_view: whether half of the frames that are not depth maps are of the second view, which clips then have.
    """

    count: int
    depth_share: float
    scale: Literal["linear", "inverse"]
    flip: bool
    second_view: bool = False

    def __call__(self, record: Record, rng: np.random.Generator) -> Arrays:
        """Returns ``images``: uint8 (count, H, W, 3)."""
        chosen = rng.choice(len(record["rgb"]), self.count, replace=self.count > len(record["rgb"]))
        images = record["rgb"][chosen]
        as_depth = rng.random(self.count) < self.depth_share
        if record["depth"] is not None:
            near, far = record["provenance"]["depth_range"]
            colors = depth_to_color(record["depth"][chosen[as_depth]], near, far, self.scale)
            images[as_depth] = colors.astype(np.uint8)
        if self.second_view:
            as_second = ~as_depth & (rng.random(self.count) < 0.5)
            images[as_second] = record["second"][chosen[as_second]]
        if self.flip:
            mirrored = rng.random(self.count) < 0.5
            images[mirrored] = images[mirrored, :, ::-1]
        return {"images": images}


def image_batch(arrays: Arrays) -> UInt8[np.ndarray, "B H W 3"]:
    """Returns stacked outputs of :class:`TokenizerImages` as one batch of images."""
    images = arrays["images"]
    return images.reshape(-1, *images.shape[2:])
