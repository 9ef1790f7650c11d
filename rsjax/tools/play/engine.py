"""One thread that generates the frames of all sessions, several in one pass if their settings agree."""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32

from rsjax.clip import Video
from rsjax.models.branch_states import Branching, BranchState, Decoding
from rsjax.models.trained import TrainedModel

Say = Callable[[str, bool], None]  # a line for the person who waits, and whether work goes on


@dataclass(eq=False)
class FrameRequest:
    """One frame to generate.

    Attributes:
        state: the frame before; generating the next frame uses up its memory.
        has_depth: whether the clip has depth.
        say: called, in the engine's thread, when a program is compiled for this frame.
    """

    state: BranchState
    action: Float32[np.ndarray, " A"]
    decoding: Decoding
    has_depth: bool
    say: Say
    done: "Future[BranchState]" = field(default_factory=Future)

    @property
    def key(self) -> tuple[bool, tuple[int, int, bool]]:
        """The settings that frames generated in one pass have in common."""
        return self.has_depth, self.decoding.program


class EngineClosedError(RuntimeError):
    """A frame was requested from an engine that was closed, because its server ends."""


class Engine:
    """Generates frames, in the order of the requests.

    Args:
        model: a model whose family implements ``branching``.
        lanes: frames in one pass, at most. On an accelerator, results for different values differ in
            their last bits.

    Attributes:
        frames: number of frames generated so far.

    Raises:
        UserError: the family cannot generate frame by frame.
    """

    def __init__(self, model: TrainedModel, lanes: int = 1) -> None:
        self.lanes = lanes
        self.frames = 0
        self._model = model
        self._branching: dict[bool, Branching] = {}
        self._waiting: deque[FrameRequest] = deque()
        self._compiled: set[tuple[bool, tuple[int, int, bool]]] = set()
        self._wake = threading.Condition()
        self._closed = False
        self.branching(False)
        self._thread = threading.Thread(target=self._run, name="play-engine", daemon=True)
        self._thread.start()

    def branching(self, has_depth: bool) -> Branching:
        """Returns the generator of clips with or without depth."""
        with self._wake:
            if has_depth not in self._branching:
                inputs = (self._model.params, self._model.assets, has_depth, self.lanes)
                self._branching[has_depth] = self._model.model.branching(*inputs)
            return self._branching[has_depth]

    def begin(self, first: Video) -> BranchState:
        """Returns a clip's first frame, (1, 1, …), with depth or without."""
        return self.branching(first.depth is not None).begin(first)

    def submit(self, work: FrameRequest) -> "Future[BranchState]":
        """Requests a frame.

        Raises:
            EngineClosedError: the server ends.
        """
        with self._wake:
            if self._closed:
                raise EngineClosedError("the engine is closed")
            self._waiting.append(work)
            self._wake.notify()
        return work.done

    @property
    def waiting(self) -> int:
        """The number of frames whose pass has not begun."""
        with self._wake:
            return len(self._waiting)

    def close(self) -> None:
        """Ends the thread and cancels waiting frames."""
        with self._wake:
            self._closed = True
            waiting = list(self._waiting)
            self._waiting.clear()
            self._wake.notify()
        for work in waiting:
            work.done.cancel()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                key = self._waiting[0].key
                works = [work for work in self._waiting if work.key == key][: self.lanes]
                for work in works:
                    self._waiting.remove(work)
            works = [work for work in works if work.done.set_running_or_notify_cancel()]
            if not works:
                continue
            try:
                states = self._advance(works)
            except Exception as error:  # a bug, or out of memory: only the sessions of this pass fail
                for work in works:
                    work.done.set_exception(error)
                continue
            self.frames += len(works)
            for work, state in zip(works, states, strict=True):
                work.done.set_result(state)

    def _advance(self, works: list[FrameRequest]) -> list[BranchState]:
        key = works[0].key
        fresh = works[0].key not in self._compiled
        if fresh:
            steps = key[1][0]
            _tell(works, f"compiling for {steps} decoding step{'s' * (steps != 1)} …", True)
        try:
            inputs = ([work.state for work in works], np.stack([work.action for work in works]))
            return self.branching(key[0]).advance(*inputs, [work.decoding for work in works])
        finally:
            if fresh:
                self._compiled.add(key)
                _tell(works, "", False)


def warm_up(engine: Engine, first: Video, width: int, decoding: Decoding) -> float:
    """Compiles the program for these settings and returns the seconds that a frame takes afterwards."""
    state = engine.begin(first)
    seconds = 0.0
    for _ in range(2):
        began = time.monotonic()
        work = FrameRequest(
            state, np.zeros(width, np.float32), decoding, first.depth is not None, lambda text, busy: None
        )
        state = engine.submit(work).result()
        seconds = time.monotonic() - began
    return seconds


def _tell(works: list[FrameRequest], text: str, busy: bool) -> None:
    for work in works:
        with suppress(RuntimeError):  # the server has stopped
            work.say(text, busy)
