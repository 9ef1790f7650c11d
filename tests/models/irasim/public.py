"""A second implementation of IRASim's network: names, shapes and computation of its authors' code.

Plain numpy in torch's layout ((out, in), OIHW), float64, without the project's tables or models. Written from
the architecture's description; it takes the weights of a public file.

Axes: B clips, F frames, S tokens, d width.
"""

import math
from dataclasses import dataclass

import numpy as np

Tensors = dict[str, np.ndarray]


@dataclass(frozen=True)
class Network:
    """Sizes, and which of the public variants it is."""

    width: int = 32
    depth: int = 4
    heads: int = 2
    frames: int = 6
    grid: tuple[int, int] = (4, 5)
    patch: int = 2
    channels: int = 4
    actions: int = 7
    video: bool = False
    linear: bool = False  # of Language-Table: two linear layers of other names, without an activation
    final_frame_ada: bool = False
    learn_sigma: bool = False

    @property
    def outputs(self) -> int:
        return self.channels * (1 + self.learn_sigma)


def shapes(net: Network) -> dict[str, tuple[int, ...]]:
    """Returns the shape of every tensor of a public file by name."""
    d, out = net.width, {}

    def linear(name: str, outs: int, ins: int) -> None:
        out.update({f"{name}.weight": (outs, ins), f"{name}.bias": (outs,)})

    out["pos_embed"] = (1, math.prod(net.grid), d)
    out["temp_embed"] = (1, net.frames, d)
    out["x_embedder.proj.weight"] = (d, net.channels, net.patch, net.patch)
    out["x_embedder.proj.bias"] = (d,)
    linear("t_embedder.mlp.0", d, 256)
    linear("t_embedder.mlp.2", d, d)
    first, second = ("embed_arm_state", "embed_state") if net.linear else ("embed_state.fc1", "embed_state.fc2")
    linear(first, 4 * d, net.actions * (net.frames - 1 if net.video and not net.linear else 1))
    linear(second, d, 4 * d)
    if net.video and net.linear:
        linear("mlp.fc1", (net.frames - 1) * d, (net.frames - 1) * d)
        linear("mlp.fc2", d, (net.frames - 1) * d)
    out["mask_emb_fn.weight"] = (1, d)
    for i in range(net.depth):
        linear(f"blocks.{i}.attn.qkv", 3 * d, d)
        linear(f"blocks.{i}.attn.proj", d, d)
        linear(f"blocks.{i}.mlp.fc1", 4 * d, d)
        linear(f"blocks.{i}.mlp.fc2", d, 4 * d)
        linear(f"blocks.{i}.adaLN_modulation.1", 6 * d, d)
    linear("final_layer.linear", net.patch**2 * net.outputs, d)
    linear("final_layer.adaLN_modulation.1", 2 * d, d)
    return out


def random_weights(net: Network, seed: int = 0) -> Tensors:
    """Returns tensors that are all drawn, also those that the public code initialises to zero, and its positions."""
    rng = np.random.default_rng(seed)
    drawn = {
        name: rng.normal(scale=0.05 if "adaLN" in name or len(shape) == 1 else math.prod(shape[1:]) ** -0.5, size=shape)
        for name, shape in shapes(net).items()
    }
    drawn |= {"pos_embed": space(net)[None], "temp_embed": waves(np.arange(net.frames), net.width)[None]}
    return {name: x.astype(np.float32) for name, x in drawn.items()}


