"""PyTorch's side of the benchmark: which models it has, and that everything is timed in both types."""

from functools import partial
from typing import Any

import pytest

from benchmarks.pytorch.baselines import check_torch, torch_baseline
from rsjax.config import Config, ConfigError, Departures, PublicCodeConfig, presets
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.tools.bench.run import bench


def toy(**model: Any) -> Config:
    """A model small enough to be measured in no time, with other fields of its settings as given."""
    settings = {"width": 16, "blocks": 1, "depth": "none"} | model
    return with_values(presets.get("debug"), {f"model.{name}": value for name, value in settings.items()})


@pytest.mark.parametrize(
    ("config", "line"),
    [
        (presets.get("tiny"), "model.departures.more_norms is on"),
        (toy(departures=Departures(more_norms=True)), "model.departures.more_norms is on"),
        (toy(public_code=PublicCodeConfig(qk_norm=True)), "model.public_code.qk_norm is on"),
        (toy(public_code=PublicCodeConfig(mup=True)), "model.public_code.mup is on"),
        (toy(departures=Departures(rotary=True)), "model.departures.rotary is on"),
        (toy(state_heads="on"), "the network has state_heads"),
        (toy(action_encoder="norms"), "model.action_encoder is norms"),
        (toy(**{"departures.action_dropout": 0.1, "sample.guidance": 2.0}), "model.sample.guidance is 2.0"),
    ],
    ids=["tiny", "more_norms", "qk_norm", "mup", "rotary", "state_heads", "norms", "guidance"],
)
def test_a_model_that_torch_lacks_is_refused(config: Config, line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        check_torch(config)


def test_without_torch_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.pytorch.baselines.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'rsjax\[torch\]'"):
        check_torch(toy())


@pytest.mark.parametrize(("horizon", "compiler"), [(3, "eager"), (48, "none")])
def test_torch_is_timed_in_both_types_on_jaxs_device(horizon: int, compiler: str) -> None:
    pytest.importorskip("torch")
    measured = bench(toy(), only=[], horizons=(horizon,), budget=0.0, rival=partial(torch_baseline, compiler=compiler))
    assert (measured["torch_device"] == "cpu") == (measured["platform"] == "cpu")
    assert all(
        measured[f"torch_{name}_{dtype}"] > 0
        for name in ("train_step_s", "sample_s_per_frame")
        for dtype in ("float32", "bfloat16")
    )
    assert all(
        measured[f"torch_tokenizer_{way}_frames_per_s_bfloat16_channels_last"] > 0 for way in ("encode", "decode")
    )
    if compiler == "eager":
        assert measured["torch_train_step_s_bfloat16_compiled"] > 0 and measured["torch_compile_s"] > 0
    else:
        assert measured["torch_compile"].startswith("unavailable: ")
        assert "torch_train_step_s_bfloat16_compiled" not in measured
