import os
import pickle
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest import video
from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.video import VideoFrames, at_times, scan
from tests.tools.ingest.formats.videos import close_videos, numbers_of, write_video


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "clip.mp4", range(30))


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(st.integers(0, 29), min_size=1, max_size=6), max_size=3))
def test_any_order_of_any_frames(clip: Path, requests: list[list[int]]) -> None:
    frames = VideoFrames(clip)
    for request in requests:
        assert numbers_of(frames.read(request)) == request


def test_av1(tmp_path: Path) -> None:
    frames = VideoFrames(write_video(tmp_path / "av1.mp4", range(12), codec="libsvtav1"))
    assert len(frames) == 12
    assert numbers_of(frames.read([11, 0, 5])) == [11, 0, 5]


def test_frames_are_upright(tmp_path: Path) -> None:
    for rotation, corner in ((0, (0, 0)), (90, (-1, 0)), (180, (-1, -1)), (-90, (0, -1))):
        path = write_video(tmp_path / f"turned{rotation}.mp4", range(1), size=(48, 64), rotation=rotation)
        picture = VideoFrames(path).read([0])[0]
        assert picture.shape == ((48, 64, 3) if rotation % 180 == 0 else (64, 48, 3))
        assert picture[corner].min() > 240, rotation


def test_some_frames_of_a_video(clip: Path) -> None:
    frames = pickle.loads(pickle.dumps(VideoFrames(clip, np.arange(10, 20))))
    assert len(frames) == 10
    assert numbers_of(frames.read([0, 9, 3])) == [10, 19, 13]
    with pytest.raises(IndexError, match="of 10"):
        frames.read([10])


def test_frames_by_time(clip: Path) -> None:
    frames = at_times(clip, np.arange(5) / 30 + 0.2, tolerance=1e-4)
    assert numbers_of(frames.read(range(5))) == [6, 7, 8, 9, 10]
    for times, tolerance, message in (
        ([0.201], 1e-4, r"clip.mp4: no frame at 0.2010 s, row 0 .* 0.001 s\s*away, 0.0001 s"),
        ([0.0, 1.0], 1e-4, "no frame at 1.0000 s, row 1"),
        ([np.nan], 1e-4, "no frame at nan s, row 0"),
        ([0.2, 0.205], 0.01, "rows 0 and 1 of the table show the same frame"),
    ):
        with pytest.raises(EpisodeError, match=message):
            at_times(clip, np.array(times), tolerance)


def test_files_kept_open_are_bounded(tmp_path: Path, clip: Path) -> None:
    close_videos()
    payload = clip.read_bytes()
    for number in range(video.OPEN_FILES + 3):
        copy = tmp_path / f"{number}.mp4"
        copy.write_bytes(payload)
        VideoFrames(copy).read([0])
    assert len(video._decoders) == video.OPEN_FILES
    close_videos()


PROGRAM = """
import os, subprocess, sys
from pathlib import Path
from rsjax.tools.ingest.video import VideoFrames
from tests.tools.ingest.formats.videos import numbers_of
frames = VideoFrames(Path(sys.argv[1]))
assert numbers_of(frames.read([3])) == [3]
subprocess.run(["true"], preexec_fn=lambda: None)
child = os.fork()
assert numbers_of(frames.read([4])) == [4]
if child:
    assert os.waitpid(child, 0)[1] == 0
    assert numbers_of(frames.read([5])) == [5]
"""


