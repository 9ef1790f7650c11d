import dataclasses
import pkgutil
from pathlib import Path

import pytest

from rsjax.config import ConfigError
from rsjax.tools.ingest.annotate import Annotators
from rsjax.tools.ingest.annotators.choose import METHODS, choose, choose_annotators, choose_recorded
from rsjax.tools.ingest.annotators.depth import RecordedDepth
from rsjax.tools.ingest.annotators.tracks import BootsTapir, LucasKanade


def test_a_word_is_a_method_and_its_fields() -> None:
    assert choose("tracks", "lucas-kanade") == LucasKanade()
    assert choose("tracks", "lucas-kanade:grid=32,tolerance=0.25") == LucasKanade(grid=32, tolerance=0.25)
    network = choose("tracks", "bootstapir:checkout=/a,weights=/b.pt,device=cuda")
    assert network == BootsTapir(Path("/a"), Path("/b.pt"), device="cuda")
    assert choose("shots", "none") is None


def test_paths_become_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    network = choose("tracks", "bootstapir:checkout=~/tapnet,weights=here/b.pt")
    assert (network.checkout, network.weights) == (Path("/home/me/tapnet"), tmp_path / "here" / "b.pt")


def test_recorded_depth_is_read_unless_depth_is_off() -> None:
    assert choose_recorded("recorded") == choose_recorded("depth-anything:model=/a") == RecordedDepth()
    assert choose_recorded("recorded:most_holes=0.8") == RecordedDepth(0.8)
    assert choose_recorded("none") is None


def test_the_default_words_are_the_default_methods() -> None:
    words = {
        "shots": "hsv-histogram",
        "motion": "dis",
        "depth": "recorded",
        "tracks": "lucas-kanade",
        "semantics": "own",
    }
    assert choose_annotators(words) == Annotators()


def test_every_method_has_its_own_name() -> None:
    for methods in METHODS.values():
        for name, place in methods.items():
            made = pkgutil.resolve_name(f"rsjax.tools.ingest.annotators.{place}")
            assert made.name == name and dataclasses.is_dataclass(made)


@pytest.mark.parametrize(
    ("stage", "word", "match"),
    [
        ("tracks", "lucas", r"tracks: no method 'lucas'.*choose lucas-kanade"),
        ("tracks", "lucas-kanade:grids=3", r"no field 'grids=3'; did you mean 'grid'"),
        ("tracks", "lucas-kanade:grid=x", r"grid is 'x'; it should be a number"),
        ("tracks", "bootstapir:checkout=/a", r"weights missing; write bootstapir:weights=VALUE"),
        ("motion", "raft:weights=/a,size=big", r"size is 'big'; choose small or large"),
        ("depth", "video-depth-anything:checkout=/a,weights=/b,metric=yes", r"metric is 'yes'; write True or False"),
        ("semantics", "internvl:model=/a,own=x", r"no field 'own=x'"),
    ],
)
def test_an_error_names_stage_method_and_field(stage: str, word: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        choose(stage, word)
