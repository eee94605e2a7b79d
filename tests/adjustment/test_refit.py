"""A network adjusted with an effect whose constants are unknown too."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.refit import ParameterEstimate, refit_with_effects
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.range_cyclic import RangeCyclic
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.model.construction import misalignment_construction
from ltsim.solve.gauss_newton import TerminationStatus
from tests.networks import with_effect


def refitted(
    effect: Effect, guess: Effect, values: list[float], *, noise: float = 1.0, adjusted: Any = adjust
) -> tuple[Adjustment, dict[str, ParameterEstimate]]:
    recording = with_effect(effect, values, noise=noise)
    start = adjust(recording, misalignment_construction()).state
    refit = refit_with_effects(partial(adjusted, recording, misalignment_construction()), [guess], start_state=start)
    return refit.adjustment, {estimate.parameter.name: estimate for estimate in refit.estimates[0]}


def test_a_refit_gives_back_sizes_and_constants_within_their_sigmas() -> None:
    true = StationSettling(("S3",), time_constant=480.0)
    _, constants = refitted(true, true.with_shape_parameters(time_constant=700.0), [30e-6, -20e-6, 40e-6])
    expected = {"tilt-x": 30e-6, "tilt-y": -20e-6, "rise": 40e-6, "time_constant": 480.0}
    assert set(constants) == set(expected)
    for name, value in expected.items():
        assert constants[name].sigma > 0
        assert abs(constants[name].value - value) < 4 * constants[name].sigma, name


def test_a_refit_without_noise_ends_at_the_truth() -> None:
    true = RangeCyclic(wavelength=0.75)
    refitted_adjustment, constants = refitted(
        true, true.with_shape_parameters(wavelength=0.76), [10e-6, 0.0], noise=0.0
    )
    assert refitted_adjustment.chi2 < 1.0
    assert constants["wavelength"].value == pytest.approx(0.75, rel=1e-3)


def test_the_frequency_of_short_waves_is_as_certain_as_that_of_long_waves() -> None:
    """From an eighth of a period off; the Fisher information of a frequency does not depend on it."""
    frequency = []
    for length, off in ((0.02, 5e-4), (0.75, 5e-3)):
        true = RangeCyclic(wavelength=length)
        start = adjust(with_effect(true, [10e-6, 0.0], noise=0.0), misalignment_construction())
        guess = [true.with_shape_parameters(wavelength=length * (1 + off))]
        refit = refit_with_effects(start.with_effects, guess, start_state=start.state)
        assert refit.adjustment.chi2 < 0.1
        *_, wavelength = refit.estimates[0]
        assert wavelength.value == pytest.approx(length, rel=1e-5)
        frequency.append(wavelength.sigma / length**2)
    assert frequency[0] == pytest.approx(frequency[1], rel=0.3)


def test_unchanged_constants_are_not_reported_and_the_estimated_noise_stays() -> None:
    true = StationSettling(("S3",), time_constant=480.0)
    recording = with_effect(true, [30e-6, -20e-6, 40e-6], noise=2.0)
    start = adjust(recording, misalignment_construction(), effects=[true], noise_grouping="observable")
    refit = refit_with_effects(
        start.with_effects, [true], start_state=start.state, fixed_shape_parameters=[{"time_constant"}]
    )
    assert refit.effects == (true,) and refit.adjustment.chi2 == pytest.approx(start.chi2)
    assert [estimate.parameter for estimate in refit.estimates[0]] == list(true.parameters)
    assert [estimate.value for estimate in refit.estimates[0]] == pytest.approx(start.state.extra_parameters, rel=1e-6)
    sigma = start.effect_covariance.diagonal() ** 0.5
    assert [estimate.sigma for estimate in refit.estimates[0]] == pytest.approx(sigma, rel=1e-6)


def test_constants_at_which_the_network_does_not_settle_are_not_taken() -> None:
    """A refit ends at the last constants with which the adjustment converged, however low a capped one came."""
    bad = 0

    def capped(*args: Any, **kwargs: Any) -> Adjustment:
        nonlocal bad
        refitted_adjustment = adjust(*args, **kwargs)
        if len(kwargs["effects"]) == 1 and kwargs["effects"][0] != guess:
            bad += 1
            return replace(
                refitted_adjustment,
                solution=replace(refitted_adjustment.solution, status=TerminationStatus.MAX_ITERATIONS_REACHED),
            )
        return refitted_adjustment

    true = RangeCyclic(wavelength=0.75)
    guess = true.with_shape_parameters(wavelength=0.76)
    refitted_adjustment, constants = refitted(true, guess, [10e-6, 0.0], noise=0.0, adjusted=capped)
    assert bad
    assert refitted_adjustment.solution.has_converged
    assert constants["wavelength"].value == pytest.approx(0.76)
