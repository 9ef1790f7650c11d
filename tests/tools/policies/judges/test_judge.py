import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import logit

from rsjax.clip import Video
from rsjax.config import Config, StateHeadsConfig
from rsjax.data.codec import decode, encode
from rsjax.data.store import Store, write_store
from rsjax.errors import UserError
from rsjax.tools.policies.judges import judge_training as judging
from rsjax.tools.policies.judges import trained_judge as judge_module
from rsjax.tools.policies.judges.head_judge import head_rule
from rsjax.tools.policies.judges.judge import HISTORY, LABELS, SUCCESS, frames_of, last_frames
from rsjax.tools.policies.judges.people_and_vlms import HumanJudge, LanguageJudge, answer_label, write_blinded
from rsjax.tools.policies.judges.trained_judge import Footage, TrainedJudge, corrupted, load_judge, train_judge
from rsjax.tools.policies.judges.validation import confusion_table, markdown, scores, summary, validate
from tests.tools.pipeline import toy
from tests.tools.policies.toy_worlds import untrained_judge


def footage(videos: int, seed: int) -> Footage:
    """A square on a ramp that rises, in some videos above the middle, which is success."""
    rng, frames, size = np.random.default_rng(seed), 6, 32
    ramp = np.linspace(40, 120, size).astype(np.uint8)
    rgb = np.broadcast_to(ramp[None, None, :, None, None], (videos, frames, size, size, 3)).copy()
    height = rng.uniform(2, 12, (videos, 1)) + rng.uniform(0, 4, (videos, 1)) * np.arange(frames)
    column = rng.integers(0, size - 8, videos)
    for i, t in np.ndindex(videos, frames):
        top = size - 8 - int(height[i, t].clip(0, size - 8))
        rgb[i, t, top : top + 8, column[i] : column[i] + 8] = (230, 30, 30)
    return Footage(rgb, height > 12)


@pytest.fixture(scope="module")
def judge() -> TrainedJudge:
    return train_judge(footage(60, 0), footage(20, 1), steps=50)


def test_a_judge_tells_success_from_failure_and_from_spoilt_frames(judge: TrainedJudge) -> None:
    result = validate(judge, footage(20, 2), corrupt=True)
    assert result["right"][0] > 0.8, result
    assert np.sum(result["confusion"]) == 2 * 20 * 5
    assert all(result[f"{label}_found"][0] > 0.6 for label in LABELS), result
    assert len(confusion_table({"clips": 20, "raw": result}).rows) == 3
    facts = summary({"clips": 20, "raw": result})
    assert facts is not None and facts["raw"]["confusion"] == result["confusion"] and "bins" not in facts["raw"]
    cells = [" / ".join(map(str, row)) for row in result["confusion"]]
    assert f"| raw | {' | '.join(cells)} | {100 * result['right'][0]:.1f} % |" in " ".join(
        " ".join(markdown(facts)).split()
    )


def test_a_judge_comes_back_from_its_file_and_damage_is_named(judge: TrainedJudge, tmp_path: Path) -> None:
    judge.save(tmp_path / "judge")
    frames = footage(2, 3).rgb
    np.testing.assert_array_equal(load_judge(tmp_path / "judge", 32)(frames), judge(frames))
    assert load_judge(tmp_path / "judge").key == judge.key != replace(judge, temperature=3.0).key
    for name in ("judge", "run"):  # a directory of one, or the run's own
        with pytest.raises(UserError, match="was trained on frames of 32 × 32 pixels, these have 64 × 64"):
            judging.judge_of(tmp_path, tmp_path / name if name == "judge" else name, 64)
    report = tmp_path / "judge" / "validation.json"
    for name, known in ((judge.key, True), ("another", False)):
        report.write_text(json.dumps({"judge": name}))
        assert (load_judge(tmp_path / "judge").validation is not None) == known
    np.testing.assert_allclose(judge(frames).sum(-1), 1, rtol=1e-5)
    np.testing.assert_array_equal(judge(frames), judge(frames[:, -HISTORY:]))
    with pytest.raises(UserError, match="no judge there; train one with rsjax judge"):
        load_judge(tmp_path)
    (tmp_path / "judge" / "judge.msgpack").write_bytes(b"nonsense")
    with pytest.raises(UserError, match="damaged"):
        load_judge(tmp_path / "judge")
    one = footage(4, 0)
    with pytest.raises(UserError, match="both success and failure"):
        train_judge(Footage(one.rgb, np.zeros_like(one.success)), one, 1)


