import dataclasses
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.ablation.fields import GridError, leaves, parse_value, with_values
from rsjax.config import Config, ConfigError, from_dict, presets, to_dict

DEBUG = presets.debug()


def nested(config: Config) -> dict[str, Any]:
    """Dotted names and values from the configuration's JSON."""

    def walk(values: dict[str, Any], prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in values.items():
            found |= walk(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
        return found

    return walk(to_dict(config), "")


def test_the_leaves_are_the_configurations_json_by_dotted_names() -> None:
    found = leaves(DEBUG)
    assert {
        name: list(leaf.value) if isinstance(leaf.value, tuple) else leaf.value for name, leaf in found.items()
    } == (nested(DEBUG))
    assert found["train.log_every"].runtime
    assert not found["train.steps"].runtime


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "loss.gamma": st.floats(0, 100),
            "loss.depth": st.floats(0, 10),
            "model.depth": st.booleans(),
            "train.optimizer.learning_rate": st.floats(1e-6, 1),
            "train.seed": st.integers(0, 2**31),
            "sample.unmask": st.sampled_from(["random", "greedy"]),
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
    assert all(leaves(changed)[name].value == value for name, value in values.items())


def test_fields_that_only_fit_together_are_set_together() -> None:
    changed = with_values(DEBUG, {"model.width": 33, "model.heads": 3})
    assert (changed.model.width, changed.model.heads) == (33, 3)
    for alone in ({"model.width": 33}, {"tokenizer.code_bits": 10}):
        with pytest.raises(ConfigError):
            with_values(DEBUG, alone)


@pytest.mark.parametrize("name", [n for n, leaf in leaves(DEBUG).items() if not isinstance(leaf.value, tuple)])
def test_a_value_as_printed_is_read_back(name: str) -> None:
    leaf = leaves(DEBUG)[name]
    value = parse_value(name, leaf.kind, str(leaf.value))
    assert value == leaf.value
    assert type(value) is type(leaf.value)


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("model.depth", "Tru", "model.depth is 'Tru' in the grid; did you mean 'True'? (choices: True, False)"),
        ("sample.unmask", "greed", "did you mean 'greedy'? (choices: random, greedy)"),
        ("loss.gamma", "five", "loss.gamma is 'five' in the grid; it takes a number"),
        ("loss.gamma", "nan", "it takes a number"),
        ("loss.num_keypoints", "8.5", "it takes a whole number"),
        ("tokenizer.channel_multipliers", "1", "holds more than one value"),
    ],
)
def test_a_value_of_another_type_is_refused(name: str, text: str, line: str) -> None:
    with pytest.raises(GridError) as caught:
        parse_value(name, leaves(DEBUG)[name].kind, text)
    assert line in str(caught.value)


def test_every_field_is_found_that_dataclasses_have() -> None:
    def count(part: Any) -> int:
        values = [getattr(part, field.name) for field in dataclasses.fields(part)]
        return sum(count(value) if dataclasses.is_dataclass(value) else 1 for value in values)

    assert len(leaves(DEBUG)) == count(DEBUG)
