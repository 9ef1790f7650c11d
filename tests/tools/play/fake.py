"""A run whose model is a few lines of numpy: its frames follow from everything that they should follow from."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rsjax.clip import Video
from rsjax.data.normalization import Normalization
from rsjax.files import write_json
from rsjax.models.branch_states import BranchState, Decoding
from rsjax.tools.play.engine import Engine
from rsjax.tools.play.hub import Hub
from rsjax.tools.play.play_run import PlayRun
from rsjax.tools.play.truth import Truths
from rsjax.tools.policies.run_data import RunData
from tests.tools.pipeline import toy

MEASURED = {"contact_false_success": 0.85}
LIGHT = 4  # every so many frames there is a small memory


@dataclass
class Memory:
    """All that a frame depends on; a large one can be used once."""

    rgb: np.ndarray
    frame: int
    light: bool
    used: bool = False


@dataclass
class FakeBranching:
    """Moves the picture, and puts a number into a corner that follows from action, settings, draws and frame.

    Attributes:
        passes: the number of frames of each pass that has begun.
        gate: passes wait until it is set.
    """

    lanes: int
    has_depth: bool
    passes: list[int] = field(default_factory=list)
    gate: threading.Event = field(default_factory=threading.Event)
    fail: bool = False

    def begin(self, first: Video) -> BranchState:
        return self._branch_state(Memory(first.rgb[0, 0], 0, True), None)

    def advance(
        self, states: Sequence[BranchState], actions: np.ndarray, decodings: Sequence[Decoding]
    ) -> list[BranchState]:
        assert 0 < len(states) <= self.lanes and len({how.program for how in decodings}) == 1
        self.passes.append(len(states))
        self.gate.wait(60)
        if self.fail:
            raise FloatingPointError("out of everything")
        return [self._next(*each) for each in zip(states, actions, decodings, strict=True)]

    def lightened(self, state: BranchState) -> BranchState:
        memory = state.memory
        return state if memory is None or memory.light else replace(state, memory=None)

    def depth(self, state: BranchState) -> np.ndarray | None:
        tokens = state.tokens
        return np.full((64, 64), 1.0, np.float32) + tokens["depth"][0] / 100 if "depth" in tokens else None

    def _next(self, state: BranchState, action: np.ndarray, how: Decoding) -> BranchState:
        memory = state.memory
        assert not memory.used, "a memory that was used up"
        memory.used = not memory.light
        frame = memory.frame + 1
        numbers = [how.seed, how.draw, frame, int(1000 * how.temperature), how.steps]
        rng = np.random.default_rng([*numbers, *np.frombuffer(action.tobytes(), np.uint32).tolist()])
        rgb = np.roll(memory.rgb, int(4 * action[0]), axis=1).copy()
        rgb[:2, :8] = rng.integers(0, 256, (2, 8, 3), np.uint8)
        return self._branch_state(Memory(rgb, frame, frame % LIGHT == 0), rng.uniform(0, 2, 16))

    def _branch_state(self, memory: Memory, entropy: np.ndarray | None) -> BranchState:
        tokens = {"rgb": memory.rgb[:4, :4, 0].reshape(-1).astype(np.int32)}
        if self.has_depth:
            tokens["depth"] = tokens["rgb"] + 1
        return BranchState(memory.rgb, tokens, entropy, memory, 0 if memory.light else 1000)


class Fakes:
    """The model of a run, with what it made.

    Attributes:
        kinds: of clips with depth and without.
    """

    def __init__(self) -> None:
        self.kinds: dict[bool, FakeBranching] = {}

    def branching(self, params: Any, assets: Any, has_depth: bool, lanes: int = 1) -> FakeBranching:
        made = FakeBranching(lanes, has_depth)
        made.gate.set()
        self.kinds[has_depth] = made
        return made


def play_run(folder: Path, fakes: Fakes, depth: bool = True) -> PlayRun:
    """The run: the clips of :mod:`tests.tools.pipeline.toy`, and a fake model."""
    clips, config = toy.store(folder / "clips", depth), toy.config()
    norm = Normalization.create(clips)
    assets = SimpleNamespace(normalization=norm, tokenizer=None)
    write_json(folder / "metrics.json", {"psnr": 20.0, "drive_gripper_error_widths": None} | MEASURED)
    data = RunData(folder)
    data.__dict__["trained"] = SimpleNamespace(config=config, model=fakes, params={"a": np.ones(3)}, assets=assets)
    data.__dict__["config"], data.__dict__["clips"] = config, clips
    return PlayRun(data, out=folder / "kept")


def hub_of(
    run: PlayRun,
    most: int = 3,
    idle: float = 600.0,
    lanes: int = 2,
    grace: float = 0.0,
    truths: Truths | None = None,
) -> Hub:
    return Hub(run, Engine(run.trained, lanes), most, idle, grace, truths)
