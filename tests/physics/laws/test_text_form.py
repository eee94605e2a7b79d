"""What is told of a driver can be read again."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.errors import ModelError
from ltsim.physics.laws.accumulations import FIXED_COUNT_RESET_FUNCTION, POINTING_DECAY_FUNCTION, TIME_DECAY_FUNCTION
from ltsim.physics.laws.columns import FORMULA_FUNCTIONS, HYSTERESIS_FUNCTION
from ltsim.physics.laws.regressor_library import BUILTIN_COVARIATES, candidate_regressors
from ltsim.physics.laws.regressors import (
    CONSTANT_REGRESSOR,
    DEFLECTION_FUNCTION,
    Regressor,
    accumulation_regressor,
    group_amounts_regressor,
    latch_regressor,
    nearness_regressor,
    path_length_regressor,
    piecewise_regressor,
    scalar_regressor,
    smooth_regressor,
    switch_regressor,
    with_position_dependence,
)
from ltsim.physics.laws.text_form import (
    GROUP_COVARIATES,
    PHRASE_BY_COVARIATE,
    TEXT_FORM_EXAMPLES,
    parse_law,
    parse_regressor,
    regressor_text,
)
from ltsim.recordings import Recording
from ltsim.scene.regions import REGION_SHAPES, HallRegion
from tests.networks import network


@pytest.fixture(scope="module")
def recording() -> Recording:
    made = network(faces=2, seed=1)[0]
    return made.replace(
        covariates={"hall_temperature_c": np.linspace(18.0, 22.0, len(made)), "press_load_kn": made.time}
    )


def every() -> list[Regressor]:
    """Drivers of all kinds with round constants."""
    named = {"power": 3.0, "abs": 1.0, "cos": 2.0, "sin": 1.0, "tan": 1.0}
    edges = [
        scalar_regressor(*which)
        for which in (("time", "step", 2820.0), ("height", "ramp", -0.25), ("azimuth", "step", 0.5))
    ]
    clocks = [scalar_regressor("station-time", function, 480.0) for function in ("decay", "relaxing", "saturated")]
    clocks.append(scalar_regressor("move-azimuth", "fading", 0.5))
    clocks += [scalar_regressor("elevation", "hysteresis", 0.5), scalar_regressor("distance", "saw", 2.0)]
    regressors = [scalar_regressor("press_load_kn" if f == "power" else "elevation", f, k) for f, k in named.items()]
    regressors += [
        CONSTANT_REGRESSOR,
        group_amounts_regressor("station", 5),
        Regressor("wave", ("azimuth",), constant=1.0),
        *edges,
        *clocks,
    ]
    regressors += [
        Regressor(kind, (name,), constant=2 * np.pi / 45.0) for kind in ("wave", "cycle") for name in ("time", "circle")
    ]
    regressors += [Regressor("wave", (name,), constant=2 * np.pi / 0.4) for name in ("x", "hall_temperature_c")]
    regressors += [smooth_regressor(name) for name in ("circle", "hall_temperature_c")] + [
        scalar_regressor(name, "power") for name in PHRASE_BY_COVARIATE if name not in GROUP_COVARIATES
    ]
    regressors += [
        scalar_regressor("distance", "power", -1.0),
        piecewise_regressor([scalar_regressor("time", "step", 600.0), scalar_regressor("time", "ramp", 900.0)]),
    ]
    regressors += [
        Regressor("lagging", ("hall_temperature_c",), constant=1200.0),
        group_amounts_regressor("last-target", 28),
    ]
    regressors += [scalar_regressor("press_load_kn", "power").with_amount_per_target(("T01", "T02", "T04"))]
    regressors += with_position_dependence(
        [scalar_regressor("press_load_kn", "power"), piecewise_regressor(edges[:1] * 2)], 2
    )
    regressors += [
        make(HallRegion(axes, (2.5, -1.25, 0.4)[: len(axes)], 0.35))
        for axes in REGION_SHAPES
        for make in (
            path_length_regressor,
            partial(path_length_regressor, function=DEFLECTION_FUNCTION),
            nearness_regressor,
        )
    ]
    regressors += [scalar_regressor("move-elevation", how, 0.3) for how in ("slack", "within", "stuck")]
    regressors += [
        accumulation_regressor("work-azimuth", how, 1.0) for how in ("after face", "after seating", "after azimuth")
    ]
    regressors += [
        accumulation_regressor("station-time", "after elevation", 1.0),
        accumulation_regressor("station-time", "after pause", 90.0),
    ]
    regressors += [
        accumulation_regressor("count", "after slew", 0.5),
        accumulation_regressor("wound-azimuth", "after tip", 0.25),
        accumulation_regressor("count", FIXED_COUNT_RESET_FUNCTION, 12.0),
    ]
    regressors += [
        accumulation_regressor("work-elevation", TIME_DECAY_FUNCTION, 300.0),
        accumulation_regressor("work-distance", POINTING_DECAY_FUNCTION, 4.0),
    ]
    regressors += [
        latch_regressor("distance", 5.2, 4.1),
        latch_regressor("elevation", 0.3, -0.2),
        latch_regressor("hall_temperature_c", 21.5, 20.5),
    ]
    regressors += [
        switch_regressor([scalar_regressor("time", "step", edge) for edge in times])
        for times in ((300.0, 900.0), (300.0, 900.0, 1500.0))
    ]
    column, start = path_length_regressor(HallRegion("xy", (1.0, 2.0), 0.3)), scalar_regressor("time", "step", -np.inf)
    regressors += [
        Regressor("product", factors=(column, switch_regressor([start, scalar_regressor("time", "step", 600.0)]))),
        Regressor(
            "product",
            factors=(column, switch_regressor([scalar_regressor("time", "step", edge) for edge in (300.0, 900.0)])),
        ),
    ]
    regressors.append(
        Regressor("product", factors=(smooth_regressor("distance", 4), group_amounts_regressor("instrument", 1)))
    )
    return [
        *regressors,
        Regressor("product", factors=(scalar_regressor("face", "power"), smooth_regressor("distance", 4))),
    ]


@pytest.mark.parametrize("clock", [True, False])
def test_every_regressor_is_parsed_from_its_text(recording: Recording, clock: bool) -> None:
    assert {*FORMULA_FUNCTIONS, HYSTERESIS_FUNCTION} <= {driver.function for driver in every()}
    for driver in every():
        words = regressor_text(driver, has_clock=clock)
        read = parse_regressor(words, recording.replace(has_clock=clock))
        assert regressor_text(read, has_clock=clock) == words
        assert read.release_threshold == pytest.approx(driver.release_threshold, rel=6e-3)
        close = replace(
            read, constant=driver.constant, release_threshold=driver.release_threshold, factors=driver.factors
        )
        assert close == driver and read.constant == pytest.approx(driver.constant, rel=6e-3), words
        assert [f.kind for f in read.factors] == [f.kind for f in driver.factors]


def test_what_a_diagnosis_may_tell_of_a_recording_is_read(recording: Recording) -> None:
    sightings = adjust(recording).sightings
    assert set(BUILTIN_COVARIATES) <= set(sightings.covariate_values)
    tried = candidate_regressors(sightings)
    for driver in [
        d for kind, laws in tried.items() for d in laws[:: 25 if kind == "wave" else 1] if kind not in ("room", "clock")
    ]:
        read = parse_regressor(regressor_text(driver), recording)
        assert regressor_text(read) == regressor_text(driver)
        assert read.n_columns == driver.n_columns


def test_a_group_tilts_and_the_whole_bends(recording: Recording) -> None:
    words = "press_load_kn times the position in the hall"
    group = parse_law("position of targets", words, recording, targets=("T01", "T02"))
    assert group.regressor == with_position_dependence([scalar_regressor("press_load_kn", "power")], 1)[
        0
    ].with_field_centred_on(("T01", "T02"))
    assert parse_law("position of targets", words, recording).regressor.factors[1].constant == 2


def test_another_amount_for_each_target_goes_with_targets(recording: Recording) -> None:
    law = parse_law(
        "height of targets in their nests", "the target, another at each", recording, targets=("T01", "T02")
    )
    assert len(law.parameters) == 2
    for words in ("the target, another at each", "time times the target, another at each"):
        with pytest.raises(ModelError, match=r"needs the names of its targets .*:TARGET,TARGET"):
            parse_law("position of targets", words, recording)


def test_each_set_up_may_have_separate_coefficients(recording: Recording) -> None:
    law = parse_law("elevation", "exp(-station-time / 8 min), separately at each set-up", recording)
    assert law.has_coefficients_per_setup and law.stations == recording.stations
    assert len(law.parameters) == len(recording.stations)
    assert not parse_law("elevation", "exp(-station-time / 8 min)", recording).has_coefficients_per_setup
    with pytest.raises(ModelError, match="applies to all set-ups, not only to S2"):
        parse_law("elevation", "time, separately at each set-up", recording, stations=("S2",))


def test_examples_are_read(recording: Recording) -> None:
    for words in TEXT_FORM_EXAMPLES:
        assert regressor_text(parse_regressor(words, recording)) == words


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "expected a text such as"),
        ("a smooth function of pressure", "hall_temperature_c"),
        ("exp(-time / 8 deg)", "time in min or in s"),
        ("exp(-time / 0 min)", "above zero"),
        ("step(hall_temperature_c above 20 s)", "hall_temperature_c without a unit"),
        ("a wave in time, 3 periods a turn", "expected a text such as"),
        ("face times pressure", "'pressure' is not a function of covariates"),
    ],
)
def test_what_is_not_understood_is_answered_with_what_is(recording: Recording, words: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        parse_regressor(words, recording)
