"""The air in the budget: what is predicted is what an adjustment that does not know it makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.geometry.rigid import rigid_motion_jacobian
from ltsim.physics.effects.air import (
    air_point_sigma_across_beam,
    air_point_sigma_along_beam,
    reading_changes_per_air_sigma,
)
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.expected_precision import ExpectedPrecision
from ltsim.planning.loading import load_plan
from ltsim.planning.search_inputs import make_search_space
from ltsim.recordings.air import AirUncertainty
from tests.planning.fixtures import survey
from tests.planning.test_hall import HALL, points_csv


def test_the_points_move_as_an_adjustment_moves_them() -> None:
    built, air = misalignment_construction(), AirUncertainty(turbulence_um2_per_m3=0.0, negligible_up_to_mm=0.0)
    without = survey(stations=3)
    made = replace(without, setup=without.setup.model_copy(update={"air": air}))
    information = ExpectedPrecision.from_survey(made, built)
    added = information.target_covariances - ExpectedPrecision.from_survey(without, built).target_covariances
    recording, sightings = made.noise_free_recording(built), information.adjustment.sightings
    errors = reading_changes_per_air_sigma(air, sightings)
    moved = []
    for cause, station in np.ndindex(2, 3):
        change = np.where((sightings.station == station)[:, None], errors[..., cause], 0.0)
        read = recording.with_readings(recording.readings + change)
        shift = (
            adjust(read, built, start_state=made.nominal_state(built)).state.target_points - made.target_points
        ).ravel()
        motion = rigid_motion_jacobian(made.target_points)
        moved.append((shift - motion @ np.linalg.lstsq(motion, shift, rcond=None)[0]).reshape(-1, 3))
    expected = np.einsum("cti,ctj->tij", np.array(moved), np.array(moved))
    assert added == pytest.approx(expected, rel=1e-4, abs=1e-4 * expected.max())


def test_sizes_along_and_across_the_beam_are_those_of_the_cards() -> None:
    air = AirUncertainty()
    assert 1e6 * air_point_sigma_along_beam(air, 40.0) == pytest.approx(0.5 * 0.954 * 40.0, rel=0.01)
    assert 1e6 * air_point_sigma_across_beam(air, 40.0) == pytest.approx(
        np.hypot(0.5 * 0.0954 * 1600, np.sqrt(0.1 * 64000)), rel=0.01
    )


def test_a_long_hall_models_the_air_by_default_and_a_short_hall_does_not(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(points_csv(), encoding="utf-8")
    file = tmp_path / "hall.toml"
    visible = {}
    for text in (HALL, HALL + "[air]\nnegligible_up_to_mm = 30000\n"):
        file.write_text(text, encoding="utf-8")
        visible[text] = make_search_space(*load_plan(file), n_stations=3, n_faces=1).survey
    with_air, without = visible.values()
    assert with_air.air == AirUncertainty()
    assert without.air is None
    assert make_search_space(*load_plan("paper-workshop"), n_stations=5, n_faces=2).survey.air is None
    larger = ExpectedPrecision.from_survey(with_air).target_rms
    assert larger > 1.05 * ExpectedPrecision.from_survey(without).target_rms