def test_a_judge_of_impossible_content_is_refused(judge: TrainedJudge, tmp_path: Path) -> None:
    folder = tmp_path / "judge"
    judge.save(folder)
    path = folder / "judge.msgpack"
    whole = decode(path.read_bytes())
    some = next(name for name, x in whole.items() if isinstance(x, np.ndarray))
    others: tuple[dict[str, Any], ...] = (
        *({"temperature": value} for value in (None, 0.0, -1.0, float("nan"), "warm", [1.0])),
        *({"side": value} for value in (0, -4, 10**9, None)),
        {some: np.zeros((2, 2), np.float32)},
        {some: whole[some].tolist()},
        *({some: whole[some].astype(kind)} for kind in (str, int, complex)),
        {some: np.full_like(whole[some], np.nan)},
        {"more": np.zeros(1, np.float32)},
        {name: None for name in whole if name not in ("temperature", "side")},
    )
    for changes in others:
        path.write_bytes(encode({name: x for name, x in (whole | changes).items() if x is not None}))
        with pytest.raises(UserError) as raised:
            load_judge(folder)
        assert "damaged" in str(raised.value), changes
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(UserError):
        load_judge(folder)
    path.unlink()
    judge.save(folder)
    good = {"confusion": [[1, 0, 0], [0, 1, 0], [0, 0, 0]], "right": [1.0, 0.5, 1.0], "calibration_error": 0.1}
    good["whole_clips"] = {"1": {"false_success": [0.5, 0.2, 0.8]}}
    for part in (None, 7, good | {"confusion": [[1]]}, good | {"right": None}, good | {"whole_clips": 3}):
        (folder / "validation.json").write_text(json.dumps({"judge": judge.key, "raw": part}))
        with pytest.raises(UserError) as raised:
            load_judge(folder)
        assert "its part 'raw'" in str(raised.value), part
    (folder / "validation.json").write_text(json.dumps({"judge": judge.key, "raw": good}))
    assert load_judge(folder).validation is not None


def test_a_trained_judge_may_ask_for_two_frames_in_a_row(judge: TrainedJudge, tmp_path: Path) -> None:
    two = replace(judge, in_a_row=2)
    frames = footage(2, 3).rgb
    expected = np.minimum(judge(frames)[:, SUCCESS], judge(frames[:, :-1])[:, SUCCESS])
    np.testing.assert_allclose(two(frames)[:, SUCCESS], expected, rtol=1e-6)
    np.testing.assert_allclose(two(frames[:, :1]), judge(frames[:, :1]), rtol=1e-6)
    assert (frames_of(judge), frames_of(two), frames_of(None)) == (HISTORY, HISTORY + 1, HISTORY)
    two.save(tmp_path)
    loaded = load_judge(tmp_path)
    assert loaded.key == two.key != judge.key
    assert loaded.in_a_row == 2


def test_histories_end_with_their_frame() -> None:
    some = footage(2, 0)
    np.testing.assert_array_equal(
        some.histories(np.array([1, 0]), np.array([1, 5])),
        np.stack([last_frames(some.rgb[1:2, :2])[0], some.rgb[0, 2:6]]),
    )


