"""Asking for more sights than there are is answered before the search, with what can be had."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import InputError
from ltsim.planning.loading import load_plan
from ltsim.planning.required_sights import max_stations_seeing_every_target, with_feasible_min_sights
from ltsim.planning.search_inputs import make_search_space
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import PlanFile, StationSettings
from ltsim.scene.visibility import SightLimits
from tests.planning.test_hall import HALL, points_csv
from tests.planning.test_search import site


def short_sighted(least: int) -> SearchSpace:
    """Three stations whose instrument reaches 5 m: no place sees the whole mesh."""
    return site(sight_limits=SightLimits(range_max=5.0), min_sights_per_target=least)


def test_what_can_be_had_is_had() -> None:
    """The number is reached by the layout it stands for, and all are seen from everywhere where that is possible."""
    assert max_stations_seeing_every_target(site(), 0.5, 2)[0] == 3
    n_stations, limiting = max_stations_seeing_every_target(short_sighted(3), 0.5, 2)
    assert 1 <= n_stations < 3
    position = short_sighted(3).grid_station_positions(0.5, 2)
    share = short_sighted(3).is_visible(position).mean(axis=0)
    assert limiting == short_sighted(3).survey.target_names[int(np.argmin(share))]


def test_asking_for_too_much_is_answered_with_the_key_and_the_number() -> None:
    n_stations, limiting = max_stations_seeing_every_target(short_sighted(3), 0.5, 2)
    asked = PlanFile(stations=StationSettings(min_stations_per_target="all"))
    with pytest.raises(
        InputError, match=rf"set stations.min_stations_per_target = {n_stations}, move {limiting}, or enlarge the floor"
    ):
        with_feasible_min_sights(asked, short_sighted(3))
    assert with_feasible_min_sights(asked, site()) is asked


def test_the_default_is_feasible() -> None:
    n_stations, _ = max_stations_seeing_every_target(short_sighted(3), 0.5, 2)
    settled = with_feasible_min_sights(PlanFile(), short_sighted(3))
    assert settled.stations.min_stations_per_target == n_stations
    assert with_feasible_min_sights(PlanFile(), site()).stations.min_stations_per_target == "all"


def test_an_exchange_finds_layouts_that_sequential_choice_misses(tmp_path: Path) -> None:
    """A machine in the middle: three stations see every point twice, but not when the first takes the best place."""
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    (tmp_path / "hall.toml").write_text(HALL.replace("grid_step_mm = 1500", "grid_step_mm = 1000"), encoding="utf-8")
    file, scenario = load_plan(tmp_path / "hall.toml")
    where = make_search_space(file, scenario, n_stations=3, n_faces=1)
    assert max_stations_seeing_every_target(where, 1.0, 1)[0] == 2
    assert with_feasible_min_sights(file, where).stations.min_stations_per_target == 2
