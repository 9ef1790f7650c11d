"""Breaks the most important functions one at a time, and says whether a test fails.

``python -m scripts.mutations`` tries every mutation, ``python -m scripts.mutations lfq cache`` those whose names begin
so, and ``--list`` only names them. Each replaces one line in a temporary copy of the tree and runs the tests that ought
to see it. A mutation that no test sees has survived: write the test. The line is looked for in all of ``rsjax``, so
that code may move between files; a line that is not there exactly once is reported, and its mutation is to be updated.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
COPIED = ("rsjax", "experiments", "benchmarks", "scripts", "tests", "pyproject.toml", "docs", "README.md")
SECONDS = 900  # of the tests of one mutation
FAILED = 1  # pytest's exit status if a test failed


@dataclass(frozen=True)
class Mutation:
    """One change for the worse.

    Attributes:
        name: the function and what is wrong with it.
        right: text that stands once in ``rsjax``.
        wrong: what replaces it.
        tests: names of the test files that ought to fail.
    """

    name: str
    right: str
    wrong: str
    tests: tuple[str, ...]


MASKING = ("test_masking.py",)
LFQ = ("test_lfq.py",)
KEYPOINTS = ("test_keypoints.py",)
OBJECTIVE = ("test_objective.py", "test_losses.py", "test_loss_terms.py")
CACHE = ("test_rollout.py", "test_window.py", "test_stepping.py")
NORMALIZATION = ("test_normalization.py",)
WINDOWS = ("test_windows.py",)
SHARDING = ("test_sharding.py", "test_state.py")
RESUME = ("test_loop.py", "test_checkpoint.py", "test_loader.py")

MUTATIONS = (
    Mutation(
        "masking: the frames before the first masked one are masked too",
        "rate = jnp.where(jnp.arange(frames) >= first, rate, 0.0)",
        "rate = jnp.where(jnp.arange(frames) >= 0, rate, 0.0)",
        MASKING,
    ),
    Mutation(
        "masking: the rate is not a cosine",
        "rate = jnp.cos(jnp.pi / 2 * jax.random.uniform(rate_key, (frames,)))",
        "rate = jax.random.uniform(rate_key, (frames,))",
        MASKING,
    ),
    Mutation(
        "masking: corruption does not accumulate over frames",
        "survive = keep * jnp.cumprod(jnp.where(late, decay, 1.0))",
        "survive = keep * jnp.where(late, decay, 1.0)",
        MASKING,
    ),
    Mutation(
        "lfq: a latent of 0 has the code +1",
        "signs = jnp.where(latents > 0, 1.0, -1.0)",
        "signs = jnp.where(latents >= 0, 1.0, -1.0)",
        LFQ,
    ),
    Mutation(
        "lfq: vocabulary 0 has the highest bits",
        "shifts = jnp.arange(vocabularies, dtype=tokens.dtype) * width",
        "shifts = jnp.arange(vocabularies, dtype=tokens.dtype)[::-1] * width",
        LFQ,
    ),
    Mutation(
        "lfq: the entropy has twice the temperature",
        "logits = 4.0 * latents.reshape",
        "logits = 2.0 * latents.reshape",
        LFQ,
    ),
    Mutation(
        "keypoints: motion counts where the point is visible before or after",
        "visible[..., 1:] & visible[..., :-1]",
        "visible[..., 1:] | visible[..., :-1]",
        KEYPOINTS,
    ),
    Mutation("keypoints: rows and columns are exchanged", "row * grid + column", "column * grid + row", KEYPOINTS),
    Mutation(
        "keypoints: the map weights the other cells",
        "jnp.where(hit[..., :-1], gamma, 1.0)",
        "jnp.where(hit[..., :-1], 1.0, gamma)",
        KEYPOINTS,
    ),
    Mutation(
        "objective: the keypoint term reads each frame's cells in the next frame",
        "later = jnp.take_along_axis(s_hat[:, 1:], cells[:, 1:, :, None], axis=2)",
        "later = jnp.take_along_axis(s_hat[:, 1:], cells[:, :-1, :, None], axis=2)",
        OBJECTIVE,
    ),
    Mutation(
        "objective: clips without depth count in the depth term",
        "clips = clips * batch.has_depth",
        "clips = clips * 1.0",
        OBJECTIVE,
    ),
    Mutation(
        "objective: the attention term has no map",
        "jnp.sum(nats * attention * masked)",
        "jnp.sum(nats * masked)",
        OBJECTIVE,
    ),
    Mutation(
        "objective: each term has weight 1",
        "loss += weights[name] * shares[name]",
        "loss += shares[name]",
        (*OBJECTIVE, "test_state.py"),
    ),
    Mutation(
        "attention: scores are divided by e instead of its root",
        'scores = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5',
        'scores = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -1.0',
        ("test_transformer.py", "test_attention.py", "test_frame_attention.py"),
    ),
    Mutation(
        "attention: rotary frequencies are wrong",
        "angles = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / half)",
        "angles = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / (half + 1))",
        ("test_rotary.py", "test_llama.py"),
    ),
    Mutation(
        "cache: a slot counts as the frame before its own",
        "return last - (last - jnp.arange(slots)) % slots",
        "return last - (last - 1 - jnp.arange(slots)) % slots",
        CACHE,
    ),
    Mutation(
        "cache: frames are written one slot too late",
        "slot = (start + i) % old.shape[-2]",
        "slot = (start + i + 1) % old.shape[-2]",
        CACHE,
    ),
    Mutation(
        "normalization: row 0 of the actions is kept",
        "scaled[..., 0, :] = 0.0",
        "scaled[..., 0, :] += 0.0",
        NORMALIZATION,
    ),
    Mutation(
        "normalization: small deviations are amplified",
        "np.maximum(self.action_std, 1e-3)",
        "np.maximum(self.action_std, 1e-9)",
        NORMALIZATION,
    ),
    Mutation(
        "windows: one that ends after its span is kept",
        "windows = first + frames[frames[:, -1] < count]",
        "windows = first + np.minimum(frames, count - 1)",
        WINDOWS,
    ),
    Mutation(
        "windows: of two nearest frames the earlier one is taken",
        "return after - (share < 0.5 - _TIE)",
        "return after - (share <= 0.5 + _TIE)",
        WINDOWS,
    ),
    Mutation(
        "sharding: the ratio of a device instead of the whole batch's",
        "whole = over_devices(jax.lax.stop_gradient(weight), axis_name)",
        "whole = jax.lax.stop_gradient(weight)",
        SHARDING,
    ),
    Mutation(
        "sharding: a batch that does not divide is accepted",
        "if loop.batch_size % (devices * loop.accumulate):",
        "if loop.batch_size % devices:",
        SHARDING,
    ),
    Mutation(
        "resume: every step draws the same numbers",
        "key = jax.random.fold_in(jax.random.key(loop.seed + 1), state.step)",
        "key = jax.random.fold_in(jax.random.key(loop.seed + 1), 0)",
        (*RESUME, "test_state.py", "test_sharding.py"),
    ),
    Mutation(
        "resume: a resumed loader begins at the start",
        "Prefetch(loader(data),",
        "Prefetch(loader(None),",
        RESUME,
    ),
)


def main() -> None:
    """Tries the named mutations; exits with 1 if one survived or could not be tried."""
    arguments = sys.argv[1:]
    wanted = tuple(argument for argument in arguments if not argument.startswith("--"))
    chosen = [each for each in MUTATIONS if not wanted or each.name.startswith(wanted)]
    if "--list" in arguments:
        print("\n".join(each.name for each in chosen))
        return
    verdicts = []
    for mutation in chosen:
        verdict = try_mutation(mutation, ROOT)
        print(f"{verdict:<10} {mutation.name}", flush=True)
        verdicts.append(verdict)
    raise SystemExit(any(verdict != "killed" for verdict in verdicts))


def try_mutation(mutation: Mutation, root: Path) -> str:
    """Returns "killed", "survived", or why the mutation could not be tried: "no anchor", "no test", "error"."""
    places = anchors(mutation, root)
    tests = [str(path.relative_to(root)) for name in mutation.tests for path in sorted((root / "tests").rglob(name))]
    if len(places) != 1:
        return "no anchor"
    if not tests:
        return "no test"
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "tree"
        copy_tree(root, copy)
        changed = copy / places[0].relative_to(root)
        changed.write_text(changed.read_text().replace(mutation.right, mutation.wrong))
        return run_tests(copy, tests)


def anchors(mutation: Mutation, root: Path) -> list[Path]:
    """Returns the file of each place where the right text stands."""
    places: list[Path] = []
    for path in sorted((root / "rsjax").rglob("*.py")):
        places += [path] * path.read_text().count(mutation.right)
    return places


def copy_tree(root: Path, copy: Path) -> None:
    """Copies what the tests need."""
    copy.mkdir()
    for name in COPIED:
        source = root / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.exists():
            shutil.copy(source, copy / name)


def run_tests(tree: Path, tests: list[str]) -> str:
    """Runs test files until one test fails, and returns the verdict."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return "error"
    return {0: "survived", FAILED: "killed"}.get(done.returncode, "error")


if __name__ == "__main__":
    main()