def waves(at: np.ndarray, width: int) -> np.ndarray:
    rows = []
    for position in at:
        angles = [position * (1.0 / 10_000 ** (i / (width / 2.0))) for i in range(width // 2)]
        rows.append([math.sin(a) for a in angles] + [math.cos(a) for a in angles])
    return np.array(rows)


def space(net: Network) -> np.ndarray:
    """Positions of a frame's tokens: the column first."""
    rows, columns = np.array([(row, column) for row in range(net.grid[0]) for column in range(net.grid[1])]).T
    return np.concatenate([waves(columns, net.width // 2), waves(rows, net.width // 2)], 1)


def forward(
    net: Network, w: Tensors, x: np.ndarray, t: np.ndarray, actions: np.ndarray, drop: np.ndarray
) -> np.ndarray:
    """Returns the noise, (B, F, C, h, w).

    Args:
        x: latents, (B, F, C, h, w).
        t: (B,).
        acts: actions, (B, F - 1, A).
        drop: (B,), whether to replace a clip's actions.
    """
    w = {name: value.astype(np.float64) for name, value in w.items()}

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    batch, frames, (rows, columns), p, d = len(x), x.shape[1], net.grid, net.patch, net.width
    tokens = np.zeros((batch, frames, rows * columns, d))
    for s in range(rows * columns):
        i, j = divmod(s, columns)
        piece = x[..., i * p : (i + 1) * p, j * p : (j + 1) * p]  # B F C p p
        tokens[:, :, s] = np.einsum("bfcij,dcij->bfd", piece, w["x_embedder.proj.weight"]) + w["x_embedder.proj.bias"]
    tokens += w["pos_embed"][:, None]

    angles = t[:, None] * 10_000.0 ** (-np.arange(128) / 128)
    time = linear("t_embedder.mlp.0", np.concatenate([np.cos(angles), np.sin(angles)], 1))
    time = linear("t_embedder.mlp.2", silu(time))

    first, second = ("embed_arm_state", "embed_state") if net.linear else ("embed_state.fc1", "embed_state.fc2")
    known = linear(first, actions.reshape(batch, 1, -1) if net.video and not net.linear else actions)
    known = linear(second, known if net.linear else gelu(known))
    if net.video and net.linear:
        known = linear("mlp.fc2", gelu(linear("mlp.fc1", known.reshape(batch, 1, -1))))
    unknown = w["mask_emb_fn.weight"]
    if not net.video:
        known = np.concatenate([np.broadcast_to(unknown, (batch, 1, d)), known], 1)
    known[drop] = unknown
    acted = np.broadcast_to(time[:, None] + known, (batch, frames, d))
    plain = acted if net.video else np.broadcast_to(time[:, None], (batch, frames, d))

    def block(name: str, x: np.ndarray, condition: np.ndarray) -> np.ndarray:
        """x: (N, L, d), condition: (N, d)."""
        parts = np.split(linear(f"{name}.adaLN_modulation.1", silu(condition))[:, None], 6, -1)
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = parts
        q, k, v = np.split(linear(f"{name}.attn.qkv", norm(x) * (1 + scale_a) + shift_a), 3, -1)
        out, size = np.zeros_like(x), d // net.heads
        for h in range(net.heads):
            at = slice(h * size, (h + 1) * size)
            scores = q[..., at] @ k[..., at].swapaxes(1, 2) / math.sqrt(size)
            scores = np.exp(scores - scores.max(-1, keepdims=True))
            out[..., at] = scores / scores.sum(-1, keepdims=True) @ v[..., at]
        x = x + gate_a * linear(f"{name}.attn.proj", out)
        hidden = gelu(linear(f"{name}.mlp.fc1", norm(x) * (1 + scale_m) + shift_m))
        return x + gate_m * linear(f"{name}.mlp.fc2", hidden)

    cells = rows * columns
    for i in range(net.depth):
        if i % 2 == 0:
            flat = tokens.reshape(batch * frames, cells, d)
            tokens = block(f"blocks.{i}", flat, acted.reshape(-1, d)).reshape(tokens.shape)
        else:
            tokens = tokens + (w["temp_embed"][:, :frames, None] if i == 1 else 0)
            flat = tokens.swapaxes(1, 2).reshape(batch * cells, frames, d)
            # One condition per clip: the same for all its frames.
            tokens = block(f"blocks.{i}", flat, np.repeat(plain[:, 0], cells, 0))
            tokens = tokens.reshape(batch, cells, frames, d).swapaxes(1, 2)

    shift, scale = np.split(
        linear("final_layer.adaLN_modulation.1", silu(acted if net.final_frame_ada else plain))[:, :, None], 2, -1
    )
    pieces = linear("final_layer.linear", norm(tokens) * (1 + scale) + shift)
    out = np.zeros((batch, frames, net.outputs, rows * p, columns * p))
    for s in range(cells):
        i, j = divmod(s, columns)
        piece = pieces[:, :, s].reshape(batch, frames, p, p, net.outputs)
        out[..., i * p : (i + 1) * p, j * p : (j + 1) * p] = piece.transpose(0, 1, 4, 2, 3)
    return out[:, :, : net.channels]  # the others are variances


def norm(x: np.ndarray) -> np.ndarray:
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)


def silu(x: np.ndarray) -> np.ndarray:
    return x / (1 + np.exp(-x))


def gelu(x: np.ndarray) -> np.ndarray:
    return 0.5 * x * (1 + np.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))
