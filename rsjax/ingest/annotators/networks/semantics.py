"""Stage "semantics" by InternVL (transformers): asked only about parts that the data set has no text for.

The network is asked for one JSON object and is not believed: it is told what is wrong with an answer that is not of the
schema, a few times, and then the episode has no answer, which is an error and not a guess.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from rsjax.ingest.annotators.networks.local import library, on_device, pretrained
from rsjax.ingest.annotators.protocols import AnnotationError, Semantic, Semantics, require_counts
from rsjax.ingest.annotators.semantics import OwnSemantics
from rsjax.ingest.episode import Episode, EpisodeError

Ask = Callable[[list[UInt8[np.ndarray, "H W 3"]], str], str]  # pictures and a question to an answer

MOST_LETTERS = {"action": 200, "skill": 40, "scene": 200}  # of the schema's texts
PROMPT = (
    "These {count} pictures, numbered 1 to {count}, are from one video of a robot, in order of time. Answer with one "
    'JSON object and nothing else: {{"action": what the robot does, one imperative sentence; "skill": its kind, one '
    'word; "scene": where, a few words; "key_picture": the number of the picture in which the action is decided}}'
)


class AnswerError(ValueError):
    """An answer that is not of the schema; the message says what is wrong with it."""


@dataclass(frozen=True)
class Answer:
    """What a network said of some pictures.

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
class InternVL:
    """InternVL; text of the data set, where there is any, stays as it is, and with it its key frames.

    In the parts that it is asked about, its key frame counts before the peak of motion, and the gripper's before both.

    Attributes:
        model: local folder, such as a copy of ``OpenGVLab/InternVL3-1B-hf``.
        pictures: of each part of an episode, evenly spaced.
        tries: answers asked for.
        new_tokens: of one answer, at most.
        own: what is done with the parts that have text.
        device: torch's name of it.
    """

    name: ClassVar[str] = "internvl"
    version: ClassVar[int] = 2
    model: Path
    pictures: int = 8
    tries: int = 3
    new_tokens: int = 200
    own: OwnSemantics = field(default_factory=OwnSemantics)
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_counts(self, "pictures", "tries", "new_tokens")

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        known = self.own(episode, camera, motion)
        if all(part.text for part in known.parts):
            return known
        return complete(known, episode, camera, _asking(*self.load(), self), self)

    def load(self) -> tuple[Any, Any]:
        """Network and processor, loaded once per process; errors as of ``protocols.prepare``."""
        return _load(self.model, self.device)


def complete(known: Semantics, episode: Episode, camera: str, ask: Ask, settings: InternVL) -> Semantics:
    """Asks about each part that has no text.

    Raises:
        AnnotationError: there was no valid answer.
        EpisodeError: there is no such camera.
    """
    if camera not in episode.cameras:
        raise EpisodeError(f"episode {episode.id}: no camera {camera!r}; it has {', '.join(episode.cameras)}")
    parts, scene = [], known.scene
    for part in known.parts:
        if part.text:
            parts.append(part)
            continue
        count = min(settings.pictures, part.end - part.start)
        frames = np.linspace(part.start, part.end - 1, count).round().astype(int).tolist()
        answer = asked(list(episode.cameras[camera].read(frames)), ask, settings.tries, f"episode {episode.id}")
        parts.append(_told(part, answer, frames, settings.name))
        scene = scene or answer.scene
    return replace(known, scene=scene, parts=tuple(parts))


def _told(part: Semantic, answer: Answer, frames: list[int], by: str) -> Semantic:
    part = replace(part, text=answer.action, skill=part.skill or answer.skill, text_by=by)
    # what a gripper says is exact to the frame, a picture's number only to the spacing of the pictures
    return part if part.key_by == "gripper" else replace(part, key_frames=(frames[answer.key_picture],), key_by=by)


def asked(pictures: Sequence[UInt8[np.ndarray, "H W 3"]], ask: Ask, tries: int, where: str) -> Answer:
    """A valid answer about these pictures.

    Raises:
        AnnotationError: none of ``tries`` answers was one.
    """
    question = prompt = PROMPT.format(count=len(pictures))
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
    """Validates an answer; a fence of backticks around the object is forgiven, text beside it is not.

    Args:
        count: how many pictures were shown.

    Raises:
        AnswerError: it is not of the schema.
    """
    bare = text.strip().removeprefix("```json").removeprefix("```").removesuffix("```").strip()
    try:
        values = json.loads(bare)
    except (ValueError, RecursionError):
        raise AnswerError("it is not JSON") from None
    names = {*MOST_LETTERS, "key_picture"}
    if not isinstance(values, dict) or values.keys() != names:
        raise AnswerError(f"it is not an object with the fields {', '.join(sorted(names))} alone")
    texts = {name: _text(name, values[name], most) for name, most in MOST_LETTERS.items()}
    if not texts["action"]:
        raise AnswerError("action is empty")
    key = values["key_picture"]
    if not isinstance(key, int) or isinstance(key, bool) or not 1 <= key <= count:
        raise AnswerError(f"key_picture is not a whole number from 1 to {count}")
    if len(texts["skill"].split()) != 1:
        raise AnswerError("skill is not one word")
    return Answer(texts["action"], texts["skill"].lower(), texts["scene"], key - 1)


def _text(name: str, value: Any, most: int) -> str:
    if not isinstance(value, str) or len(value) > most:
        raise AnswerError(f"{name} is not a text of at most {most} letters")
    return " ".join(value.split())


def _asking(model: Any, processor: Any, settings: InternVL) -> Ask:
    torch = library("torch", "InternVL")

    def ask(pictures: list[np.ndarray], question: str) -> str:
        content = [{"type": "image", "image": Image.fromarray(picture)} for picture in pictures]
        messages = [{"role": "user", "content": [*content, {"type": "text", "text": question}]}]
        # Without this each picture would be cut into a dozen tiles, hundreds of tokens each.
        whole = {"crop_to_patches": False, "return_tensors": "pt"}
        options = {"add_generation_prompt": True, "tokenize": True, "return_dict": True, "processor_kwargs": whole}
        inputs = processor.apply_chat_template(messages, **options).to(settings.device, dtype=model.dtype)
        with torch.no_grad():
            said = model.generate(**inputs, max_new_tokens=settings.new_tokens, do_sample=False)
        return processor.decode(said[0, inputs["input_ids"].shape[1] :], skip_special_tokens=True)

    return ask


@lru_cache(maxsize=1)
def _load(folder: Path, device: str) -> tuple[Any, Any]:
    what = "InternVL"
    library("torch", what)
    model = pretrained("AutoModelForImageTextToText", folder, what, dtype="auto").eval()
    return on_device(model, device, what), pretrained("AutoProcessor", folder, what)
