"""Collects the probes of a store of Lift's clips: grasps at set offsets, and free drives.

The clips' camera sees them, and they begin from starts that no clip has. Each direction and height of grasps has a
start of its own, from which the offset alone decides.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rsjax.config import SimConfig, content_key
from rsjax.data.codec import Record
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.evaluation.probes import Probes
from rsjax.tools.sim.collect import Collection, Report, collection_key, make_store
from rsjax.tools.sim.drives import FRAMES, Drive
from rsjax.tools.sim.episode import EpisodePlan
from rsjax.tools.sim.grasps import STEPS, Grasp
from rsjax.tools.sim.unseen import UNITS

FOLDER = "probes"  # inside the store's directory, so that it moves with the store
RECIPE = 1  # raise when the same configuration gives different probes
SEED = 2_000_000  # added to the clips' seed
# Metres from the cube's centre: where the fingers close. The simulator's success falls from 1 to 0 in this range.
OFFSETS = (0.0, 0.01, 0.02, 0.025, 0.03, 0.04, 0.06)
HEIGHTS = (0.0, -0.008, 0.012)
DIRECTIONS = range(4)
GRASPS = tuple(
    EpisodePlan(f"{number:06d}", number // len(OFFSETS), manner=Grasp(offset, direction, height))
    for number, (height, direction, offset) in enumerate(itertools.product(HEIGHTS, DIRECTIONS, OFFSETS))
)
DRIVES = tuple(EpisodePlan(f"{number:06d}", len(GRASPS) + number, manner=Drive()) for number in range(12))


def collect_probes(
    config: SimConfig,
    clips: Store,
    report: Report,
    workers: int = 0,
    grasps: Sequence[EpisodePlan] = GRASPS,
    drives: Sequence[EpisodePlan] = DRIVES,
) -> Probes:
    """Collects the probes, unless they exist.

    Args:
        config: the configuration of ``clips``.
        clips: the store that training reads; the probes are kept in its directory.
        report: called as episodes finish, of both kinds.
        workers: processes that simulate; 0: one per core.
        grasps: the episodes of grasps.
        drives: the episodes of drives, all of one length.

    Raises:
        UserError: as :func:`rsjax.tools.sim.collect.collect`, or the simulator fails on a probe.
    """
    total = len(grasps) + len(drives)
    length = -(-STEPS // config.control_steps) + 1
    return Probes(
        _collected(config, clips, "grasps", grasps, length, lambda done, _: report(done, total), workers),
        _collected(config, clips, "drives", drives, FRAMES, lambda done, _: report(len(grasps) + done, total), workers),
    )


def _collected(
    config: SimConfig,
    clips: Store,
    split: str,
    plans: Sequence[EpisodePlan],
    frames: int,
    report: Report,
    workers: int,
) -> list[Record]:
    seed = (config.seed + SEED) % 2**32
    config = replace(config, frames=frames, seed=seed, tracks=1, track_points="grid")
    key = content_key(FOLDER, RECIPE, split, collection_key(config), tuple(plans))
    meta: dict[str, Any] = {name: clips.manifest[name] for name in UNITS} | {"probes_of": clips.manifest.get("key")}
    out = clips.path / FOLDER / key
    make_store(Collection(key, config, {split: tuple(plans)}, meta), out, report, workers)
    made = open_store(out).source(split)
    if len(made) < len(plans):
        raise UserError(f"{out}: the simulator failed on {len(plans) - len(made)} of {len(plans)} {split}")
    return [made[number] for number in range(len(made))]
