import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.ingest.annotators.protocols import AnnotationError
from rsjax.tools.ingest.annotators.semantics import (
    AnswerError,
    InternVL,
    OwnSemantics,
    complete,
    parse_answer,
    valid_answer,
)
from rsjax.tools.ingest.episode import Segment
from tests.tools.ingest.videos import episode, sliding

GOOD = {"action": "Lift the cube.", "skill": "Lift", "scene": "a table", "key_picture": 2}
FRAMES = sliding(20, (1, 0), (16, 16))
PARTS = (Segment(0, 8, "reach for it", "Reach"), Segment(8, 20, ""))


def saying(*answers):
    """A network that gives these answers, one after the other, and keeps the questions."""

    def ask(pictures, question):
        ask.seen.append((pictures, question))
        return answers[len(ask.seen) - 1]

    ask.seen = []
    return ask


def test_a_valid_answer_is_parsed():
    answer = parse_answer(json.dumps(GOOD), 3)
    assert (answer.action, answer.skill, answer.scene, answer.key_picture) == ("Lift the cube.", "lift", "a table", 1)
    assert parse_answer(f"```json\n{json.dumps(GOOD)}\n```", 3) == answer


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"key_picture": 0}, "1 to 3"),
        ({"key_picture": 4}, "1 to 3"),
        ({"key_picture": "2"}, "1 to 3"),
        ({"key_picture": True}, "1 to 3"),
        ({"action": " "}, "action is empty"),
        ({"action": 5}, "action is not a text"),
        ({"action": "x" * 201}, "at most 200"),
        ({"skill": "pick up"}, "one word"),
        ({"skill": ""}, "one word"),
        ({"more": 1}, "fields"),
    ],
)
def test_an_answer_outside_the_schema_is_refused(change, wrong):
    with pytest.raises(AnswerError, match=wrong):
        parse_answer(json.dumps(GOOD | change), 3)


@pytest.mark.parametrize(
    "text", ["", "The robot lifts.", "[1]", "null", "{}", f"Sure! {json.dumps(GOOD)}", "[" * 10**5]
)
def test_anything_but_the_object_is_refused(text):
    with pytest.raises(AnswerError):
        parse_answer(text, 3)


ANY: st.SearchStrategy = (
    st.none() | st.booleans() | st.integers(-1, 4) | st.floats() | st.text(max_size=5) | st.just([])
)


@given(st.fixed_dictionaries(dict.fromkeys(GOOD, ANY)))
def test_any_json_is_an_answer_or_an_answer_error(value):
    try:
        answer = parse_answer(json.dumps(value), 3)
    except AnswerError:
        return
    assert answer.action and 0 <= answer.key_picture < 3


def test_a_refused_question_is_repeated_with_the_reason():
    ask = saying("no", json.dumps(GOOD | {"key_picture": 9}), json.dumps(GOOD))
    assert valid_answer(list(FRAMES.pictures[:3]), ask, 3, "e0").key_picture == 1
    assert [question.partition("refused: ")[2] for _, question in ask.seen] == [
        "",
        "it is not JSON",
        "key_picture is not a whole number from 1 to 3",
    ]


def test_without_a_valid_answer_the_last_reason_is_named():
    with pytest.raises(AnnotationError, match="e0: no valid answer in 2 tries, the last one: it is not JSON"):
        valid_answer(list(FRAMES.pictures[:3]), saying("no", "no"), 2, "e0")


def test_only_parts_without_text_are_asked_about_and_key_pictures_become_frames(tmp_path):
    recording = episode(FRAMES, "", PARTS)
    ask = saying(json.dumps(GOOD))
    found = complete(OwnSemantics()(recording, "top"), recording, "top", ask, InternVL(tmp_path, pictures=4))
    ((pictures, question),) = ask.seen
    np.testing.assert_array_equal(np.stack(pictures), FRAMES.pictures[[8, 12, 15, 19]])
    assert "numbered 1 to 4" in question
    first, second = found.parts
    assert (first.text, first.text_by) == ("reach for it", "segment")
    assert (second.text, second.text_by, second.skill) == ("Lift the cube.", "internvl", "lift")
    assert (second.key_frames, second.key_by) == ((12,), "internvl")
    assert found.scene == "a table"


def test_a_key_picture_counts_before_the_peak_of_motion(tmp_path):
    recording = episode(FRAMES, "", PARTS)
    motion = np.eye(20)[18]
    own = OwnSemantics()(recording, "top", motion)
    assert own.parts[1].key_by == "motion" and own.parts[1].key_frames != (12,)
    found = complete(own, recording, "top", saying(json.dumps(GOOD)), InternVL(tmp_path, pictures=4))
    assert (found.parts[1].key_frames, found.parts[1].key_by) == ((12,), "internvl")


def test_a_key_frame_of_the_gripper_stays(tmp_path):
    grip = np.where(np.arange(20) < 14, -1, 1).astype(np.float32)
    recording = episode(FRAMES, "", PARTS, grip)
    found = complete(OwnSemantics()(recording, "top"), recording, "top", saying(json.dumps(GOOD)), InternVL(tmp_path))
    assert (found.parts[1].key_frames, found.parts[1].key_by) == ((14,), "gripper")


def test_no_network_is_loaded_where_all_parts_have_text(tmp_path):
    recording = episode(FRAMES, "tidy up", PARTS)
    assert InternVL(tmp_path / "none")(recording, "top") == OwnSemantics()(recording, "top")


def test_the_real_network_sees_every_picture_and_is_checked(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    pytest.importorskip("transformers")
    pytest.importorskip("torchvision", reason="transformers' processor of videos needs it")
    from tests.tools.ingest.annotators.networks.internvl import save_small

    recording = episode(FRAMES, "", PARTS)
    settings = InternVL(save_small(tmp_path), pictures=3, tries=2, new_tokens=4)
    model, _ = settings.load()
    shapes = []
    generate = model.generate
    monkeypatch.setattr(model, "generate", lambda **x: shapes.append(x["pixel_values"].shape) or generate(**x))
    with pytest.raises(AnnotationError, match="episode e0: no valid answer in 2 tries"):
        settings(recording, "top")
    assert [tuple(shape) for shape in shapes] == [(3, 3, 28, 28)] * 2
