import dataclasses
import json
from typing import Any, ClassVar, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.config import Config, ConfigError, Muon, content_key, from_dict, presets, to_dict
from rsjax.config.config_fields import config_fields, with_sections, with_values

DEBUG = presets.debug()


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted names and values of a configuration's JSON."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        out |= flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return out


def test_config_fields_are_the_configurations_json_by_dotted_names() -> None:
    known = config_fields(DEBUG)
    saved = flat(to_dict(DEBUG))
    for name, field in known.items():
        if not field.section:
            assert saved[name] == (list(field.value) if isinstance(field.value, tuple) else field.value)
    classes = {"model.family", "train.optimizer.kind", "tokenizer_train.optimizer.kind", "model.depth.kind"}
    assert set(saved) - set(known) == classes
    assert known["runtime.log_every"].runtime
    assert not known["train.steps"].runtime


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "prompt_frames": st.integers(1, 5),
            "model.loss.gamma": st.floats(0, 100),
            "model.loss.depth_weight": st.floats(0, 10),
            "train.optimizer.learning_rate": st.floats(1e-6, 1),
            "train.seed": st.integers(0, 2**31),
            "model.sample.unmask": st.sampled_from(["random", "greedy"]),
        },
    )
)
def test_values_reach_their_fields_and_no_other(values: dict[str, Any]) -> None:
    expected = to_dict(DEBUG)
    for name, value in values.items():
        *path, last = name.split(".")
        section = expected
        for part in path:
            section = section[part]
        section[last] = value
    changed = with_values(DEBUG, values)
    assert changed == from_dict(Config, expected)
    assert all(config_fields(changed)[name].value == value for name, value in values.items())


def test_fields_that_only_fit_together_are_set_together() -> None:
    changed = with_values(DEBUG, {"model.width": 33, "model.heads": 3})
    known = config_fields(changed)
    assert (known["model.width"].value, known["model.heads"].value) == (33, 3)
    alone = {"model.width 33 is not divisible": {"model.width": 33}, "code_bits 9 does not": {"tokenizer.code_bits": 9}}
    for reason, values in alone.items():
        with pytest.raises(ConfigError) as refused:
            with_values(DEBUG, values)
        assert reason in str(refused.value)


@dataclasses.dataclass(frozen=True)
class Slow:
    kind: ClassVar[str] = "slow"
    rate: float = 1.0


@dataclasses.dataclass(frozen=True)
class Fast:
    kind: ClassVar[str] = "fast"
    rate: float = 2.0
    drops: tuple[int, ...] = ()


@dataclasses.dataclass(frozen=True)
class Parts:
    driver: Slow | Fast = Fast()
    extra: Slow | None = None


def test_a_section_of_which_there_is_a_choice_is_a_field_with_the_word_that_chooses_it() -> None:
    known = config_fields(Parts())
    assert {name: field.value for name, field in known.items()} == {
        "driver": "fast",
        "driver.rate": 2.0,
        "driver.drops": (),
        "extra": "off",
    }
    assert [name for name, field in known.items() if field.section] == ["driver", "extra"]
    assert get_args(known["driver"].kind) == ("slow", "fast")
    assert get_args(known["extra"].kind) == ("on", "off")


def test_a_section_is_changed_by_its_word_by_itself_or_by_a_field_in_it() -> None:
    parts = Parts(driver=Fast(rate=3.0, drops=(1,)))
    assert with_values(parts, {"driver": "fast"}) == parts
    assert with_values(parts, {"driver": "slow"}) == Parts(Slow(rate=3.0)), "shared fields stay"
    assert with_values(parts, {"driver": "slow", "driver.rate": 4.0}) == Parts(Slow(rate=4.0))
    assert with_values(parts, {"driver": Slow()}) == Parts(Slow())
    assert with_values(parts, {"extra": "on"}).extra == with_values(parts, {"extra.rate": 1.0}).extra == Slow()
    assert with_values(Parts(extra=Slow()), {"extra": "off"}) == with_values(Parts(), {"extra": None}) == Parts()
    assert with_sections(Parts(), ["extra.rate", "driver.rate"]) == Parts(extra=Slow())


def test_a_section_of_another_class_takes_no_choice_that_it_does_not_have() -> None:
    full = presets.get("roboscape_s")
    assert full.tokenizer_train.optimizer.schedule == "steps"
    changed = with_values(full, {"tokenizer_train.optimizer": "muon"})
    assert changed.tokenizer_train.optimizer == Muon(learning_rate=1e-4, warmup_steps=0)
    assert from_dict(Config, to_dict(changed)) == changed


@pytest.mark.parametrize("parts", [Parts(), Parts(Slow(rate=3.0), Slow())])
def test_sections_survive_json(parts: Parts) -> None:
    assert from_dict(Parts, json.loads(json.dumps(to_dict(parts)))) == parts
    assert content_key(Parts(Slow())) != content_key(Parts(Fast(rate=1.0)))


def test_a_section_of_no_known_kind_is_refused() -> None:
    for driver in ({"rate": 1.0}, {"kind": "quick"}, 3):
        with pytest.raises(ConfigError) as caught:
            from_dict(Parts, {"driver": driver})
        assert "Parts.driver must be fields with a kind, slow or fast" in str(caught.value)


@dataclasses.dataclass(frozen=True)
class Base:
    width: int = 1


@dataclasses.dataclass(frozen=True)
class Family(Base):
    gamma: float = 5.0


@dataclasses.dataclass(frozen=True)
class Whole:
    model: Base = Family()


def test_the_fields_of_a_section_are_those_of_its_own_class() -> None:
    assert list(config_fields(Whole())) == ["model.width", "model.gamma"]
    assert list(config_fields(Whole(Base()))) == ["model.width"]
    assert with_values(Whole(), {"model.gamma": 2.0}) == Whole(Family(gamma=2.0))
