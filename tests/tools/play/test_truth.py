"""The simulator beside the dream: its own frames, on every branch, never in the dream's way."""

import functools
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rsjax.tools.play.messages import Refused
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.truth import Follower, Truths
from tests.tools.play.client import Client, Server, serving
from tests.tools.play.fake import Fakes, hub_of, play_run
from tests.tools.play.fake_simulator import adding
from tests.tools.play.test_session import rgb


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    run = play_run(tmp_path_factory.mktemp("truth"), Fakes())
    for clip in range(run.clips):
        assert "seed" not in run.clip(clip)["provenance"]
    with serving(hub_of(seeded(run), truths=Truths(functools.partial(adding, 0.0), most=1))) as served:
        yield served


def seeded(run: PlayRun) -> PlayRun:
    """The run, whose clips say how their episodes began."""

    class Source:
        def __len__(self) -> int:
            return 5

        def __getitem__(self, number: int) -> object:
            clip = run.data.clips.source("test")[number]
            return clip | {"provenance": clip["provenance"] | {"seed": 0, "episode": number}}

    run.__dict__["source"] = Source()
    return run


def drive(page: Client, branch: int, *actions: float) -> None:
    for each in actions:
        assert page.ask("step", branch=branch, action=[each] + [0] * 6)["type"] == "stepped"


def test_truth_follows_each_branch_and_says_how_far_off_the_dream_is(server: Server) -> None:
    with server.client() as (page, welcome):
        assert welcome["truth"] == ""
        assert page.ask("start", clip=0)["has_truth"]
        drive(page, 0, 0.1)
        page.ask("watch", kinds=["truth"])
        drive(page, 0, 0.1, 0.1)
        told = page.until_pushed("truth", 4)
        assert [each["frame"] for each in told] == [0, 1, 2, 3], "also those before it was asked for"
        page.ask("fork", branch=0, frame=1)
        drive(page, 1, 1.0)
        last = page.until_pushed("truth", 5)[-1]
        assert (last["branch"], last["frame"], last["success"]) == (1, 2, True)
        page.ask("frames", branch=0, first=0, count=9, kinds=["truth"])
        page.ask("frames", branch=1, first=2, count=1, kinds=["rgb", "truth"])
        shown = {(each.branch, each.frame): int(rgb(each)[0, 0, 0]) for each in page.pictures if each.kind == 3}
        assert shown == {(0, 0): 0, (0, 1): 10, (0, 2): 20, (0, 3): 30, (1, 2): 110}
        dream = rgb(page.pictures[-2] if page.pictures[-2].kind == 1 else page.pictures[-1]).astype(float)
        error = np.mean((dream - 110) ** 2)
        assert last["psnr"] == pytest.approx(10 * np.log10(255**2 / error), abs=0.01)


def test_a_simulator_that_dies_or_diverges_does_not_end_the_dream(server: Server) -> None:
    with server.client() as (page, _):
        page.ask("start", clip=1)
        page.ask("watch", kinds=["truth"])
        for deadly in (0.5, 0.75):
            drive(page, 0, deadly)
            page.until_pushed("truth_off", 1)
            page.pushed.clear()
            page.ask("start", clip=1)
        drive(page, 0, 0.25)
        assert page.until_pushed("truth", 2)[-1]["frame"] == 1
        drive(page, 0, 0.625)
        page.until_pushed("truth_off", 1)
        drive(page, 0, 0.0625)
        page.until_pushed("truth", 4)
        truths = [int(rgb(each)[0, 0, 0]) for each in page.until(3, 4)]
        assert truths[-2:] == [88, 94], "no action is taken twice"


def test_one_viewer_more_than_simulators_is_told_so(server: Server) -> None:
    with server.client() as (one, _), server.client() as (other, _):
        for page in (one, other):
            page.ask("start", clip=0)
            page.ask("watch", kinds=["truth"])
            drive(page, 0, 0.1)
            if page is one:
                one.until_pushed("truth", 2)
        other.until_pushed("truth_off", 1)
        one.ask("watch", kinds=[])
        drive(other, 0, 0.1)
        assert other.until_pushed("truth", 3)


def test_a_slow_simulator_does_not_hold_up_the_dream(tmp_path: Path) -> None:
    run = seeded(play_run(tmp_path, Fakes()))
    with serving(hub_of(run, truths=Truths(functools.partial(adding, 3.0)))) as server, server.client() as (page, _):
        page.ask("start", clip=0)
        page.ask("watch", kinds=["truth"])
        began = time.monotonic()
        drive(page, 0, *[0.1] * 10)
        assert time.monotonic() - began < 3 and not any(each["type"] == "truth" for each in page.pushed)


def test_a_new_start_has_a_simulator_of_its_own(tmp_path: Path) -> None:
    run = seeded(play_run(tmp_path, Fakes()))
    with serving(hub_of(run, truths=Truths(functools.partial(adding, 0.5)))) as server, server.client() as (page, _):
        page.ask("watch", kinds=["truth"])
        page.ask("start", clip=0)
        drive(page, 0, 0.9)
        page.ask("start", clip=1)  # while the first one is still on its way
        drive(page, 0, 0.1)
        told = page.until_pushed("truth", 2)
        assert [each["frame"] for each in told] == [0, 1]
        assert [int(rgb(each)[0, 0, 0]) for each in page.pictures if each.kind == 3] == [0, 10]


def test_a_clip_from_the_middle_of_an_episode_has_no_truth() -> None:
    with pytest.raises(Refused) as refused:
        Follower(Truths(functools.partial(adding, 0.0)), {"seed": 0, "episode": 1, "window": 3}, "lift")
    assert "begins in the middle of its episode" in str(refused.value)
