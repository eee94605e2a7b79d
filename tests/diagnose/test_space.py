"""Carriers, drivers, places: what is scored at once is what each law is worth alone."""

from __future__ import annotations

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ltsim.adjust import adjust
from ltsim.adjust.residual_space import ResidualSpace
from ltsim.diagnose.cards import Cards
from ltsim.diagnose.carriers import CARRIERS, carrier_designs
from ltsim.diagnose.drivers import CONSTANT, Driver, general_drivers, moves, products, simple, smooth, waves
from ltsim.diagnose.evidence import PRIOR, SIZES, log_average, log_evidence, posterior, sign_weight
from ltsim.diagnose.law import Law, card_of, told_of
from ltsim.diagnose.panels import panels
from ltsim.diagnose.places import LEAST_GROUP, branches
from ltsim.diagnose.probe import Probe
from ltsim.diagnose.sets import MISFIT, Found, Hypothesis, Ranking
from ltsim.effects import find_effect
from ltsim.effects.motions import station_design
from ltsim.model.construction import misalignment
from ltsim.randomness import stream
from ltsim.recording.recording import OBSERVABLES
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(faces=2, values=drawn(misalignment(), 1), seed=1)
    return ResidualSpace.of(adjust(recording, misalignment()))


@pytest.fixture(scope="module")
def made(space):
    """All panels, scored once."""
    probe = Probe.of(space, 0, judged=True)
    found = panels(space, PRIOR["law"])
    return probe, found, [panel.score(probe) for panel in found]


def alone(space: ResidualSpace, law: Law, residual: np.ndarray, extension: np.ndarray) -> float:
    """Log evidence of a law by its own signature."""
    left = space.project(space.signature(law))
    left -= extension @ (extension.T @ left)
    sizes = np.array([p.prior_sigma for p in law.parameters])
    return posterior(left.T @ left, left.T @ residual, sizes)[2]


def test_priors_sum_to_one(made):
    assert sum(PRIOR.values()) == pytest.approx(1.0)
    _, found, _ = made
    hypotheses = (
        np.exp(p.log_prior) * len(p.carriers) * len(p.places) * sum(len(d.spreads) for d in p.drivers) for p in found
    )
    assert sum(hypotheses) == pytest.approx(PRIOR["law"])


def test_scores_by_sums_over_places_are_those_of_single_laws(space, made):
    _, found, scored = made
    nothing = np.zeros((space.size, 0))
    for (hits, _, _), panel in zip(scored, found, strict=True):
        for hit in (hits[0], hits[-1]):
            scales = range(len(hit.driver.spreads))
            laws = [Law(hit.place.stations, hit.place.targets, hit.carrier, hit.driver, scale=k) for k in scales]
            logs = np.array([alone(space, law, space.residual, nothing) for law in laws])
            exact = log_average(logs) + hit.log_prior
            assert hit.value == pytest.approx(float(exact), abs=0.02), (panel.carriers[0], hit)


def test_beside_what_was_found_nothing_of_it_is_left_to_score(space, made):
    probe, found, _ = made
    law = Law((), (), CARRIERS["elevation"][0], simple("time", "power"))
    extension = space.project(space.signature(law))
    extension /= np.linalg.norm(extension)
    residual = space.residual - extension @ (extension.T @ space.residual)
    hits = [h for p in found for h in p.score(probe.beside(residual, extension))[0]]
    same = [h for h in hits if h.carrier == law.carrier and h.driver == law.driver and not h.place.stations]
    assert all(h.value < h.log_prior + 0.1 for h in same)


def test_what_chance_makes_of_a_search_has_no_expectation_of_its_own(made):
    """Marginal likelihood ratios average to one where there is nothing."""
    for _, _, null in made[2]:
        assert log_average(null) - np.log(len(null)) < np.log(PRIOR["law"]) + 1.5


def test_simulated_residuals_stand_for_the_basis_in_large_networks(space, monkeypatch):
    monkeypatch.setattr("ltsim.diagnose.probe.MOST_UNKNOWNS", 0)
    probe = Probe.of(space, 0, judged=False)
    assert probe.basis is None
    effects = [find_effect("station-weather")(("S2",)), find_effect("index-drift")()]
    sampled = Cards.of(space, effects)
    sampled.score(probe)
    monkeypatch.undo()
    exact = Cards.of(space, effects)
    exact.score(Probe.of(space, 0, judged=False))
    for one, other in zip(sampled.groups, exact.groups, strict=True):
        np.testing.assert_allclose(one.gram, other.gram, rtol=0.35)


