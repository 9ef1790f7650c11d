"""Judges that are not trained here: people who do not know where a video comes from, and vision-language models.

Axes: B videos, T frames, H×W pixels.
"""

import csv
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from rsjax.errors import UserError, did_you_mean, first_line
from rsjax.files import regular, write_file
from rsjax.tools.policies.judges.judge import LABELS, UNINTERPRETABLE
from rsjax.tools.studies.report.video import write_mp4

SHEET = "labels.csv"
QUESTION = "These are frames of a robot arm in order. Is the red cube lifted off the table in the last one?"
ANSWERS = {"yes": 0, "no": 1, "unclear": 2}


def video_name(frames: UInt8[np.ndarray, "T H W 3"]) -> str:
    """Returns a video's name in a sheet of labels: a hash of its frames, which does not reveal where it comes from."""
    return hashlib.sha256(repr(frames.shape).encode() + np.ascontiguousarray(frames).tobytes()).hexdigest()[:12]


def write_blinded(videos: Sequence[UInt8[np.ndarray, "T H W 3"]], folder: Path, fps: float = 5.0) -> Path:
    """Writes videos for people to judge; names and order do not reveal where the videos come from.

    Returns:
        A sheet for :class:`HumanJudge` with the columns video and label (to be filled in with ``LABELS``).
    """
    named = {video_name(video): video for video in videos}
    for name, video in named.items():
        write_mp4(folder / f"{name}.mp4", video, fps, upscale=4)
    sheet = folder / SHEET
    write_file(
        sheet, "".join(f"{line}\n" for line in ("video,label", *(f"{name}," for name in sorted(named)))).encode()
    )
    return sheet


@dataclass(frozen=True)
class HumanJudge:
    """A ``Judge`` of labels that people gave to whole videos, by :func:`video_name`."""

    labels: Mapping[str, int]
    sheet: Path

    @classmethod
    def read(cls, sheet: Path) -> "HumanJudge":
        """Reads a filled-in sheet of :func:`write_blinded`.

        Raises:
            UserError: the sheet is missing or lacks a column, or a video has no label, an unknown label or two labels.
        """
        try:
            with regular(sheet).open(newline="", encoding="utf-8-sig") as file:
                reader = csv.DictReader(file)
                rows = list(reader)
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise UserError(
                f"{sheet}: cannot be read ({first_line(error)}); rsjax.tools.policies.judges.people_and_vlms writes it"
            ) from error
        if missing := {"video", "label"} - set(reader.fieldnames or ()):
            raise UserError(f"{sheet}: has no column {', '.join(sorted(missing))}; it needs video and label")
        labels: dict[str, int] = {}
        for number, row in enumerate(rows, 2):
            name, label = (str(row[key] or "").strip() for key in ("video", "label"))
            if label.lower() not in LABELS:
                if label:
                    hint = f"is {label!r}{did_you_mean(label.lower(), LABELS)}"
                else:
                    hint = "is empty"
                raise UserError(f"{sheet}: line {number}: the label {hint} (labels: {', '.join(LABELS)})")
            if labels.setdefault(name, LABELS.index(label.lower())) != LABELS.index(label.lower()):
                raise UserError(f"{sheet}: line {number}: video {name} has another label above; keep one of them")
        return cls(labels, sheet)

    def __call__(self, frames: UInt8[np.ndarray, "B T H W 3"]) -> Float[np.ndarray, "B 3"]:
        """Returns probability 1 for the label that people gave to each video, and 0 for the others.

        Raises:
            UserError: a video is not in the sheet.
        """
        names = [video_name(video) for video in frames]
        if unknown := [name for name in names if name not in self.labels]:
            raise UserError(
                f"{self.sheet}: has no label of {len(unknown)} of {len(names)} videos, such as {unknown[0]}"
            )
        return np.eye(len(LABELS))[[self.labels[name] for name in names]]


@dataclass(frozen=True)
class LanguageJudge:
    """A ``Judge`` that asks a vision-language model about the frames.

    Attributes:
        model, processor: of the ``transformers`` library.
        question: the question to the model, which asks for one word: yes, no or unclear.
        frames: how many of the last frames the model sees.
    """

    model: Any
    processor: Any
    question: str = QUESTION
    frames: int = 4

    @classmethod
    def load(cls, path: Path, question: str = QUESTION, frames: int = 4) -> "LanguageJudge":
        """Loads a model from a directory of its files; nothing is downloaded.

        Raises:
            UserError: ``transformers`` or torch is not installed, or the directory has no such model.
        """
        try:
            from transformers import AutoModelForImageTextToText, AutoProcessor
        except ImportError as error:
            raise UserError(
                f"a vision-language judge needs torch and transformers ({error}): pip install 'rsjax[annotate]'"
            ) from error
        if not (path / "config.json").exists():
            raise UserError(f"{path}: no config.json, so no model of transformers is there; download one to it")
        try:
            processor = AutoProcessor.from_pretrained(path, local_files_only=True)
            model = AutoModelForImageTextToText.from_pretrained(path, local_files_only=True)
        except (OSError, ValueError, ImportError) as error:
            raise UserError(
                f"{path}: transformers cannot load a vision-language model ({first_line(error)})"
            ) from error
        return cls(model.eval(), processor, question, frames)

    def __call__(self, frames: UInt8[np.ndarray, "B T H W 3"]) -> Float[np.ndarray, "B 3"]:
        """Returns probability 1 for the label that each answer means, and 0 for the others."""
        from PIL import Image

        text = {"type": "text", "text": f"{self.question} Answer with one word: yes, no or unclear."}
        settings = {"add_generation_prompt": True, "tokenize": True, "return_dict": True, "return_tensors": "pt"}
        labels = []
        for video in frames:
            last = video[-self.frames :]
            images: list[dict[str, Any]] = [{"type": "image", "image": Image.fromarray(frame)} for frame in last]
            chat = [{"role": "user", "content": [*images, text]}]
            inputs = self.processor.apply_chat_template(chat, **settings)
            made = self.model.generate(**inputs, max_new_tokens=8, do_sample=False)
            answer = self.processor.decode(made[0, inputs["input_ids"].shape[1] :], skip_special_tokens=True)
            labels.append(answer_label(answer))
        return np.eye(len(LABELS))[labels]


def answer_label(answer: str) -> int:
    """Returns the index of the label that the first word of an answer means; "uninterpretable" for unknown words."""
    words = "".join(c if c.isalpha() else " " for c in answer.lower()).split()
    if words:
        return ANSWERS.get(words[0], UNINTERPRETABLE)
    return UNINTERPRETABLE
