"""Links that make a session again, videos, and clips of a store."""

import base64
import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from rsjax.data.store import open_store
from rsjax.tools.play import keep
from rsjax.tools.play.controls import Controls
from rsjax.tools.play.play_run import PlayRun
from tests.tools.play.client import Client, Server, serving
from tests.tools.play.fake import Fakes, hub_of, play_run
from tests.tools.play.test_session import rgb, same

FRAMES = 6  # of a clip


def play(page: Client) -> None:
    """A session with two forks, several settings, and a clip's actions."""
    page.ask("start", clip=3, seed=9)
    page.drive(4)
    page.ask("settings", temperature=0.7)
    page.drive(3)
    page.ask("fork", branch=0, frame=5, draw="new")
    page.drive(3, branch=1, source={"kind": "clip", "clip": 2})
    page.ask("settings", steps=3)
    page.ask("fork", branch=1, frame=2)
    page.drive(5, branch=2, action=[0.25] * 7)


def test_a_link_makes_the_session_again_on_another_server(server: Server, tmp_path: Path) -> None:
    with server.client() as (page, _):
        play(page)
        session, link = page.ask("start", clip=1), page.ask("link")  # a start forgets
        assert len(session["branches"]) == 1
        play(page)
        link = page.ask("link")
        assert link["bytes"] == len(link["state"]) < 3000
        shown = {}
        for branch in (0, 1, 2):
            page.pictures.clear()
            page.ask("frames", branch=branch, first=0, count=64, kinds=["rgb", "uncertainty"])
            shown[branch] = list(page.pictures)
    again = play_run(tmp_path, Fakes())
    with serving(hub_of(again)) as other, other.client() as (page, _):
        loaded = page.ask("load", state=link["state"])
        assert loaded["type"] == "session" and loaded["seed"] == 9
        assert loaded["settings"] == {"temperature": 0.7, "steps": 3, "guidance": 1.0, "top_k": 0}
        assert [each["length"] for each in loaded["branches"]] == [8, 9, 8]
        assert [each["parent"] for each in loaded["branches"]] == [None, 0, 1]
        assert any(each["type"] == "progress" for each in page.pushed)
        for branch, pictures in shown.items():
            page.pictures.clear()
            page.ask("frames", branch=branch, first=0, count=64, kinds=["rgb", "uncertainty"])
            assert [each.payload for each in page.pictures] == [each.payload for each in pictures]
        assert page.ask("link")["state"] == link["state"]


def unpacked(state: str) -> Any:
    return json.loads(zlib.decompress(base64.urlsafe_b64decode(state + "=" * (-len(state) % 4))))


def changed(state: str, **values: Any) -> str:
    return base64.urlsafe_b64encode(zlib.compress(json.dumps(unpacked(state) | values).encode())).decode()


def test_links_that_cannot_be_are_refused(server: Server) -> None:
    bomb = base64.urlsafe_b64encode(zlib.compress(b"[" * 2**22)).decode()
    with server.client() as (page, _):
        page.ask("start", clip=3)
        page.drive(2)
        state = page.ask("link")["state"]
        row = unpacked(state)["branches"][0]
        side = server.hub.run.data.config.clips.image_size
        buffer = io.BytesIO()
        Image.new("RGB", (side, side)).save(buffer, "PNG")
        picture = base64.b64encode(buffer.getvalue()).decode()
        begun = {"upload": picture, "size": [90, 70], "square": 70}
        assert page.ask("load", state=changed(state, start=begun))["start"]["upload"]["from"] == [90, 70]
        assert page.ask("load", state=state)["type"] == "session"
        bad = [
            None, "", "%%%", state[:-9], bomb,
            changed(state, version=2), changed(state, run="0" * 16), changed(state, start={"clip": 99}),
            changed(state, start={"upload": "????", "size": [1, 1], "square": 1}), changed(state, branches=[]),
            *(changed(state, start=begun | {"size": size, "square": square})
              for size, square in (([-1, 64], 1), ([64, 10**400], 64), ([64, float("inf")], 64), ([64, 64], -3),
                                   ([64, 64], 65), ([64], 64), ("64", 6), ([64.0, 64], 64))),
            changed(state, branches=[row | {"actions": row["actions"][:8]}]),
            changed(state, branches=[row | {"how": [[row["how"][0][0], 10**9]]}]),
            changed(state, branches=[row, row | {"parent": 1}]), changed(state, seed=-1), changed(state, settings=None),
        ]  # fmt: skip
        for each in bad:
            assert page.ask("load", state=each)["error"] == "bad_state", each
        assert page.drive(1), "what was there is still there"


