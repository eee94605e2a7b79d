"""What is told of a driver can be read again."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.core.errors import ModelError
from ltsim.physics.laws.columns import HYSTERESIS, SIMPLE_FUNCTIONS
from ltsim.physics.laws.regressor_library import READING_COVARIATES, regressors_of
from ltsim.physics.laws.regressors import (
    CONSTANT,
    LEVER,
    Regressor,
    across_the_room,
    amounts,
    latch,
    memory,
    near,
    passage,
    pieces,
    simple,
    smooth,
    switch,
)
from ltsim.physics.laws.states import EVERY, FADES, FORGETS
from ltsim.physics.laws.words import EXAMPLES, OWNERS, PHRASE_OF, describe, read_law, read_regressor
from ltsim.recordings import Recording
from ltsim.scene.regions import SHAPES, Region
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
        simple(*which) for which in (("time", "step", 2820.0), ("height", "ramp", -0.25), ("azimuth", "step", 0.5))
    ]
    clocks = [simple("station-time", function, 480.0) for function in ("decay", "relaxing", "saturated")]
    clocks.append(simple("move-azimuth", "fading", 0.5))
    clocks += [simple("elevation", "hysteresis", 0.5), simple("distance", "saw", 2.0)]
    found = [simple("press_load_kn" if f == "power" else "elevation", f, k) for f, k in named.items()]
    found += [CONSTANT, amounts("station", 5), Regressor("wave", ("azimuth",), constant=1.0), *edges, *clocks]
    found += [
        Regressor(kind, (name,), constant=2 * np.pi / 45.0) for kind in ("wave", "cycle") for name in ("time", "circle")
    ]
    found += [Regressor("wave", (name,), constant=2 * np.pi / 0.4) for name in ("x", "hall_temperature_c")]
    found += [smooth(name) for name in ("circle", "hall_temperature_c")] + [
        simple(name, "power") for name in PHRASE_OF if name not in OWNERS
    ]
    found += [simple("distance", "power", -1.0), pieces([simple("time", "step", 600.0), simple("time", "ramp", 900.0)])]
    found += [Regressor("lagging", ("hall_temperature_c",), constant=1200.0), amounts("last-target", 28)]
    found += [simple("press_load_kn", "power").per_target(("T01", "T02", "T04"))]
    found += across_the_room([simple("press_load_kn", "power"), pieces(edges[:1] * 2)], 2)
    found += [
        make(Region(axes, (2.5, -1.25, 0.4)[: len(axes)], 0.35))
        for axes in SHAPES
        for make in (passage, partial(passage, function=LEVER), near)
    ]
    found += [simple("move-elevation", how, 0.3) for how in ("slack", "within", "stuck")]
    found += [memory("work-azimuth", how, 1.0) for how in ("after face", "after seating", "after azimuth")]
    found += [memory("station-time", "after elevation", 1.0), memory("station-time", "after pause", 90.0)]
    found += [
        memory("count", "after slew", 0.5),
        memory("wound-azimuth", "after tip", 0.25),
        memory("count", EVERY, 12.0),
    ]
    found += [memory("work-elevation", FADES, 300.0), memory("work-distance", FORGETS, 4.0)]
    found += [latch("distance", 5.2, 4.1), latch("elevation", 0.3, -0.2), latch("hall_temperature_c", 21.5, 20.5)]
    found += [
        switch([simple("time", "step", edge) for edge in times]) for times in ((300.0, 900.0), (300.0, 900.0, 1500.0))
    ]
    column, start = passage(Region("xy", (1.0, 2.0), 0.3)), simple("time", "step", -np.inf)
    found += [
        Regressor("product", factors=(column, switch([start, simple("time", "step", 600.0)]))),
        Regressor("product", factors=(column, switch([simple("time", "step", edge) for edge in (300.0, 900.0)]))),
    ]
    found.append(Regressor("product", factors=(smooth("distance", 4), amounts("instrument", 1))))
    return [*found, Regressor("product", factors=(simple("face", "power"), smooth("distance", 4)))]


@pytest.mark.parametrize("clock", [True, False])
def test_every_driver_is_read_as_it_is_told(recording: Recording, clock: bool) -> None:
    assert {*SIMPLE_FUNCTIONS, HYSTERESIS} <= {driver.function for driver in every()}
    for driver in every():
        words = describe(driver, clock=clock)
        read = read_regressor(words, recording.replace(has_clock=clock))
        assert describe(read, clock=clock) == words
        assert read.released == pytest.approx(driver.released, rel=6e-3)
        close = replace(read, constant=driver.constant, released=driver.released, factors=driver.factors)
        assert close == driver and read.constant == pytest.approx(driver.constant, rel=6e-3), words
        assert [f.kind for f in read.factors] == [f.kind for f in driver.factors]


def test_what_a_diagnosis_may_tell_of_a_recording_is_read(recording: Recording) -> None:
    sightings = adjust(recording).sightings
    assert set(READING_COVARIATES) <= set(sightings.quantities)
    tried = regressors_of(sightings)
    for driver in [
        d for kind, some in tried.items() for d in some[:: 25 if kind == "wave" else 1] if kind not in ("room", "clock")
    ]:
        read = read_regressor(describe(driver), recording)
        assert describe(read) == describe(driver)
        assert read.size == driver.size


def test_a_group_tilts_and_the_whole_bends(recording: Recording) -> None:
    words = "press_load_kn times the place in the room"
    group = read_law("place of targets", words, recording, targets=("T01", "T02"))
    assert group.driver == across_the_room([simple("press_load_kn", "power")], 1)[0].centred_on(("T01", "T02"))
    assert read_law("place of targets", words, recording).driver.factors[1].constant == 2


def test_another_amount_for_each_target_goes_with_targets(recording: Recording) -> None:
    law = read_law("height of targets in their nests", "the target, another at each", recording, targets=("T01", "T02"))
    assert len(law.parameters) == 2
    for words in ("the target, another at each", "time times the target, another at each"):
        with pytest.raises(ModelError, match=r"applies to targets, .*:TARGET,TARGET"):
            read_law("place of targets", words, recording)


def test_each_set_up_may_follow_in_its_own_way(recording: Recording) -> None:
    law = read_law("elevation", "exp(-station-time / 8 min), in its own way at each set-up", recording)
    assert law.each and law.stations == recording.stations
    assert len(law.parameters) == len(recording.stations)
    assert not read_law("elevation", "exp(-station-time / 8 min)", recording).each
    with pytest.raises(ModelError, match="applies to all set-ups, not to S2"):
        read_law("elevation", "time, in its own way at each set-up", recording, stations=("S2",))


def test_examples_are_read(recording: Recording) -> None:
    for words in EXAMPLES:
        assert describe(read_regressor(words, recording)) == words


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "expected words such as"),
        ("a smooth function of pressure", "hall_temperature_c"),
        ("exp(-time / 8 deg)", "time in min or in s"),
        ("exp(-time / 0 min)", "above zero"),
        ("step(hall_temperature_c above 20 s)", "hall_temperature_c alone"),
        ("a wave in time, 3 periods a turn", "expected words such as"),
        ("face times pressure", "'pressure' is not a regressor"),
    ],
)
def test_what_is_not_understood_is_answered_with_what_is(recording: Recording, words: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        read_regressor(words, recording)
