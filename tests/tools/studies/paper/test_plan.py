"""Budgets and plans: how large the cells are, which are made, in what order."""

from collections import Counter
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import Config, ConfigError, presets
from rsjax.config.config_fields import with_values
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper import budget
from rsjax.tools.studies.paper.budget import HOUR, parse_duration, scale, step_seconds, training_cost
from rsjax.tools.studies.paper.claim import Arm, ArmComparison, chosen, claims
from rsjax.tools.studies.paper.claims.baselines import FRAME
from rsjax.tools.studies.paper.plan import Plan, arm_config, make_plan
from rsjax.tools.studies.paper.run import print_plan
from tests.tools.studies.paper import toy

DATA = Path("data")
TINY = presets.roboscape_tiny()
KNOWN = tuple(claims().values())


@pytest.fixture(scope="module")
def three_hours() -> Plan:
    return make_plan(KNOWN, scale(TINY, 3 * HOUR), DATA)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30min", 1800), ("3h", 10800), ("1h30min", 5400), ("90 s", 90), ("0.5h", 1800), ("1d", 86400), (" 3h ", 10800)],
)
def test_durations(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize(
    ("texts", "line"),
    [
        (("", "3", "h", "3hours", "0min", "-3h", "3h and more"), "not a duration; write 30min"),
        (("9" * 400 + "h", "400d"), "longer than 366 days"),
    ],
)
def test_what_is_no_duration_or_too_long_is_refused(texts: tuple[str, ...], line: str) -> None:
    for text in texts:
        with pytest.raises(ConfigError) as refused:
            parse_duration(text)
        assert line in str(refused.value) and len(str(refused.value)) < 200


@settings(max_examples=8)
@given(st.floats(120, 2e5), st.floats(1, 10))
def test_a_larger_budget_never_makes_anything_smaller_and_no_size_exceeds_the_presets(
    seconds: float, by: float
) -> None:
    small, large = (_sizes(scale(TINY, each).base) for each in (seconds, by * seconds))
    assert all(one <= other <= own for one, other, own in zip(small, large, _sizes(TINY), strict=True))


def _sizes(config: Config) -> tuple[int, ...]:
    return config.sim.episodes, config.tokenizer_train.steps, config.eval.action_draws


def test_both_of_table_1_have_the_seconds_of_a_frame_of_every_arm() -> None:
    for claim in chosen(["table1*"], claims()):
        assert claim.beside == {FRAME: FRAME}, claim.name
        assert all(FRAME in claim.measurements(arm.name) for arm in claim.arms)
    assert len(chosen(["table1*"], claims())) == 2


def test_a_small_preset_keeps_its_own_sizes() -> None:
    """So that a run of the preset is a cell."""
    whole = Run(presets.debug(), Path(), DATA).keys()
    assert Run(scale(presets.debug(), 3 * HOUR).base, Path(), DATA).keys() == whole


def test_own_frames_begin_at_the_same_share_of_fewer_and_more_steps(three_hours: Plan) -> None:
    small = scale(TINY, 3 * HOUR).base
    genie = three_hours.of("table1", "Genie")[0].config
    assert genie.train.steps > small.train.steps < TINY.train.steps
    whole, *others = [each.model.departures.self_conditioning_after / each.train.steps for each in (TINY, small, genie)]  # type: ignore[attr-defined]
    assert whole > 0 and others == pytest.approx([whole] * 2, abs=0.01)


def test_a_presets_curriculum_does_not_set_the_steps_of_a_budget() -> None:
    assert presets.get("roboscape_s").train.curriculum
    assert not scale(presets.get("roboscape_s"), HOUR).base.train.curriculum


def test_a_cell_that_shares_its_world_model_costs_its_evaluation_alone(three_hours: Plan) -> None:
    """Sampling differs, not what is trained."""
    tasks = {task.cell: task for task in (*three_hours.tasks, *three_hours.left_out) if not task.measurement}
    (cell, *_) = three_hours.of("departure-mean-codes", "to the letter")
    assert tasks[cell.name].seconds == budget.evaluation_seconds(cell.config)


@pytest.mark.parametrize("hours", [0.5, 12])
def test_the_estimates_keep_to_the_budget_and_the_tables_come_first(hours: float) -> None:
    plan = make_plan(KNOWN, scale(TINY, hours * HOUR), DATA)
    assert 0.75 * hours * HOUR < sum(task.seconds for task in plan.tasks) <= 1.05 * hours * HOUR
    assert [task.claim for task in plan.tasks[:14]] == ["table2"] * 12 + ["table1"] * 2
    seeds = [plan.cells[task.cell].config.train.seed for task in plan.tasks[:12]]
    assert seeds == [0] * 4 + [1] * 4 + [2] * 4


def test_every_other_claim_has_two_seeds_before_the_next_and_a_third_after_all(three_hours: Plan) -> None:
    """One seed gives no verdict."""
    tasks = [task for task in (*three_hours.tasks, *three_hours.left_out) if claims()[task.claim].rank]
    made = [(three_hours.cells[task.cell].config.train.seed, task.claim) for task in tasks if not task.measurement]
    third = [seed == 2 for seed, _ in made]
    assert third == sorted(third) and any(third)
    two = [claim for claim, _ in groupby(claim for seed, claim in made if seed < 2)]
    assert len(two) == len(set(two)) > 10


def test_no_configuration_is_there_twice_and_every_arm_has_its_seeds(three_hours: Plan) -> None:
    cells = three_hours.cells.values()
    keys = Counter(Run(cell.config, Path(), DATA).keys()["evaluation"] for cell in cells)
    assert set(keys.values()) == {1}
    for claim in KNOWN:
        for arm in claim.arms:
            seeds = [cell.config.train.seed for cell in three_hours.of(claim.name, arm.name)]
            assert seeds == ([] if (claim.name, arm.name) in three_hours.absent else [0, 1, 2])


def test_every_cell_is_trained_before_it_is_measured(three_hours: Plan) -> None:
    tasks = [*three_hours.tasks, *three_hours.left_out]
    assert [task.cell for task in tasks if not task.measurement] == list(three_hours.cells)
    places = {task.cell: place for place, task in enumerate(tasks) if not task.measurement}
    measured = [(task, place) for place, task in enumerate(tasks) if task.measurement]
    assert measured
    assert all(places[task.cell] < place for task, place in measured)


def test_named_claims_have_the_same_trainings_and_more_of_them(three_hours: Plan) -> None:
    some = make_plan(chosen(["table1", "departure-a*"], claims()), three_hours.scale, DATA)
    assert [claim.name for claim in some.claims] == ["table1", "departure-actions"]
    whole = {name: cell.config for name, cell in three_hours.cells.items()}
    assert all(whole[name] == cell.config for name, cell in some.cells.items())
    done, left = ({task.cell for task in plan.tasks} for plan in (some, three_hours))
    assert done - left  # the budget of the other claims
    assert {task.measurement for task in some.tasks} == {"", "seconds a frame"}
    assert some.of("table1", "Genie") and some.of("departure-actions", "to the letter")


def test_equal_time_is_equal_steps_times_their_seconds(three_hours: Plan) -> None:
    base = three_hours.scale.base
    genie = arm_config(Arm("", model="genie", equal="seconds"), three_hours.scale, 0)
    assert genie.train.steps > 1.5 * base.train.steps
    assert genie.train.steps * step_seconds(genie) == pytest.approx(base.train.steps * step_seconds(base), rel=0.01)


@pytest.mark.parametrize(
    ("way", "ratio"),
    [
        ({"model.depth": "head"}, 1.02),
        ({"model.depth": "small_branch", "model.depth.width": 32}, 1.24),
        ({"model.depth": "small_branch", "model.depth.width": 64}, 1.49),
        ({"model.depth": "small_branch", "model.depth.blocks": 2}, 1.48),
        ({"model.depth": "small_branch", "model.depth.cells": 2}, 1.40),
    ],
)
def test_a_step_with_depth_is_estimated_as_it_was_measured_beside_one_without(way: dict, ratio: float) -> None:
    alone = with_values(TINY, {"model.depth": "none"})
    assert step_seconds(with_values(TINY, way)) / step_seconds(alone) == pytest.approx(ratio, rel=0.08)


@pytest.mark.parametrize(("preset", "simple"), [("roboscape_tiny", 0.55), ("roboscape_multitask", 0.5)])
def test_a_curriculum_and_its_mixture_read_the_same_clips_in_as_many_steps(preset: str, simple: float) -> None:
    """With as many clips of each difficulty as expected, every clip is drawn as often in both."""
    at = scale(presets.get(preset), 3 * HOUR)
    clips = at.base.sim.episodes - at.base.sim.test_episodes
    counts = {"simple": simple * clips, "difficult": (1 - simple) * clips}
    ordered, mixed = (
        arm_config(Arm("", curriculum={"simple": 2, "difficult": 3}, mixed=on), at, 0).train for on in (False, True)
    )
    drawn = {
        s.components[0].difficulties[0]: s.epochs * counts[s.components[0].difficulties[0]] for s in ordered.curriculum
    }
    assert list(drawn) == ["simple", "difficult"]
    assert drawn["simple"] / counts["simple"] == pytest.approx(2 / 3 * drawn["difficult"] / counts["difficult"])
    assert sum(drawn.values()) == pytest.approx(ordered.steps * ordered.batch_size)
    (stage,) = mixed.curriculum
    assert stage.epochs * clips == pytest.approx(ordered.steps * ordered.batch_size)
    weights = {part.difficulties[0]: part.weight for part in stage.components}
    assert weights["simple"] / weights["difficult"] == pytest.approx(drawn["simple"] / drawn["difficult"])


def test_a_share_of_the_data_is_read_for_as_many_steps(three_hours: Plan) -> None:
    train = arm_config(Arm("", data=0.5), three_hours.scale, 0).train
    (stage,) = train.curriculum
    base = three_hours.scale.base
    assert stage.components[0].clips == round((base.sim.episodes - base.sim.test_episodes) / 2)
    assert stage.epochs * stage.components[0].clips == pytest.approx(base.train.steps * base.train.batch_size)


def test_estimated_annotations_are_read_for_as_many_steps_and_cost_their_time(three_hours: Plan) -> None:
    base = three_hours.scale.base
    for words in ("estimated_tracks", "estimated_depth", "estimated"):
        config = arm_config(Arm("", annotations=words), three_hours.scale, 0)  # type: ignore[arg-type]
        (stage,) = config.train.curriculum
        clips = base.sim.episodes - base.sim.test_episodes
        assert stage.epochs * clips == pytest.approx(base.train.steps * base.train.batch_size)
        assert Run(config, DATA, DATA).keys()["tokens"] == Run(base, DATA, DATA).keys()["tokens"]
        assert budget.annotation_seconds(config) > budget.annotation_seconds(base) == 0


@pytest.mark.parametrize("name", ["ivideogpt", "irasim", "cogvideox"])
def test_a_family_has_the_base_presets_clips_and_as_many_seconds_or_operations(name: str) -> None:
    at = scale(TINY, HOUR)
    whole = presets.get(f"{name}_tiny")
    for equal in ("seconds", "flops"):
        config = arm_config(Arm("", preset=name, equal=equal), at, 2)  # type: ignore[arg-type]
        assert (config.sim, config.eval, config.train.seed) == (at.base.sim, at.base.eval, 2)
        one, other = (sum(training_cost(each, equal)) for each in (config, at.base))  # type: ignore[arg-type]
        assert one == pytest.approx(other, rel=0.02)
        both = config.tokenizer_train.steps / whole.tokenizer_train.steps, config.train.steps / whole.train.steps
        assert both[0] == pytest.approx(both[1], rel=0.02) and config.runtime.eval_every == 0


def test_equal_operations_count_the_shared_tokenizer(three_hours: Plan) -> None:
    base, genie = three_hours.scale.base, arm_config(Arm("", model="genie", equal="flops"), three_hours.scale, 0)
    one, other = (sum(training_cost(each, "flops")) for each in (genie, base))
    assert one == pytest.approx(other, rel=0.01)
    assert genie.tokenizer_train == base.tokenizer_train and genie.train.steps > base.train.steps


def test_all_families_can_be_compared_on_several_tasks() -> None:
    plan = make_plan(chosen(["table1"], claims()), scale(presets.get("roboscape_multitask"), 12 * HOUR), DATA)
    assert not plan.absent
    models = {arm.name: plan.of("table1", arm.name)[0].config for arm in plan.claims[0].arms}
    assert {config.sim for config in models.values()} == {plan.scale.base.sim}
    assert models["CogVideoX"].model.text.tasks == plan.scale.base.sim.train_tasks  # type: ignore[attr-defined]


def test_every_family_of_table_1_has_the_same_trials_of_its_learning_rate(three_hours: Plan) -> None:
    for family in claims()["table1"].arms:
        trials = [arm.name for arm in claims()["learning-rates"].arms if arm.name.split(",")[0] == family.name]
        cells = [three_hours.of("learning-rates", name)[0] for name in trials]
        rates = sorted(cell.config.train.optimizer.learning_rate for cell in cells)
        assert [rate / rates[1] for rate in rates] == pytest.approx([0.3, 1, 3, 10])
        assert len({cell.config.train.steps for cell in cells}) == 1
        scored = three_hours.of("table1", family.name)[0].config
        assert scored.train.optimizer.learning_rate in rates
        clips = {Run(config, Path(), DATA).keys()["collect"] for config in (scored, *(cell.config for cell in cells))}
        assert len(clips) == 2, "rates are chosen on clips that no table scores"


def test_a_trial_of_the_rate_multiplies_that_of_the_base_preset() -> None:
    at = scale(presets.debug(), HOUR)
    rates = [arm_config(Arm("", rate=factor), at, 0).train.optimizer.learning_rate for factor in (1.0, 3.0)]
    assert rates[1] == pytest.approx(3 * rates[0])


def test_more_seeds_are_more_trainings() -> None:
    plan = make_plan(chosen(["table2"], claims()), scale(TINY, HOUR), DATA, seeds=range(5))
    assert [cell.config.train.seed for cell in plan.of("table2", "full")] == [0, 1, 2, 3, 4]
    last = make_plan(chosen(["table2"], claims()), scale(TINY, HOUR), DATA, seeds=range(3, 5))
    assert last.of("table2", "full") == plan.of("table2", "full")[3:]


def test_seeds_of_everything_have_their_own_clips_and_tokenizers_which_their_arms_share() -> None:
    at = scale(TINY, 3 * HOUR)
    claim = chosen(["table2"], claims())
    model, everything = (make_plan(claim, at, DATA, seeds=range(3), vary=vary) for vary in ("model", "everything"))
    made = [Run(cell.config, Path(), DATA).keys() for cell in everything.cells.values()]
    for stage, number in (("collect", 3), ("tokenizer", 3), ("world_model", 12)):
        assert len({keys[stage] for keys in made}) == number
    of_seed_0 = [name for name, cell in model.cells.items() if cell.config.train.seed == 0]
    assert of_seed_0 == [name for name in everything.cells if name in model.cells]
    tasks = [sum(task.seconds for task in (*plan.tasks, *plan.left_out)) for plan in (model, everything)]
    own = 2 * (budget.collect_seconds(at.base) + budget.tokenizer_seconds(at.base))
    assert tasks[1] - tasks[0] == pytest.approx(own)


def test_random_actions_are_drawn_as_often_as_the_preset_says_and_cost_their_time() -> None:
    for hours in (0.5, 3, 12, 48):
        base = scale(TINY, hours * HOUR).base
        assert base.eval.action_draws == TINY.eval.action_draws == 3
        extra = budget.evaluation_seconds(base) - budget.evaluation_seconds(base, draws=1)
        assert extra == pytest.approx(4 * base.eval.clips * budget.ROLLOUT)


def test_an_arm_that_cannot_be_trained_is_absent_with_its_reason(capsys: pytest.CaptureFixture[str]) -> None:
    claim = replace(toy.claim(), arms=(*toy.claim().arms, Arm("other", preset="other"), Arm("odd", {"model.x": 1})))
    plan = toy.plan(claim)
    assert plan.absent["toy", "other"] == "there is no preset other_tiny in this version"
    assert "no such field" in plan.absent["toy", "odd"]
    print_plan(plan, Path("out"), DATA)
    assert "toy: other is left out: there is no preset other_tiny" in capsys.readouterr().out


def test_claims_name_their_arms_and_are_chosen_by_name() -> None:
    with pytest.raises(ConfigError, match="compares 'none', which is not one of its arms"):
        toy.claim("toy", ArmComparison("psnr", "with", "none"))
    with pytest.raises(ConfigError, match=r"--only tabel1: no such claim; did you mean 'table1'\? \(claims: table2"):
        chosen(["tabel1"], claims())


def test_the_rival_with_channels_of_depth_trains_for_as_long_as_the_one_without(three_hours: Plan) -> None:
    names = ("RoboScape", "RGB and depth as channels", "RGB alone")
    ours, rival, rgb = (three_hours.of("geometry", name)[0].config for name in names)
    assert ours == three_hours.of("table1", "RoboScape")[0].config
    assert rgb == three_hours.of("table1", "IRASim")[0].config
    assert (rival.train, rival.tokenizer_train.steps) == (rgb.train, rgb.tokenizer_train.steps)
    assert rival.model.uses_depth and not rgb.model.uses_depth
