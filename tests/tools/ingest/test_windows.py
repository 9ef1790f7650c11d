import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.config import ConfigError
from rsjax.tools.ingest.episode import EpisodeError, Segment
from rsjax.tools.ingest.windows import (
    Span,
    WindowConfig,
    WindowIndex,
    cut_spans,
    index_windows,
    judge,
    segment_at,
    starts_by_reason,
    tally,
)

CONFIGS = st.builds(
    WindowConfig, frames=st.integers(2, 20), rate=st.sampled_from([0.0, 1, 2, 2.5, 3, 5]), hop=st.integers(1, 5)
)
FPS = st.sampled_from([5.0, 7.5, 10, 15, 24, 25, 29.97, 30, 60])


def even_windows(fps: float, spans: list[Span], config: WindowConfig) -> WindowIndex:
    count = max((end for _, end in spans), default=0)
    return index_windows(np.arange(count) / fps, fps, spans, config)


@st.composite
def spans(draw: st.DrawFn) -> list[Span]:
    """In order, without overlap."""
    lengths = draw(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 400)), max_size=5))
    parts = []
    at = 0
    for gap, length in lengths:
        parts.append((at + gap, at + gap + length))
        at += gap + length
    return parts


def test_the_papers_windows_span_226_recorded_frames() -> None:
    config = WindowConfig(frames=16, rate=2)
    index = even_windows(30, [(0, 2160)], config)
    assert index.frames[0].tolist() == list(range(0, 226, 15))
    assert len(index) == (2160 - 226) // 15 + 1 == 129
    assert even_windows(30, [(0, 225)], config).short == 1


@given(FPS, spans(), CONFIGS)
def test_no_room_is_left_for_one_more_window(fps: float, parts: list[Span], config: WindowConfig) -> None:
    """Where time is even, windows are at even steps, rounded to frames, each within one span."""
    index = even_windows(fps, parts, config)
    step = fps / config.rate if config.rate else 1
    offsets = np.floor(np.arange(config.frames) * step + 0.5 + 1e-6)
    expected = []
    short = 0
    for first, end in parts:
        starts = np.floor(np.arange((end - first) / step / config.hop + 1) * step * config.hop + 0.5 + 1e-6)
        found = [first + start + offsets for start in starts if first + start + offsets[-1] < end]
        expected += found
        short += not found
    np.testing.assert_array_equal(index.frames, np.reshape(expected, (-1, config.frames)))
    assert index.short == short


@given(
    st.lists(st.sampled_from([0.01, 0.02, 0.033, 0.04, 0.1, 0.12, 0.25, 3.0]), min_size=20, max_size=200),
    st.sampled_from([1.0, 2, 2.5, 3]),
    st.integers(2, 8),
    st.integers(1, 3),
)
def test_uneven_recordings_are_sampled_by_time(steps: list[float], rate: float, count: int, hop: int) -> None:
    config = WindowConfig(frames=count, rate=rate, hop=hop)
    times = np.cumsum(steps)
    index = index_windows(times, 100.0, [(0, len(times))], config)
    kept = [frames for frames, why in zip(index.frames, judge(index, times, None, (), config), strict=True) if not why]
    for frames in kept:
        wanted = times[frames[0]] + np.arange(count) / rate
        nearest = np.abs(times[:, None] - wanted).min(0)
        np.testing.assert_allclose(np.abs(times[frames] - wanted), nearest, atol=1e-6)
        assert (np.diff(frames) > 0).all()
    starts = times[index.frames[:, 0]] - times[0]
    even = np.arange(starts[-1] * rate / hop + 1) * hop / rate if len(starts) else np.zeros(0)
    near = [np.abs(times - times[0] - at).argmin() for at in even]
    assert {*index.frames[:, 0]} <= {*near, *(place + 1 for place in near)}  # the later one of two


def test_a_camera_that_slows_down_is_sampled_at_one_rate() -> None:
    """A frame every 1/30 s, then, in the dark, every 1/10 s: by number, clips would run three times as fast."""
    times = np.concatenate([np.arange(300) / 30, 10 + np.arange(100) / 10])
    config = WindowConfig(frames=16, rate=2)
    index = index_windows(times, 30.0, [(0, 400)], config)
    assert len(index) == 25 and set(judge(index, times, None, (), config)) == {""}
    np.testing.assert_allclose(np.diff(times[index.frames], axis=1), 0.5)
    assert np.diff(index.frames[10]).tolist() == [15] * 10 + [5] * 5


def test_a_recording_that_stops_for_years_has_few_windows() -> None:
    times = np.concatenate([np.arange(100) / 10, 1e9 + np.arange(100) / 10])
    config = WindowConfig(frames=4, rate=2)
    reasons = judge(index_windows(times, 10.0, [(0, 200)], config), times, None, (), config)
    assert 34 <= tally(reasons)["kept"] <= 36 and tally(reasons)["gap"] <= 6


def test_a_rate_above_the_recorded_one_is_refused() -> None:
    with pytest.raises(EpisodeError, match=r"fps: recorded at 5 fps, windows take 10"):
        even_windows(5, [(0, 9)], WindowConfig(rate=10))


