"""What each message of a page does: one function for each type, which returns the final answer."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from rsjax.play import shown
from rsjax.play.errors import Refused
from rsjax.play.frames import Place
from rsjax.play.messages import MOST_ID, choice, kinds, whole
from rsjax.play.pictures import read_picture
from rsjax.play.settings import MOST_SEED
from rsjax.play.viewer import Viewer

Message = dict[str, Any]
Answer = Callable[[Viewer, Message], Awaitable[Message]]

ANSWERS: dict[str, Answer] = {}
MOST_NUMBER = 2**16 - 1  # of a branch
MOST_FRAMES = 64  # of a message "frames"


def answers(kind: str) -> Callable[[Answer], Answer]:
    """Registers a function as the answer to a type of messages."""

    def register(function: Answer) -> Answer:
        ANSWERS[kind] = function
        return function

    return register


async def answer(viewer: Viewer, message: Message) -> Message:
    """Does what a message asks for and returns the final answer, with its id."""
    number = message["id"] if type(message.get("id")) is int and 0 < message["id"] <= MOST_ID else 0
    try:
        whole(message, "id", 1, MOST_ID)
        if message["type"] not in ANSWERS:
            raise Refused("bad_message", f"there is no message {message['type']!r:.40}; there are {', '.join(ANSWERS)}")
        return {"id": number} | await ANSWERS[message["type"]](viewer, message)
    except Refused as error:
        return refusal(number, error)


def refusal(number: int, error: Refused) -> Message:
    """Returns the answer to what cannot be done."""
    return {"type": "error", "id": number, "error": error.code, "message": error.message}


async def upload(viewer: Viewer, payload: bytes) -> Message:
    """Keeps an uploaded picture for a start."""
    try:
        size = viewer.session.run.data.config.clips.image_size
        viewer.session.upload = made = await asyncio.to_thread(read_picture, payload, size)
    except Refused as error:
        return refusal(0, error)
    return {"type": "uploaded", "id": 0} | made.describe() | {"message": made.message}


@answers("ping")
async def _ping(viewer: Viewer, message: Message) -> Message:
    return {"type": "pong"}


@answers("start")
async def _start(viewer: Viewer, message: Message) -> Message:
    session = viewer.session
    seed = whole(message, "seed", 0, MOST_SEED, session.seed)
    uploaded = message.get("upload") is True
    start = session.upload_start() if uploaded else session.clip_start(whole(message, "clip", 0, MOST_SEED))
    await session.begin(start, seed)
    viewer.begun()
    await viewer.show(0, 0, message["id"])
    return {"type": "session"} | viewer.describe()


@answers("settings")
async def _settings(viewer: Viewer, message: Message) -> Message:
    session = viewer.session
    session.settings = session.settings.changed(message, session.limits)
    return {"type": "settings"} | session.settings.describe()


@answers("watch")
async def _watch(viewer: Viewer, message: Message) -> Message:
    viewer.session.watched = kinds(message, shown.KINDS)
    return {"type": "ok"}


@answers("step")
async def _step(viewer: Viewer, message: Message) -> Message:
    session, began = viewer.session, time.monotonic()
    branch = session.grown.branch(whole(message, "branch", 0, MOST_NUMBER))
    source, given = message.get("source"), message.get("action")
    if (source is None) == (given is None) or not isinstance(source, dict | None):
        raise Refused("bad_message", "a step has either an action, a list of numbers, or a source, an object")
    if source is not None:
        given = await viewer.sourced(branch, source)
    action, clipped = session.run.controls.action(given)
    frame = await session.step(branch.number, action)
    viewer.sources.acted(branch)
    await viewer.show(branch.number, frame, message["id"])
    node = branch.nodes[frame]
    facts = {"branch": branch.number, "frame": frame, "action": [round(float(x), 6) for x in action]}
    unsure = viewer.mean_bits(node) if "uncertainty" in session.watched else None
    milliseconds = round(1000 * (time.monotonic() - began), 2)
    return {"type": "stepped"} | facts | {"clipped": clipped, "ms": milliseconds, "uncertainty": unsure}


@answers("fork")
async def _fork(viewer: Viewer, message: Message) -> Message:
    number, frame = whole(message, "branch", 0, MOST_NUMBER), whole(message, "frame", 0, MOST_SEED)
    fresh = choice(message, "draw", ("same", "new"), "same") == "new"
    return {"type": "branch"} | viewer.session.fork(number, frame, fresh).describe()


@answers("drop")
async def _drop(viewer: Viewer, message: Message) -> Message:
    viewer.session.drop(whole(message, "branch", 0, MOST_NUMBER))
    return {"type": "ok"}


@answers("frames")
async def _frames(viewer: Viewer, message: Message) -> Message:
    number, chosen = whole(message, "branch", 0, MOST_NUMBER), kinds(message, ("rgb", *shown.KINDS))
    first, count = whole(message, "first", 0, MOST_SEED), whole(message, "count", 1, MOST_FRAMES)
    nodes = viewer.session.grown.branch(number).nodes
    if first >= len(nodes):
        raise Refused("no_frame", f"branch {number} has frames 0 to {len(nodes) - 1}, not {first}")
    for frame in range(first, min(first + count, len(nodes))):
        await viewer.again(Place(number, frame, message["id"]), nodes[: frame + 1], chosen)
    return {"type": "ok"}