def test_a_forked_process_reads_files_of_its_own_and_ends(clip: Path) -> None:
    """The threads of FFmpeg's that its parent may have are not copied; Ray forks thus before it starts a command."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    subprocess.run([sys.executable, "-c", PROGRAM, str(clip)], env=environment, check=True, timeout=600)


def test_a_file_that_changes_is_scanned_again(tmp_path: Path) -> None:
    frames = VideoFrames(write_video(tmp_path / "v.mp4", range(5)))
    assert numbers_of(frames.read([4])) == [4]
    write_video(tmp_path / "v.mp4", range(9))
    assert numbers_of(frames.read([8])) == [8]


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 0.999))
def test_a_truncated_file_is_reported_or_read_right(tmp_path: Path, clip: Path, share: float) -> None:
    payload = clip.read_bytes()
    short = tmp_path / "short.mp4"
    short.write_bytes(payload[: int(share * len(payload))])
    try:
        read = numbers_of(VideoFrames(short).read(range(30)))
    except EpisodeError as error:
        message = str(error)
        assert re.fullmatch(f"{short}: .*; fetch the file again or leave the episode out", message)
        return
    assert share > 0.9  # all but the tags at the end is there
    assert read == list(range(30))


def test_a_truncated_file_whose_header_comes_first_is_reported(tmp_path: Path, clip: Path) -> None:
    with av.open(str(clip)) as source, av.open(str(tmp_path / "f.mp4"), "w", options={"movflags": "faststart"}) as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)
    payload = (tmp_path / "f.mp4").read_bytes()
    assert len(scan(tmp_path / "f.mp4").stamps) == 30
    (tmp_path / "f.mp4").write_bytes(payload[: -len(payload) // 5])
    with pytest.raises(EpisodeError, match=r"f.mp4: truncated: \d+ of the 30 frames that its header names"):
        scan(tmp_path / "f.mp4")


def test_damage_in_the_middle_is_reported(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", range(30))
    payload = bytearray(path.read_bytes())
    middle = payload.index(b"mdat") + (len(payload) - payload.index(b"mdat")) // 3
    payload[middle : middle + 300] = bytes(300)
    path.write_bytes(payload)
    with pytest.raises(EpisodeError, match=r"v.mp4: frame \d+ \(at .* s\) cannot be decoded"):
        VideoFrames(path).read(range(30))


def remuxed(source: Path, path: Path, first: int, begins: int) -> Path:
    """The packets from frame ``first`` on, of a file that is shown from frame ``begins`` on: so trimming tools cut."""
    options = {"avoid_negative_ts": "disabled", "use_editlist": "1"}
    with av.open(str(source)) as recorded, av.open(str(path), "w", options=options) as out:
        stream = out.add_stream_from_template(recorded.streams.video[0])
        tick = scan(source).stamps[1]
        for packet in recorded.demux(video=0):
            if packet.pts is not None and packet.dts is not None and packet.pts >= first * tick:
                packet.pts = packet.pts - begins * tick
                packet.dts = packet.dts - begins * tick
                packet.stream = stream
                out.mux(packet)
    return path


def test_frames_that_an_edit_list_hides_are_not_missing(tmp_path: Path, clip: Path) -> None:
    path = remuxed(clip, tmp_path / "cut.mp4", first=5, begins=8)
    frames = VideoFrames(path)
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 25 > len(frames) == 22
    assert numbers_of(frames.read(range(22))) == list(range(8, 30))
    assert numbers_of(frames.read([5])) == [13]


def test_pictures_of_several_sizes_are_reported(tmp_path: Path) -> None:
    streams = []
    for side in (32, 64):
        with av.open(str(tmp_path / f"{side}.h264"), "w", format="h264") as out:
            stream = out.add_stream("libx264", rate=30, options={"bf": "0"})
            stream.height = side
            stream.width = side
            stream.pix_fmt = "yuv420p"
            for _ in range(3):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((side, side, 3), np.uint8))))
            out.mux(stream.encode())
        streams.append((tmp_path / f"{side}.h264").read_bytes())
    (tmp_path / "both.h264").write_bytes(b"".join(streams))
    with av.open(str(tmp_path / "both.h264")) as source, av.open(str(tmp_path / "both.mkv"), "w") as out:
        stream = out.add_stream_from_template(source.streams.video[0])
        packets = [packet for packet in source.demux(video=0) if packet.size]
        for number, packet in enumerate(packets):
            packet.pts = packet.dts = number * 33
            packet.time_base = Fraction(1, 1000)
            packet.stream = stream
            out.mux(packet)
    frames = VideoFrames(tmp_path / "both.mkv")
    assert frames.read([0, 1]).shape == (2, 32, 32, 3)
    with pytest.raises(EpisodeError, match=r"both.mkv: frame 5: pictures of several sizes \(64 × 64"):
        frames.read([0, 5])


def test_what_is_no_video_is_reported(tmp_path: Path, clip: Path) -> None:
    """A playlist opens no other file."""
    (tmp_path / "beside.mp4").write_bytes(clip.read_bytes())
    (tmp_path / "loop.mp4").symlink_to(tmp_path / "loop.mp4")
    for payload, name in (
        (b"ffconcat version 1.0\nfile beside.mp4\n", "list.mp4"),
        (b"", "empty.mp4"),
        (b"not a video", "concat:x.mp4"),
        (b"\x00" * 5000, "zeros.mp4"),
    ):
        (tmp_path / name).write_bytes(payload)
    messages = dict.fromkeys(("list.mp4", "empty.mp4", "concat:x.mp4", "zeros.mp4"), "not a readable video")
    messages |= {"gone.mp4": "missing", "loop.mp4": r"not a readable video \(Too many levels of symbolic links\)"}
    for name, message in messages.items():
        with pytest.raises(EpisodeError, match=f"{name}: {message}"):
            len(VideoFrames(tmp_path / name))
