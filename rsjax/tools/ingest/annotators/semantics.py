"""Step "semantics": the text and key frames of each part: the data set's own, or InternVL's where it has none.

Key frames are those in which a gripper opens or closes; without such a change or a known gripper, the frame with most
motion. The network has to answer with one JSON object. An answer outside the schema is refused with the reason, a few
times; after that the episode has no answer, which is an error and not a guess.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from rsjax.tools.ingest.actions import ActionLayout
from rsjax.tools.ingest.annotators.network import NetworkAnnotator, library, pretrained
from rsjax.tools.ingest.annotators.protocols import AnnotationError, Annotator, Semantic, Semantics
from rsjax.tools.ingest.episode import Episode, Segment

Ask = Callable[[list[UInt8[np.ndarray, "H W 3"]], str], str]  # (pictures, question) to an answer

MOST_LETTERS = {"action": 200, "skill": 40, "scene": 200}  # of the schema's texts
PROMPT = (
    "These {count} pictures, numbered 1 to {count}, are from one video of a robot, in order of time. Answer with one "
    'JSON object and nothing else: {{"action": what the robot does, one imperative sentence; "skill": its kind, one '
    'word; "scene": where, a few words; "key_picture": the number of the picture in which the action is decided}}'
)


@dataclass(frozen=True)
class OwnSemantics(Annotator):
    """The data set's own language and segments; without segments, the whole episode is one part.

    Attributes:
        least_grip: how far a gripper's command has to move over the episode to count as used, in the data set's unit
            (mostly 0–1 or -1–1).
        smooth: frames over which motion is averaged before its peak is taken.
    """

    name: ClassVar[str] = "own"
    least_grip: float = 0.1
    smooth: int = 5

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        changes = gripper_changes(episode, self.least_grip)
        parts = []
        for segment in episode.segments or (Segment(0, len(episode.timestamps), ""),):
            frames, by = key_frames(segment, changes, motion, self.smooth)
            if segment.text:
                text = segment.text
                text_by = "segment"
            else:
                text = episode.task
                text_by = episode.task and "task"
            parts.append(Semantic(segment.start, segment.end, text, segment.skill, frames, text_by, by))
        return Semantics(episode.task, str(episode.meta.get("scene", "")), tuple(parts))


def key_frames(
    segment: Segment, changes: list[int], motion: Float[np.ndarray, " N"] | None, smooth: int
) -> tuple[tuple[int, ...], str]:
    """Returns a segment's key frames and their origin: "gripper", "motion" or, if nothing moves, "".

    Args:
        changes: frames of the episode at which a gripper opens or closes.
        motion: motion into each frame of the episode; None if it was not measured.
        smooth: frames over which motion is averaged.
    """
    if inside := tuple(t for t in changes if segment.start <= t < segment.end):
        return inside, "gripper"
    if motion is None or not (within := motion[segment.start : segment.end]).any():
        return (), ""
    width = min(smooth, len(within))
    evened = np.convolve(within, np.full(width, 1 / width), "same")
    return (segment.start + int(evened.argmax()),), "motion"


def gripper_changes(episode: Episode, least: float) -> list[int]:
    """Returns the frames in which a gripper begins to open or close.

    There, its command passes from the lower third of its range to the upper third, or back.

    Args:
        episode: its ``meta["actions"]`` lists the dimensions of gripper commands; without such a list it has none.
        least: a command that moves less than this over the whole episode is ignored.
    """
    changes = set[int]()
    for dimension in ActionLayout.from_json(episode.meta.get("actions", {})).held:
        command = episode.actions[1:, dimension]  # row 0 may be unknown
        if not len(command) or np.ptp(command) < least:
            continue
        position = (command - command.min()) / np.ptp(command)
        sure = np.flatnonzero((position < 1 / 3) | (position > 2 / 3))  # between these thirds the last state holds
        closed = position[sure] > 0.5
        changes.update((sure[1:][closed[1:] != closed[:-1]] + 1).tolist())
    return sorted(changes)


class AnswerError(ValueError):
    """An answer outside the schema; the message says what is wrong with it."""


@dataclass(frozen=True)
class Answer:
    """A network's description of some pictures.

    Attributes:
        action: not empty.
        skill: one word, lower case.
        scene: may be empty.
        key_picture: from 0.
    """

    action: str
    skill: str
    scene: str
    key_picture: int


@dataclass(frozen=True)
class InternVL(NetworkAnnotator):
    """InternVL, for the parts of an episode that the data set has no text for; :class:`OwnSemantics` does the others.

    Its key frame counts before the peak of motion, a gripper's before both.

    Attributes:
        model: local folder, such as a copy of ``OpenGVLab/InternVL3-1B-hf``.
        pictures: of each part of an episode, evenly spaced.
        tries: answers before it gives up.
        new_tokens: of one answer, at most.
    """

    name: ClassVar[str] = "internvl"
    version: ClassVar[int] = 2
    title: ClassVar[str] = "InternVL"
    model: Path
    pictures: int = 8
    tries: int = 3
    new_tokens: int = 200

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        known = OwnSemantics()(episode, camera, motion)
        if all(part.text for part in known.parts):
            return known
        return complete(known, episode, camera, self._ask, self)

    def params(self) -> dict[str, Any]:
        return super().params() | {"own": OwnSemantics().params()}

    def build(self) -> tuple[Any, Any]:
        kinds = ("AutoModelForImageTextToText", "AutoProcessor")
        return pretrained(kinds, self.model, self.device, self.title, dtype="auto")

    def _ask(self, pictures: list[UInt8[np.ndarray, "H W 3"]], question: str) -> str:
        (model, processor) = self.load()
        torch = library("torch", self.title)
        content = [{"type": "image", "image": Image.fromarray(picture)} for picture in pictures]
        messages = [{"role": "user", "content": [*content, {"type": "text", "text": question}]}]
        # Without this each picture would be cut into a dozen tiles, hundreds of tokens each.
        whole = {"crop_to_patches": False, "return_tensors": "pt"}
        options = {"add_generation_prompt": True, "tokenize": True, "return_dict": True, "processor_kwargs": whole}
        inputs = processor.apply_chat_template(messages, **options).to(self.device, dtype=model.dtype)
        with torch.no_grad():
            output = model.generate(**inputs, max_new_tokens=self.new_tokens, do_sample=False)
        return processor.decode(output[0, inputs["input_ids"].shape[1] :], skip_special_tokens=True)


def complete(known: Semantics, episode: Episode, camera: str, ask: Ask, settings: InternVL) -> Semantics:
    """Asks about each part that has no text.

    Raises:
        AnnotationError: the network gave no valid answer.
        EpisodeError: a picture cannot be read.
    """
    parts = []
    scene = known.scene
    for part in known.parts:
        if not part.text:
            count = min(settings.pictures, part.end - part.start)
            frames = np.linspace(part.start, part.end - 1, count).round().astype(int).tolist()
            pictures = list(episode.cameras[camera].read(frames))
            answer = valid_answer(pictures, ask, settings.tries, f"episode {episode.id}")
            part = replace(part, text=answer.action, skill=part.skill or answer.skill, text_by=settings.name)
            if part.key_by != "gripper":  # which is exact to the frame, a picture only to the pictures' spacing
                part = replace(part, key_frames=(frames[answer.key_picture],), key_by=settings.name)
            scene = scene or answer.scene
        parts.append(part)
    return replace(known, scene=scene, parts=tuple(parts))


def valid_answer(pictures: Sequence[UInt8[np.ndarray, "H W 3"]], ask: Ask, tries: int, where: str) -> Answer:
    """Asks about these pictures until an answer is valid.

    Raises:
        AnnotationError: none of ``tries`` answers was.
    """
    question = PROMPT.format(count=len(pictures))
    prompt = question
    for _ in range(tries):
        text = ask(list(pictures), prompt)
        try:
            return parse_answer(text, len(pictures))
        except AnswerError as error:
            wrong = str(error)
            prompt = f"{question}\nYour last answer was refused: {wrong}"
    raise AnnotationError(
        f"{where}: no valid answer in {tries} tries, the last one: {wrong}; raise tries or annotate it"
    )


def parse_answer(text: str, count: int) -> Answer:
    """Validates an answer; a fence of backticks around the object is allowed, text beside it is not.

    Args:
        count: of the pictures shown.

    Raises:
        AnswerError: it is outside the schema.
    """
    bare = text.strip().removeprefix("```json").removeprefix("```").removesuffix("```").strip()
    try:
        values = json.loads(bare)
    except (ValueError, RecursionError):
        raise AnswerError("it is not JSON") from None
    names = {*MOST_LETTERS, "key_picture"}
    if not isinstance(values, dict) or values.keys() != names:
        raise AnswerError(f"it is not an object with the fields {', '.join(sorted(names))} alone")
    texts = {}
    for name, most in MOST_LETTERS.items():
        value = values[name]
        if not isinstance(value, str) or len(value) > most:
            raise AnswerError(f"{name} is not a text of at most {most} letters")
        texts[name] = " ".join(value.split())
    if not texts["action"]:
        raise AnswerError("action is empty")
    key = values["key_picture"]
    if not isinstance(key, int) or isinstance(key, bool) or not 1 <= key <= count:
        raise AnswerError(f"key_picture is not a whole number from 1 to {count}")
    if len(texts["skill"].split()) != 1:
        raise AnswerError("skill is not one word")
    return Answer(texts["action"], texts["skill"].lower(), texts["scene"], key - 1)
