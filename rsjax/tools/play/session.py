"""One viewer's session: a start, settings, and a tree of branches that grows frame by frame."""

import asyncio
import secrets
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from rsjax.clip import Video
from rsjax.config import Config
from rsjax.data.codec import Record
from rsjax.models.branch_states import BranchState, Decoding
from rsjax.tools.play.engine import Engine, FrameRequest
from rsjax.tools.play.messages import Refused, number, whole
from rsjax.tools.play.pictures import Upload
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.send_queue import SendQueue
from rsjax.tools.play.tree import Branch, Memories, Node, Tree

MOST_STEPS = 16
MOST_TEMPERATURE = 4.0
MOST_GUIDANCE = 8.0
MOST_SEED = 2**31 - 1
MOST_BRANCHES = 32
MOST_FRAMES = 4096
FRAME_BYTES = 256 * 2**20  # of a session's pictures; for large pictures this lowers the number of frames


@dataclass(frozen=True)
class SampleSettings:
    """Settings that a page can change: those of :class:`rsjax.config.SampleConfig`."""

    temperature: float
    steps: int
    guidance: float
    top_k: int

    def describe(self) -> dict[str, Any]:
        """Returns the settings for a page."""
        return asdict(self)

    def decoding(self, seed: int, draw: int) -> Decoding:
        """Returns how the next frame is decoded."""
        return Decoding(self.steps, self.temperature, self.guidance, self.top_k, seed, draw)

    def changed(self, message: dict[str, Any], limits: dict[str, Any]) -> "SampleSettings":
        """Returns the settings with the fields that a message changes.

        Raises:
            Refused: a field is outside the run's limits.
        """
        try:
            low, high = limits["guidance"]
            return replace(
                self,
                temperature=number(message, "temperature", 0, MOST_TEMPERATURE, self.temperature),
                steps=whole(message, "steps", 1, limits["steps"], self.steps),
                guidance=number(message, "guidance", low, high, self.guidance),
                top_k=whole(message, "top_k", 0, limits["top_k"], self.top_k),
            )
        except Refused as error:
            raise Refused("bad_settings", error.message) from error


def first_settings(config: Config) -> SampleSettings:
    """Returns the run's own settings."""
    sample: Any = config.model.sample  # type: ignore[attr-defined]  # every family that branches has it
    return SampleSettings(float(sample.temperature), sample.steps, float(sample.guidance), sample.top_k)


