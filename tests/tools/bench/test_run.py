import contextlib
import dataclasses
import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from rsjax.config import Config, presets
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.models.cogvideox.config import TextConfig
from rsjax.models.cogvideox.text import texts_of
from rsjax.tools.bench import parts
from rsjax.tools.bench.run import PARTS, _shown, bench, ratios, terminal_table
from tests.models.cogvideox import toy as cogvideox


def toy(**model: Any) -> Config:
    """A model small enough to be measured in no time, with other fields of its settings as given."""
    settings = {"width": 16, "blocks": 1, "depth": "none"} | model
    return with_values(presets.get("debug"), {f"model.{name}": value for name, value in settings.items()})


@pytest.fixture(scope="module")
def numbers() -> dict[str, Any]:
    """All parts of a toy model, with the matrix products small.

    Its batch of one clip is one part on one device, whatever the preset has.
    """
    config = with_values(toy(), {"train.accumulate": 2, "runtime.sharding": "mesh", "runtime.fsdp": 2})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "CPU_PRODUCTS", ((64, 16, 32), (128, 64, 64)))
        patch.setattr(parts, "ACCELERATOR_PRODUCTS", ((64, 16, 32), (128, 64, 64)))
        patch.setattr(parts, "ENVIRONMENTS", (1,))
        patch.setattr("rsjax.tools.bench.roofline.STREAM", 2**12)
        return bench(config, horizons=(4,), budget=0.0)


def test_every_quantity_is_there_positive_and_flat(numbers: dict[str, Any]) -> None:
    measured = {
        "matmul_ceiling_flops",
        "train_step_s",
        "train_tokens_per_s",
        "train_flops",
        "train_share_of_ceiling",
        "compile_s",
        "roofline_qkv_s",
        "roofline_optimizer_least_s",
        "roofline_sum_share",
        "roofline_encode_sum_s",
        "roofline_decode_sum_share",
        "roofline_cached_pass_least_s",
        "sample_s_per_frame_cached",
        "sample_s_per_frame_cached_4",
        "sample_s_per_frame_uncached",
        "sample_s_per_frame_uncached_4",
        "tokenizer_encode_frames_per_s",
        "tokenizer_decode_frames_per_s",
        "environment_steps_per_s_1",
        "loader_clips_per_s",
        "feed_step_s",
        "data_wait_share",
        "peak_memory_bytes",
    }
    assert measured <= numbers.keys()
    assert all(numbers[name] > 0 for name in measured)
    assert all(isinstance(value, str | int | float) for value in numbers.values())
    assert json.loads(json.dumps(numbers)) == numbers


def test_quantities_agree_with_one_another(numbers: dict[str, Any]) -> None:
    config = toy()
    step = numbers["train_step_s"]
    assert numbers["train_tokens_per_s"] == pytest.approx(config.clips.frames * config.grid**2 / step)
    assert numbers["train_flops"] == pytest.approx(numbers["train_step_flops"] / step)
    assert numbers["matmul_ceiling_flops"] == max(numbers["matmul_flops_64x16x32"], numbers["matmul_flops_128x64x64"])
    assert numbers["roofline_sum_s"] > sum(numbers[f"roofline_{name}_s"] for name in ("qkv", "gelu", "loss"))
    assert numbers["roofline_sum_share"] == numbers["roofline_sum_least_s"] / numbers["roofline_sum_s"]
    assert numbers["sample_s_per_frame_cached"] == numbers["sample_s_per_frame_cached_4"]
    assert numbers["data_wait_share"] == pytest.approx(numbers["data_wait_s"] / numbers["feed_step_s"])
    peaks = [numbers[f"{part}_peak_memory_bytes"] for part in PARTS]
    assert peaks == sorted(peaks) and numbers["peak_memory_bytes"] >= peaks[-1]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("environment_steps_per_s_64", "73.8 /s"),
        ("roofline_bandwidth_bytes_per_s", "0.0 GB/s"),
        ("train_tokens_per_s", "73.8 /s"),
        ("train_step_s", "73.760 s"),
        ("sample_s_per_frame_cached_16", "73.760 s"),
    ],
)
def test_rates_and_times_have_their_units(name: str, text: str) -> None:
    assert _shown(name, 73.76) == text