def test_every_history_is_spoilt_and_in_several_ways() -> None:
    frames, rng = footage(40, 4).rgb[:, :HISTORY], np.random.default_rng(0)
    changed = np.abs(corrupted(frames, frames[::-1], rng).astype(float) - frames).mean((1, 2, 3, 4))
    assert changed.min() > 1 and changed.max() > 10 * changed.min()


def test_no_history_is_put_on_top_of_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs: list[tuple[np.ndarray, np.ndarray]] = []

    def keep(frames: np.ndarray, others: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        pairs.append((frames, others))
        return frames

    monkeypatch.setattr(judge_module, "corrupted", keep)
    some, rng = footage(20, 5), np.random.default_rng(0)
    found = [np.argwhere(some.success == done) for done in (True, False)]
    for _ in range(30):
        judge_module._batch(some, found, rng)
    assert len(pairs) == 30
    assert all((one != other).any((1, 2, 3, 4)).all() for one, other in pairs)


def test_frames_whose_side_is_no_multiple_of_8_are_spoilt_but_for_a_border() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (40, HISTORY, 21, 21, 3), np.uint8)
    made = corrupted(frames, frames[::-1], np.random.default_rng(1))
    changed = made != frames
    assert changed[:, :, :16, :16].any((1, 2, 3, 4)).all()
    border = changed[:, :, 16:].any((1, 2, 3, 4)) | changed[:, :, :, 16:].any((1, 2, 3, 4))
    assert 0.25 < border.mean() < 0.75, "blocks and blur leave it"


def test_scores_agree_with_a_count_by_hand() -> None:
    sure = np.array([[0.9, 0.1, 0.0], [0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.2, 0.2, 0.6]])
    result = scores(sure, np.array([0, 1, 1, 1]))
    assert result["confusion"] == [[1, 0, 0], [1, 1, 1], [0, 0, 0]]
    assert result["right"][0] == 0.5 and result["success_found"][0] == 1
    assert result["fail_found"][0] == pytest.approx(1 / 3)
    assert "uninterpretable_found" not in result and result["uninterpretable_share"] == 0.25
    assert result["calibration_error"] == pytest.approx((abs(0.9 - 1) + abs(0.7 - 0) + 2 * abs(0.6 - 0.5)) / 4)


def use(monkeypatch: pytest.MonkeyPatch, model: Any, store: Store, config: Config | None = None) -> None:
    """Makes a model and a store those of any run."""
    trained = SimpleNamespace(config=config or toy.config(), model=model, params=None, assets=None)
    monkeypatch.setattr(judging, "load", lambda run: trained)
    monkeypatch.setattr(judging.Run, "open_clips", lambda self: store)


class Telling:
    """A model whose head reads the first number of a frame's action as the probability of success."""

    def generate(self, params: Any, assets: Any, prompt: Video, actions: np.ndarray, **options: Any) -> Video:
        state = np.repeat(np.clip(actions[..., :1], 0.01, 0.99), 3, axis=-1)
        return Video(prompt.rgb.repeat(actions.shape[1], 1), state=state)

    def teacher_forced(self, params: Any, assets: Any, video: Video, actions: np.ndarray, first: int) -> Video:
        return self.generate(params, assets, video.frames(0, 1), actions).frames(first)


