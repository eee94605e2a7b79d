"""What every effect of the catalogue promises, at every place and shape."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from ltsim import effects
from ltsim.core.errors import ModelError
from ltsim.physics.effects import CATALOGUE, NoiseEffect, catalogue_entry, find_effect
from ltsim.physics.effects.catalogue import NO_MEASUREMENT_PHRASE
from ltsim.physics.effects.effect import Blunder, ChainErrorEffect, Effect, LightPathStage
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import OBSERVABLES
from tests.physics.effects.scenes import all_candidates, chosen, samples, scene

SCENE = scene()
EVERY = pytest.mark.parametrize("kind", CATALOGUE, ids=lambda kind: kind.name)
AIR = ("air-gradient", "air-layer", "heat-plume")
"""First order here is a quadrature along the straight path: it has an error of its own, in proportion."""


def prior(effect: Effect) -> np.ndarray:
    return np.array([p.prior_sigma for p in effect.parameters])


@EVERY
def test_parameters_are_declared(kind: type[Effect]) -> None:
    for effect in samples(kind, SCENE):
        assert effect.parameters
        names = [p.name for p in effect.parameters]
        assert len(set(names)) == len(names)
        for p in effect.parameters:
            assert re.fullmatch(r"[a-z][a-z-]*", p.name)
            assert p.description
            assert p.si_per_display_unit > 0
            assert p.prior_sigma > 0


@EVERY
def test_the_card_has_all_parts(kind: type[Effect]) -> None:
    card = catalogue_entry(kind)
    assert all(text.endswith(".") for _, text in card.sections())
    assert not card.title.endswith(".")
    sections = dict(card.sections())
    assert re.search(r"\d", sections["Size"]) or issubclass(kind, Blunder)
    assert re.search(r"validated|empirical", sections["Validation"])


@EVERY
def test_what_confirms_an_effect_is_a_measurement(kind: type[Effect]) -> None:
    """A page said that an effect is "confirmed by no measurement is needed"."""
    card = catalogue_entry(kind)
    assert not re.match(r"no\b|nothing|none", card.confirming_measurement, re.IGNORECASE)
    assert bool(card.confirming_measurement) != dict(card.sections())["Separate by"].startswith(NO_MEASUREMENT_PHRASE)


@EVERY
def test_shapes_and_finite_values(kind: type[Effect]) -> None:
    for scene_ in (SCENE, chosen(SCENE, [3]), chosen(SCENE, [])):
        for effect in samples(kind, SCENE):
            p, n = len(effect.parameters), len(scene_)
            design, shift = effect.design(scene_), effect.reading_change(scene_, prior(effect))
            assert design.shape == (n, 3, p)
            assert shift.shape == (n, 3)
            assert np.isfinite(design).all()
            assert np.isfinite(shift).all()


@EVERY
def test_zero_values_change_nothing(kind: type[Effect]) -> None:
    for effect in samples(kind, SCENE):
        zero = np.zeros(len(effect.parameters))
        np.testing.assert_allclose(effect.reading_change(SCENE, zero), 0.0, atol=1e-13)


@EVERY
def test_exact_form_agrees_with_first_order(kind: type[Effect]) -> None:
    """The difference is second order: within 5 % at a bad size, and a hundred times smaller at a tenth of it."""
    tolerance = 2e-3 if kind.name in AIR else 1e-9
    for effect in samples(kind, SCENE):
        values = prior(effect)
        linear = effect.design(SCENE) @ values
        size = np.abs(linear).max(axis=0)
        large = np.abs(effect.reading_change(SCENE, values) - linear).max(axis=0)
        small = np.abs(effect.reading_change(SCENE, 0.1 * values) - 0.1 * linear).max(axis=0)
        assert (large <= 0.05 * size + 1e-12).all(), effect
        assert (small <= 0.02 * large + 0.1 * tolerance * size + 1e-13).all(), effect


@pytest.mark.parametrize(
    "kind", [k for k in CATALOGUE if k.light_path_stage <= LightPathStage.STATION], ids=lambda kind: kind.name
)
def test_motions_take_a_high_reflector_into_account(kind: type[Effect]) -> None:
    """Two metres above its mark it sees another turn of the station than the mark would, exactly and in first order."""
    lifted = replace(SCENE, sight_vector_offsets=np.tile([0.0, 0.0, 2.0], (len(SCENE), 1)))
    for effect in samples(kind, lifted):
        values = 0.1 * prior(effect)
        np.testing.assert_allclose(effect.reading_change(lifted, 0.0 * values), 0.0, atol=1e-13)
        linear = effect.design(lifted) @ values
        size = np.abs(linear).max(axis=0)
        assert (np.abs(effect.reading_change(lifted, values) - linear).max(axis=0) <= 5e-3 * size + 1e-12).all(), effect


@EVERY
def test_only_declared_observables_change(kind: type[Effect]) -> None:
    for effect in samples(kind, SCENE):
        silent = [c for c, o in enumerate(OBSERVABLES) if o not in effect.observables]
        columns = [c for c, o in enumerate(OBSERVABLES) if o in effect.observables]
        changes = np.abs(np.dstack([effect.design(SCENE), effect.reading_change(SCENE, prior(effect))])).max(axis=0)
        largest = changes.max(axis=0)
        assert (changes[silent] <= 1e-9 * largest + 1e-14).all()
        if not isinstance(effect, NoiseEffect) and columns:
            assert (changes[columns].max(axis=1) > 1e-9 * largest.min()).all(), effect


@EVERY
def test_nothing_happens_outside_its_place(kind: type[Effect]) -> None:
    for effect in samples(kind, SCENE):
        outside = effect.pointing_indicator(SCENE) == 0
        assert not effect.design(SCENE)[outside].any()
        assert not effect.reading_change(SCENE, prior(effect))[outside].any()
        assert set(effect.stations) <= set(SCENE.station_names)
        assert set(effect.targets) <= set(SCENE.target_names)
        if isinstance(effect, NoiseEffect):
            sigma = np.full((len(SCENE), 3), 3e-6)
            np.testing.assert_allclose(effect.variance(SCENE, sigma, prior(effect))[outside], 9e-12)


@EVERY
def test_written_and_packed_and_back(kind: type[Effect]) -> None:
    for effect in samples(kind, SCENE):
        assert eval(repr(effect), {kind.__name__: kind}) == effect
        back = pickle.loads(pickle.dumps(effect))
        assert back == effect
        assert back.parameters == effect.parameters
        np.testing.assert_array_equal(back.design(SCENE), effect.design(SCENE))


@EVERY
def test_shapes_lie_between_their_bounds(kind: type[Effect]) -> None:
    for shape in kind.shape_parameters:
        for effect in all_candidates(kind, SCENE):
            value = getattr(effect, shape.name)
            assert shape.lower_bound * (1 - 1e-9) <= value <= shape.upper_bound * (1 + 1e-9) or shape.lower_bound < 0
            low, high = shape.neighbouring_grid_interval(value)
            assert low <= value <= high


@pytest.mark.parametrize("kind", [k for k in CATALOGUE if issubclass(k, ChainErrorEffect)], ids=lambda kind: kind.name)
def test_first_order_agrees_with_the_exact_chain(kind: type[ChainErrorEffect]) -> None:
    for effect in samples(kind, SCENE):
        assert isinstance(effect, ChainErrorEffect)
        values = 0.01 * prior(effect)
        exact = (
            misalignment_construction([effect]).readings_from_points(SCENE.local_points, SCENE.face, values)
            - SCENE.ideal_raw_readings
        )
        exact[:, 1] = (exact[:, 1] + np.pi) % (2 * np.pi) - np.pi
        linear = effect.design(SCENE) @ values
        np.testing.assert_allclose(exact, linear, atol=2e-3 * np.abs(linear).max() + 1e-13)


@pytest.mark.parametrize("kind", [k for k in CATALOGUE if issubclass(k, NoiseEffect)], ids=lambda kind: kind.name)
def test_noise_is_the_declared_noise_at_zero(kind: type[NoiseEffect]) -> None:
    sigma = np.abs(np.random.default_rng(1).normal(size=(len(SCENE), 3)))
    for effect in kind.candidates(SCENE):
        zero = np.zeros(len(effect.parameters))
        np.testing.assert_allclose(effect.variance(SCENE, sigma, zero), sigma**2)
        for values in effect.candidate_parameter_values():
            assert len(values) == len(effect.parameters)
            assert (effect.variance(SCENE, sigma, np.array(values)) > 0).all()
        felt = [effect.variance(SCENE, sigma, size) != sigma**2 for size in np.diag(prior(effect))]
        assert np.sum(felt, axis=0).max() == 1  # a reading follows one of the values


def test_a_search_over_all_candidates_is_bounded() -> None:
    """Two thousand to three thousand on 280 pointings."""
    assert sum(len(kind.candidates(SCENE)) for kind in CATALOGUE) < 4000


def test_effects_are_looked_up_by_name() -> None:
    assert find_effect("head-sag") is effects.find_effect("head-sag")
    assert find_effect("head-sag").name == "head-sag"
    with pytest.raises(ModelError, match=r"did you mean .*range-cyclic"):
        find_effect("range-cycle")


def test_warm_ups_end_while_they_are_measured() -> None:
    """A time constant of many spans is a constant; where rows stand for seconds constants are shares of all of them."""
    kind = find_effect("range-drift")
    for span in (12.0, 3600.0, 30_000.0):
        times = np.linspace(0.0, span, len(SCENE))
        tried = [e.time_constant for e in kind.candidates(replace(SCENE, time=times)) if e.law == "exponential"]
        assert tried and min(tried) > 0.0 and max(tried) <= 2.0 * span
