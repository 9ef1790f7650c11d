from dataclasses import replace
from pathlib import Path

import pytest

from rsjax.tools.ingest.doctor import Thresholds, diagnose, select, write_selection
from rsjax.tools.ingest.episode import EpisodeError, SourceError
from tests.tools.ingest.toy_source import ToySource, episode, source


def test_episodes_of_one_name_are_all_counted_and_left_out(tmp_path: Path) -> None:
    diagnosis = diagnose(source(replace(episode(7), id="episode-2")), Thresholds())
    assert diagnosis.counts() == {"duplicate": 2}
    assert write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons()) == (5, 2)


def test_the_fix_leaves_out_the_bad_ones_with_reasons_and_counts_them(tmp_path: Path) -> None:
    data_set = source(replace(episode(6), task=""), episode(7))
    diagnosis = diagnose(data_set, Thresholds())
    assert write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons()) == (7, 1)
    chosen = select(data_set, tmp_path / "m.json")
    refs = list(chosen.episodes())
    assert [ref.id for ref in refs] == [f"episode-{number}" for number in range(8)]
    assert [chosen.read(ref).id for ref in refs if ref.id != "episode-6"] == [r.id for r in refs if r.id != "episode-6"]
    with pytest.raises(EpisodeError, match="episode-6: left out by the list: no-task: its task is empty"):
        chosen.read(refs[6])
    plain = {ref.id: ref.fingerprint for ref in data_set.episodes()}
    assert [ref.id for ref in refs if ref.fingerprint != plain[ref.id]] == ["episode-6"]


def test_an_episode_that_was_mended_is_read_again(tmp_path: Path) -> None:
    bad = replace(episode(6), task="")
    diagnosis = diagnose(source(bad), Thresholds())
    write_selection(tmp_path / "m.json", "toy", diagnosis.refs, diagnosis.reasons())
    mended = select(source(replace(bad, task="lift", fingerprint="0" * 16)), tmp_path / "m.json")
    assert [mended.read(ref).task for ref in mended.episodes()][6] == "lift"


def test_a_list_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    diagnosis = diagnose(source(), Thresholds())
    write_selection(path, "toy", diagnosis.refs, diagnosis.reasons())
    whole = path.read_text()
    write_selection(path, "toy", (("other", "0" * 16),), {})
    of_another = path.read_text()
    others = ToySource(tuple(replace(episode(seed), fingerprint="1" * 16) for seed in range(6)))
    no_lists = ("", "[]", "{}", '{"format": 2}', '{"format": 1, "kept": 3, "left_out": []}', "[" * 100_000)
    for data_set, content, message in (
        (source(), None, "not there"),
        (others, whole, "the data set was read with other options then"),
        (source(), of_another, "names no episode of this data set"),
        *((source(), content, "not a list of") for content in no_lists),
    ):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_text(content)
        with pytest.raises(SourceError, match=f"m.json: {message}"):
            select(data_set, path)
