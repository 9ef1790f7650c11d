"""A family with an autoencoder of its own trains it in the stage before its model, on what the autoencoder makes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import rsjax
from rsjax.clip import Video
from rsjax.config import Config, ModelConfig, RuntimeConfig, TrainConfig, register_family
from rsjax.config.model import FAMILIES
from rsjax.errors import UserError
from rsjax.models.base import MODELS, WorldModel, implements
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.tokenize import described, prepare_store
from rsjax.tools.bench import parts
from rsjax.tools.describe import describe
from rsjax.tools.pipeline.run import Run, RunError
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.pipeline.stages import prepare, train_tokenizer, train_world_model
from tests.tools.pipeline import toy


@dataclass(frozen=True)
class MeanConfig:
    start: float = 0.5


class Codec:
    def __init__(self, gain):
        self.gain = gain

    def encode(self, video):
        return {"mean": video.rgb.mean((2, 3, 4)) * float(self.gain) / 255}

    def decode(self, tokens, has_depth):
        level = np.clip(255 * tokens["mean"], 0, 255).astype(np.uint8)[..., None, None, None]
        return Video(np.broadcast_to(level, (*level.shape[:2], SIZE, SIZE, 3)))


@dataclass(frozen=True)
class Mean(Autoencoder):
    """Learns the gain that maps a frame's mean to itself."""

    config: MeanConfig
    loss_weights = {"error": 1.0}  # noqa: RUF012

    def init(self, key):
        return {"gain": jnp.float32(self.config.start)}

    def loss_terms(self, params, batch, key, context):
        return {"error": (jnp.sum(jnp.square((params["gain"] - 1) * batch)), jnp.float32(batch.size))}

    def transform(self):
        return lambda clip, rng: {"mean": clip["rgb"].mean((1, 2, 3)) / 255}

    def batch(self, arrays):
        return arrays["mean"]

    def codec(self, params, normalization):
        return Codec(params["gain"])

    def notes(self):
        return ["it learns one number"]


@pytest.fixture
def config(tmp_path: Path) -> Iterator[Config]:
    @register_family("mean")
    @dataclass(frozen=True)
    class Settings(ModelConfig):
        uses_tokenizer = True
        autoencoder: MeanConfig = MeanConfig()
        error_weight: float = 1.0

        @property
        def own_autoencoder(self):
            return self.autoencoder

    @implements(Settings)
    @dataclass(frozen=True)
    class Family(WorldModel):
        """Predicts the mean of the last given frame, plus a learned offset."""

        config: Config

        @classmethod
        def autoencoder(cls, config):
            return Mean(config.model.autoencoder)

        def init(self, key):
            return {"offset": jnp.float32(0.1)}

        def prepare(self, clips, assets, folder, max_damaged):
            codec = Codec(assets.tokenizer["gain"])
            encode = lambda clip: {"mean": codec.encode(Video(clip["rgb"][None]))["mean"][0]} | described(clip)  # noqa: E731
            return prepare_store(
                clips, self.config.autoencoder, assets.tokenizer, encode, self.config.clips.image_size, folder, 0.1
            )

        def transform(self, normalization):
            return lambda record, rng: {"mean": record["mean"].astype(np.float32)}

        def example(self, rng):
            return {"mean": rng.random(self.config.clips.frames, np.float32)}

        def loss_terms(self, params, batch, key, context):
            error = jnp.diff(batch["mean"], axis=1) - params["offset"]
            weight = jnp.broadcast_to(batch["weight"][:, None], error.shape)
            return {"error": (jnp.sum(weight * error**2), jnp.sum(weight))}

        def generate(self, params, assets, prompt, actions, *, index=None, depth=True):
            codec = Codec(assets.tokenizer["gain"])
            last = codec.encode(prompt)["mean"][:, -1:] + params["offset"]
            return codec.decode({"mean": np.repeat(last, actions.shape[1], 1)}, None)

    base = toy.config()
    train = TrainConfig(steps=4, batch_size=2)
    small = replace(base.tokenizer_train, steps=4, batch_size=2)
    runtime = RuntimeConfig(log_every=2, eval_every=4)
    store = toy.store(tmp_path / "clips")
    config = replace(base, model=Settings(), train=train, tokenizer_train=small, runtime=runtime)
    yield on_store(config, store.path)
    del FAMILIES["mean"], MODELS[Settings]


SIZE = toy.config().clips.image_size


def test_both_stages_train_and_the_model_reads_what_the_autoencoder_made(
    config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(config, tmp_path / "run", tmp_path)
    assert run.stages[:4] == ("collect", "tokenizer", "tokens", "world_model")
    run.prepare(overwrite=False)
    for stage, work in (
        ("tokenizer", lambda: train_tokenizer(run, True)),
        ("tokens", lambda: prepare(run)),
        ("world_model", lambda: train_world_model(run, True)),
    ):
        with run.stage(stage):
            work()
        assert run.finished(stage)
    assert capsys.readouterr().out.count("note: it learns one number") == 1
    model = rsjax.load(run.directory)
    assert model.assets.tokenizer is not None and model.assets.tokenizer["gain"] > 0.5, "it has learned"
    prepared = run.open_prepared()
    assert config.data is not None
    assert prepared.manifest["key"] != config.data.key and prepared.counts() == run.open_clips().counts()
    clip = run.open_clips().source("test")[0]
    kept = clip["rgb"].mean() / 255 * model.assets.tokenizer["gain"]
    np.testing.assert_allclose(prepared.source("test")[0]["mean"], kept, rtol=1e-4)
    assert model.generate(clip["rgb"][:1], clip["actions"]).rgb.shape == clip["rgb"].shape
    with pytest.raises(UserError, match="has no tokens"):
        model.encode(clip["rgb"])
    other = replace(config, model=replace(config.model, autoencoder=MeanConfig(0.7)))  # type: ignore[call-arg]
    with pytest.raises(RunError, match="tokenizer of another configuration .model.autoencoder.start is 0.5 there"):
        Run(other, run.directory, tmp_path).prepare(overwrite=False)
    assert (
        Run(replace(config, tokenizer=replace(config.tokenizer, channels=24)), tmp_path, tmp_path).keys() == run.keys()
    )


def test_bench_and_describe_know_it(config: Config) -> None:
    assert describe(config).modules["tokenizer"].keys() == {"gain"}
    assert parts.tokenizer(config, 2, 0.0)["tokenizer_frames"] == 2 * config.clips.frames
    assert parts.sample(config, 2, 0.0, (3,))["sample_s_per_frame"] > 0