def test_a_head_is_shifted_to_the_rate_of_clips_and_longer_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It reads 0.9 in one frame of a third of them; of those, every other truly succeeds, and its reading is higher."""
    store = toy.store(tmp_path / "clips")
    use(monkeypatch, Telling(), store, toy.with_model(toy.config(), state_heads=StateHeadsConfig()))
    stores = []
    for frames in (6, 9):
        records = []
        for number in range(12):
            record = vars(toy.clip(number)) | {"depth": None}
            for name in ("rgb", "actions"):
                record[name] = np.resize(record[name], (frames, *record[name].shape[1:]))
            record["actions"][:, 0] = 0.2
            record["success"] = np.zeros(frames, bool)
            if number % 3 == 0:
                record["actions"][frames - 2, 0] = 0.9 + 0.05 * (number % 2)
                record["success"][-1] = number % 2
            records.append(record)
        write_store(tmp_path / str(frames), "clips", {"train": records}, {"success_share": 0.2})
        stores.append(tmp_path / str(frames))
    validated = judging.validate_heads(tmp_path / "run", tmp_path, also=stores)
    rule = head_rule(tmp_path / "run")
    assert rule.shift == validated["shift"]
    assert -logit(0.95) < rule.shift < -logit(0.9)
    small = [record | {"rgb": record["rgb"][:, ::2, ::2]} for record in records]
    write_store(tmp_path / "small", "clips", {"train": small}, {"success_share": 0.2})
    with pytest.raises(UserError) as raised:
        judging.validate_heads(tmp_path / "run", tmp_path, also=[tmp_path / "small"])
    assert "name clips of the run's length, size and actions" in str(raised.value)


def test_a_runs_judge_is_made_and_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The toy's clips teach nothing, so a fresh network stands in for the result of its training."""

    def generate(params: Any, assets: Any, prompt: Video, actions: np.ndarray, **options: Any) -> Video:
        return Video(prompt.rgb.repeat(actions.shape[1], 1))

    judge = untrained_judge(64, temperature=2.0)
    run, store = tmp_path / "run", toy.store(tmp_path / "clips")
    use(monkeypatch, SimpleNamespace(generate=generate, reconstruct=lambda assets, video: video), store)
    seen: list[Footage] = []

    def train(learned: Footage, *_: object) -> TrainedJudge:
        seen.append(learned)
        return judge

    monkeypatch.setattr(judging, "train_judge", train)
    result = judging.make_judge(run, tmp_path, settings=judging.JudgeSettings(reconstructed=2))
    assert seen[0].rgb.shape[0] == toy.TRAIN + 2
    settings = judging.JudgeSettings(reconstructed=2, generated=3)
    judging.make_judge(run, tmp_path, settings=settings, also=[toy.store(tmp_path / "more").path])
    assert seen[1].rgb.shape[0] == len(seen[1].success) == 2 * (toy.TRAIN + 2 + 3)
    ours, theirs = np.split(seen[1].rgb, 2)
    np.testing.assert_array_equal(ours, theirs)
    records = [store.source("train")[number] for number in range(2)]
    short = [record | {"rgb": record["rgb"][:-1]} for record in records]
    for name, clips, meta, message in (
        ("unlabelled", records, {}, "do not say whether they succeed"),
        ("short", short, {"success_share": 0.5}, "name clips of the run's length, size and actions"),
    ):
        write_store(tmp_path / name, "clips", {"train": clips}, {"key": name, **meta})
        with pytest.raises(UserError) as raised:
            judging.make_judge(run, tmp_path, also=[tmp_path / name])
        assert message in str(raised.value)
    assert {kind: np.sum(result[kind]["confusion"]) for kind in ("raw", "reconstructed", "generated")} == {
        "raw": 2 * toy.TEST * 5,
        "reconstructed": toy.TEST * 5,
        "generated": toy.TEST * 5,
    }
    loaded = load_judge(run / judging.FOLDER)
    assert loaded.validation == json.loads((run / "judge" / "validation.json").read_text()) and loaded.validation
    assert judging.judge_of(run, "run", 64).temperature == loaded.temperature  # type: ignore[union-attr]
    assert judging.judge_of(tmp_path, "run", 64) is None


