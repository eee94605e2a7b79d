"""Which reflector to move, add or leave out: what is promised is what the changed layout has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.objective import INSTRUMENT_QUALITY_NAME, TARGETS_QUALITY_NAME, LayoutObjective
from ltsim.planning.planner import objective_and_qualities
from ltsim.planning.reflector_changes import ReflectorChangeEntry, evaluate_reflector_changes
from ltsim.planning.reflectors import choose_reflectors
from ltsim.planning.search_inputs import is_target_fixed_in_search, is_target_never_moved, make_search_space
from ltsim.planning.survey import PlannedSurvey
from tests.planning.test_hall import HALL, points_csv
from tests.planning.test_search import site

STAYS = np.arange(28) >= 24


def wall_places() -> tuple[Floats, tuple[str, ...]]:
    along, height = np.meshgrid(np.linspace(0.3, 5.7, 6), [0.15, 2.0, 4.0, 5.9])
    wall = np.stack([np.zeros(24), along.ravel(), height.ravel()], axis=1)
    places = np.concatenate([wall, wall[:, [1, 0, 2]]])
    return places, tuple(f"P{i}" for i in range(len(places)))


def changed(survey: PlannedSurvey, change: ReflectorChangeEntry) -> PlannedSurvey:
    """The survey with a change made by hand."""
    keep = [i for i, name in enumerate(survey.target_names) if name != change.reflector]
    points = survey.target_points[keep]
    names = tuple(survey.target_names[i] for i in keep)
    if change.position_mm is not None:
        points, names = np.vstack([points, 1e-3 * np.array(change.position_mm)]), (*names, change.new_place)
    return survey.replace(
        target_names=names, target_points=points, is_visible=np.ones((len(survey.station_positions), len(names)), bool)
    )


def point_error(survey: PlannedSurvey, names: list[str]) -> float:
    """Point error [m] of some targets, root mean square, inner constraints over them."""
    network = ExpectedPrecision.from_survey(survey).adjustment.with_inner_datum(names)
    trace = np.einsum("tii->t", network.target_covariances)
    return float(np.sqrt(np.mean([trace[survey.target_names.index(name)] for name in names])))


@pytest.mark.parametrize("weights", [{INSTRUMENT_QUALITY_NAME: 1.0}, {TARGETS_QUALITY_NAME: 1.0}])
def test_a_change_brings_what_it_promises(weights: dict[str, float]) -> None:
    places, names = wall_places()
    where = site(candidate_reflector_places=places, reflector_place_names=names, min_reflector_spacing=0.5)
    objective = LayoutObjective(weights)
    changes = evaluate_reflector_changes(where, where.survey, STAYS, objective, misalignment_construction())
    assert {change.kind for change in changes.reported_changes} == {"move", "add", "remove"}
    before = objective_and_qualities(where.survey, objective, misalignment_construction())[0]
    for change in changes.reported_changes[::3]:
        made = changed(where.survey, change)
        common = [name for name in where.survey.target_names if name in made.target_names]
        gain = 1e6 * (point_error(where.survey, common) - point_error(made, common))
        assert change.target_rms_decrease_um == pytest.approx(gain, abs=1e-3)
        if INSTRUMENT_QUALITY_NAME in weights:
            assert change.objective_ratio == pytest.approx(
                objective_and_qualities(made, objective, misalignment_construction())[0] / before, rel=1e-6
            )
        else:
            assert change.objective_ratio == pytest.approx(
                1 - 1e-6 * gain / point_error(where.survey, common), rel=1e-4
            )
    moves = [change.objective_ratio for change in changes.reported_changes if change.kind == "move"]
    assert moves == sorted(moves)
    assert moves[-1] < 1.0


def test_changes_without_improvement_are_reported() -> None:
    places, names = wall_places()
    where = site(candidate_reflector_places=places, reflector_place_names=names, min_reflector_spacing=0.5)
    made = choose_reflectors(where, where.survey, STAYS, LayoutObjective(), misalignment_construction())
    changes = evaluate_reflector_changes(where, made, np.arange(28) < 4, LayoutObjective(), misalignment_construction())
    assert changes.n_useful_by_kind["move"] == 0, "the exchange has made every move that helps"
    assert changes.n_evaluated_by_kind["move"] > 300
    assert f"{changes.n_evaluated_by_kind['move']} moves of a reflector (0 useful)" in changes.summary_sentence
    alone = evaluate_reflector_changes(site(), site().survey, STAYS, LayoutObjective(), misalignment_construction())
    assert alone.n_evaluated_by_kind == {"move": 0, "add": 0, "remove": 24}
    assert "Give candidate places" in alone.summary_sentence


def test_reflectors_are_chosen_for_the_targets_alone() -> None:
    places, names = wall_places()
    where = site(candidate_reflector_places=places, reflector_place_names=names, min_reflector_spacing=0.5)
    made = choose_reflectors(
        where, where.survey, STAYS, LayoutObjective({TARGETS_QUALITY_NAME: 1.0}), misalignment_construction()
    )
    assert ExpectedPrecision.from_survey(made).target_rms < 0.9 * ExpectedPrecision.from_survey(where.survey).target_rms


def test_points_of_a_list_are_moved_only_where_they_are_called_movable(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    ways = {
        "none": "",
        "walls": 'candidate_bodies = ["walls", "machine"]',
        "both": 'candidate_bodies = ["machine"]\nmovable_points = ["wall"]',
    }
    for name, given in ways.items():
        text = HALL.replace("box_mm", 'name = "machine"\nbox_mm').replace(
            "[search]", f"[reflectors]\n{given}\n[search]"
        )
        (tmp_path / "hall.toml").write_text(text, encoding="utf-8")
        file, scenario = load_plan(tmp_path / "hall.toml")
        where = make_search_space(file, scenario, n_stations=4, n_faces=1).replace(min_sights_per_target=1)
        survey = where.survey.replace(is_visible=where.is_visible(where.survey.station_positions))
        stays = is_target_never_moved(file, scenario, survey)
        changes = evaluate_reflector_changes(
            where, survey, stays, LayoutObjective({TARGETS_QUALITY_NAME: 1.0}), misalignment_construction()
        )
        assert is_target_fixed_in_search(file, scenario).all(), "the search leaves the points of a list where they are"
        assert {what for what, count in changes.n_evaluated_by_kind.items() if count} == {
            "none": set(), "walls": {"add"}, "both": {"move", "add", "remove"},
        }[name]  # fmt: skip
        for change in changes.reported_changes:
            assert change.reflector == "" or change.reflector.startswith("W")
            assert change.most_affected_parameter in survey.target_names
            if change.position_mm is not None:
                assert (
                    np.linalg.norm(survey.target_points - 1e-3 * np.array(change.position_mm), axis=1).min()
                    >= where.min_reflector_spacing
                )
    places = [change.new_place for change in changes.reported_changes if change.kind == "move"]
    assert len(places) == len(set(places)), "each place is told once"


def test_missing_bodies_and_groups_are_reported(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    for given, sentence in (
        ('candidate_bodies = ["wals"]', "did you mean walls"),
        ('movable_points = ["wal"]', "did you mean wall"),
    ):
        text = HALL.replace("[search]", f"[reflectors]\n{given}\n[search]")
        (tmp_path / "hall.toml").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=sentence):
            load_plan(tmp_path / "hall.toml")