@pytest.mark.parametrize("slower", [-0.005, 0.005, 0.01])
def test_a_clock_that_is_a_little_off_is_of_its_rate(slower: float) -> None:
    fps = 5.0 * (1 - slower)
    windows = even_windows(fps, [(0, 60)], WindowConfig(frames=16, rate=5.0, hop=1)).frames
    assert len(windows) >= 40 and (np.diff(windows, axis=1) >= 1).all()
    assert np.ptp(windows, axis=1).tolist() == [15] * len(windows)


@pytest.mark.parametrize("fps", [1e30, float("inf"), float("nan")])
def test_a_rate_that_no_camera_has_is_refused(fps: float) -> None:
    with pytest.raises(EpisodeError, match=r"fps: recorded at .* which no camera does"):
        index_windows(np.arange(100.0), fps, [(0, 100)], WindowConfig())


@given(FPS, st.lists(st.integers(1, 299), max_size=6), st.lists(st.integers(0, 300), max_size=8), CONFIGS)
def test_no_window_reaches_across_a_cut_or_out_of_a_segment(
    fps: float, cuts: list[int], edges: list[int], config: WindowConfig
) -> None:
    bounds = [0, *sorted(set(cuts)), 300]
    edges = sorted(set(edges))
    segments = [Segment(a, b, f"{a}") for a, b in itertools.pairwise(edges)][::2]
    for within in (False, True):
        changed = dataclasses.replace(config, within_segments=within)
        index = even_windows(fps, cut_spans(300, list(itertools.pairwise(bounds)), segments, changed), changed)
        for first, last in index.frames[:, [0, -1]]:
            assert first >= 0 and last < 300
            assert not any(first < cut <= last for cut in bounds)
            assert not (within and segments) or any(s.start <= first and last < s.end for s in segments)


def test_spans_are_shots_and_where_asked_segments_within_them() -> None:
    segments = [Segment(0, 30, "a"), Segment(30, 80, "b")]
    assert cut_spans(100, [], segments, WindowConfig()) == [(0, 100)]
    assert cut_spans(70, [(0, 40), (40, 100)], segments, WindowConfig()) == [(0, 40), (40, 70)]
    inside = WindowConfig(within_segments=True)
    assert cut_spans(100, [(0, 40), (40, 100)], segments, inside) == [(0, 30), (30, 40), (40, 80)]
    with pytest.raises(EpisodeError, match=r"'a' and 'b' overlap"):
        cut_spans(100, [], [Segment(0, 31, "a"), segments[1]], inside)


def test_the_segment_that_holds_most_frames_names_the_window() -> None:
    segments = [Segment(0, 30, "a"), Segment(30, 80, "b")]
    frames = np.array([20, 25, 30, 35, 40])
    assert segment_at(segments, frames) == segments[1]
    assert segment_at(segments, frames - 5) == segments[0]
    assert segment_at(segments, frames + 100) is None


def test_each_filter_leaves_out_what_it_names() -> None:
    index = even_windows(10, [(0, 60)], WindowConfig(frames=3, rate=2, hop=2))
    assert index.frames[:, 0].tolist() == [0, 10, 20, 30, 40]
    times = np.arange(60) / 10
    motion = np.full(60, 5.0)
    times[5:] += 3  # the recording stopped
    motion[11:21] = 0.1
    motion[31:41] = 90
    config = WindowConfig(frames=3, rate=2, hop=2, least_motion=1, most_motion=50, key_frame=True)
    reasons = judge(index, times, motion, [3, 20, 35], config)
    assert reasons == ["gap", "still", "", "shaking", "no key frame"]
    assert tally(reasons) == {"kept": 1, "gap": 1, "no key frame": 1, "shaking": 1, "still": 1}
    assert starts_by_reason(index, reasons) == {"gap": [0], "still": [10], "shaking": [30], "no key frame": [40]}
    assert judge(index, np.arange(60) / 10, None, [], WindowConfig(frames=3, rate=2)) == [""] * 5


@pytest.mark.parametrize(("fps", "rate"), [(5.0, 4.0), (30.0, 24.0), (30.0, 29.0), (10.0, 3.0)])
def test_rounding_to_recorded_frames_is_no_gap(fps: float, rate: float) -> None:
    config = WindowConfig(frames=8, rate=rate)
    index = even_windows(fps, [(0, 200)], config)
    times = np.arange(200) / fps
    assert set(judge(index, times, None, (), config)) == {""}
    times[100:] += 2 / rate
    assert "gap" in judge(index, times, None, (), config)


@pytest.mark.parametrize(
    "fields", [{"frames": 1}, {"frames": 10**9}, {"rate": -1}, {"hop": 0}, {"most_gap": 0.5}, {"most_motion": -1}]
)
def test_impossible_windows_are_refused_by_name(fields: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"windows.{next(iter(fields))}"):
        WindowConfig(**fields)  # type: ignore[arg-type]
