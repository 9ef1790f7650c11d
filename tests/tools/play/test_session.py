"""Driving, branching and coming back, over a real socket with a fake model."""

import io
import itertools
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rsjax.config import DataConfig
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.viewer import SEARCHING
from rsjax.tools.policies.judges.judge_training import FOLDER
from rsjax.tools.policies.judges.trained_judge import FILE
from tests.tools.play.client import Client, Picture, Server
from tests.tools.play.fake import LIGHT, MEASURED, Fakes
from tests.waiting import wait_until

HUGE = 10**400


def rgb(picture: Picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(picture.payload)).convert("RGB"))


def same(ones: list[Picture], others: list[Picture]) -> bool:
    assert len(ones) == len(others)
    return all(np.array_equal(rgb(one), rgb(other)) for one, other in zip(ones, others, strict=True))


def test_the_first_message_says_what_there_is(server: Server, run: PlayRun) -> None:
    with server.client() as (_, welcome):
        assert (welcome["type"], welcome["version"], welcome["returned"]) == ("welcome", 1, False)
        assert welcome["run"]["clips"] == 5 and welcome["run"]["image_size"] == 64
        assert len(welcome["controls"]) * welcome["repeat"] == welcome["action_dim"] == run.controls.width
        assert [each["kind"] for each in welcome["controls"]] == ["axis"] * 6 + ["toggle"]
        assert welcome["sources"]["clip"] == "" and "--policy" in welcome["sources"]["policy"]
        assert welcome["run"]["measured"] == MEASURED


def test_a_step_brings_a_frame_and_says_what_was_done(server: Server, run: PlayRun) -> None:
    with server.client() as (page, _):
        begun = page.ask("start", clip=2, seed=5)
        assert begun["start"] == {"clip": 2} and begun["seed"] == 5 and begun["task"] == "drift"
        assert begun["branches"] == [{"branch": 0, "parent": None, "fork": None, "length": 1, "draw": 2}]
        assert np.array_equal(rgb(page.pictures[0]), run.clip(2)["rgb"][0])
        control = [0.5, 0, 0, 0, 0, 0, 3.0]
        made = page.ask("step", branch=0, action=control)
        assert (made["frame"], made["clipped"]) == (1, 4), "the gripper's 3 is clipped in each of four controls"
        assert made["action"] == [0.5, 0, 0, 0, 0, 0, 1.0] * 4
        frame = page.pictures[1]
        assert (frame.kind, frame.branch, frame.frame, frame.id) == (1, 0, 1, page.number)
        assert np.array_equal(rgb(frame)[2:], np.roll(run.clip(2)["rgb"][0], 2, axis=1)[2:])


def test_a_clips_own_actions_are_taken_until_it_ends(server: Server, run: PlayRun) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=1)
        low, high = run.controls.limits
        for frame in range(1, 6):
            made = page.ask("step", branch=0, source={"kind": "clip"})
            wanted = np.clip(run.clip(1)["actions"][frame], low, high)
            np.testing.assert_allclose(made["action"], wanted, atol=1e-6)
        assert page.ask("step", branch=0, source={"kind": "clip"})["error"] == "no_action"
        other = page.ask("step", branch=0, source={"kind": "clip", "clip": 3})
        np.testing.assert_allclose(other["action"], np.clip(run.clip(3)["actions"][1], low, high), atol=1e-6)


