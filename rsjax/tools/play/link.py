"""Writes a session as text, from which it can be restored bit for bit: start, seed, settings, actions of branches."""

import base64
import binascii
import io
import json
import zlib
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Float32
from PIL import Image

from rsjax.models.branch_states import Decoding
from rsjax.tools.play.messages import TEXT_BYTES, Refused, parse_json, whole
from rsjax.tools.play.pictures import MOST_SIDE, Upload, read_picture
from rsjax.tools.play.session import MOST_BRANCHES, MOST_SEED, SampleSettings, Session, Start

VERSION = 1
MOST_TEXT = TEXT_BYTES - 1024  # characters, because a link must fit into one message
MOST_JSON = 4 * 2**20  # bytes, unpacked; a session of the most frames has less


@dataclass(frozen=True)
class SavedBranch:
    """A branch of a saved session.

    Attributes:
        parent: the parent's index among the saved branches; None for the first branch.
        steps: actions and decodings of the frames after the fork.
    """

    parent: int | None
    fork: int
    draw: int
    steps: list[tuple[Float32[np.ndarray, " A"], Decoding]]


@dataclass(frozen=True)
class Saved:
    """A saved session; ``lanes`` is the setting of the server that saved it."""

    start: Start
    seed: int
    settings: SampleSettings
    branches: list[SavedBranch]
    lanes: int


def state_of(session: Session) -> str:
    """Returns a session as text for a link.

    Raises:
        Refused: the session has no start, or is too long.
    """
    tree = session.grown
    start = session.start
    assert start is not None
    places: dict[int | None, int | None] = {None: None}  # of each branch among the saved ones; the first has no parent
    branches = []
    for place, (number, branch) in enumerate(tree.branches.items()):
        places[number] = place
        made = branch.nodes[1 + int(branch.fork or 0) :]
        actions = np.array([node.action for node in made], "<f4")
        how = [[vars(how), len(list(same))] for how, same in groupby(node.decoding for node in made)]
        facts = {"parent": places[branch.parent], "fork": int(branch.fork or 0), "draw": branch.draw, "how": how}
        branches.append(facts | {"actions": base64.b64encode(actions.tobytes()).decode()})
    begun: dict[str, Any] = {"clip": start.number}
    if start.upload is not None:
        buffer = io.BytesIO()
        Image.fromarray(start.upload.rgb).save(buffer, "PNG", optimize=True)
        png = base64.b64encode(buffer.getvalue()).decode()
        begun = {"upload": png, "size": list(start.upload.size), "square": start.upload.square}
    values = {
        "version": VERSION,
        "run": session.run.fingerprint,
        "split": session.run.split,
        "lanes": session.engine.lanes,
        "start": begun,
        "seed": session.seed,
        "settings": session.settings.describe(),
        "branches": branches,
    }
    text = base64.urlsafe_b64encode(zlib.compress(json.dumps(values).encode(), 9)).decode().rstrip("=")
    if len(text) > MOST_TEXT:
        raise Refused("too_large", f"the session is too long for a link: {len(text)} characters of {MOST_TEXT}")
    return text


def read_state(session: Session, text: object) -> Saved:
    """Reads the text that :func:`state_of` returned for any session of the same run.

    Raises:
        Refused: the text is damaged, of another run or another version, or exceeds the limits of a session.
    """
    try:
        if not isinstance(text, str):
            raise ValueError("no text")
        packed = base64.b64decode(text + "=" * (-len(text) % 4), b"-_", validate=True)
        values = parse_json(zlib.decompressobj().decompress(packed, MOST_JSON))
        if not isinstance(values, dict):
            raise ValueError("no object")
    except (ValueError, binascii.Error, zlib.error) as error:
        raise Refused("bad_state", "the link is damaged: a part of it is missing or changed") from error
    try:
        if values["version"] != VERSION:
            raise Refused("bad_state", f"the link is of version {values['version']!r:.20}, this server's is {VERSION}")
        if values["run"] != session.run.fingerprint:
            raise Refused("bad_state", "the link is of another model: other weights or settings than this run's")
        start = _start(session, values)
        rows = values["branches"]
        if not isinstance(rows, list) or not 0 < len(rows) <= MOST_BRANCHES:
            raise Refused("bad_state", f"the link has no branches, or more than {MOST_BRANCHES}")
        made = []  # the branches' actions as they were sent; their numbers are not checked yet
        for row in rows:
            plain = base64.b64decode(row["actions"], validate=True)
            made.append(np.frombuffer(plain, "<f4").reshape(-1, session.run.controls.width))
        if sum(map(len, made)) >= session.limits["frames"]:
            raise Refused("bad_state", f"the link has more than {session.limits['frames']} frames")
        branches = [_read_branch(session, row, *each) for row, each in zip(rows, enumerate(made), strict=True)]
        seed = whole(values, "seed", 0, MOST_SEED)
        lanes = whole(values, "lanes", 1, 256)
        settings = session.settings.changed(values["settings"], session.limits)
    except Refused as error:
        raise Refused("bad_state", error.message) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise Refused("bad_state", "the link is damaged") from error
    return Saved(start, seed, settings, branches, lanes)


def _start(session: Session, values: dict[str, Any]) -> Start:
    begun = values["start"]
    size = session.run.data.config.clips.image_size
    if "upload" not in begun:
        if values["split"] != session.run.split:
            raise Refused("bad_state", f"the link begins with a clip of the split {values['split']!r:.20}")
        return session.clip_start(whole(begun, "clip", 0, MOST_SEED))
    picture = read_picture(base64.b64decode(begun["upload"], validate=True), size)
    if picture.size != (size, size):
        raise Refused("bad_state", f"the link's picture has {picture.size} pixels, not {size} × {size}")
    width, height = (whole({"size": side}, "size", 1, MOST_SIDE) for side in begun["size"])
    return Start(None, None, Upload(picture.rgb, (width, height), whole(begun, "square", 1, min(width, height))))


def _read_branch(session: Session, row: dict[str, Any], place: int, numbers: Float32[np.ndarray, "T A"]) -> SavedBranch:
    limits = session.limits
    actions = [session.run.controls.action(action)[0] for action in numbers]
    decodings: list[Decoding] = []
    for values, count in row["how"]:
        settings = session.settings.changed({name: values[name] for name in session.settings.describe()}, limits)
        seed = whole(values, "seed", 0, MOST_SEED)
        draw = whole(values, "draw", 0, MOST_SEED)
        decodings += [settings.decoding(seed, draw)] * whole({"count": count}, "count", 1, limits["frames"])
        if len(decodings) > len(actions):
            break
    if len(decodings) != len(actions):
        raise ValueError("other numbers of actions and settings")
    if place == 0:
        parent = None
    else:
        parent = whole(row, "parent", 0, place - 1)
    steps = list(zip(actions, decodings, strict=True))
    return SavedBranch(parent, whole(row, "fork", 0, MOST_SEED), whole(row, "draw", 0, MOST_SEED), steps)
