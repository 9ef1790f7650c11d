import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.tools.ingest.annotators.depth import DepthAnything, VideoDepthAnything
from rsjax.tools.ingest.annotators.motion import DISFlow, RaftFlow
from rsjax.tools.ingest.annotators.protocols import Annotator, in_chunks
from rsjax.tools.ingest.annotators.semantics import InternVL, OwnSemantics
from rsjax.tools.ingest.annotators.shots import HistogramShots, TransNetShots
from rsjax.tools.ingest.annotators.tracks import BootsTapir, LucasKanade, SpatialTracker
from tests.tools.ingest.videos import ArrayFrames

HERE = Path(__file__)
ALL = [
    LucasKanade(),
    HistogramShots(),
    DISFlow(),
    OwnSemantics(),
    SpatialTracker(HERE.parent, HERE),
    BootsTapir(HERE.parent, HERE),
    TransNetShots(),
    RaftFlow(HERE),
    VideoDepthAnything(HERE.parent, HERE),
    DepthAnything(HERE.parent),
    InternVL(HERE.parent),
]


@dataclass(frozen=True)
class Weighted(Annotator):
    name: ClassVar[str] = "weighted"
    weights: Path
    strength: float = 1.0
    device: str = "cpu"


@pytest.mark.parametrize("annotator", ALL, ids=lambda annotator: annotator.name)
def test_every_annotator_can_be_pickled_and_its_parameters_written_as_json(annotator):
    assert pickle.loads(pickle.dumps(annotator)) == annotator
    params = annotator.params()
    assert json.loads(json.dumps(params)) == params
    assert params["name"] == annotator.name and params["version"] == annotator.version


def test_parameters_depend_on_weights_and_not_on_the_device(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for folder in "ab":
        (tmp_path / folder / "w.pt").write_bytes(b"weights")
    one = Weighted(tmp_path / "a" / "w.pt")
    assert one.params() == Weighted(tmp_path / "b" / "w.pt", device="cuda").params()
    assert one.params() != replace(one, strength=2.0).params()
    before = one.params()
    (tmp_path / "a" / "w.pt").write_bytes(b"other weights")
    assert one.params() != before


def test_a_folder_counts_by_all_its_files(tmp_path):
    folder = Weighted(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    before = folder.params()
    (tmp_path / "model.safetensors").write_bytes(b"x")
    assert folder.params() != before


@given(st.integers(0, 40), st.integers(2, 9), st.integers(0, 1))
def test_chunks_cover_every_frame_and_overlap(count, size, overlap):
    pictures = np.arange(count, dtype=np.uint8).reshape(-1, 1, 1, 1) * np.ones((1, 1, 1, 3), np.uint8)
    chunks = [(start, part[:, 0, 0, 0].tolist()) for start, part in in_chunks(ArrayFrames(pictures), overlap, size)]
    assert all(part == list(range(start, start + len(part))) and len(part) <= size for start, part in chunks)
    covered = [t for i, (_, part) in enumerate(chunks) for t in part[overlap if i else 0 :]]
    assert covered == list(range(count))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: LucasKanade(grid=0), "lucas-kanade: grid is 0"),
        (lambda: LucasKanade(window=2), "at least 3"),
        (lambda: LucasKanade(levels=-1), "levels is -1"),
        (lambda: HistogramShots(shortest=0), "hsv-histogram: shortest is 0"),
        (lambda: DISFlow(preset=3), "choose 0, 1 or 2"),
        (lambda: OwnSemantics(smooth=0), "own: smooth is 0"),
        (lambda: SpatialTracker(HERE, HERE, span=0), "spatial-tracker: span is 0"),
        (lambda: BootsTapir(HERE, HERE, side=100), "multiple of 8"),
        (lambda: TransNetShots(shortest=-1), "transnetv2: shortest is -1"),
        (lambda: RaftFlow(HERE, batch=0), "raft: batch is 0"),
        (lambda: VideoDepthAnything(HERE, HERE, input_size=0), "input_size is 0"),
        (lambda: DepthAnything(HERE, batch=0), "depth-anything: batch is 0"),
        (lambda: InternVL(HERE, tries=0), "internvl: tries is 0"),
    ],
)
def test_an_impossible_number_is_refused(wrong, message):
    with pytest.raises(ConfigError, match=message):
        wrong()
