"""Manages the sessions of a server: limits their number, and frees those that nobody uses."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rsjax.tools.play import messages
from rsjax.tools.play.engine import Engine
from rsjax.tools.play.keep import Files
from rsjax.tools.play.messages import Refused
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.session import Session
from rsjax.tools.play.sources import reasons
from rsjax.tools.play.tree import Memories
from rsjax.tools.play.truth import Truths
from rsjax.tools.play.viewer import Side, Viewer

VERSION = 1  # of the protocol
IN_FLIGHT = 4  # unanswered steps of a session, at most
GRACE = 20.0


@dataclass(eq=False)
class Seat:
    """One of the places for sessions, and the session in it.

    Attributes:
        close: ends the connection with a code and a reason; None while no page is connected.
        left: when the page left, in seconds of :func:`time.monotonic`.
    """

    viewer: Viewer
    close: Callable[[int, str], None] | None = None
    left: float = 0.0


class Hub:
    """All sessions of one run.

    Args:
        run: the run to play.
        engine: generates the frames of all sessions.
        most: sessions at a time.
        idle: seconds without a message or a new frame after which a session is freed.
        grace: seconds for which a session whose page has left keeps its place when all places are taken.
        truths: the simulators; by default those of the run's clips.
    """

    def __init__(
        self, run: PlayRun, engine: Engine, most: int, idle: float, grace: float = GRACE, truths: Truths | None = None
    ) -> None:
        self.run = run
        self.engine = engine
        self.most = most
        self.idle = idle
        self._grace = grace
        self._memories = Memories(most)
        self._side = Side()
        self.files = Files(run.out)
        self._truths = truths or Truths.of(run.simulator)
        self._seats: dict[str, Seat] = {}

    def __len__(self) -> int:
        return len(self._seats)

    def open(self, name: str | None, close: Callable[[int, str], None]) -> tuple[Seat, bool]:
        """Returns a seat, and whether it is one that the viewer had before.

        Args:
            name: name of the session to return to; if it no longer exists, a new one is made.
            close: ends the connection.

        Raises:
            Refused: all places are taken.
        """
        seat = self._seats.get(name or "")
        if seat is not None:
            if seat.close is not None:
                seat.close(4409, "this session was opened in another page")
            seat.close = close
            seat.viewer.session.used = time.monotonic()
            return seat, True
        if len(self._seats) >= self.most:
            gone = [seat for seat in self._seats.values() if seat.close is None]
            oldest = min(gone, key=lambda seat: seat.left, default=None)
            if oldest is None or time.monotonic() - oldest.left <= self._grace:
                waits = [self.idle - (time.monotonic() - seat.viewer.session.used) for seat in self._seats.values()]
                waits += [self._grace - (time.monotonic() - seat.left) for seat in gone]
                soon = _minutes(max(1, round(min(waits))))
                raise Refused(
                    "no_session", f"all {self.most} sessions are in use; one is free in {soon} if nobody uses it"
                )
            self._free(oldest)
        seat = Seat(Viewer(Session(self.run, self.engine, self._memories), self._side, self.files, self._truths), close)
        self._seats[seat.viewer.session.name] = seat
        return seat, False

    def leave(self, seat: Seat, close: Callable[[int, str], None]) -> None:
        """Notes that a page has left; its session stays for a while."""
        if seat.close == close:  # otherwise another page has taken the session over
            seat.close = None
            seat.left = time.monotonic()
            seat.viewer.session.out = None
            seat.viewer.rest()

    def sweep(self) -> None:
        """Frees the sessions that nobody has used for ``idle`` seconds."""
        now = time.monotonic()
        for seat in list(self._seats.values()):
            if now - seat.viewer.session.used > self.idle:
                if seat.close is not None:
                    seat.close(4408, f"nobody used this session for {_minutes(self.idle)}; it is freed")
                self._free(seat)

    def close(self) -> None:
        """Frees all sessions."""
        for seat in list(self._seats.values()):
            self._free(seat)
        self._side.pool.shutdown(wait=False, cancel_futures=True)

    def welcome(self, seat: Seat, returned: bool) -> dict[str, Any]:
        """Returns the first message to a page."""
        session = seat.viewer.session
        facts = {"version": VERSION, "session": session.name, "returned": returned, "run": self.run.describe()}
        limits = session.limits | {
            "text_bytes": messages.TEXT_BYTES,
            "upload_bytes": messages.UPLOAD_BYTES,
            "in_flight": IN_FLIGHT,
            "idle_seconds": self.idle,
        }
        facts |= self.run.controls.describe() | {"sources": reasons(self.run), "truth": seat.viewer.no_truth}
        facts |= {"settings": session.settings.describe(), "seed": session.seed, "limits": limits}
        return {"type": "welcome"} | facts

    def _free(self, seat: Seat) -> None:
        self._seats.pop(seat.viewer.session.name, None)
        seat.viewer.close()


def _minutes(seconds: float) -> str:
    if seconds < 90:
        return f"{round(seconds)} seconds"
    return f"{round(seconds / 60)} minutes"
