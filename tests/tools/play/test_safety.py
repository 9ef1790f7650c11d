"""What comes in from outside: other sites, no token, floods, garbage, pages that die, and fifty at once."""

import json
import os
import socket
import threading
import time
from contextlib import ExitStack, suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from rsjax.data.codec import Record
from rsjax.data.store import StoreError
from rsjax.tools.play.connection import BURST, STRIKES
from rsjax.tools.play.guard import is_loopback
from rsjax.tools.play.messages import TEXT_BYTES, UPLOAD_BYTES, Refused, parse
from rsjax.tools.play.pictures import read_picture
from rsjax.tools.play.play_run import FPS, PlayRun
from rsjax.tools.play.send_queue import MOST, UNSENT, SendQueue
from tests.tools.play.client import Client, Picture, Server, serving
from tests.tools.play.fake import Fakes, hub_of
from tests.waiting import wait_until

TOKEN = "a-token-nobody-knows"


def closing(page: Client) -> tuple[int, str]:
    """Waits until the server ends the connection; returns its code and reason."""
    try:
        while True:
            page.next()
    except ConnectionClosed as closed:
        return (closed.rcvd.code, closed.rcvd.reason) if closed.rcvd else (0, "")


def refused(server: Server, query: str = "", **options: object) -> int:
    """Connects where nobody is let in; returns the code."""
    with pytest.raises(ConnectionClosed) as caught, server.client(query, **options):
        pass
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code


def test_pages_of_other_sites_and_other_names_are_refused(server: Server) -> None:
    assert refused(server, origin="http://evil.example") == 4403
    assert refused(server, origin=f"http://127.0.0.1:{server.port + 1}") == 4403
    assert refused(server, origin="null") == refused(server, origin="http://[") == 4403
    raw, own = socket.create_connection(("127.0.0.1", server.port)), Origin("http://evil.example")
    with connect("ws://evil.example/ws", sock=raw, origin=own) as page:  # its name was made to point here (rebinding)
        assert closing(Client(page))[0] == 4403
    with server.client(origin=f"http://127.0.0.1:{server.port}") as (_, welcome):
        assert welcome["type"] == "welcome"
    for path in ("/", "/api/health", "/api/clips", "/page/index.html"):
        assert server.get(path, host="evil.example")[0] == 403
        for broken in ("[::1", "[::1]evil", "localhost:80:evil", "localhost:x", "::1"):
            assert server.get(path, host=broken)[0] == 403, broken
        assert server.get(path, host=f"localhost:{server.port}")[0] in (200, 404)


def test_without_the_token_nobody_comes_in(run: PlayRun) -> None:
    with serving(hub_of(run), TOKEN) as server:
        assert refused(server) == refused(server, "?token=wrong") == refused(server, "?token=%C3%A9") == 4401
        with server.client(f"?token={TOKEN}") as (_, welcome):
            assert welcome["type"] == "welcome"
        for path in ("/api/health", "/api/clips", "/api/clip/0.webp", "/api/file/x"):
            assert server.get(path)[0] == 401
        assert server.get(f"/api/health?token={TOKEN}", host="any.name")[0] == 200


def test_no_path_comes_from_outside(server: Server) -> None:
    clips = (f"/api/clip/{number}.webp" for number in (-1, "9" * 4400))
    for path in ("/page/../serve.py", "/page/..%2fserve.py", "/page//etc/passwd", "/etc/passwd", *clips):
        assert server.get(path)[0] == 404
    status, headers, _ = server.get("/api/clip/0.webp")
    assert status == 200 and headers["content-type"] == "image/webp"
    assert "script-src 'self'" in headers["content-security-policy"] and headers["cache-control"] == "no-store"
    for query in ("first=x", "count=1000", f"first={'9' * 4400}"):
        assert server.get(f"/api/clips?{query}")[0] == 400
    listed = json.loads(server.get("/api/clips?first=3")[2])
    assert [clip["clip"] for clip in listed["clips"]] == [3, 4] and listed["total"] == 5
    assert server.get("/api/health", method="POST")[0] in (404, 405)


