import dataclasses
import io
import json
from typing import Any

import pytest
from rich.console import Console

from rsjax import presets
from rsjax.bench import parts
from rsjax.bench.run import PARTS, bench, ratios, table
from rsjax.config import Config
from rsjax.errors import UserError


def toy() -> Config:
    debug = presets.get("debug")
    model = dataclasses.replace(debug.model, width=16, blocks=1, depth=False)
    return dataclasses.replace(debug, model=model)


@pytest.fixture(scope="module")
def numbers() -> dict[str, Any]:
    """All parts of a toy model, with the matrix products small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "CPU_PRODUCTS", ((64, 16, 32), (128, 64, 64)))
        patch.setattr(parts, "ACCELERATOR_PRODUCTS", ((64, 16, 32), (128, 64, 64)))
        return bench(toy(), batch=2, horizons=(4, 6), budget=0.0)


def test_every_quantity_is_there_positive_and_flat(numbers: dict[str, Any]) -> None:
    measured = {
        "matmul_ceiling_flops",
        "train_step_s",
        "train_tokens_per_s",
        "train_flops",
        "train_share_of_ceiling",
        "compile_s",
        "sample_s_per_frame_cached",
        "sample_s_per_frame_cached_4",
        "sample_s_per_frame_cached_6",
        "sample_s_per_frame_uncached",
        "sample_s_per_frame_uncached_4",
        "sample_s_per_frame_uncached_6",
        "tokenizer_encode_frames_per_s",
        "tokenizer_decode_frames_per_s",
        "loader_clips_per_s",
        "peak_memory_bytes",
    }
    assert measured <= numbers.keys()
    assert all(numbers[name] > 0 for name in measured)
    assert all(isinstance(value, str | int | float) for value in numbers.values())
    assert json.loads(json.dumps(numbers)) == numbers


def test_quantities_agree_with_one_another(numbers: dict[str, Any]) -> None:
    config = toy()
    step = numbers["train_step_s"]
    assert numbers["train_tokens_per_s"] == pytest.approx(2 * config.sim.frames * config.model.grid**2 / step)
    assert numbers["train_flops"] == pytest.approx(numbers["train_step_flops"] / step)
    assert numbers["matmul_ceiling_flops"] == max(numbers["matmul_flops_64x16x32"], numbers["matmul_flops_128x64x64"])
    assert numbers["sample_s_per_frame_cached"] == numbers["sample_s_per_frame_cached_4"]
    peaks = [numbers[f"{part}_peak_memory_bytes"] for part in PARTS]
    assert peaks == sorted(peaks) and numbers["peak_memory_bytes"] >= peaks[-1]


def test_the_table_has_a_row_for_every_key(numbers: dict[str, Any]) -> None:
    console = Console(width=120, file=io.StringIO())
    with console.capture() as shown:
        console.print(table(numbers))
    assert all(name in shown.get() for name in numbers)


def test_a_part_alone_measures_that_part() -> None:
    measured = bench(toy(), batch=1, only=["loader"], budget=0.0)
    assert "loader_clips_per_s" in measured
    assert not [name for name in measured if name.startswith(("train_", "sample_", "tokenizer_", "matmul_"))]


def test_torch_is_compared_with_a_single_branch_only() -> None:
    seconds = {"torch_train_step_s_float32": 6.0, "train_step_s": 2.0}
    assert ratios(seconds, dual=False) == {"train_speedup_over_torch_float32": 3.0}
    assert ratios(seconds, dual=True) == {}


@pytest.mark.parametrize(
    ("request_", "line"),
    [
        ({"only": ["trian"]}, "--only has no part 'trian'; did you mean 'train'"),
        ({"batch": 0}, "--batch is 0"),
        ({"horizons": (1,)}, "--horizons has 1; the prompt alone is 1 frames"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_is(request_: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line):
        bench(toy(), **({"batch": 1} | request_))


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsjax.bench.torch_part.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'rsjax\[torch\]'"):
        bench(toy(), batch=1, torch=True)


def test_torch_is_timed_in_both_types() -> None:
    pytest.importorskip("torch")
    measured = bench(toy(), batch=1, only=[], budget=0.0, torch=True)
    assert all(
        measured[f"torch_{name}_{dtype}"] > 0
        for name in ("train_step_s", "sample_s_per_frame")
        for dtype in ("float32", "bfloat16")
    )
