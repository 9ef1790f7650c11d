import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.bench.torch_part import check_plain
from rsjax.config import ConfigError, OptimizerConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer

torch = pytest.importorskip("torch")

TOY = Architecture(
    frames=3, grid=4, code_bits=8, action_inputs=0, width=24, blocks=2, heads=3, use_depth=False, position_std=0.5
)


def copied(params: Any) -> Any:
    """The baseline with the weights of the RGB branch."""
    from rsjax.bench.genie_torch import GenieTorch

    model = GenieTorch(TOY)
    tensor = lambda x: torch.tensor(np.asarray(x))  # noqa: E731
    blocks = params["blocks"]["rgb"]
    state = {
        "pos_embed_TSC": tensor(params["pos_embed"])[None],
        "mask_token_embed": tensor(params["rgb_embed"]["mask_token_embed"])[None],
        "out_x_proj.weight": tensor(params["rgb_head"]["kernel"]).T,
        "out_x_proj.bias": tensor(params["rgb_head"]["bias"]),
    }
    for k in range(2):
        state[f"factored_embeds.{k}.weight"] = tensor(params["rgb_embed"][f"factored_embed_{k}"]["embedding"])
    for i in range(TOY.blocks):
        for norm in ("norm1", "norm2"):
            state[f"layers.{i}.{norm}.weight"] = tensor(blocks[norm]["scale"][i])
            state[f"layers.{i}.{norm}.bias"] = tensor(blocks[norm]["bias"][i])
        layers = {f"{a}_attn.{p}": blocks[f"{a}_attn"][p] for a in ("spatial", "temporal") for p in ("qkv", "proj")}
        for name, layer in (layers | {f"mlp.{fc}": blocks[fc] for fc in ("fc1", "fc2")}).items():
            state[f"layers.{i}.{name}.weight"] = tensor(layer["kernel"][i]).T
            if "bias" in layer:
                state[f"layers.{i}.{name}.bias"] = tensor(layer["bias"][i])
    model.load_state_dict(state)
    return model


@pytest.fixture(scope="module")
def params() -> Any:
    """Random weights, those that start at zero too."""
    fresh = Transformer(TOY).init_params(jax.random.key(0))
    leaves, tree = jax.tree.flatten(fresh)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noisy = [x + 0.1 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, noisy)


def test_logits_are_those_of_the_rgb_branch(params: Any) -> None:
    rng = np.random.default_rng(0)
    tokens, mask = rng.integers(0, 256, (2, 3, 4, 4)), rng.random((2, 3, 4, 4)) < 0.4
    ours, _ = Transformer(TOY).apply({"params": params}, {"rgb": jnp.array(tokens)}, jnp.array(mask), None)
    with torch.no_grad():
        theirs = copied(params)(torch.tensor(tokens.reshape(2, 3, 16)), torch.tensor(mask.reshape(2, 3, 16)))
    np.testing.assert_allclose(ours["rgb"], theirs.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bf16", [False, True])
def test_steps_lower_the_loss_of_the_same_clip(params: Any, bf16: bool) -> None:
    from rsjax.bench.genie_torch import make_adamw, train_step

    torch.manual_seed(0)
    model = copied(params)
    adamw = make_adamw(model, OptimizerConfig(learning_rate=1e-2))
    tokens, mask = torch.randint(0, 256, (1, 3, 16)), torch.rand(1, 3, 16) < 0.5
    losses = [train_step(model, adamw, tokens, mask, bf16).item() for _ in range(8)]
    assert losses[-1] < 0.8 * losses[0]


def test_a_clip_of_zero_clips_nothing(params: Any) -> None:
    from rsjax.bench.genie_torch import make_adamw, train_step

    torch.manual_seed(0)
    tokens, mask = torch.randint(0, 256, (1, 3, 16)), torch.rand(1, 3, 16) < 0.5
    norms = []
    for grad_clip in (0.0, 1e9, 1e-3):
        model = copied(params)
        train_step(model, make_adamw(model, OptimizerConfig()), tokens, mask, False, grad_clip)
        norms.append(torch.stack([p.grad.norm() for p in model.parameters()]).norm().item())
    assert norms[0] == pytest.approx(norms[1], rel=1e-4) and norms[0] > 0.1
    assert norms[2] == pytest.approx(1e-3, rel=1e-2)


def test_decoding_fills_one_frame_and_one_step_takes_the_most_probable_codes(params: Any) -> None:
    from rsjax.bench.genie_torch import decode_frame

    model, tokens = copied(params), torch.randint(0, 256, (2, 3, 16))
    decoded = decode_frame(model, tokens, t=1, steps=1, bf16=False)
    mask = torch.zeros_like(tokens, dtype=torch.bool)
    mask[:, 1] = True
    with torch.no_grad():
        codes = model(tokens, mask)[:, 1].argmax(-1)
    assert torch.equal(decoded[:, 1], codes[..., 0] + 16 * codes[..., 1])
    assert torch.equal(decoded[:, ::2], tokens[:, ::2])


def test_what_the_public_code_has_not_is_refused() -> None:
    with pytest.raises(ConfigError, match="model.final_norm is on"):
        check_plain(dataclasses.replace(TOY, final_norm=True))