def test_evidence_is_that_of_the_dense_covariance():
    """log N(r; 0, 1 + t^2 G G') - log N(r; 0, 1), averaged over sizes, by determinants."""
    rng = stream(4, "dense")
    signature, residual = rng.standard_normal((12, 2)), rng.standard_normal(12)
    logs = []
    for t in SIZES:
        covariance = np.eye(12) + t**2 * signature @ signature.T
        quadratic = residual @ (residual - np.linalg.solve(covariance, residual))
        logs.append(0.5 * (quadratic - np.linalg.slogdet(covariance)[1]))
    gram = signature.T @ signature
    found = posterior(gram, signature.T @ residual, np.ones(2))
    single = [log_average(np.array([log])) for log in logs]
    assert min(single) < found[2] < max(single)
    strength, turn = np.linalg.eigh(gram)
    assert found[2] == pytest.approx(float(log_evidence((turn.T @ signature.T @ residual) ** 2, strength)))


def test_a_negative_thickness_is_no_explanation():
    assert sign_weight(3.0, 1.0) == pytest.approx(np.log(2.0), abs=0.01)
    assert sign_weight(-5.0, 1.0) < -10.0


def test_drivers_have_columns_of_unit_size_and_words_of_the_interface(space):
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
    }
    drivers = [*general_drivers(space.sightings), *products(space.sightings), *list(waves(space.sightings))[::50]]
    for driver in drivers:
        columns = driver.columns(space.sightings)
        assert columns.shape == (len(space.sightings), driver.size)
        assert np.isfinite(columns).all()
        assert set(driver.told) <= words | set(space.sightings.covariates)
        spread = np.sqrt(((columns * driver.spreads[0]) ** 2).sum(axis=1).mean())
        assert 0.2 < spread < 2.0, driver


def test_carriers_are_derivatives_of_the_readings(space):
    designs = carrier_designs(space.sightings)
    assert "vertical index" in designs  # two faces tell it from the elevation
    assert set(designs) <= set(CARRIERS)
    for name, (carrier, design) in designs.items():
        assert design.shape == (len(space.sightings), 3, len(carrier.ways))
        assert np.isfinite(design).all(), name
        if len(carrier.observables) == 1:
            column = ("distance", "azimuth", "elevation").index(carrier.observables[0])
            assert (design[:, column] ** 2).sum() > 0.6 * (design**2).sum(), name


def test_laws_are_effects_like_any_other(space):
    law = Law(("S2",), (), CARRIERS["vertical index"][0], smooth("station-time"))
    assert pickle.loads(pickle.dumps(law)) == law
    design = law.design(space.sightings)
    assert design.shape == (len(space.sightings), 3, len(law.parameters))
    assert not design[space.sightings.station != 1].any()
    short = law.formulas(space.sightings)
    assert {d.driver.function for d in short} >= {"power", "decay"}
    assert card_of(Law((), (), law.carrier, simple("station-time", "decay", 900.0))) == "index-drift"
    wave = Law((), (), CARRIERS["elevation"][0], Driver("wave", ("elevation",), constant=107.35))
    assert card_of(wave) == "encoder-interpolation"
    assert card_of(law) == "unknown"


def test_an_elevation_that_errs_as_the_vertical_index_is_told_as_that(space):
    reading = Law(carrier=CARRIERS["elevation"][0], driver=simple("face", "power"))
    one, _ = network(faces=1, seed=1)
    alone = adjust(one, misalignment()).sightings
    cases = [
        (reading, space.sightings, "vertical index"),
        (replace(reading, driver=smooth("time")), space.sightings, "elevation"),
        (replace(reading, driver=smooth("time")), alone, "vertical index"),
        (replace(reading, driver=smooth("elevation")), alone, "elevation"),
        (replace(reading, carrier=CARRIERS["azimuth"][0]), space.sightings, "azimuth"),
    ]
    for law, sightings, carrier in cases:
        told = law.as_constant(sightings)
        assert told.carrier.name == carrier
        assert np.abs(np.abs(told.design(sightings)) - np.abs(law.design(sightings))).max() < 1e-12


