"""Keypoints that follow what moves."""

import numpy as np

from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.points import GRID, points_of
from tests.tools.play.client import Server


def test_keypoints_move_with_the_picture_on_every_branch(server: Server, run: PlayRun) -> None:
    """The fake model shifts the picture by four times the first number of an action."""
    with server.client() as (page, _):
        page.ask("start", clip=0)
        page.ask("watch", kinds=["points"])
        for shift in (0.5, 0.5):
            page.ask("step", branch=0, action=[shift] + [0] * 6)
        told = page.until_pushed("points", 2)
        assert [(each["frame"], each["pane"]) for each in told] == [(1, "rgb"), (2, "rgb")]
        page.ask("fork", branch=0, frame=1)
        page.ask("step", branch=1, action=[-0.5] + [0] * 6)
        page.ask("frames", branch=0, first=0, count=1, kinds=["points"])
        told = page.until_pushed("points", 4)
        at = {(each["branch"], each["frame"]): np.array(each["points"]) for each in told}
    start = at[0, 0]
    clip = run.clip(0)
    assert len(start) == run.data.config.model.marked_keypoints <= len(clip["tracks"]) and start[:, 2].all()
    inside = (start[:, 0] > 0.2) & (start[:, 0] < 0.7) & (start[:, 1] > 0.2) & (start[:, 1] < 0.8)
    for place, pixels in (((0, 1), 2), ((0, 2), 4), ((1, 2), 0)):
        seen = inside & (at[place][:, 2] > 0)
        assert seen.sum() >= inside.sum() / 2
        moved = 64 * (at[place][seen, 0] - start[seen, 0])
        assert abs(np.median(moved) - pixels) < 0.5, place


def test_a_picture_without_tracks_has_points_on_a_grid(server: Server) -> None:
    with server.client() as (page, welcome):
        page.ask("start", clip=0)
        session = server.hub._seats[welcome["session"]].viewer.session
        assert session.start is not None and session.start.clip is not None
        session.start.clip["visible"] = np.zeros_like(session.start.clip["visible"])
        assert len(points_of(session, session.grown.branch(0).nodes, "rgb")) == GRID**2
