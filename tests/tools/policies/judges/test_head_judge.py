"""The judge of a model's own success head, and how whole clips are judged."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import StateHeadsConfig
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.models.base import TeacherForced
from rsjax.tools.policies.judges.head_judge import HeadJudge, head_judge, head_rule, likeliest, matching_shift
from rsjax.tools.policies.judges.judge import FAIL, SUCCESS, all_successes
from rsjax.tools.policies.judges.judge_training import head_validation
from rsjax.tools.policies.judges.trained_judge import Footage
from rsjax.tools.policies.judges.validation import outcomes, validate, whole_clips
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from tests.tools.pipeline import toy
from tests.tools.policies.judges.test_judge import footage
from tests.tools.policies.toy import CONTROLS, WIDTH, picture
from tests.tools.policies.toy_worlds import action_range, trained_like

P = np.array([0.9, 0.2, 0.8, 0.7])


def state_of(success: np.ndarray) -> np.ndarray:
    return np.stack([success, np.full_like(success, 0.1), np.full_like(success, 0.05)], axis=-1)[None]


def test_frames_in_a_row_count_by_the_least_of_them() -> None:
    verdicts = np.random.default_rng(0).dirichlet((1, 1, 1), (3, 5))
    joined = all_successes(verdicts)
    for video in range(5):
        least = min(verdicts[k, video, SUCCESS] for k in range(3))
        assert joined[video, SUCCESS] == least
        assert joined[video].sum() == pytest.approx(1)
        assert joined[video, 2] == verdicts[-1, video, 2]
    np.testing.assert_array_equal(all_successes(verdicts[:1]), verdicts[0])


def test_a_head_judges_by_the_last_frames_that_it_read() -> None:
    assert HeadJudge().read(state_of(P))[0].tolist() == pytest.approx([0.7, 0.3, 0])
    assert HeadJudge(3).read(state_of(P))[0].tolist() == pytest.approx([0.2, 0.8, 0])
    unknown = state_of(np.array([np.nan, 0.9]))
    assert HeadJudge(2).read(unknown)[0].argmax() == FAIL
    assert HeadJudge(3).read(state_of(P[2:]))[0].tolist() == pytest.approx([0.7, 0.3, 0])  # no more frames yet
    assert HeadJudge(1).key != HeadJudge(2).key
    with pytest.raises(UserError) as caught:
        head_judge(SimpleNamespace(config=toy.config()), Path("runs/a"))  # type: ignore[arg-type]
    assert "runs/a: has no state heads" in str(caught.value)
    assert "--model.state-heads on" in str(caught.value)


@pytest.mark.parametrize("in_a_row", [1, 2])
@pytest.mark.parametrize("true", [0, 7, 20])
def test_a_shifted_head_calls_as_many_videos_a_success_as_truly_are_one(in_a_row: int, true: int) -> None:
    rng = np.random.default_rng(true)
    state = np.concatenate([state_of(p) for p in rng.random((20, 6))])
    success = np.zeros((20, 6), bool)
    success[rng.permutation(20)[:true], 3] = True
    judge = HeadJudge(in_a_row, shift=matching_shift(likeliest(state, in_a_row), success.max(axis=1)))
    called = np.zeros(20, bool)
    for t in range(6):
        called |= judge.read(state[:, : t + 1]).argmax(-1) == SUCCESS
    assert called.sum() == true
    assert judge.key != HeadJudge(in_a_row).key


def test_whole_clips_succeed_where_some_frame_does() -> None:
    rng = np.random.default_rng(1)
    verdicts = rng.dirichlet((1, 1, 1), (7, 40))
    success = rng.random((40, 7)) < 0.1
    for count in (1, 2):
        wrong = {"false_success": [0, 0], "false_failure": [0, 0]}
        for clip in range(40):
            called = False
            for t in range(7):
                row = verdicts[max(0, t - count + 1) : t + 1, clip]
                least = row[:, SUCCESS].min()
                rest = row[-1, FAIL] + row[-1, SUCCESS] - least
                called |= bool(least > max(rest, row[-1, 2]))
            name = "false_failure" if success[clip].any() else "false_success"
            wrong[name][0] += called != success[clip].any()
            wrong[name][1] += 1
        found = outcomes(verdicts, success)[str(count)]
        for name, (errors, total) in wrong.items():
            assert found[name][0] == pytest.approx(errors / total), (count, name)


def test_a_validation_says_how_whole_clips_are_judged() -> None:
    some = footage(4, 0)

    def sure(frames: np.ndarray) -> np.ndarray:
        return np.tile([1.0, 0.0, 0.0], (len(frames), 1))

    result = validate(sure, Footage(some.rgb, np.zeros_like(some.success)))
    assert result["whole_clips"]["2"]["false_success"][0] == 1
    table = whole_clips({"raw": result})
    assert table is not None and len(table.rows) == len(result["whole_clips"])
    assert whole_clips({"raw": {"confusion": []}}) is None


class Reading:
    """An imagination whose head reads a probability that rises by 0.3 a step."""

    def restart(self, which: np.ndarray, first: Video, index: np.ndarray) -> Video:
        if which.all():
            self.p = np.zeros(len(which))
        self.p[which] = 0.1
        return replace(first, state=np.repeat(state_of(np.array([0.1])), len(first), 0))

    def step(self, actions: np.ndarray) -> Video:
        self.p = self.p + 0.3
        rgb = np.repeat(picture(0)[None, None], len(actions), 0)
        return Video(rgb, state=np.concatenate([state_of(np.array([p])) for p in self.p]))


class Imagining:
    def imagine(self, params: Any, assets: Any, count: int, depth: bool = True) -> Reading:
        return Reading()


@pytest.mark.parametrize(("in_a_row", "steps"), [(1, 2), (2, 3)])
def test_a_world_succeeds_when_the_head_says_so(in_a_row: int, steps: int) -> None:
    world = ModelWorld(trained_like(Imagining(), {}), 2, HeadJudge(in_a_row), action_range(1.0))
    first = FirstFrame(picture(0), None, 0)
    world.reset([first, first])
    rows = np.zeros((2, CONTROLS * WIDTH), np.float32)
    successes = []
    for _ in range(3):
        state = world.step(rows)
        successes.append(bool(state.success[0]))
    assert successes.index(True) == steps - 1
    assert state.read is not None
    np.testing.assert_allclose(state.read[0], [1.0, 0.1, 0.05])
    again = world.reset([first], which=np.array([True, False]))
    assert again.read is not None
    np.testing.assert_allclose(again.read[:, 0], [0.1, 1.0])
    assert again.success.tolist() == [False, True]


def test_heads_are_validated_on_true_frames_and_on_rollouts(tmp_path: Path) -> None:
    clips = [vars(toy.clip(number, success=number < 2)) for number in range(4)]
    success = np.stack([clip["success"] for clip in clips]).astype(float)

    def generate(params: Any, assets: Any, prompt: Video, actions: np.ndarray, index: Any, depth: bool) -> Video:
        read = np.stack([success[number] for number in index])  # sure, and always right
        return Video(prompt.rgb.repeat(actions.shape[1], 1), state=np.stack([read] * 3, -1))

    def teacher_forced(params: Any, assets: Any, video: Video, actions: np.ndarray, first: int) -> TeacherForced:
        wrong = 1 - success[:, first:]
        return TeacherForced({}, {}, None, np.stack([wrong] * 3, -1))

    cfg = toy.with_model(toy.config(), state_heads=StateHeadsConfig())
    model = SimpleNamespace(generate=generate, teacher_forced=teacher_forced)
    trained: Any = SimpleNamespace(config=cfg, model=model, params=None, assets=None)
    result = head_validation(trained, HeadJudge(2), clips)
    assert result["raw"]["right"][0] == 0
    assert result["generated"]["right"][0] == pytest.approx(1 - 2 / success[:, 1:].size)  # the first frames of success
    assert result["generated"]["whole_clips"]["1"]["right"][0] == 1
    write_json(tmp_path / "judge_head" / "validation.json", result | {"shift": -0.5})
    assert head_judge(trained, tmp_path).shift == -0.5
    assert head_rule(tmp_path) == HeadJudge(2, shift=-0.5)
    write_json(tmp_path / "judge_head" / "validation.json", result)
    assert head_judge(trained, tmp_path) == HeadJudge(2, json.loads(json.dumps(result)))
    assert (head_rule(tmp_path), head_rule(tmp_path / "elsewhere")) == (HeadJudge(2), HeadJudge())
    data = RunData(tmp_path)
    data.__dict__["trained"] = trained
    assert (
        data.world_judge(Path("head")) == data.world_judge(Path("head"), HeadJudge(2)) == head_judge(trained, tmp_path)
    )
    for rule in (HeadJudge(1), HeadJudge(2, shift=-0.5)):  # another run's, with which it is compared
        assert data.world_judge(Path("head"), rule) == rule
