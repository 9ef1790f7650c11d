"""Answers a page's messages: one function for each type does what the message asks, and returns the final answer."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Any

from rsjax.tools.play import keep
from rsjax.tools.play.link import read_state, state_of
from rsjax.tools.play.messages import MOST_ID, Refused, choice, kinds, number, whole, words
from rsjax.tools.play.pictures import Place, read_picture
from rsjax.tools.play.session import MOST_SEED
from rsjax.tools.play.viewer import KINDS, Viewer

Message = dict[str, Any]
Answer = Callable[[Viewer, Message], Awaitable[Message]]

ANSWERS: dict[str, Answer] = {}
MOST_NUMBER = 2**16 - 1  # the greatest number of a branch
MOST_FRAMES = 64  # in a message "frames"
MOST_PANES = 6


def answers(kind: str) -> Callable[[Answer], Answer]:
    """Registers a function as the answer to one type of message."""

    def register(function: Answer) -> Answer:
        ANSWERS[kind] = function
        return function

    return register


async def answer(viewer: Viewer, message: Message) -> Message:
    """Does what a message asks for and returns the final answer, with the message's id."""
    if type(message.get("id")) is int and 0 < message["id"] <= MOST_ID:
        own = message["id"]
    else:
        own = 0
    try:
        whole(message, "id", 1, MOST_ID)
        if message["type"] not in ANSWERS:
            raise Refused("bad_message", f"there is no message {message['type']!r:.40}; there are {', '.join(ANSWERS)}")
        return {"id": own} | await ANSWERS[message["type"]](viewer, message)
    except Refused as error:
        return refusal(own, error)


def refusal(number: int, error: Refused) -> Message:
    """Returns the answer to a message that cannot be done."""
    return {"type": "error", "id": number, "error": error.code, "message": error.message}


async def upload(viewer: Viewer, payload: bytes) -> Message:
    """Keeps an uploaded picture, from which a session can start."""
    try:
        size = viewer.session.run.data.config.clips.image_size
        made = await asyncio.to_thread(read_picture, payload, size)
        viewer.session.upload = made
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
    if uploaded:
        start = session.upload_start()
    else:
        start = session.clip_start(whole(message, "clip", 0, MOST_SEED))
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
    viewer.session.watched = kinds(message, KINDS)
    if not {"truth", "truth_depth"} & set(viewer.session.watched):
        viewer.rest()
    return {"type": "ok"}


@answers("step")
async def _step(viewer: Viewer, message: Message) -> Message:
    session = viewer.session
    began = time.monotonic()
    branch = session.grown.branch(whole(message, "branch", 0, MOST_NUMBER))
    source = message.get("source")
    numbers = message.get("action")
    if (source is None) == (numbers is None) or not isinstance(source, dict | None):
        raise Refused("bad_message", "a step has either an action, a list of numbers, or a source, an object")
    if source is not None:
        numbers = await viewer.sourced(branch, source)
    action, clipped = session.run.controls.action(numbers)
    frame = await session.step(branch.number, action)
    viewer.sources.acted(branch, source)
    await viewer.show(branch.number, frame, message["id"])
    node = branch.nodes[frame]
    facts = {"branch": branch.number, "frame": frame, "action": [round(float(x), 6) for x in action]}
    if "uncertainty" in session.watched:
        unsure = viewer.mean_bits(node)
    else:
        unsure = None
    known = {"uncertainty": unsure, "coverage": viewer.coverage(node)}
    milliseconds = round(1000 * (time.monotonic() - began), 2)
    return {"type": "stepped"} | facts | {"clipped": clipped, "ms": milliseconds} | known


@answers("fork")
async def _fork(viewer: Viewer, message: Message) -> Message:
    branch = whole(message, "branch", 0, MOST_NUMBER)
    frame = whole(message, "frame", 0, MOST_SEED)
    fresh = choice(message, "draw", ("same", "new"), "same") == "new"
    return {"type": "branch"} | viewer.session.fork(branch, frame, fresh).describe()


@answers("drop")
async def _drop(viewer: Viewer, message: Message) -> Message:
    viewer.session.drop(whole(message, "branch", 0, MOST_NUMBER))
    return {"type": "ok"}


@answers("frames")
async def _frames(viewer: Viewer, message: Message) -> Message:
    branch = whole(message, "branch", 0, MOST_NUMBER)
    chosen = kinds(message, ("rgb", *KINDS))
    first = whole(message, "first", 0, MOST_SEED)
    count = whole(message, "count", 1, MOST_FRAMES)
    nodes = viewer.session.grown.branch(branch).nodes
    if first >= len(nodes):
        raise Refused("no_frame", f"branch {branch} has frames 0 to {len(nodes) - 1}, not {first}")
    for frame in range(first, min(first + count, len(nodes))):
        await viewer.again(Place(branch, frame, message["id"]), nodes[: frame + 1], chosen)
    return {"type": "ok"}


@answers("record")
async def _record(viewer: Viewer, message: Message) -> Message:
    kind = choice(message, "format", ("mp4", "gif"))
    branch = whole(message, "branch", 0, MOST_NUMBER)
    panes = words(message, "panes", MOST_PANES)
    scale = whole(message, "scale", 1, 8, 4)
    fps = number(message, "fps", 1, 60, viewer.session.run.fps)
    if not panes:
        raise Refused("bad_message", "panes is empty; choose one at least")
    path = viewer.files.place(viewer.session, f".{kind}")
    await viewer.side.run(keep.record, viewer.session, path, branch, panes, fps, scale)
    return viewer.files.add(path)


@answers("export")
async def _export(viewer: Viewer, message: Message) -> Message:
    chosen = message.get("branches", list(viewer.session.grown.branches))
    if not isinstance(chosen, list) or len(chosen) > MOST_NUMBER:
        raise Refused("bad_message", "branches is a list of numbers")
    numbers = [whole({"branches": each}, "branches", 0, MOST_NUMBER) for each in chosen]
    path = viewer.files.place(viewer.session, "-clips")
    made = viewer.files.add(await viewer.side.run(keep.export, viewer.session, path, list(dict.fromkeys(numbers))))
    return made | {"path": str(path)}


@answers("link")
async def _link(viewer: Viewer, message: Message) -> Message:
    state = state_of(viewer.session)
    return {"type": "link", "state": state, "bytes": len(state)}


@answers("load")
async def _load(viewer: Viewer, message: Message) -> Message:
    session = viewer.session
    saved = await asyncio.to_thread(read_state, session, message.get("state"))
    await session.begin(saved.start, saved.seed)
    viewer.begun()
    session.settings = saved.settings
    await viewer.show(0, 0, message["id"])
    done = 0
    total = sum(len(branch.steps) for branch in saved.branches)
    for place, branch in enumerate(saved.branches):
        if branch.parent is not None:
            session.fork(branch.parent, branch.fork, fresh=False)
        session.grown.branch(place).draw = branch.draw
        for action, decoding in branch.steps:
            frame = await session.step(place, action, decoding)
            if session.out is not None:
                await session.out.room()
            await viewer.show(place, frame, message["id"])
            done += 1
            facts = {"done": done, "total": total, "what": "frames"}
            session.send({"type": "progress", "id": message["id"]} | facts, droppable=True)
    if saved.lanes != session.engine.lanes:
        text = f"made with --lanes {saved.lanes}, here are {session.engine.lanes}: frames may differ in their last bit"
        session.send({"type": "status", "text": text, "busy": False})
    return {"type": "session"} | viewer.describe()