def test_garbage_is_refused_and_in_the_end_its_sender_too(server: Server) -> None:
    garbage = ["", "{", "[]", "7", '{"type": 3}', '{"type": "ping"}', '{"type": "ping", "id": 0}', "[" * 5000,
               '{"type": "step", "id": 1, "branch": NaN}']  # fmt: skip
    with server.client() as (page, _):
        for text in garbage:
            page.socket.send(text)
            answer = page.next()
            assert isinstance(answer, dict) and answer["error"] == "bad_message", text
        page.socket.send("x" * (TEXT_BYTES + 1))
        assert page.wait(0)["error"] == "too_large"
        assert page.ask("ping")["type"] == "pong"
        with suppress(ConnectionClosed):  # the garbage above counted too
            for _ in range(STRIKES):
                page.socket.send("{")
        assert closing(page)[0] == 1008
    with server.client() as (page, _):
        with suppress(ConnectionClosed):
            page.socket.send(os.urandom(UPLOAD_BYTES + 4096))
        assert closing(page)[0] in (1009, 0)  # it may end before its last word is read
    with server.client() as (page, _):
        assert page.ask("ping")["type"] == "pong"


def test_a_flood_is_slowed_and_then_ended(server: Server) -> None:
    with server.client() as (page, _):
        with suppress(ConnectionClosed):
            for number in range(1, 5 * int(BURST)):
                page.socket.send(json.dumps({"type": "ping", "id": number}))
        assert closing(page)[0] == 1008


def test_more_steps_or_pictures_than_may_wait_are_refused(server: Server, fakes: Fakes) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        fakes.kinds[True].gate.clear()
        numbers = [page.send("step", branch=0, action=[0] * 7) for _ in range(6)]
        early = [page.wait(number) for number in numbers[4:]]
        for _ in range(2):
            page.socket.send(b"no picture")
        early.append(page.wait(0))
        fakes.kinds[True].gate.set()
        assert [each["error"] for each in early] == ["busy"] * 3
        assert page.wait(numbers[3])["frame"] == 4
        assert page.wait(0)["error"] == "bad_image"
        page.socket.send(b"no picture")
        assert page.wait(0)["error"] == "bad_image"


def test_the_next_session_is_told_so_and_an_idle_one_gives_way(run: PlayRun) -> None:
    with serving(hub_of(run, most=2, idle=3, grace=30)) as server, ExitStack() as pages:
        one, _ = pages.enter_context(server.client())
        other, _ = pages.enter_context(server.client())
        with pytest.raises(ConnectionClosed) as caught, server.client():
            pass
        assert caught.value.rcvd is not None and caught.value.rcvd.code == 4429
        assert "all 2 sessions are in use" in caught.value.rcvd.reason
        for _ in range(16):
            time.sleep(0.25)
            other.ask("ping")
        assert closing(one) == (4408, "nobody used this session for 3 seconds; it is freed")
        with server.client() as (page, _):
            assert page.ask("ping") and other.ask("ping")


def test_a_damaged_first_clip_turns_nobody_away(server: Server, run: PlayRun, monkeypatch: pytest.MonkeyPatch) -> None:
    class Damaged(list[Record]):
        def __getitem__(self, number: object) -> Record:  # type: ignore[override]
            raise StoreError("damaged")

    monkeypatch.setitem(run.__dict__, "source", Damaged([{}]))
    with server.client() as (page, welcome):
        assert welcome["run"]["fps"] == FPS and page.ask("start", clip=0)["error"] == "no_clip"


