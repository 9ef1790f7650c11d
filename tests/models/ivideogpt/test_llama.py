"""The LLaMA with actions: its size, its sequences, what depends on what, sampling with the cache, long rollouts."""

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import ClipShape
from rsjax.data.normalization import Normalization
from rsjax.layers.cpu import frame_attention
from rsjax.models.base import Assets
from rsjax.models.ivideogpt.config import IVideoGPTConfig, TopKConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.models.ivideogpt.rollout import pick, sample
from rsjax.models.ivideogpt.sequence import Layout
from rsjax.tools.describe import count
from rsjax.trainable import StepContext
from tests.models.ivideogpt.toy import ARCH, CLIPS, MODEL, VQ, frames, llama_params, vq_params

PUBLIC = Layout(codes=8192, context=1, cells=256, tokens=16, positions=1024)
GREEDY = replace(MODEL, sample=TopKConfig(temperature=0.0))
RNG = np.random.default_rng(0)
CONTEXT, FUTURE = RNG.integers(0, VQ.codes, (2, 1, 8, 8)), RNG.integers(0, VQ.codes, (2, 3, 4))
SEQUENCE = ARCH.layout.join(CONTEXT, FUTURE)
ACTIONS = RNG.normal(size=(2, 3, 3)).astype(np.float32)


@pytest.mark.parametrize(
    ("config", "parameters"),
    [
        (IVideoGPTConfig(use_actions=False), 138_434_304),
        (IVideoGPTConfig(use_actions=False, width=1024, blocks=24, heads=16, mlp_width=4096), 436_261_888),
        (IVideoGPTConfig(), 138_434_304 + 768 * 5),
    ],
    ids=["small", "medium", "actions"],
)
def test_the_public_sizes_have_their_exact_counts(config: IVideoGPTConfig, parameters: int) -> None:
    arch = Architecture.create(config, ClipShape(16, 64, 1, 4, 2))
    assert count(jax.eval_shape(LLaMA(arch).init_params, jax.random.key(0))) == parameters


def test_sequences_are_those_of_the_public_code() -> None:
    assert (PUBLIC.length(16), PUBLIC.first_slot, PUBLIC.most_frames, PUBLIC.vocabulary) == (511, 256, 46, 16386)
    two = replace(PUBLIC, context=2)
    assert (two.length(16), two.first_slot) == (257 * 2 - 1 + 17 * 14, 513)
    joined = two.join(np.zeros((1, 2, 16, 16), int), np.full((1, 14, 16), 5))[0]
    assert len(joined) == two.length(16)
    assert np.flatnonzero(joined == 16384).tolist() == [256]
    assert np.flatnonzero(joined == 16385).tolist() == [513 + 17 * i for i in range(14)]
    np.testing.assert_array_equal(two.future(joined[None, 513:]), np.full((1, 14, 16), 5))
    stray = joined[None, 513:].copy()
    stray[0, 1:3] = (3, 16385)
    assert two.future(stray)[0, 0, :3].tolist() == [0, 8191, 5]


@jax.jit
def logits(params: Any, tokens: Any = SEQUENCE, actions: Any = ACTIONS) -> Any:
    return LLaMA(ARCH).apply({"params": params}, tokens, actions)[0]


@partial(jax.jit, static_argnums=0)
def token_term(model: IVideoGPT, params: Any, batch: Any) -> Any:
    return model.loss_terms(params, batch, jax.random.key(0), StepContext(jnp.int32(0), None, None))["token"]


