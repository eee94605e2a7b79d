"""Carriers, drivers, places, and the laws that are made of them."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.randomness import stream
from ltsim.physics.effects.motions import station_design
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.names import name_of
from ltsim.physics.laws.places import MIN_GROUP, clusters
from ltsim.physics.laws.regressor_library import READING_COVARIATES, group_regressors, is_admissible, regressors_of
from ltsim.physics.laws.regressors import CONSTANT, Regressor, amounts, simple, smooth
from ltsim.physics.laws.responses import RESPONSES, response_designs
from ltsim.physics.laws.sizes import sizes_of
from ltsim.physics.model.construction import misalignment
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def sightings() -> Sightings:
    recording, _ = network(faces=2, values=drawn(misalignment(), 1), seed=1)
    return adjust(recording, misalignment()).sightings


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
    kinds = {**regressors_of(sightings), **{f"group {k}": d for k, d in group_regressors(sightings).items()}}
    drivers = [d for kind, some in kinds.items() for d in some[:: 50 if kind == "wave" else 3 if "room" in kind else 1]]
    for driver in drivers:
        columns = driver.columns(sightings)
        assert columns.shape == (len(sightings), driver.size)
        assert np.isfinite(columns).all()
        assert set(driver.covariate_labels) <= words | set(sightings.covariates)
        spread = np.sqrt(((columns * driver.spreads[0]) ** 2).sum(axis=1).mean())
        assert 0.2 < spread < 2.5, driver


def test_what_a_law_may_follow_is_closed_under_the_operators(sightings):
    """Of what is pointed at and of each further column: the value before, the change, the work done."""
    rng = stream(3, "load")
    load = rng.uniform(0.0, 50.0, len(sightings))
    loaded = replace(sightings, covariates={"press_load_kn": load})
    before = loaded.previous
    there = before >= 0
    followed = {f for kind in ("memory", "lag") for d in regressors_of(loaded)[kind] for f in d.covariates}
    for name in ("azimuth", "elevation", "distance", "press_load_kn"):
        assert {f"{how}-{name}" for how in ("last", "move", "work")} <= followed
    quantities = loaded.quantities
    np.testing.assert_allclose(quantities["last-press_load_kn"][there], load[before[there]])
    np.testing.assert_allclose(quantities["move-press_load_kn"][there], (load - load[before])[there])
    rows = np.flatnonzero(sightings.station == 1)
    rows = rows[np.argsort(sightings.time[rows], kind="stable")]
    done = np.append(0.0, np.cumsum(np.abs(np.diff(load[rows]))))
    np.testing.assert_allclose(quantities["work-press_load_kn"][rows], done)
    assert simple("work-press_load_kn", "power").covariate_labels == ("press_load_kn",)
    assert simple("work-azimuth", "power").covariate_labels == ("approach",)
    assert set(READING_COVARIATES) - {"station", "last-target"} <= set(quantities)


def test_amounts_are_those_of_the_target_measured_before(sightings):
    found = amounts("last-target", len(sightings.target_names)).columns(sightings)
    rows = sightings.previous >= 0
    np.testing.assert_array_equal(np.argmax(found[rows], axis=1), sightings.target[sightings.previous[rows]])
    assert not found[~rows].any()


def test_carriers_show_mainly_in_the_readings_that_they_name(sightings):
    designs = response_designs(sightings)
    assert "vertical index" in designs  # two faces tell it from the elevation
    assert set(designs) <= set(RESPONSES)
    for name, (carrier, design) in designs.items():
        assert design.shape == (len(sightings), 3, len(carrier.ways))
        assert np.isfinite(design).all(), name
        if len(carrier.observables) == 1:
            column = ("distance", "azimuth", "elevation").index(carrier.observables[0])
            assert (design[:, column] ** 2).sum() > 0.6 * (design**2).sum(), name


def test_laws_are_effects_like_any_other(sightings):
    law = Law(("S2",), (), RESPONSES["vertical index"][0], smooth("station-time"))
    assert pickle.loads(pickle.dumps(law)) == law
    design = law.design(sightings)
    assert design.shape == (len(sightings), 3, len(law.parameters))
    assert not design[sightings.station != 1].any()
    short = law.formulas(sightings)
    assert {d.driver.function for d in short} >= {"power", "decay"}
    assert name_of(Law((), (), law.carrier, simple("station-time", "decay", 900.0))) == "index-drift"
    wave = Law((), (), RESPONSES["elevation"][0], Regressor("wave", ("elevation",), constant=107.35))
    assert name_of(wave) == "encoder-interpolation"
    assert name_of(law) == "unknown"


def test_an_elevation_that_errs_as_the_vertical_index_is_told_as_that(sightings):
    reading = Law(carrier=RESPONSES["elevation"][0], driver=simple("face", "power"))
    one, _ = network(faces=1, seed=1)
    alone = adjust(one, misalignment()).sightings
    cases = [
        (reading, sightings, "vertical index"),
        (replace(reading, driver=smooth("time")), sightings, "elevation"),
        (replace(reading, driver=smooth("time")), alone, "vertical index"),
        (replace(reading, driver=smooth("elevation")), alone, "elevation"),
        (replace(reading, carrier=RESPONSES["azimuth"][0]), sightings, "azimuth"),
    ]
    for law, sightings, carrier in cases:
        told = law.as_constant(sightings)
        assert told.carrier.name == carrier
        assert np.abs(np.abs(told.design(sightings)) - np.abs(law.design(sightings))).max() < 1e-12


def test_a_wave_is_told_by_amplitude_and_phase(sightings):
    wave = Law((), (), RESPONSES["distance"][0], Regressor("wave", ("azimuth",), constant=3.0))
    amplitude, phase = sizes_of(wave, sightings, np.array([3e-6, 4e-6]), 1e-14 * np.eye(2))
    assert amplitude.value == pytest.approx(5.0 * np.sqrt(2.0))
    assert amplitude.sigma == pytest.approx(0.1 * np.sqrt(2.0))
    assert (phase.value, phase.unit) == (pytest.approx(53.13, abs=0.01), "deg")


def test_a_stand_that_leans_askew_is_one_law_and_told_along_both_axes(sightings):
    law = Law(("S2",), (), RESPONSES["lean of the stand"][0], simple("station-time", "power"))
    way = 5e-6 * np.array([0.6, 0.8])
    column = law.driver.columns(sightings)[:, 0] * (sightings.station == 1)
    expected = (station_design(sightings)[:, :, 3:5] @ way) * column[:, None]
    np.testing.assert_allclose(law.design(sightings) @ way, expected, atol=1e-20)
    told = sizes_of(law, sightings, way, 1e-16 * np.eye(2))
    assert [e.name for e in told] == ["rms", "swing about x", "swing about y"]
    assert told[2].value / told[1].value == pytest.approx(0.8 / 0.6)
    assert told[0].value == pytest.approx(
        np.sqrt(np.mean(column[sightings.station == 1] ** 2)) * 1e6 * np.hypot(*way), rel=1e-6
    )
    assert set(law.observables) == set(OBSERVABLES)


def test_what_every_set_up_does_in_its_own_way_is_the_laws_of_the_set_ups_together(sightings):
    alone = Law(("S2",), (), RESPONSES["vertical index"][0], simple("station-time", "power"))
    together = alone.at_each(sightings)
    assert together is not None
    parts = [replace(alone, stations=(name,)).design(sightings) for name in sightings.station_names]
    np.testing.assert_array_equal(together.design(sightings), np.concatenate(parts, axis=2))
    mean = np.where(np.arange(len(parts)) == 3, -4e-6, 1e-6)
    (_, swing) = sizes_of(together, sightings, mean, 1e-16 * np.eye(len(mean)))
    (_, own) = sizes_of(replace(alone, stations=("S4",)), sightings, mean[[3]], 1e-16 * np.eye(1))
    assert swing == own  # where it does most


def test_a_wall_does_not_know_where_a_tracker_looks(sightings):
    assert not is_admissible("target", smooth("azimuth"), sightings)
    assert is_admissible("target", smooth("time"), sightings)
    assert is_admissible("reading", smooth("azimuth"), sightings)


def test_targets_on_one_surface_belong_together():
    rng = stream(5, "places")
    points = rng.uniform(0.0, 10.0, (12, 3))
    look = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 6, axis=0)
    found = clusters(SimpleNamespace(points=points, nest_normal=look))
    assert {tuple(range(6)), tuple(range(6, 12))} <= found
    assert all(MIN_GROUP <= len(group) <= 12 - MIN_GROUP for group in found)


def test_coordinates_are_those_of_the_start_or_of_a_column_at_rest(sightings):
    loaded = replace(sightings, covariates={"load": np.maximum(np.sin(sightings.time / 900.0), 0.0)})
    load = simple("load", "power").columns(loaded, moving=True)
    assert load[loaded.covariates["load"] == 0.0].max() == 0.0
    time = simple("time", "decay", 600.0).columns(loaded, moving=True)
    assert time[np.argmin(loaded.time)] == 0.0
    assert abs(smooth("time").columns(loaded, moving=True).mean(axis=0)).max() < 1e-12


def test_how_far_targets_move_is_told_as_far_as_they_move(sightings):
    decay = Law(targets=("T02",), carrier=RESPONSES["place of targets"][0], driver=simple("time", "decay", 600.0))
    mean = np.array([0.0, 0.0, 3e-5])
    there = decay.mask(sightings) > 0
    moved = decay.columns(sightings)[there, 0] * mean[2]
    *_, along_z = sizes_of(decay, sightings, mean, 1e-12 * np.eye(3))
    assert along_z.value == pytest.approx(1e6 * np.ptp(moved)) or along_z.value == pytest.approx(-1e6 * np.ptp(moved))


def test_an_elevation_that_errs_by_its_sign_is_the_vertical_index(sightings):
    elevation, face = RESPONSES["elevation"][0], simple("face", "power")
    law = Law((), (), elevation, Regressor("product", factors=(face, smooth("time", 4))))
    assert (law.as_constant(sightings).carrier.name, law.as_constant(sightings).driver) == (
        "vertical index",
        smooth("time", 4),
    )
    assert Law((), (), elevation, face).as_constant(sightings).driver.kind == "constant"
    assert Law((), (), elevation, smooth("time")).as_constant(sightings).carrier == elevation
    index = law.as_constant(sightings).design(sightings)
    np.testing.assert_allclose(
        np.abs(index), np.abs(law.design(sightings)[:, :, 1:]), atol=1e-9
    )  # a product has a constant too


def test_each_target_of_a_small_group_may_move_by_an_amount_of_its_own(sightings):
    group = sightings.target_names[:4]
    law = Law((), group, RESPONSES["height of targets in their nests"][0], simple("time", "power"))
    (own,) = law.forms(sightings)["members"][0]
    columns = own.columns(sightings)
    assert columns.shape == (len(sightings), 4)
    for column, name in zip(columns.T, group, strict=True):
        at = sightings.target == sightings.target_names.index(name)
        assert column[at].any() and not column[~at].any()
        assert column[sightings.time == sightings.time.min()].max(initial=0.0) == 0.0  # where it says at first
    assert "members" not in replace(law, targets=sightings.target_names[:2]).forms(sightings)
    assert "members" not in replace(law, carrier=RESPONSES["distance"][0]).forms(sightings)


@pytest.mark.parametrize(
    ("carrier", "driver", "stations", "name"),
    [
        ("distance", simple("time", "power"), (), "range-drift"),
        ("distance", simple("station-time", "decay", 600.0), ("S2",), "range-drift"),
        ("distance", simple("distance", "power"), (), "unknown"),
        ("distance", CONSTANT, (), "range-offset"),
        ("distance", CONSTANT, ("S2",), "range-step"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=5.0), (), "azimuth-harmonic"),
        ("elevation", Regressor("wave", ("elevation",), constant=3.0), (), "elevation-harmonic"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=1.0), (), "unknown"),
        ("azimuth", Regressor("wave", ("azimuth",), constant=90.0), (), "encoder-interpolation"),
    ],
)
def test_a_law_that_a_card_describes_has_its_name(carrier, driver, stations, name):
    assert name_of(Law(stations, (), RESPONSES[carrier][0], driver)) == name