def test_a_connection_that_fails_leaves_its_seat(run: PlayRun, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(hub_of(run, most=1)) as server:
        with monkeypatch.context() as broken:
            broken.setattr(server.hub, "welcome", None)
            with pytest.raises(ConnectionClosed), server.client():
                pass
        with server.client() as (_, welcome):
            assert welcome["type"] == "welcome"


def test_frames_keep_a_session_that_sends_nothing(server: Server, fakes: Fakes) -> None:
    with server.client() as (page, welcome):
        page.ask("start", clip=0)
        session, gate = server.hub._seats[welcome["session"]].viewer.session, fakes.kinds[True].gate
        gate.clear()
        before, number = session.used, page.send("step", branch=0, action=[0] * 7)
        wait_until(lambda: session.used != before)
        asked = session.used
        gate.set()
        assert page.wait(number)["type"] == "stepped" and session.used > asked


def test_a_session_opened_in_another_page_moves_there(server: Server) -> None:
    with server.client() as (page, welcome), server.client(f"?session={welcome['session']}") as (other, again):
        assert again["returned"] and closing(page)[0] == 4409
        assert other.ask("start", clip=0)["type"] == "session"
    time.sleep(0.1)


def test_an_error_of_the_engine_ends_no_session(
    server: Server, fakes: Fakes, capfd: pytest.CaptureFixture[str]
) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        fakes.kinds[True].fail = True
        broken = page.ask("step", branch=0, action=[0] * 7)
        fakes.kinds[True].fail = False
        assert broken["error"] == "failed" and "out of everything" in capfd.readouterr().err
        assert page.drive(2)


def test_a_page_that_is_killed_in_the_middle_of_a_step_hurts_nobody(server: Server, fakes: Fakes) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        with server.client() as (victim, _):
            victim.ask("start", clip=1)
            fakes.kinds[True].gate.clear()
            victim.send("step", branch=0, action=[0] * 7)
            victim.socket.socket.shutdown(socket.SHUT_RDWR)
        fakes.kinds[True].gate.set()
        assert page.drive(3)


def test_fifty_at_once(run: PlayRun) -> None:
    """Some leave without a word, some send garbage; each of the others gets its frames."""
    count, steps, failed = 50, 5, []

    def drive(server: Server, number: int) -> None:
        try:
            with server.client() as (page, _):
                page.ask("start", clip=number % 5, seed=number)
                if number % 5 == 1:
                    page.socket.send("{" * number)
                if number % 5 == 2:
                    page.send("step", branch=0, action=[0] * 7)
                    page.socket.socket.shutdown(socket.SHUT_RDWR)
                    return
                pictures = page.drive(steps, action=[number / 50] * 7)
                assert [each.frame for each in pictures] == list(range(1, steps + 1))
        except Exception as error:
            if number % 5 != 2:
                failed.append((number, error))

    with serving(hub_of(run, most=count + 1, lanes=4)) as server:
        threads = [threading.Thread(target=drive, args=(server, number)) for number in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failed
        assert json.loads(server.get("/api/health")[2])["frames"] >= 40 * steps
        with server.client() as (page, _):
            assert page.ask("start", clip=0)["type"] == "session" and page.drive(1)


def test_a_slow_page_loses_what_it_can_ask_for_again_and_then_its_connection() -> None:
    box = SendQueue()
    for number in range(UNSENT + 5):
        box.put({"number": number}, droppable=True)
    assert len(box._items) == UNSENT
    for number in range(MOST):
        box.put({"number": number})
    assert box.overflowed


@given(st.binary(max_size=200))
@settings(max_examples=60)
def test_no_bytes_break_the_readers(payload: bytes) -> None:
    for head in (b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"RIFF\x10\0\0\0WEBPVP8 "):
        with pytest.raises(Refused):
            read_picture(head + payload, 64)
    with suppress(Refused):
        assert isinstance(parse(payload.decode("latin-1")), dict)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("localhost", True), ("127.3.2.1", True), ("::1", True), ("[::1]", True), ("0.0.0.0", False), ("::", False),
     ("[::1", False), ("::1]", False), ("10.0.0.1", False), ("localhost.evil.example", False),
     ("127.0.0.1.evil.example", False), ("", False)],
)  # fmt: skip
def test_what_is_this_machine(host: str, loopback: bool) -> None:
    assert is_loopback(host) == loopback


def test_pictures_come_in_order(server: Server) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=0)
        page.ask("watch", kinds=["depth", "uncertainty"])
        numbers = [page.send("step", branch=0, action=[0.1] * 7) for _ in range(4)]
        for number in numbers:
            assert page.wait(number)["type"] == "stepped"
        assert [each.frame for each in page.pictures if isinstance(each, Picture) and each.kind == 1] == [0, 1, 2, 3, 4]
