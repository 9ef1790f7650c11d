import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import AdamW, Departures, TokenizerConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers import magvit2
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tools.convert.table import to_tensors
from rsjax.tools.convert.tokenizer import name_table

torch = pytest.importorskip("torch")

TOY = Architecture(
    frames=3,
    grid=4,
    code_bits=8,
    action_inputs=0,
    width=24,
    blocks=2,
    heads=3,
    depth="none",
    departures=Departures(embedding_std=0.5),
)


def copied(params: Any, arch: Architecture = TOY) -> Any:
    """The baseline with the weights of the RGB branch."""
    from benchmarks.pytorch.genie import GenieTorch

    model = GenieTorch(arch)
    tensor = lambda x: torch.tensor(np.asarray(x))  # noqa: E731
    blocks = params["blocks"]["rgb"]
    state = {
        "pos_embed_TSC": tensor(params["pos_embed"])[None],
        "mask_token_embed": tensor(params["rgb_embed"]["mask_token_embed"])[None],
        "out_x_proj.weight": tensor(params["rgb_head"]["kernel"]).T,
        "out_x_proj.bias": tensor(params["rgb_head"]["bias"]),
    }
    for i in range(2 * bool(arch.action_inputs)):
        layer = params[f"action_encoder_fc{i + 1}"]
        state[f"action_encoder.{2 * i}.weight"] = tensor(layer["kernel"]).T
        state[f"action_encoder.{2 * i}.bias"] = tensor(layer["bias"])
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


def noisy(fresh: Any) -> Any:
    """Random weights, those that start at zero too."""
    leaves, tree = jax.tree.flatten(fresh)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [x + 0.1 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(tree, drawn)


@pytest.fixture(scope="module")
def params() -> Any:
    return noisy(jax.jit(Transformer(TOY).init_params)(jax.random.key(0)))


@pytest.mark.parametrize("action_inputs", [0, 5])
def test_logits_are_those_of_the_rgb_branch(action_inputs: int) -> None:
    arch = dataclasses.replace(TOY, action_inputs=action_inputs, action_encoder="mlp" if action_inputs else "none")
    params = noisy(jax.jit(Transformer(arch).init_params)(jax.random.key(0)))
    rng = np.random.default_rng(0)
    tokens, mask = rng.integers(0, 256, (2, 3, 4, 4)), rng.random((2, 3, 4, 4)) < 0.4
    actions = rng.normal(size=(2, 3, 5)).astype(np.float32)
    ours: Any = Transformer(arch).apply({"params": params}, {"rgb": jnp.array(tokens)}, jnp.array(mask), actions)
    flat = (torch.tensor(tokens.reshape(2, 3, 16)), torch.tensor(mask.reshape(2, 3, 16)))
    with torch.no_grad():
        theirs = copied(params, arch)(*flat, torch.tensor(actions))
    np.testing.assert_allclose(ours[0]["rgb"], theirs.numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("changes", [{"adaptive_norm": True}, {"patch_size": 2, "local_codes": True}])
def test_the_tokenizer_is_magvit2(changes: dict[str, Any]) -> None:
    from benchmarks.pytorch.magvit2 import MagvitDecoderTorch, MagvitEncoderTorch
    from benchmarks.pytorch.measure import to_channels_last

    config = TokenizerConfig(
        channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4, code_bits=6, **changes
    )
    drawn = noisy(jax.jit(Tokenizer(config).init_params)(jax.random.key(0)))
    encoder = MagvitEncoderTorch(config)
    decoder = MagvitDecoderTorch(config)
    tensors = {name: torch.tensor(np.ascontiguousarray(x)) for name, x in to_tensors(drawn, name_table(config)).items()}
    for name, half in (("encoder", encoder), ("decoder", decoder)):
        half.load_state_dict({key[8:]: x for key, x in tensors.items() if key.startswith(name)})
    images = np.random.default_rng(0).uniform(-1, 1, (2, 16, 16, 3)).astype(np.float32)
    with torch.no_grad():
        latents = encoder(torch.tensor(images).permute(0, 3, 1, 2))
        made = decoder(latents.sign()).permute(0, 2, 3, 1)
    own: Any = magvit2.MagvitEncoder(config).apply({"params": drawn["encoder"]}, images)
    np.testing.assert_allclose(own, latents.permute(0, 2, 3, 1), atol=2e-5)
    codes = latents.sign().permute(0, 2, 3, 1).numpy()
    decoded: Any = magvit2.MagvitDecoder(config).apply({"params": drawn["decoder"]}, codes)
    np.testing.assert_allclose(decoded, made, atol=2e-5)
    to_channels_last([encoder, decoder])
    with torch.no_grad():
        assert torch.allclose(encoder(torch.tensor(images).permute(0, 3, 1, 2)), latents, atol=2e-5)
        again = decoder(latents.sign())
    assert again.is_contiguous(memory_format=torch.channels_last)
    np.testing.assert_allclose(again.permute(0, 2, 3, 1), made, atol=2e-5)


@pytest.mark.parametrize("bf16", [False, True])
def test_steps_lower_the_loss_of_the_same_clip(params: Any, bf16: bool) -> None:
    from benchmarks.pytorch.genie import masked_loss
    from benchmarks.pytorch.measure import make_adamw, train_step

    torch.manual_seed(0)
    model = copied(params)
    adamw = make_adamw(model.parameters(), AdamW(learning_rate=1e-2))
    tokens, mask = torch.randint(0, 256, (1, 3, 16)), torch.rand(1, 3, 16) < 0.5

    def loss() -> Any:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=bf16):
            return masked_loss(model, tokens, mask)

    losses = [train_step(loss, [model], adamw).item() for _ in range(8)]
    assert losses[-1] < 0.8 * losses[0]


def test_a_clip_of_zero_clips_nothing(params: Any) -> None:
    from benchmarks.pytorch.genie import masked_loss
    from benchmarks.pytorch.measure import make_adamw, train_step

    torch.manual_seed(0)
    tokens, mask = torch.randint(0, 256, (1, 3, 16)), torch.rand(1, 3, 16) < 0.5
    norms = []
    for grad_clip in (0.0, 1e9, 1e-3):
        model = copied(params)
        adamw = make_adamw(model.parameters(), AdamW())
        train_step(lambda: masked_loss(model, tokens, mask), [model], adamw, grad_clip)  # noqa: B023
        norms.append(torch.stack([p.grad.norm() for p in model.parameters()]).norm().item())
    assert norms[0] == pytest.approx(norms[1], rel=1e-4) and norms[0] > 0.1
    assert norms[2] == pytest.approx(1e-3, rel=1e-2)


def test_decoding_fills_one_frame_and_one_step_takes_the_most_probable_codes(params: Any) -> None:
    from benchmarks.pytorch.genie import decode_frame

    model, tokens = copied(params), torch.randint(0, 256, (2, 3, 16))
    decoded = decode_frame(model, tokens, t=1, steps=1)
    mask = torch.zeros_like(tokens, dtype=torch.bool)
    mask[:, 1] = True
    with torch.no_grad():
        codes = model(tokens, mask)[:, 1].argmax(-1)
    assert torch.equal(decoded[:, 1], codes[..., 0] + 16 * codes[..., 1])
    assert torch.equal(decoded[:, ::2], tokens[:, ::2])