@pytest.mark.parametrize("remat", ["none", "blocks"])
def test_fast_attention_and_its_gradient_are_the_plain_ones(
    monkeypatch: pytest.MonkeyPatch, remat: Literal["none", "blocks"]
) -> None:
    arch, params = replace(ARCH, config=replace(MODEL, compute_dtype="bfloat16", remat=remat)), llama_params()

    def loss(params: Any) -> Any:
        return jnp.mean(jnp.sin(LLaMA(arch).apply({"params": params}, SEQUENCE, ACTIONS)[0]))

    plain = jax.value_and_grad(loss)(params)
    monkeypatch.setattr(frame_attention, "LARGE_FRAME", 1)
    for x, y in zip(jax.tree.leaves(jax.value_and_grad(loss)(params)), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(x, y, atol=0.03 * float(jnp.max(jnp.abs(y))) + 1e-6)


def test_nothing_depends_on_what_comes_later_and_an_action_acts_from_its_slot_on() -> None:
    params, layout = llama_params(), ARCH.layout
    before = logits(params)
    slot = layout.first_slot + layout.per_frame
    moved = ACTIONS.copy()
    moved[:, 1] += 1
    differs = np.abs(logits(params, actions=moved) - before).max((0, 2)) > 1e-6
    assert differs.tolist() == [place >= slot for place in range(SEQUENCE.shape[1])]
    changed = SEQUENCE.copy()
    changed[:, slot + 2] ^= 1
    differs = np.abs(logits(params, changed) - before).max((0, 2)) > 1e-6
    assert differs.tolist() == [place >= slot + 2 for place in range(SEQUENCE.shape[1])]


@pytest.mark.parametrize("given", [0, 1])
def test_each_token_sampled_with_the_cache_is_the_most_probable_one_of_a_whole_pass(given: int) -> None:
    arch = Architecture.create(GREEDY, CLIPS)
    params, keys = llama_params(arch), jax.random.split(jax.random.key(0), 2)
    begin = arch.layout.join(CONTEXT, FUTURE[:, :given])
    tail = np.asarray(sample(arch, params, begin, ACTIONS, keys))
    whole = np.concatenate([begin[:, : arch.layout.first_slot], tail], axis=1)
    assert whole.shape == SEQUENCE.shape
    np.testing.assert_array_equal(whole[:, : begin.shape[1]], begin)
    likely = np.asarray(logits(params, whole)).argmax(-1)
    slots = arch.layout.first_slot + arch.layout.per_frame * np.arange(3)
    assert (whole[:, slots] == arch.layout.slot).all()
    drawn = np.setdiff1d(np.arange(begin.shape[1], whole.shape[1]), slots)
    np.testing.assert_array_equal(whole[:, drawn], likely[:, drawn - 1])


def test_draws_are_from_the_most_probable_and_follow_the_clips_key() -> None:
    scores = jnp.tile(jnp.array([0.0, 5, 4, 3, -9]), (400, 1))
    keys = jax.random.split(jax.random.key(1), 400)
    drawn = np.asarray(pick(TopKConfig(top_k=3), scores, keys))
    assert set(drawn) == {1, 2, 3}
    share = np.exp([5, 4, 3]) / np.exp([5, 4, 3]).sum()
    np.testing.assert_allclose([(drawn == token).mean() for token in (1, 2, 3)], share, atol=0.08)
    np.testing.assert_array_equal(pick(TopKConfig(top_k=3), scores[:7], keys[93:100]), drawn[93:100])
    assert set(np.asarray(pick(TopKConfig(temperature=0.0), scores, keys))) == {1}
    assert set(np.asarray(pick(TopKConfig(temperature=1000.0, top_k=0), scores, keys))) == set(range(5))


def test_the_loss_is_the_mean_over_numbers_after_the_first_slot_of_clips_that_count() -> None:
    model, params = IVideoGPT(MODEL, CLIPS), llama_params()
    batch: Any = {"tokens": SEQUENCE, "actions": ACTIONS, "weight": np.array([1, 0], np.float32), "index": np.arange(2)}
    value, weight = token_term(model, params, batch)
    first = ARCH.layout.first_slot
    log_p = jax.nn.log_softmax(logits(params))[0, first:-1]
    expected = -log_p[np.arange(len(log_p)), SEQUENCE[0, first + 1 :]].sum()
    assert (float(value), float(weight)) == (pytest.approx(float(expected), rel=1e-5), len(log_p))
    dropping = IVideoGPT(replace(MODEL, dropout=0.5), CLIPS)
    both = batch | {"weight": np.ones(2, np.float32)}
    whole = token_term(dropping, params, both)[0]
    halves = [token_term(dropping, params, {k: x[i : i + 1] for k, x in both.items()})[0] for i in range(2)]
    assert float(whole) == pytest.approx(float(sum(halves)), rel=1e-5), "dropout follows the clip, not its place"
    assert abs(float(halves[0]) - float(value)) > 0.1


def test_a_rollout_beyond_the_positions_goes_on_with_its_last_frame_as_context() -> None:
    short = replace(GREEDY, positions=ARCH.layout.length(3), integrate_actions=True)
    model = IVideoGPT(short, CLIPS)
    params, assets = llama_params(model.architecture), Assets(Normalization((0.0,) * 3, (1.0,) * 3, None), vq_params())
    prompt, actions = Video(frames(2, 1)), RNG.normal(size=(2, 6, 3)).astype(np.float32)
    made = model.generate(params, assets, prompt, actions).rgb
    assert made.shape == (2, 6, *made.shape[2:])
    begun = model.generate(params, assets, prompt, actions[:, :3]).rgb
    np.testing.assert_array_equal(made[:, :3], begun)
    went_on = model.generate(params, assets, Video(begun[:, -1:]), actions[:, 2:5]).rgb
    np.testing.assert_array_equal(made[:, 3:5], went_on[:, 1:])
    assert (made[:, 5] != made[:, 4]).any()
    alone = model.generate(params, assets, prompt[1:], actions[1:]).rgb
    np.testing.assert_allclose(alone.astype(int), made[1:], atol=1)  # batches of two sizes round differently
    given = frames(1, 4)
    long = model.generate(params, assets, Video(given), actions[:1, :5]).rgb
    assert long.shape[1] == 5, "a prompt longer than a sequence"
    last = model.generate(params, assets, Video(given[:, -1:]), actions[:1, 3:5]).rgb
    np.testing.assert_allclose(long[:, 4].astype(int), last[:, 1], atol=1)


def test_logits_are_those_of_transformers() -> None:
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    from rsjax.tools.convert.ivideogpt import llama_table
    from rsjax.tools.convert.table import to_tensors

    params = llama_params()
    tensors = {
        name: torch.tensor(np.ascontiguousarray(x)) for name, x in to_tensors(params, llama_table(MODEL)).items()
    }
    settings = transformers.LlamaConfig(
        vocab_size=ARCH.layout.vocabulary,
        hidden_size=MODEL.width,
        intermediate_size=MODEL.mlp_width,
        num_hidden_layers=MODEL.blocks,
        num_attention_heads=MODEL.heads,
        max_position_embeddings=1024,
    )
    reference = transformers.LlamaForCausalLM(settings).eval()
    reference.load_state_dict({name[4:]: x for name, x in tensors.items() if name.startswith("llm.")})
    layout, tokens = ARCH.layout, torch.tensor(SEQUENCE, dtype=torch.long)
    with torch.no_grad():
        embedded = reference.get_input_embeddings()(tokens)
        added = torch.tensor(ACTIONS) @ tensors["action_linear.weight"].T + tensors["action_linear.bias"]
        embedded[:, layout.first_slot + layout.per_frame * torch.arange(3)] += added
        labels = tokens.clone()
        labels[:, : layout.first_slot + 1] = -100
        made = reference(inputs_embeds=embedded, labels=labels)
    assert 0.3 < made.logits.std() < 10
    np.testing.assert_allclose(logits(params), made.logits.numpy(), atol=1e-5)
    batch: Any = {"tokens": SEQUENCE, "actions": ACTIONS, "weight": np.ones(2, np.float32), "index": np.arange(2)}
    value, weight = token_term(IVideoGPT(MODEL, CLIPS), params, batch)
    assert float(value / weight) == pytest.approx(float(made.loss), abs=1e-5)
