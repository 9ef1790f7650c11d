"""Token records whose clips run backwards."""

from dataclasses import replace

import numpy as np
import pytest

from rsjax.config import BackwardsConfig, ConfigError, RoboScapeConfig, StateHeadsConfig, presets
from rsjax.config.config_fields import with_values
from rsjax.data.normalization import Normalization
from rsjax.data.store import Record, encode_clip
from rsjax.models.base import create_model
from rsjax.models.roboscape.departures.backwards import drawn_direction, undoing
from tests.tools.pipeline import toy

ALWAYS = BackwardsConfig(share=1.0, held=(2,))


@pytest.fixture
def record() -> Record:
    grid = np.arange(6 * 8 * 8, dtype=np.int32).reshape(6, 8, 8)
    actions = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    actions[0] = 0
    return encode_clip(toy.clip(0)) | {"rgb": grid, "depth": None, "actions": actions}


def test_the_actions_lead_back(record: Record) -> None:
    poses = np.cumsum(record["actions"], axis=0)  # of the steps
    back = undoing(record["actions"], held=(2,))
    np.testing.assert_allclose(np.cumsum(back, axis=0)[:, :2], (poses - poses[-1])[::-1, :2], atol=1e-6)
    np.testing.assert_array_equal(back[1:-1, 2], record["actions"][1:-1, 2][::-1])
    assert back[-1, 2] == record["actions"][1, 2]  # nobody knows what was held in the first frame
    assert not back[0].any()


def test_frames_and_tracks_turn_together(record: Record) -> None:
    record = record | {"depth": record["rgb"] + 1, "second": record["rgb"] + 2}
    turned = drawn_direction(ALWAYS, record, np.random.default_rng(0))
    for name in ("rgb", "depth", "second"):
        np.testing.assert_array_equal(turned[name], record[name][::-1])
    np.testing.assert_array_equal(turned["tracks"], record["tracks"][:, ::-1])
    np.testing.assert_array_equal(turned["visible"], record["visible"][:, ::-1])
    assert drawn_direction(ALWAYS, record | {"depth": None}, np.random.default_rng(0))["depth"] is None
    again = drawn_direction(BackwardsConfig(share=1.0), turned, np.random.default_rng(0))
    np.testing.assert_array_equal(again["actions"][:, :2], record["actions"][:, :2])


def test_a_share_of_the_clips_runs_backwards(record: Record) -> None:
    rng = np.random.default_rng(0)
    drawn = [drawn_direction(BackwardsConfig(share=0.25), record, rng) is not record for _ in range(400)]
    assert 70 < sum(drawn) < 130
    assert drawn_direction(None, record, rng) is record


def test_a_models_loader_turns_its_clips(record: Record) -> None:
    config = with_values(toy.config(), {"model.backwards.share": 1.0})
    normalization = Normalization((0.0,) * 3, (1.0,) * 3, None)
    arrays = create_model(config).transform(normalization)(record, np.random.default_rng(0))
    np.testing.assert_array_equal(arrays["rgb"], record["rgb"][::-1])


def test_labels_of_the_state_cannot_turn() -> None:
    model = presets.debug().model
    assert isinstance(model, RoboScapeConfig)
    with pytest.raises(ConfigError) as caught:
        replace(model, backwards=BackwardsConfig(), state_heads=StateHeadsConfig())
    assert "switch one off" in str(caught.value)