def test_a_link_of_too_many_frames_is_refused_before_its_actions_are_looked_at(
    server: Server, run: PlayRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    with server.client() as (page, welcome):
        page.ask("start", clip=3)
        page.drive(1)
        state, most = page.ask("link")["state"], welcome["limits"]["frames"]
        many = base64.b64encode(bytes(most * 2 // 3 * 4 * run.controls.width)).decode()
        monkeypatch.setattr(Controls, "action", None)
        rows = [unpacked(state)["branches"][0] | {"actions": many}] * 2
        refused = page.ask("load", state=changed(state, branches=rows))
        assert refused["error"] == "bad_state" and f"more than {most} frames" in refused["message"]


def test_a_branch_is_recorded_with_panes_side_by_side(server: Server, run: PlayRun) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        page.drive(4)
        page.ask("fork", branch=0, frame=1)
        page.drive(1, branch=1)
        panes = ["rgb", "depth", "truth", "branch:1"]
        made = page.ask("record", branch=0, format="mp4", fps=8, panes=panes, scale=2)
        assert made["type"] == "file" and Path(made["path"]).parent == run.out
        status, headers, body = server.get(made["url"])
        assert (status, headers["content-type"]) == (200, "video/mp4") and len(body) == made["bytes"]
        with av.open(io.BytesIO(body), "r") as video:
            frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
            assert video.streams.video[0].average_rate == 8
        wide = 4 * 64 * 2 + 3 * keep.GAP * 2
        assert [frame.shape for frame in frames] == [(128, wide, 3)] * 5
        first = rgb(page.pictures[0]).repeat(2, 0).repeat(2, 1).astype(int)
        assert np.abs(frames[0][:, :128] - first).mean() < 12
        assert page.ask("record", branch=0, format="gif", panes=["rgb"], scale=1)["name"].endswith(".gif")
        assert page.ask("record", branch=0, format="gif", panes=["../x"], scale=1)["error"] == "bad_message"
        assert page.ask("record", branch=0, format="exe", panes=["rgb"], scale=1)["error"] == "bad_message"
    assert server.get("/api/file/guessed")[0] == 404


def test_branches_are_exported_as_generated_clips(server: Server, run: PlayRun, tmp_path: Path) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=2, seed=4)
        page.drive(3)
        assert page.ask("export")["error"] == "no_frame"
        frames = page.pictures + page.drive(2 * FRAMES)
        page.ask("fork", branch=0, frame=FRAMES)
        page.drive(FRAMES, branch=1)
        made = page.ask("export")
        with zipfile.ZipFile(io.BytesIO(server.get(made["url"])[2])) as archive:
            archive.extractall(tmp_path / "clips")
    store = open_store(tmp_path / "clips")
    clips = [store.source("train")[number] for number in range(len(store.source("train")))]
    assert len(clips) == 3, "two of branch 0, and the one of branch 1 that is not all its parent's"
    first = next(clip for clip in clips if clip["provenance"]["first_frame"] == 0)
    np.testing.assert_array_equal(first["rgb"], np.stack([rgb(each) for each in frames if each.kind == 1][:FRAMES]))
    assert (first["provenance"]["source"], first["provenance"]["from"]["clip"]) == ("generated", 2)
    assert first["provenance"]["model"] == run.fingerprint and first["depth"].shape == (FRAMES, 64, 64)
    assert not first["actions"][0].any() and first["actions"][1:].any()


def test_a_full_disk_is_said_and_the_session_goes_on(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    with server.client() as (page, _):
        page.ask("start", clip=0)
        page.drive(FRAMES)
        for name in ("write_mp4", "write_clips"):
            monkeypatch.setattr(keep, name, full)
        for kind, fields in (("record", {"branch": 0, "format": "mp4", "panes": ["rgb"]}), ("export", {})):
            refused = page.ask(kind, **fields)
            assert refused["error"] == "disk" and "disk is full" in refused["message"]
        assert same(page.drive(1)[:0], []) and page.drive(1)
