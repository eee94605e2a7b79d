"""The ladder of simple causes: its simulator and its peers fit the declared noise, and rungs are judged as stated."""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

import ltsim as lt
from experiments.__main__ import FOLDERS

ladder, hall, peers = (import_module(f"experiments.29_ladder.{name}") for name in ("run", "hall", "peers"))
SETTINGS = tomllib.loads((FOLDERS["29"] / "config.toml").read_text(encoding="utf-8"))


def hall_of(number: int) -> hall.Hall:
    return hall.Hall.of(SETTINGS["hall"][number], SETTINGS["noise"], SETTINGS["seed"] + number)


def rung_of(number: int, name: str, rung: int) -> tuple[hall.Observations, hall.Cause]:
    true_hall = hall_of(number)
    for row, cause, noise in ladder.rungs_of(true_hall, SETTINGS):
        if (row["cause"], row.get("rung")) == (name, rung):
            return hall.Observations.of(true_hall, cause, noise), cause
    raise LookupError(name)


@pytest.mark.parametrize("number", range(len(SETTINGS["hall"])))
def test_recordings_without_a_cause_fit_the_declared_noise(number: int, tmp_path: Path) -> None:
    observations = hall.Observations.of(hall_of(number))
    for file in (observations.write(tmp_path / "recording"), peers.gama_file(observations, tmp_path / "gama")):
        fit = lt.adjust(lt.read(file)).fit
        assert fit.chi2 == pytest.approx(fit.dof, abs=4.0 * np.sqrt(2.0 * fit.dof))
    assert np.abs(peers.snooping(observations).points - observations.hall.points).max() < 60e-6


@pytest.mark.parametrize("number", range(len(SETTINGS["hall"])))
def test_every_cause_changes_something_and_the_first_rung_has_its_noncentrality(number: int) -> None:
    true_hall, small = hall_of(number), 1e-3
    for row, cause, noise in ladder.rungs_of(true_hall, SETTINGS):
        if cause is None:
            continue
        clean, changed = hall.Observations.of(true_hall, None, noise), hall.Observations.of(true_hall, cause, noise)
        same = np.array_equal(clean.readings, changed.readings) and clean.length == changed.length
        same &= all(np.array_equal(clean.control[k], changed.control[k]) for k in clean.control)
        assert not same or not np.array_equal(clean.target, changed.target) or changed.noise_factor != 1.0
        if row["unit"] and row["rung"] == 1:
            tiny = hall.Cause(cause.name, small * cause.size, cause.station, cause.target)
            strength = peers.noncentrality(true_hall, hall.Observations.of(true_hall, tiny, noisy=False)) / small**2
            assert strength == pytest.approx(SETTINGS["noncentrality"], rel=0.02)


def test_snooping_names_a_wrong_distance_and_all_entrants_are_judged() -> None:
    observations, cause = rung_of(2, "one distance", 2)
    place = observations.hall.place(cause)
    answer = peers.snooping(observations)
    assert place.includes(answer.stations, answer.targets)
    rows = ladder.rungs(observations.hall, [None, cause], 3, ["check", "adjust", "snooping"])
    assert rows == 2 * [{"check": "right", "adjust": "right", "snooping": "right"}]


def test_verdicts() -> None:
    place = hall.Place(targets=frozenset({"K07"}))
    cause = hall.Cause("target moved", 1e-3, 0, 6)
    assert place.includes({"S2"}, {"K07"}) and not place.includes(set(), {"K07", "K08"})
    elsewhere = ladder.Report(np.zeros((1, 3)), False, True, True)
    assert ladder.verdict("diagnose", elsewhere, cause, False) == "place, elsewhere, coordinates"
    assert ladder.verdict("adjust", elsewhere, cause, True) == "right: coordinates"
    assert ladder.verdict("adjust", elsewhere, cause, False) == "place, coordinates"
    assert ladder.verdict("adjust", ladder.Report(None, True, False, True), cause, False) == "right: place"
    assert ladder.verdict("check", ladder.Report(None, True, False, False), cause, False) == "passes"
    assert ladder.verdict("adjust", elsewhere, None, True) == "false report"
    assert ladder.says("no-go: the distances to K07 are 1 mm too long", place)
    assert not ladder.says("no-go: the distances to K071 are 1 mm too long", place)


def test_the_largest_residual_of_gama_is_its_report() -> None:
    text = """<gama><coordinates><adjusted><point><id>K01</id><x>1.0</x><y>2.0</y><z>3.0</z></point></adjusted>
    </coordinates><observations><distance><from>S1</from><to>K01</to><std-residual>{}</std-residual></distance>
    <direction><from>S2</from><to>K01</to><std-residual>0.5</std-residual></direction></observations></gama>"""
    answer = peers.gama_answer(fromstring(text.format(9.0)), 2)
    assert (answer.stations, answer.targets) == ({"S1"}, {"K01"})
    assert answer.points[0].tolist() == [1.0, 2.0, 3.0] and np.isnan(answer.points[1]).all()
    assert peers.gama_answer(fromstring(text.format(1.0)), 1).targets == set()