def test_a_wave_is_told_by_amplitude_and_phase(space):
    wave = Law((), (), CARRIERS["distance"][0], Driver("wave", ("azimuth",), constant=3.0))
    amplitude, phase = told_of(wave, space.sightings, np.array([3e-6, 4e-6]), 1e-14 * np.eye(2))
    assert amplitude.value == pytest.approx(5.0 * np.sqrt(2.0))
    assert amplitude.sigma == pytest.approx(0.1 * np.sqrt(2.0))
    assert (phase.value, phase.unit) == (pytest.approx(53.13, abs=0.01), "deg")


def test_a_stand_that_leans_askew_is_one_law_and_told_along_both_axes(space):
    sightings = space.sightings
    law = Law(("S2",), (), CARRIERS["lean of the stand"][0], simple("station-time", "power"))
    way = 5e-6 * np.array([0.6, 0.8])
    column = law.driver.columns(sightings)[:, 0] * (sightings.station == 1)
    expected = (station_design(sightings)[:, :, 3:5] @ way) * column[:, None]
    np.testing.assert_allclose(law.design(sightings) @ way, expected, atol=1e-20)
    told = told_of(law, sightings, way, 1e-16 * np.eye(2))
    assert [e.name for e in told] == ["swing about x", "swing about y"]
    assert told[1].value / told[0].value == pytest.approx(0.8 / 0.6)
    assert set(law.observables) == set(OBSERVABLES)


def test_what_every_set_up_does_in_its_own_way_is_the_laws_of_the_set_ups_together(space):
    sightings = space.sightings
    alone = Law(("S2",), (), CARRIERS["vertical index"][0], simple("station-time", "power"))
    together = alone.at_each(sightings)
    assert together is not None
    parts = [replace(alone, stations=(name,)).design(sightings) for name in sightings.station_names]
    np.testing.assert_array_equal(together.design(sightings), np.concatenate(parts, axis=2))
    mean = np.where(np.arange(len(parts)) == 3, -4e-6, 1e-6)
    (swing,) = told_of(together, sightings, mean, 1e-16 * np.eye(len(mean)))
    (own,) = told_of(replace(alone, stations=("S4",)), sightings, mean[[3]], 1e-16 * np.eye(1))
    assert swing == own  # where it does most


def test_a_wall_does_not_know_where_a_tracker_looks(space):
    sightings = space.sightings
    assert not moves("target", smooth("azimuth"), sightings)
    assert moves("target", smooth("time"), sightings)
    assert moves("reading", smooth("azimuth"), sightings)


def test_unknown_is_told_where_it_is_likelier_than_all_names_together():
    def ranking(**values: float) -> Ranking:
        law = Law((), (), CARRIERS["distance"][0], CONSTANT)
        return Ranking(tuple(Hypothesis(law, 0.0, v, n) for n, v in values.items()), 0.0)

    assert ranking(unknown=10.0, window=9.5, backlash=9.4).name() == "window"
    assert ranking(unknown=10.0, window=9.0, backlash=8.0).name() == "unknown"


def test_targets_on_one_surface_belong_together():
    rng = stream(5, "places")
    points = rng.uniform(0.0, 10.0, (12, 3))
    look = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 6, axis=0)
    found = branches(SimpleNamespace(points=points, nest_normal=look))
    assert {tuple(range(6)), tuple(range(6, 12))} <= found
    assert all(LEAST_GROUP <= len(group) <= 12 - LEAST_GROUP for group in found)


def test_what_an_unknown_law_leaves_is_no_further_cause(space):
    law = Law((), (), CARRIERS["distance"][0], simple("time", "power"))
    left = space.project(space.signature(law))
    unknown = Hypothesis(law, 0.0, 0.0, "unknown")
    known = Hypothesis(find_effect("index-drift")(), 0.0, 0.0, "index-drift")
    whole = 1e7 * left[:, 0]
    found = [Found((h,), (left,), np.linalg.norm(left, axis=0)[None], whole) for h in (unknown, known)]
    assert found[0].misfit == pytest.approx(0.5 * MISFIT * whole @ whole)
    assert found[1].misfit == 0.0


def test_coordinates_are_those_of_the_start_or_of_a_column_at_rest(space):
    sightings = replace(space.sightings, covariates={"load": np.maximum(np.sin(space.sightings.time / 900.0), 0.0)})
    load = simple("load", "power").columns(sightings, moving=True)
    assert load[sightings.covariates["load"] == 0.0].max() == 0.0
    time = simple("time", "decay", 600.0).columns(sightings, moving=True)
    assert time[np.argmin(sightings.time)] == 0.0
    assert abs(smooth("time").columns(sightings, moving=True).mean(axis=0)).max() < 1e-12