def settings_limits(config: Config) -> dict[str, Any]:
    """Returns the limits of a run's settings."""
    departures = getattr(config.model, "departures", None)  # only families of tokens have them
    guided = departures is not None and departures.action_dropout > 0
    codes = 2 ** (config.tokenizer.code_bits // config.tokenizer.vocabularies)
    cells = config.grid**2
    return {
        "steps": max(min(MOST_STEPS, cells), first_settings(config).steps),
        "guidance": [0.0, MOST_GUIDANCE] if guided else [1.0, 1.0],
        "top_k": codes,
    }


@dataclass(frozen=True)
class Start:
    """The beginning of a session's branches: a clip of the run, or an uploaded picture.

    Attributes:
        number: the clip's number.
        clip: the clip.
    """

    number: int | None
    clip: Record | None
    upload: Upload | None

    def describe(self) -> dict[str, Any]:
        """Returns the description of the start for a page."""
        if self.clip is None:
            assert self.upload is not None
            return {"start": {"upload": self.upload.describe()}, "task": "", "clip_frames": None}
        facts = {"start": {"clip": self.number}, "task": str(self.clip["task"])}
        return facts | {"clip_frames": len(self.clip["rgb"])}


class Session:
    """One viewer's session. Its coroutines run one after another, in the order of the viewer's messages.

    Args:
        run: the run to play.
        engine: generates the session's frames.
        memories: the memories of all sessions.

    Attributes:
        name: a name that nobody can guess.
        out: the destination of messages; None while no page is connected.
        watched: kinds of pictures that are sent with each new frame.
        used: when the last message came or the last frame was made, in seconds of :func:`time.monotonic`.
    """

    def __init__(self, run: PlayRun, engine: Engine, memories: Memories) -> None:
        self.name = secrets.token_urlsafe(16)
        self.used = time.monotonic()
        self.run = run
        self.engine = engine
        self.out: SendQueue | None = None
        self.watched: list[str] = []
        self.settings = first_settings(run.data.config)
        self.seed = 0
        self.upload: Upload | None = None
        self.start: Start | None = None
        self.tree: Tree | None = None
        self._memories = memories

    @property
    def limits(self) -> dict[str, Any]:
        """The limits of a session."""
        frame = 3 * self.run.data.config.clips.image_size**2
        most = {"frames": min(MOST_FRAMES, FRAME_BYTES // frame), "branches": MOST_BRANCHES}
        return settings_limits(self.run.data.config) | most

    @property
    def grown(self) -> Tree:
        """The tree; raises :class:`Refused` before the first start."""
        if self.tree is None:
            raise Refused("no_start", "begin with a clip or a picture first")
        return self.tree

    @property
    def has_depth(self) -> bool:
        """Whether the session's frames have depth."""
        return self.tree is not None and "depth" in self.grown.node(0, 0).state.tokens

    def describe(self) -> dict[str, Any]:
        """Returns the description of a session that has a start, for a page."""
        assert self.start is not None
        facts = self.start.describe() | {"seed": self.seed, "settings": self.settings.describe()}
        branches = [branch.describe() for branch in self.grown.branches.values()]
        return facts | {"session": self.name, "has_depth": self.has_depth, "branches": branches}

    def send(self, item: bytes | dict[str, Any], droppable: bool = False) -> None:
        """Sends a message, unless no page is connected."""
        if self.out is not None:
            self.out.put(item, droppable)

    async def begin(self, start: Start, seed: int) -> None:
        """Begins a new tree; the old one is forgotten."""
        if start.clip is not None:
            first = self.run.first(start.clip)
            draw = int(start.number or 0)
        else:
            assert start.upload is not None
            if self.run.trained.config.second_view:
                raise Refused("bad_image", "the model reads a second view, which a picture lacks; begin with a clip")
            first = Video(start.upload.rgb[None, None])
            draw = 0
        state = await asyncio.to_thread(self.engine.begin, first)
        self.forget()
        self.start = start
        self.seed = seed
        self.tree = Tree(Node(state), draw)

    def clip_start(self, number: int) -> Start:
        """Returns a clip as a start."""
        return Start(number, self.run.clip(number), None)

    def upload_start(self) -> Start:
        """Returns the last uploaded picture as a start."""
        if self.upload is None:
            raise Refused("no_upload", "send a picture first")
        return Start(None, None, self.upload)

    def fork(self, number: int, frame: int, fresh: bool) -> Branch:
        """Makes a branch; if ``fresh``, it has its own random draws."""
        if len(self.grown.branches) >= MOST_BRANCHES:
            raise Refused("full", f"a session can have {MOST_BRANCHES} branches; drop one")
        if fresh:
            draw = secrets.randbelow(MOST_SEED)
        else:
            draw = None
        return self.grown.fork(number, frame, draw)

    def drop(self, number: int) -> None:
        """Removes a branch from which no other branch forks."""
        branch = self.grown.branch(number)
        self.grown.drop(number)
        if len(branch.nodes) - 1 > int(branch.fork or 0):  # otherwise the parent has its last frame
            self._memories.forget(branch.nodes[-1])
            branch.nodes[-1].state = self._lighten(branch.nodes[-1].state)

    async def step(self, number: int, action: Float32[np.ndarray, " A"], decoding: Decoding | None = None) -> int:
        """Generates a branch's next frame and returns its number.

        Args:
            action: the action, within limits.
            decoding: None: according to the session's settings.
        """
        tree = self.grown
        branch = tree.branch(number)
        if tree.frames >= self.limits["frames"]:
            raise Refused("full", f"a session can have {self.limits['frames']} frames; begin again, or drop a branch")
        how = decoding or self.settings.decoding(self.seed, branch.draw)
        # The last frame may have lost its memory: generate the frames again from the nearest one that has its memory.
        known = len(branch.nodes) - 1
        while branch.nodes[known].state.memory is None:
            known -= 1
        for before, after in zip(branch.nodes[known:], branch.nodes[known + 1 :], strict=False):
            assert after.action is not None and after.decoding is not None
            after.state = await self._advance(before, after.action, after.decoding)
        state = await self._advance(branch.nodes[-1], action, how)
        node = Node(state, action, how)
        self._memories.note(node, self._lighten)
        return tree.append(number, node)

    def forget(self) -> None:
        """Forgets the start and the tree, and frees its memory."""
        if self.tree is not None:
            for branch in self.tree.branches.values():
                for node in branch.nodes:
                    self._memories.forget(node)
        self.tree = None
        self.start = None

    async def _advance(self, node: Node, action: Float32[np.ndarray, " A"], how: Decoding) -> BranchState:
        state = node.state
        loop = asyncio.get_running_loop()
        self._memories.forget(node)
        node.state = self._lighten(state)

        def say(text: str, busy: bool) -> None:
            loop.call_soon_threadsafe(self.send, {"type": "status", "text": text, "busy": busy})

        work = FrameRequest(state, action, how, self.has_depth, say)
        made = await asyncio.wrap_future(self.engine.submit(work))
        self.used = time.monotonic()
        return made

    def _lighten(self, state: BranchState) -> BranchState:
        return self.engine.branching(self.has_depth).lightened(state)