def test_a_judge_is_validated_on_videos_of_the_clips_tasks_and_depth() -> None:
    clips = [vars(toy.clip(number, success=True)) for number in range(3)]
    clips[1]["depth"] = None
    prompts: list[Video] = []

    def generate(params: Any, assets: Any, prompt: Video, actions: np.ndarray, index: Any, depth: bool) -> Video:
        prompts.append(prompt)
        return Video(prompt.rgb.repeat(actions.shape[1], 1))

    model = SimpleNamespace(generate=generate, reconstruct=lambda assets, video: None)
    config = SimpleNamespace(prompt_frames=1, eval=SimpleNamespace(batch_size=2))
    trained: Any = SimpleNamespace(config=config, model=model, params=None, assets=None)
    result = judging.validation(trained, lambda frames: np.tile([0.5, 0.3, 0.2], (len(frames), 1)), clips)
    assert "reconstructed" not in result and np.sum(result["generated"]["confusion"]) == 3 * 5
    assert prompts[0].tasks is not None and prompts[0].tasks.tolist() == ["drift", "drift"]
    assert prompts[0].depth is not None and np.isnan(prompts[0].depth).all((1, 2, 3)).tolist() == [False, True]


def test_people_judge_videos_whose_names_say_nothing(tmp_path: Path) -> None:
    videos = footage(3, 0).rgb
    sheet = write_blinded(list(videos), tmp_path / "blind")
    lines = sheet.read_text().splitlines()
    assert lines[0] == "video,label" and len(lines) == 4 == len(list((tmp_path / "blind").glob("*.mp4"))) + 1
    with pytest.raises(UserError, match="line 2: the label is empty"):
        HumanJudge.read(sheet)
    filled = [lines[0], *(f"{line}{label}" for line, label in zip(lines[1:], ("success", "Fail", "fail"), strict=True))]
    sheet.write_text("\n".join(filled))
    verdicts = HumanJudge.read(sheet)(videos)
    assert sorted(verdicts.argmax(-1)) == [0, 1, 1]
    with pytest.raises(UserError, match="has no label of 1 of 1 videos"):
        HumanJudge.read(sheet)(footage(1, 9).rgb)
    for text, message in {
        "video\na": "has no column label",
        "video,label\na,sucess": "'sucess'; did you mean 'success'",
        "video,label\na,fail\na,success": "line 3: video a has another label above",
    }.items():
        sheet.write_text(text)
        with pytest.raises(UserError, match=message):
            HumanJudge.read(sheet)


def test_a_language_model_answers_in_words(tmp_path: Path) -> None:
    answers = {"Yes.": 0, " no, it is not": 1, "**Unclear**": 2, "": 2, "maybe": 2}
    assert {answer: answer_label(answer) for answer in answers} == answers
    with pytest.raises(UserError, match="needs torch and transformers|no config.json"):
        LanguageJudge.load(tmp_path)


class Words:
    """Stands in for a processor of transformers: a token of the prompt for each picture and text, one of the answer."""

    def __init__(self) -> None:
        self.seen: list[list[Any]] = []

    def apply_chat_template(self, chat: list[Any], **settings: Any) -> dict[str, np.ndarray]:
        assert settings["tokenize"] and settings["add_generation_prompt"] and chat[0]["role"] == "user"
        self.seen.append(chat[0]["content"])
        return {"input_ids": np.zeros((1, len(chat[0]["content"])), int)}

    def decode(self, tokens: np.ndarray, skip_special_tokens: bool) -> str:
        return ("Yes.", "no", "I cannot see it")[tokens.item()]


def test_a_language_model_sees_the_last_frames_and_its_answer_counts() -> None:
    videos, words = footage(3, 0).rgb, Words()
    answers = iter(range(3))

    def generate(input_ids: np.ndarray, **settings: Any) -> np.ndarray:
        return np.concatenate([input_ids, [[next(answers)]]], 1)  # the prompt, then the answer

    judge = LanguageJudge(SimpleNamespace(generate=generate), words, "Is it up?", frames=2)
    np.testing.assert_array_equal(judge(videos), np.eye(3))
    for video, (*pictures, text) in zip(videos, words.seen, strict=True):
        np.testing.assert_array_equal([picture["image"] for picture in pictures], video[-2:])
        assert text["text"] == "Is it up? Answer with one word: yes, no or unclear."