def test_the_table_has_a_row_for_every_key(numbers: dict[str, Any]) -> None:
    console = Console(width=120, file=io.StringIO())
    with console.capture() as shown:
        console.print(terminal_table(numbers))
    assert all(name in shown.get() for name in numbers)


def test_the_share_of_waiting_is_that_of_a_slow_loader(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock by which a step takes a second, a batch three, and nothing else any time."""
    clock = [0.0]

    class Batches(contextlib.nullcontext):  # type: ignore[type-arg]
        waited = 0.0

        def __next__(self) -> Any:
            clock[0] += 3.0
            self.waited += 3.0
            return SimpleNamespace(batch=None)

    def step(state: Any, batch: Any) -> tuple[Any, Any]:
        clock[0] += 1.0
        return state, {}

    batches = Batches()
    batches.enter_result = batches
    monkeypatch.setattr(parts, "Prefetch", lambda *_: batches)
    monkeypatch.setattr(parts, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(parts.Sharding, "create", lambda loop: SimpleNamespace(compile=lambda *_: step, put_batch=None))
    monkeypatch.setattr(parts, "create_state", lambda model, loop: 0)
    measured = bench(toy(), only=["feed"], budget=0.0)
    assert measured["data_wait_share"] == 0.75
    assert (measured["feed_steps"], measured["feed_batch"]) == (parts.LEAST, toy().train.batch_size)


def test_a_file_of_texts_need_not_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sampling reads one of the right shape, which is gone after the benchmark."""
    files = []

    def sample(config: Config, *_: Any) -> dict[str, Any]:
        text = config.model.text  # type: ignore[attr-defined]
        files.append(text.file)
        return {"sample_shape": str(texts_of(text, None, 3).shape)}

    monkeypatch.setattr(parts, "sample", sample)
    config = cogvideox.config(text=TextConfig(tokens=2, width=4, file="missing.safetensors"))
    assert bench(config, only=["sample"])["sample_shape"] == "(3, 2, 4)"
    assert not Path(files[0]).exists()


def test_rollouts_begin_with_one_frame_whatever_the_preset_trains_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a rollout of two frames one is left to decode, with the cache and without."""
    seen: dict[bool, list[tuple[int, int]]] = {True: [], False: []}

    def rollout(_: Any, __: Any, ___: Any, prompt: Any, actions: Any, key: Any, cached: bool) -> None:
        seen[cached].append((prompt["rgb"].shape[1], actions.shape[1]))

    monkeypatch.setattr(parts, "rollout", rollout)
    monkeypatch.setattr(parts.RoboScape, "init", lambda model, key: {})
    monkeypatch.setattr(parts, "median_seconds", lambda call, budget: call() or 6.0)
    config = dataclasses.replace(toy(), prompt_frames=3)
    numbers = parts.sample(config, 1, 0.0, (2, 4, 7))
    assert seen == {True: [(1, 2), (1, 4), (1, 7)], False: [(1, 2), (2, 4), (5, 7)]}
    assert numbers["sample_prompt_frames"] == 1
    assert [numbers[f"sample_uncached_frames_measured_{frames}"] for frames in (2, 4, 7)] == [1, 2, 2]
    assert [numbers[f"sample_s_per_frame_cached_{frames}"] for frames in (2, 4, 7)] == [6.0, 2.0, 1.0]
    assert numbers["sample_uncached_frames_measured"] == 1
    assert numbers["sample_cost_ratio_7_over_2"] == 1 / 6
    assert not [name for name in parts.sample(config, 1, 0.0, (4,)) if "ratio" in name]


@pytest.mark.parametrize(
    ("torch", "jax", "dual", "compared"),
    [
        ("cpu", "cpu", False, True),
        ("cuda", "gpu", False, True),
        ("cpu", "gpu", False, False),
        ("cpu", "cpu", True, False),
    ],
)
def test_torch_is_compared_on_one_device_and_with_a_single_branch_only(
    torch: str, jax: str, dual: bool, compared: bool
) -> None:
    numbers = {"torch_device": torch, "platform": jax, "torch_train_step_s_float32": 6.0, "train_step_s": 2.0}
    assert ratios(numbers, dual) == ({"train_speedup_over_torch_float32": 3.0} if compared else {})


def test_torchs_adamw_is_compared_with_our_step_with_adamw(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = []

    def train(config: Config, batch: int, budget: float) -> dict[str, float]:
        kinds.append(config.train.optimizer.kind)
        return {"train_step_s": 2.0}

    monkeypatch.setattr(parts, "train", train)
    config = toy()
    assert parts.train_adamw(config, 1, 0.0) == {} and not kinds
    measured = parts.train_adamw(with_values(config, {"train.optimizer": "muon"}), 1, 0.0)
    assert measured == {"train_step_s_adamw": 2.0} and kinds == ["adamw"]
    numbers = {"torch_device": "cpu", "platform": "cpu", "torch_train_step_s_float32": 6.0, "train_step_s": 4.0}
    assert ratios(numbers | measured, False) == {"train_speedup_over_torch_float32": 3.0}


@pytest.mark.parametrize(
    ("request_", "line"),
    [
        ({"only": ["trian"]}, "--only has no part 'trian'; did you mean 'train'"),
        ({"batch": 0}, "--batch is 0"),
        ({"horizons": (4, 1)}, "--horizons has 1; a rollout has 1 prompt frame"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is(request_: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line):
        bench(toy(), **request_)


def test_torchs_faster_variant_is_compared_and_named() -> None:
    plain = {"torch_device": "cpu", "platform": "cpu", "train_step_s": 2.0, "torch_train_step_s_bfloat16": 6.0}
    rate = "tokenizer_encode_frames_per_s"
    plain |= {rate: 2.0, f"torch_{rate}_bfloat16": 4.0}
    slower = plain | {"torch_train_step_s_bfloat16_compiled": 8.0, f"torch_{rate}_bfloat16_channels_last": 1.0}
    faster = plain | {"torch_train_step_s_bfloat16_compiled": 5.0, f"torch_{rate}_bfloat16_channels_last": 8.0}
    assert ratios(slower, False) == {
        "train_speedup_over_torch_bfloat16": 3.0,
        "train_fastest_torch_bfloat16": "eager",
        "tokenizer_encode_speedup_over_torch_bfloat16": 0.5,
        "tokenizer_encode_fastest_torch_bfloat16": "eager",
    }
    assert ratios(faster, False) == {
        "train_speedup_over_torch_bfloat16": 2.5,
        "train_fastest_torch_bfloat16": "compiled",
        "tokenizer_encode_speedup_over_torch_bfloat16": 0.25,
        "tokenizer_encode_fastest_torch_bfloat16": "channels_last",
    }


def test_a_rival_is_measured_last_beside_our_step_with_adamw(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, float, int]] = []

    def rival(config: Config, batch: int, budget: float, horizon: int) -> dict[str, Any]:
        calls.append((batch, budget, horizon))
        return {"torch_device": "cpu", "torch_train_step_s_float32": 6.0}

    monkeypatch.setattr(parts, "train", lambda *_: {"train_step_s": 2.0, "train_flops": 1.0})
    numbers = bench(toy(), batch=3, only=["train"], horizons=(4, 6), rival=rival, budget=0.5)
    assert calls == [(3, 0.5, 4)]
    assert numbers["train_speedup_over_torch_float32"] == 3.0
