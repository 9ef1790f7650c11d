"""The rope and its rigid twin: alike until they are touched, followed exactly by tracks, lifted by the expert."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rsjax.config import SimConfig
from rsjax.tools.sim.collect import collection_key
from rsjax.tools.sim.episode import EpisodePlan, run_episode, task_of
from rsjax.tools.sim.rope import LINKS, MODES, ROD, ROPE, Manner, RopeSim, draw_manner
from rsjax.tools.sim.tracks import Snapshot, object_pixels, track

SIZE = 64
LIFT = Manner("lift", LINKS // 2, (0.0, -0.002), 1.0, 0.0, 0, (0.0, 0.0, 0.15), -1)
CONFIG = SimConfig(episodes=4, test_episodes=2, frames=3, image_size=32, tracks=16, camera="near", env="rope")


@pytest.fixture(scope="module")
def sims(gl: str) -> Iterator[dict[str, RopeSim]]:
    with RopeSim(ROPE, image_size=SIZE) as rope, RopeSim(ROD, image_size=SIZE) as rod:
        yield {ROPE: rope, ROD: rod}


def bends(sim: RopeSim) -> np.ndarray:
    """The angles between neighbouring links' axes."""
    axes = sim.body_poses()[1][sim.object_bodies][:, :, 0]
    return np.arccos(np.clip((axes[:-1] * axes[1:]).sum(-1), -1, 1))


@pytest.fixture(scope="module")
def lifts(sims: dict[str, RopeSim]) -> dict[str, list]:
    """Of each object: snapshots, views, segmentation and bends while the same grasp lifts it from the same start."""
    moments: dict[str, list] = {}
    for name, sim in sims.items():
        sim.reset(3)
        act = LIFT.expert(np.random.default_rng(0)).act
        moments[name] = []
        for step in range(61):
            if step % 12 == 0:
                view = sim.render()
                shot = Snapshot(sim.camera, *sim.body_poses(), view.fine_depth)
                moments[name].append((shot, view, sim.segment(), bends(sim)))
            sim.step(act(sim.state))
    return moments


def test_rope_and_rod_begin_alike_and_only_the_rope_bends(sims: dict[str, RopeSim], lifts: dict[str, list]) -> None:
    (_, view, bodies, bent), (_, other, same, alike) = lifts[ROPE][0], lifts[ROD][0]
    np.testing.assert_array_equal(view.rgb, other.rgb)
    np.testing.assert_array_equal(view.depth, other.depth)
    np.testing.assert_array_equal(bodies, same)
    np.testing.assert_allclose(bent, alike, atol=1e-9)
    assert sims[ROPE].success and sims[ROD].success
    assert np.abs(lifts[ROPE][-1][3] - bent).max() > 0.1
    assert np.abs(lifts[ROD][-1][3] - alike).max() < 1e-3


@pytest.mark.parametrize("name", [ROPE, ROD])
def test_tracks_stay_on_the_surface(name: str, sims: dict[str, RopeSim], lifts: dict[str, list]) -> None:
    """Visible tracks of the object lie on it in the segmentation, at the depth that the picture has there."""
    shots = [moment[0] for moment in lifts[name]]
    _, view, bodies, _ = lifts[name][0]
    sim = sims[name]
    pixels = object_pixels(bodies, sim.movable, sim.object_bodies, 200, np.random.default_rng(0))
    pixels = pixels[np.isin(bodies[tuple(pixels.T)], sim.object_bodies)]
    assert len(pixels) > 40
    tracks, visible = track(pixels, view.depth, bodies, shots)
    assert np.abs(tracks[:, -1] - tracks[:, 0]).max() > 0.1, "the object moves"
    on_object: list[bool] = []
    for number, (_, _, seen, _) in enumerate(lifts[name]):
        cells = np.clip((tracks[visible[:, number], number] * SIZE).astype(int), 0, SIZE - 1)
        on_object.extend(np.isin(seen[cells[:, 1], cells[:, 0]], sim.object_bodies))
    assert len(on_object) > 100
    assert np.mean(on_object) > 0.9  # the others lie within a pixel of an edge


def test_episodes_take_turns_and_depend_only_on_their_plan(sims: dict[str, RopeSim]) -> None:
    assert CONFIG.action_dim == 28
    assert sorted(task_of(CONFIG, number) for number in range(2)) == [ROD, ROPE]
    plan = EpisodePlan("x", 0, ROPE)
    config = replace(CONFIG, image_size=SIZE)
    clip = run_episode(sims[ROPE], config, plan)
    again = run_episode(sims[ROPE], config, plan)
    np.testing.assert_array_equal(clip.rgb, again.rgb)
    np.testing.assert_array_equal(clip.tracks, again.tracks)
    assert clip.task == ROPE and clip.provenance["source"] == "robosuite/Rope/Panda"
    assert clip.provenance["expert"]["mode"] in MODES
    assert len(clip.provenance["objects"]["object"]) == config.frames
    assert collection_key(CONFIG) != collection_key(replace(CONFIG, tasks=(ROPE,)))


def test_the_expert_does_not_know_which_object_it_meets() -> None:
    """Equal draws give equal manners: nothing in them depends on rope or rod."""
    assert draw_manner(np.random.default_rng(4)) == draw_manner(np.random.default_rng(4))
    assert sum(MODES.values()) == pytest.approx(1)
