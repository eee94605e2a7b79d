"""A part of a scenario's stations and reflectors: what goes with those that are left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.simulation.scenario import change_scenario, load_scenario, space_filling_order

FILE = Path("changed.toml")


def test_effects_and_trackers_go_with_their_places() -> None:
    base = load_scenario("two-trackers")
    last = list(base.stations)[-1]
    effects = [
        {"name": "head-sag", "stations": [last]},
        {"name": "head-sag", "stations": ["S1", last]},
        {"name": "head-sag"},
    ]
    first = base.stations["S1"].instrument
    few = change_scenario(base, {"effects": effects, "work.stations": 1}, FILE)
    assert list(few.stations) == ["S1"] and list(few.instruments) == [first]
    assert [entry.stations for entry in few.effects] == [("S1",), ()]
    assert change_scenario(few, {}, FILE) == few


def test_reflectors_fill_the_room_before_they_crowd() -> None:
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0))
    places = np.column_stack([x.ravel(), y.ravel(), np.zeros(49)])
    order = space_filling_order(places)
    assert sorted(order) == list(range(49))
    assert {tuple(places[k, :2]) for k in order[:4]} == {(0, 0), (0, 6), (6, 0), (6, 6)}
    assert tuple(places[order[4], :2]) == (3, 3)
