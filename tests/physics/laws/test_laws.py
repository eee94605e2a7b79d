"""Carriers, drivers, places, and the laws that are made of them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.randomness import random_stream
from ltsim.physics.laws.catalogue_names import equivalent_effect_name
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.places import MIN_GROUP_TARGETS, target_clusters
from ltsim.physics.laws.regressor_library import (
    BUILTIN_COVARIATES,
    candidate_regressors,
    is_physically_possible,
    regressors_for_target_groups,
)
from ltsim.physics.laws.regressors import (
    CONSTANT_REGRESSOR,
    Regressor,
    group_amounts_regressor,
    piecewise_regressor,
    scalar_regressor,
    smooth_regressor,
)
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME, response_designs
from ltsim.physics.laws.sizes import displayed_sizes
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def sightings() -> Sightings:
    recording, _ = network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)
    return adjust(recording, misalignment_construction()).sightings


def test_drivers_have_columns_of_unit_size_and_words_of_the_interface(sightings):
    words = {
        "time",
        "azimuth",
        "elevation",
        "distance",
        "incidence",
        "height",
        "place",
        "temperature",
        "approach",
        "face",
        "target",
    }
    kinds = {
        **candidate_regressors(sightings),
        **{f"group {k}": d for k, d in regressors_for_target_groups(sightings).items()},
    }
    drivers = [
        d
        for kind, regressors in kinds.items()
        for d in regressors[:: 50 if kind == "wave" else 3 if "room" in kind else 1]
    ]
    for driver in drivers:
        columns = driver.columns(sightings)
        assert columns.shape == (len(sightings), driver.n_columns)
        assert np.isfinite(columns).all()
        assert set(driver.covariate_names_in_files) <= words | set(sightings.covariates)
        spread = np.sqrt(((columns * driver.coefficient_sigmas[0]) ** 2).sum(axis=1).mean())
        assert 0.2 < spread < 2.5, driver


def test_what_a_law_may_follow_is_closed_under_the_operators(sightings):
    """Of what is pointed at and of each further column: the value before, the change, the work done."""
    rng = random_stream(3, "load")
    load = rng.uniform(0.0, 50.0, len(sightings))
    loaded = replace(sightings, covariates={"press_load_kn": load})
    before = loaded.previous_pointing_indices
    there = before >= 0
    followed = {f for kind in ("memory", "lag") for d in candidate_regressors(loaded)[kind] for f in d.covariates}
    for name in ("azimuth", "elevation", "distance", "press_load_kn"):
        assert {f"{how}-{name}" for how in ("last", "move", "work")} <= followed
    quantities = loaded.covariate_values
    np.testing.assert_allclose(quantities["last-press_load_kn"][there], load[before[there]])
    np.testing.assert_allclose(quantities["move-press_load_kn"][there], (load - load[before])[there])
    rows = np.flatnonzero(sightings.station == 1)
    rows = rows[np.argsort(sightings.time[rows], kind="stable")]
    done = np.append(0.0, np.cumsum(np.abs(np.diff(load[rows]))))
    np.testing.assert_allclose(quantities["work-press_load_kn"][rows], done)
    assert scalar_regressor("work-press_load_kn", "power").covariate_names_in_files == ("press_load_kn",)
    assert scalar_regressor("work-azimuth", "power").covariate_names_in_files == ("approach",)
    assert set(BUILTIN_COVARIATES) - {"station", "last-target"} <= set(quantities)


def test_amounts_are_those_of_the_target_measured_before(sightings):
    columns = group_amounts_regressor("last-target", len(sightings.target_names)).columns(sightings)
    rows = sightings.previous_pointing_indices >= 0
    np.testing.assert_array_equal(
        np.argmax(columns[rows], axis=1), sightings.target[sightings.previous_pointing_indices[rows]]
    )
    assert not columns[~rows].any()


def test_carriers_show_mainly_in_the_readings_that_they_name(sightings):
    designs = response_designs(sightings)
    assert "vertical index" in designs  # two faces tell it from the elevation
    assert set(designs) <= set(RESPONSE_AND_DESIGN_BY_NAME)
    for name, (carrier, design) in designs.items():
        assert design.shape == (len(sightings), 3, len(carrier.component_names))
        assert np.isfinite(design).all(), name
        if len(carrier.observables) == 1:
            column = ("distance", "azimuth", "elevation").index(carrier.observables[0])
            assert (design[:, column] ** 2).sum() > 0.6 * (design**2).sum(), name


def test_laws_are_effects_like_any_other(sightings):
    law = EmpiricalLaw(("S2",), (), RESPONSE_AND_DESIGN_BY_NAME["vertical index"][0], smooth_regressor("station-time"))
    assert pickle.loads(pickle.dumps(law)) == law
    design = law.design(sightings)
    assert design.shape == (len(sightings), 3, len(law.parameters))
    assert not design[sightings.station != 1].any()
    short = law.candidate_formulas(sightings)
    assert {d.regressor.function for d in short} >= {"power", "decay"}
    assert (
        equivalent_effect_name(EmpiricalLaw((), (), law.response, scalar_regressor("station-time", "decay", 900.0)))
        == "index-drift"
    )
    wave = EmpiricalLaw(
        (), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], Regressor("wave", ("elevation",), constant=107.35)
    )
    assert equivalent_effect_name(wave) == "encoder-interpolation"
    assert equivalent_effect_name(law) == "unknown"


def test_an_elevation_that_errs_as_the_vertical_index_is_reported_as_such(sightings):
    reading = EmpiricalLaw(
        response=RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], regressor=scalar_regressor("face", "power")
    )
    recording, _ = network(faces=1, seed=1)
    alone = adjust(recording, misalignment_construction()).sightings
    cases = [
        (reading, sightings, "vertical index"),
        (replace(reading, regressor=smooth_regressor("time")), sightings, "elevation"),
        (replace(reading, regressor=smooth_regressor("time")), alone, "vertical index"),
        (replace(reading, regressor=smooth_regressor("elevation")), alone, "elevation"),
        (replace(reading, response=RESPONSE_AND_DESIGN_BY_NAME["azimuth"][0]), sightings, "azimuth"),
    ]
    for law, sightings, carrier in cases:
        equivalent = law.equivalent_vertical_index_law(sightings)
        assert equivalent.response.name == carrier
        assert np.abs(np.abs(equivalent.design(sightings)) - np.abs(law.design(sightings))).max() < 1e-12


def test_a_wave_is_reported_by_amplitude_and_phase(sightings):
    wave = EmpiricalLaw(
        (), (), RESPONSE_AND_DESIGN_BY_NAME["distance"][0], Regressor("wave", ("azimuth",), constant=3.0)
    )
    amplitude, phase = displayed_sizes(wave, sightings, np.array([3e-6, 4e-6]), 1e-14 * np.eye(2))
    assert amplitude.value == pytest.approx(5.0 * np.sqrt(2.0))
    assert amplitude.sigma == pytest.approx(0.1 * np.sqrt(2.0))
    assert (phase.value, phase.unit) == (pytest.approx(53.13, abs=0.01), "deg")


def test_an_obliquely_leaning_stand_is_a_single_law_and_reported_along_both_axes(sightings):
    law = EmpiricalLaw(
        ("S2",), (), RESPONSE_AND_DESIGN_BY_NAME["lean of the stand"][0], scalar_regressor("station-time", "power")
    )
    way = 5e-6 * np.array([0.6, 0.8])
    column = law.regressor.columns(sightings)[:, 0] * (sightings.station == 1)
    expected = (sightings.pose_derivatives[:, :, 3:5] @ way) * column[:, None]
    np.testing.assert_allclose(law.design(sightings) @ way, expected, atol=1e-20)
    sizes = displayed_sizes(law, sightings, way, 1e-16 * np.eye(2))
    assert [e.name for e in sizes] == ["rms", "swing about x", "swing about y"]
    assert sizes[2].value / sizes[1].value == pytest.approx(0.8 / 0.6)
    assert sizes[0].value == pytest.approx(
        np.sqrt(np.mean(column[sightings.station == 1] ** 2)) * 1e6 * np.hypot(*way), rel=1e-6
    )
    assert set(law.observables) == set(OBSERVABLES)


def test_a_law_with_separate_coefficients_is_the_sum_of_the_laws_of_the_set_ups(sightings):
    alone = EmpiricalLaw(
        ("S2",), (), RESPONSE_AND_DESIGN_BY_NAME["vertical index"][0], scalar_regressor("station-time", "power")
    )
    together = alone.with_coefficients_per_setup(sightings)
    assert together is not None
    parts = [replace(alone, stations=(name,)).design(sightings) for name in sightings.station_names]
    np.testing.assert_array_equal(together.design(sightings), np.concatenate(parts, axis=2))
    mean = np.where(np.arange(len(parts)) == 3, -4e-6, 1e-6)
    (_, swing) = displayed_sizes(together, sightings, mean, 1e-16 * np.eye(len(mean)))
    (_, separate_sizes) = displayed_sizes(replace(alone, stations=("S4",)), sightings, mean[[3]], 1e-16 * np.eye(1))
    assert swing == separate_sizes  # where it does most


def test_a_wall_does_not_know_where_a_tracker_looks(sightings):
    assert not is_physically_possible("target", smooth_regressor("azimuth"), sightings)
    assert is_physically_possible("target", smooth_regressor("time"), sightings)
    assert is_physically_possible("reading", smooth_regressor("azimuth"), sightings)


def test_targets_on_a_common_surface_belong_together():
    rng = random_stream(5, "places")
    points = rng.uniform(0.0, 10.0, (12, 3))
    look = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 6, axis=0)
    clusters = target_clusters(SimpleNamespace(target_points=points, nest_normals=look))
    assert {tuple(range(6)), tuple(range(6, 12))} <= clusters
    assert all(MIN_GROUP_TARGETS <= len(group) <= 12 - MIN_GROUP_TARGETS for group in clusters)


def test_coordinates_are_those_of_the_start_or_of_a_column_at_rest(sightings):
    loaded = replace(sightings, covariates={"load": np.maximum(np.sin(sightings.time / 900.0), 0.0)})
    load = scalar_regressor("load", "power").columns(loaded, acts_on_targets=True)
    assert load[loaded.covariates["load"] == 0.0].max() == 0.0
    time = scalar_regressor("time", "decay", 600.0).columns(loaded, acts_on_targets=True)
    assert time[np.argmin(loaded.time)] == 0.0
    assert abs(smooth_regressor("time").columns(loaded, acts_on_targets=True).mean(axis=0)).max() < 1e-12


def test_reported_motions_of_targets_have_their_size(sightings):
    decay = EmpiricalLaw(
        targets=("T02",),
        response=RESPONSE_AND_DESIGN_BY_NAME["position of targets"][0],
        regressor=scalar_regressor("time", "decay", 600.0),
    )
    mean = np.array([0.0, 0.0, 3e-5])
    there = decay.pointing_indicator(sightings) > 0
    moved = decay.columns(sightings)[there, 0] * mean[2]
    *_, along_z = displayed_sizes(decay, sightings, mean, 1e-12 * np.eye(3))
    assert along_z.value == pytest.approx(1e6 * np.ptp(moved)) or along_z.value == pytest.approx(-1e6 * np.ptp(moved))


def test_an_elevation_that_errs_by_its_sign_is_the_vertical_index(sightings):
    elevation, face = RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], scalar_regressor("face", "power")
    law = EmpiricalLaw((), (), elevation, Regressor("product", factors=(face, smooth_regressor("time", 4))))
    assert (
        law.equivalent_vertical_index_law(sightings).response.name,
        law.equivalent_vertical_index_law(sightings).regressor,
    ) == (
        "vertical index",
        smooth_regressor("time", 4),
    )
    assert EmpiricalLaw((), (), elevation, face).equivalent_vertical_index_law(sightings).regressor.kind == "constant"
    assert (
        EmpiricalLaw((), (), elevation, smooth_regressor("time")).equivalent_vertical_index_law(sightings).response
        == elevation
    )
    index = law.equivalent_vertical_index_law(sightings).design(sightings)
    np.testing.assert_allclose(
        np.abs(index), np.abs(law.design(sightings)[:, :, 1:]), atol=1e-9
    )  # a product has a constant too


def test_each_target_of_a_small_group_may_move_by_a_separate_amount(sightings):
    group = sightings.target_names[:4]
    law = EmpiricalLaw(
        (), group, RESPONSE_AND_DESIGN_BY_NAME["height of targets in their nests"][0], scalar_regressor("time", "power")
    )
    (form,) = law.candidate_forms_by_kind(sightings)["members"][0]
    columns = form.columns(sightings)
    assert columns.shape == (len(sightings), 4)
    for column, name in zip(columns.T, group, strict=True):
        at = sightings.target == sightings.target_names.index(name)
        assert column[at].any() and not column[~at].any()
        assert column[sightings.time == sightings.time.min()].max(initial=0.0) == 0.0  # where it says at first
    assert "members" not in replace(law, targets=sightings.target_names[:2]).candidate_forms_by_kind(sightings)
    assert "members" not in replace(law, response=RESPONSE_AND_DESIGN_BY_NAME["distance"][0]).candidate_forms_by_kind(
        sightings
    )


@pytest.mark.parametrize(
    ("carrier", "driver", "stations", "name"),
    [
        ("distance", scalar_regressor("time", "power"), (), "range-drift"),
        ("distance", scalar_regressor("station-time", "decay", 600.0), ("S2",), "range-drift"),
        ("distance", scalar_regressor("distance", "power"), (), "unknown"),
        ("distance", scalar_regressor("incidence", "power", 2.0), (), "smr-incidence"),
        ("distance", scalar_regressor("incidence", "tan"), (), "smr-incidence"),
        ("elevation", scalar_regressor("incidence", "tan"), (), "unknown"),
        ("distance", CONSTANT_REGRESSOR, (), "range-offset"),
        ("distance", CONSTANT_REGRESSOR, ("S2",), "reflector-constant"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=5.0), (), "azimuth-harmonic"),
        ("elevation", Regressor("wave", ("elevation",), constant=3.0), (), "elevation-harmonic"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=1.0), (), "unknown"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=90.0), (), "encoder-interpolation"),
    ],
)
def test_a_law_that_a_card_describes_has_its_name(carrier, driver, stations, name):
    assert equivalent_effect_name(EmpiricalLaw(stations, (), RESPONSE_AND_DESIGN_BY_NAME[carrier][0], driver)) == name


@pytest.mark.parametrize(
    ("targets", "driver", "name"),
    [
        (("T1",), scalar_regressor("time", "step", 600.0), "target-moved"),
        (("T1",), scalar_regressor("time", "power"), "target-moved"),
        (("T1",), piecewise_regressor([scalar_regressor("time", "step", 600.0)]), "target-moved"),
        (("T1",), piecewise_regressor([scalar_regressor("time", "step", t) for t in (6.0, 9.0)]), "unknown"),
        (("T1",), scalar_regressor("time", "decay", 600.0), "target-moved"),
        (("T1", "T2"), scalar_regressor("time", "step", 600.0), "unknown"),
        (("T1",), scalar_regressor("distance", "power"), "unknown"),
    ],
)
def test_a_step_or_creep_of_a_single_target_is_a_moved_target(targets, driver, name):
    assert (
        equivalent_effect_name(EmpiricalLaw((), targets, RESPONSE_AND_DESIGN_BY_NAME["position of targets"][0], driver))
        == name
    )
