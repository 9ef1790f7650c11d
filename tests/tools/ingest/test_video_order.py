"""Frames that are stored in another order than they are shown in, which some containers do not say."""

import dataclasses
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from rsjax.tools.ingest import doctor, video
from rsjax.tools.ingest.annotate import Annotated
from rsjax.tools.ingest.clips import ClipConfig, cut
from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats import open_source
from rsjax.tools.ingest.video import VideoFrames, misread, scan
from rsjax.tools.ingest.windows import WindowConfig
from tests.tools.ingest.formats.videos import close_videos, numbers_of, picture

COUNT = 30
CLOSED = "keyint=12:min-keyint=12:bframes=3:b-adapt=0:scenecut=0"
OPTIONS = {
    "closed groups": ("libx264", {"crf": "1", "x264-params": CLOSED}),
    "open groups": ("libx264", {"crf": "1", "x264-params": f"{CLOSED}:open-gop=1"}),
    "one group": ("libx264", {"crf": "1", "x264-params": "keyint=250:bframes=5:b-adapt=0:b-pyramid=normal"}),
    "key frames alone": ("libx264", {"crf": "1", "x264-params": "keyint=1"}),
    "MPEG-4": ("mpeg4", {"bf": "2", "qmin": "1", "qmax": "2"}),
}


def write(path: Path, name: str, stamps: Any = None) -> Path:
    """Writes the pictures 0 … COUNT - 1, at 30 fps or at these stamps of 1/30 s."""
    codec, options = OPTIONS[name]
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream(codec, rate=30, options=options)
        stream.height = 32
        stream.width = 32
        stream.pix_fmt = "yuv420p"
        for number in range(COUNT):
            frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24")
            frame.pts = int(number if stamps is None else stamps[number])
            frame.time_base = Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def copied(source: Path, path: Path) -> Path:
    """The same packets, shown in the order of the file: what tools make of AVI."""
    with av.open(str(source)) as recorded, av.open(str(path), "w") as out:
        stream = out.add_stream_from_template(recorded.streams.video[0])
        for packet in recorded.demux(video=0):
            if packet.dts is not None:
                packet.pts = packet.dts
                packet.stream = stream
                out.mux(packet)
    return path


def check_order(path: Path) -> None:
    frames = VideoFrames(path)
    assert numbers_of(frames.read(range(len(frames)))) == list(range(COUNT))
    for number in np.random.default_rng(0).permutation(COUNT).tolist():
        assert numbers_of(frames.read([number])) == [number]
    assert misread(path) is None
    close_videos()


@pytest.mark.parametrize("name", OPTIONS)
def test_any_frame_of_any_container(tmp_path: Path, name: str) -> None:
    for ending in ("avi", "mkv", "mp4"):
        path = write(tmp_path / f"v.{ending}", name)
        check_order(path)
        np.testing.assert_allclose(np.diff(scan(path).times()), 1 / 30, atol=1e-3)


@pytest.mark.parametrize(("name", "ending"), [("closed groups", "mkv"), ("open groups", "mp4")])
def test_copies_of_avi_that_invent_times(tmp_path: Path, name: str, ending: str) -> None:
    check_order(copied(write(tmp_path / "v.avi", name), tmp_path / f"v.{ending}"))


def test_avi_with_places_left_empty_is_not_truncated(tmp_path: Path) -> None:
    stamps = np.cumsum(np.resize([2, 1, 3], COUNT)) - 2
    check_order(path := write(tmp_path / "v.avi", "closed groups", stamps))
    assert len(set(np.diff(scan(path).stamps))) > 1
    payload = path.read_bytes()
    path.write_bytes(payload[: len(payload) * 2 // 3])
    with pytest.raises(EpisodeError, match=r"v.avi: truncated: \d+ of the \d+ frames that its header names"):
        scan(path)


def test_damage_where_the_order_is_unknown_is_reported(tmp_path: Path) -> None:
    path = write(tmp_path / "v.avi", "closed groups")
    payload = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        coded = bytes(next(packet for packet in container.demux(video=0) if packet.dts == 13))
    begin = payload.index(coded)
    payload[begin : begin + len(coded)] = bytes(len(coded))
    path.write_bytes(payload)
    with pytest.raises(EpisodeError, match=r"does not say when its frames are shown, .* only \d+ of 30"):
        scan(path)


def test_the_doctor_compares_seeking_with_decoding_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "one").mkdir()
    copied(write(tmp_path / "v.avi", "open groups"), tmp_path / "one/main.mp4")
    (tmp_path / "v.avi").unlink()
    np.save(tmp_path / "one/actions.npy", np.ones((COUNT, 2)))

    def kinds() -> set[str]:
        close_videos()
        source = open_source("folder", tmp_path, task="go", kind="delta", held=[])
        findings, _ = doctor.check_episode(source.read(next(source.episodes())), doctor.Thresholds(frames=2))
        return {finding.kind for finding in findings}

    assert not kinds()
    index = scan(tmp_path / "one/main.mp4")
    assert not np.array_equal(index.labels, index.stamps)
    trusted = dataclasses.replace(index, labels=index.stamps)  # as if the file's times were right
    monkeypatch.setattr(video, "scan", lambda path: trusted)
    assert "seeking" in kinds()
    monkeypatch.undo()
    assert not kinds()


@pytest.mark.parametrize(("name", "ending"), [("closed groups", "mkv"), ("key frames alone", "mov")])
def test_uneven_videos_give_clips_at_one_rate(tmp_path: Path, name: str, ending: str) -> None:
    """Pictures come every 1/30 s at first and every 1/10 s later."""
    stamps = np.concatenate([np.arange(15), 15 + 3 * np.arange(COUNT - 15)])
    (tmp_path / "one").mkdir()
    check_order(write(tmp_path / f"one/main.{ending}", name, stamps))
    np.save(tmp_path / "one/actions.npy", np.ones((COUNT, 2)))
    source = open_source("folder", tmp_path, task="go", kind="delta", held=[])
    episode = source.read(next(source.episodes()))
    np.testing.assert_allclose(episode.timestamps, stamps / 30, atol=1e-3)
    clips = list(cut(Annotated(episode), ClipConfig(WindowConfig(frames=3, rate=5), image_size=32, tracks=1)))
    for clip in clips:
        numbers = numbers_of(clip["rgb"])
        assert numbers == clip["provenance"]["frames"] and np.abs(np.diff(stamps[numbers]) - 6).max() <= 1
        assert clip["actions"][1:, 0].tolist() == np.diff(numbers).tolist()
    assert {*np.diff([clip["provenance"]["frames"] for clip in clips]).ravel()} >= {2, 6}