def test_a_policy_begins_anew_after_a_person_steered(
    server: Server, run: PlayRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    def actor(seed: int) -> Callable[[np.ndarray], np.ndarray]:
        count = itertools.count(1)
        return lambda rgb: np.full((1, run.controls.width), next(count) / 10)

    monkeypatch.setitem(run.__dict__, "policy", SimpleNamespace(actor=actor))
    policy: dict[str, Any] = {"source": {"kind": "policy"}}
    with server.client() as (page, _):
        page.ask("start", clip=0)
        made = [page.ask("step", branch=0, **each) for each in (policy, policy, {"action": [0] * 7}, policy, policy)]
        assert [each["action"][0] for each in made] == [0.1, 0.2, 0.0, 0.1, 0.2]


def test_the_page_hears_that_the_planner_searches_and_why_it_cannot(server: Server, run: PlayRun) -> None:
    judge = run.data.run / FOLDER / FILE
    judge.parent.mkdir()
    judge.write_bytes(b"no judge")
    with server.client() as (page, _):
        page.ask("start", clip=0)
        made = page.ask("step", branch=0, source={"kind": "planner"})
        said = [(each["text"], each["busy"]) for each in page.pushed if each["type"] == "status"]
    judge.unlink()
    assert made["error"] == "no_source" and f"{judge}: damaged" in made["message"]
    assert said == [(SEARCHING, True), ("", False)]


def test_a_branch_that_went_nowhere_leaves_its_parent_as_it_was(server: Server, fakes: Fakes) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        page.drive(LIGHT - 1)
        page.ask("fork", branch=0, frame=LIGHT - 1)
        assert page.ask("drop", branch=1)["type"] == "ok"
        fakes.kinds[True].passes.clear()
        page.drive(1)
        assert fakes.kinds[True].passes == [1], "earlier frames were generated again"


def test_sliders_of_recordings_have_the_names_of_their_actions(run: PlayRun, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run.store is not None
    config, shape = run.data.config, asdict(run.data.config.clips)
    monkeypatch.setitem(run.data.__dict__, "config", replace(config, data=DataConfig(store="a", key="a", **shape)))
    monkeypatch.setitem(run.store.manifest, "action_dimensions", ["x (delta)", "(held)"])
    labels = [each.label for each in replace(run).controls.each]
    assert labels[:3] == ["x (delta)", "action 1 (held)", "action 2"]


def test_a_fork_repeats_its_parent_under_the_same_actions_and_differs_with_new_draws(server: Server) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        first = page.drive(2 * LIGHT + 2)
        made = page.ask("fork", branch=0, frame=LIGHT + 1)
        assert (made["branch"], made["parent"], made["fork"], made["length"]) == (1, 0, LIGHT + 1, LIGHT + 2)
        again = page.drive(LIGHT + 1, branch=1)
        assert same(again, first[LIGHT + 1 :])
        page.ask("fork", branch=0, frame=LIGHT + 1, draw="new")
        assert not same(page.drive(1, branch=2), again[:1])
        assert same(page.drive(2), page.drive(2, branch=1)), "both go on from the same frame"


def test_seed_and_temperature_decide_the_frames(server: Server) -> None:
    with server.client() as (page, _):
        made = []
        for seed, temperature in ((1, 0), (2, 0), (1, 0.5), (1, 0)):
            assert page.ask("settings", temperature=temperature)["temperature"] == temperature
            page.ask("start", clip=0, seed=seed)
            made.append(page.drive(2, action=[0] * 7))
        assert same(made[0], made[3]) and not same(made[0], made[1]) and not same(made[0], made[2])


def test_what_is_watched_comes_with_each_frame_and_can_be_asked_for_again(server: Server) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=4)
        page.ask("watch", kinds=["depth", "uncertainty"])
        made = page.ask("step", branch=0, action=[0] * 7)
        assert 0 < made["uncertainty"] < 18
        [depth], [unsure] = page.until(2, 1), page.until(5, 1)
        assert (depth.width, depth.scale) == (64, 2.0) and len(unsure.payload) == unsure.width * unsure.height == 16
        before = len(page.pictures)
        page.ask("frames", branch=0, first=0, count=9, kinds=["rgb", "depth", "uncertainty"])
        again = page.pictures[before:]
        assert [(each.kind, each.frame) for each in again] == [(1, 0), (2, 0), (1, 1), (5, 1), (2, 1)]
        assert again[4].payload == depth.payload and again[3].payload == unsure.payload


def test_a_picture_begins_without_depth_and_says_how_it_was_cut(server: Server) -> None:
    image = Image.new("RGB", (100, 60), (250, 0, 0))
    image.paste((0, 0, 250), (20, 0, 80, 60))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    with server.client() as (page, _):
        assert page.ask("start", upload=True)["error"] == "no_upload"
        page.socket.send(buffer.getvalue())
        sent = page.wait(0)
        assert (sent["from"], sent["cropped"], sent["to"]) == ([100, 60], [60, 60], 64)
        assert sent["message"] == "100 × 60 pixels, cut to its middle 60 × 60, scaled to 64 × 64"
        begun = page.ask("start", upload=True)
        assert begun["start"]["upload"]["to"] == 64 and not begun["has_depth"] and begun["clip_frames"] is None
        assert (rgb(page.pictures[0]) == (0, 0, 250)).all(), "the middle is blue"
        assert page.ask("step", branch=0, source={"kind": "clip"})["error"] == "no_action"
        assert page.drive(1)
        page.socket.send(b"no picture at all")
        assert page.wait(0)["error"] == "bad_image"


def test_a_viewer_returns_to_the_own_session(server: Server) -> None:
    with server.client() as (page, welcome):
        page.ask("start", clip=0)
        first = page.drive(3)
    with server.client(f"?session={welcome['session']}") as (page, back):
        assert back["returned"] and back["session"] == welcome["session"]
        session = page.wait(0)
        assert session["branches"][0]["length"] == 4
        page.ask("frames", branch=0, first=1, count=3, kinds=["rgb"])
        assert same(page.pictures, first)
        page.drive(1)
    with server.client("?session=unknown") as (_, new):
        assert not new["returned"]


def test_frames_of_two_viewers_share_passes_and_keep_their_bits(server: Server, fakes: Fakes) -> None:
    def drive(page: Client, made: list[Picture]) -> None:
        made += page.drive(6, source={"kind": "random"})

    with server.client() as (one, _), server.client() as (other, _), server.client() as (third, _):
        for clip, page in enumerate((one, other, third)):
            page.ask("start", clip=clip, seed=3 + clip)
        alone = one.drive(6)
        one.ask("start", clip=0, seed=3)
        fake, engine = fakes.kinds[True], server.hub.engine
        fake.gate.clear()
        fake.passes.clear()
        blocking = third.send("step", branch=0, action=[0] * 7)
        wait_until(lambda: fake.passes == [1])  # this pass holds the engine until both others have asked
        made: tuple[list[Picture], list[Picture]] = ([], [])
        threads = [threading.Thread(target=drive, args=each) for each in zip((one, other), made, strict=True)]
        for thread in threads:
            thread.start()
        wait_until(lambda: len(engine._waiting) == 2)
        fake.gate.set()
        for thread in threads:
            thread.join()
        assert third.wait(blocking)["type"] == "stepped"
        assert 2 in fake.passes and sum(fake.passes) == 13
        assert same(made[0], alone)


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ({"type": "step", "branch": 7, "action": [0] * 7}, "no_branch"),
        ({"type": "step", "branch": 0}, "bad_message"),
        ({"type": "step", "branch": 0, "action": [0] * 6}, "bad_action"),
        ({"type": "step", "branch": 0, "action": [True] * 7}, "bad_action"),
        ({"type": "step", "branch": 0, "action": [1e300] * 7}, "bad_action"),
        ({"type": "step", "branch": 0, "action": "up"}, "bad_action"),
        ({"type": "step", "branch": 0, "source": {"kind": "policy"}}, "no_source"),
        ({"type": "step", "branch": 0, "source": {"kind": "magic"}}, "bad_message"),
        ({"type": "step", "branch": 0, "source": {"kind": "clip", "clip": 99}}, "no_clip"),
        ({"type": "start", "clip": 5}, "no_clip"),
        ({"type": "start", "clip": -1}, "bad_message"),
        ({"type": "fork", "branch": 0, "frame": 99}, "no_frame"),
        ({"type": "drop", "branch": 0}, "no_branch"),
        ({"type": "settings", "temperature": -1}, "bad_settings"),
        ({"type": "settings", "steps": 0}, "bad_settings"),
        ({"type": "settings", "guidance": 2}, "bad_settings"),
        ({"type": "watch", "kinds": ["x-rays"]}, "bad_message"),
        ({"type": "frames", "branch": 0, "first": 9, "count": 1, "kinds": ["rgb"]}, "no_frame"),
        ({"type": "frames", "branch": 0, "first": 0, "count": 65, "kinds": ["rgb"]}, "bad_message"),
        ({"type": "fly"}, "bad_message"),
        ({"type": "settings", "temperature": HUGE}, "bad_settings"),
        ({"type": "settings", "steps": -HUGE}, "bad_settings"),
        ({"type": "step", "branch": 0, "action": [HUGE] + [0] * 6}, "bad_action"),
        ({"type": "step", "branch": HUGE, "action": [0] * 7}, "bad_message"),
        ({"type": "record", "format": "gif", "branch": 0, "panes": ["rgb"], "fps": HUGE}, "bad_message"),
        ({"type": "start", "clip": HUGE}, "bad_message"),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(server: Server, message: dict[str, object], code: str) -> None:
    with server.client() as (page, _):
        assert page.ask("step", branch=0, action=[0] * 7)["error"] == "no_start"
        page.ask("start", clip=0)
        kind = str(message.pop("type"))
        refused = page.ask(kind, **message)
        assert (refused["type"], refused["error"]) == ("error", code) and len(refused["message"]) > 10
        assert page.drive(1), "the session goes on"
