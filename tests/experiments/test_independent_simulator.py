"""The second simulator: it shares no formula with ltsim, and gives the same readings for the same constants."""

from __future__ import annotations

import ast
import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.effects import CATALOGUE
from ltsim.effects.effect import Effect, NoiseEffect
from ltsim.effects.nest_lift import NestLift
from ltsim.geometry.polar import wrap
from ltsim.model.construction import misalignment
from ltsim.model.measurement import MeasurementModel, State, sightings_of
from ltsim.randomness import stream

PLACE = "experiments.20_concealed_physics.concealed."
causes, hall_of, known, made, tracker = (
    import_module(f"{PLACE}independent.{name}") for name in ("cause", "hall", "known", "make", "tracker")
)
plan, conceal = import_module(f"{PLACE}plan"), import_module(f"{PLACE}conceal")
ALLOWED = {"numpy", "scipy", "ltsim.recording"}
STANDARD = {"__future__", "collections", "dataclasses", "functools", "typing"}


def state_of(hall: Any) -> State:
    p = hall.pointings
    return State(p.position, p.rotation, p.points, p.constants)


def halls(number: int) -> list[Any]:
    return [hall_of.draw_hall(stream(31, "halls", k)) for k in range(number)]


def test_it_imports_numpy_and_the_recording_alone(root: Path) -> None:
    folder = root / "experiments" / "20_concealed_physics" / "concealed" / "independent"
    files = sorted(folder.glob("*.py"))
    assert len(files) >= 6
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level < 2, f"{file.name}: {node.module}"
                names = [] if node.level else [node.module or ""]
            for name in names:
                known_one = name.split(".")[0] in STANDARD or any(
                    name == a or name.startswith(f"{a}.") for a in ALLOWED
                )
                assert known_one, f"{file.name} imports {name}"


@pytest.mark.parametrize("number", range(4))
def test_both_simulators_read_the_same(number: int) -> None:
    hall = halls(number + 1)[number]
    ours = MeasurementModel(hall.recording(hall.pointings.readings(), hall.lengths), misalignment()).predict(
        state_of(hall)
    )
    gap = hall.pointings.readings() - ours
    gap[:, 1] = wrap(gap[:, 1])
    assert np.abs(gap).max() < 1e-9
    assert misalignment().names == tracker.CONSTANTS


def effect_of(name: str, cause: Any, order: int = 3) -> Effect:
    """The catalogue's effect at the place and shape of a cause."""
    kind = next(k for k in CATALOGUE if k.name == name)
    constants: dict[str, Any] = {"stations": cause.stations, "targets": cause.targets}
    shape = dict(cause.shape)
    if "time" in shape:
        constants["time"] = shape["time"]
    if "time_constant" in shape:
        constants |= {"law": "exponential", "time_constant": 60.0 * shape["time_constant"]}
    if "wavelength" in shape:
        constants["wavelength"] = 1e-3 * shape["wavelength"]
    if name in ("index-drift", "azimuth-drift"):
        constants["law"] = "visit" if name == "azimuth-drift" else "linear"
    if name == "azimuth-harmonic":
        constants["order"] = order
    if name == "nest-lift":
        return NestLift(cause.stations, cause.targets, "normal")
    return kind(**constants)


@pytest.mark.parametrize("name", list(known.KNOWN))
def test_a_catalogued_cause_does_what_the_catalogue_says(name: str) -> None:
    faces = 1 if name == "backlash" else 2
    hall = next(h for h in halls(20) if h.pointings.face.max() == faces)
    cause = known.KNOWN[name](hall, stream(32, name))
    factors = {"um": 1e-6, "urad": 1e-6, "ppm": 1e-6, "um/h": 1e-6 / 3600, "urad/h": 1e-6 / 3600, "": 1.0}
    units = cause.unit.split() or [""]
    values = cause.values * [factors[u] for u in (units if len(units) > 1 else units * len(cause.names))]
    recording = hall.recording(hall.pointings.readings(), hall.lengths)
    sightings = sightings_of(recording, state_of(hall))
    change = cause.change()
    fits = []
    for order in range(3, 7) if name == "azimuth-harmonic" else (3,):
        effect = effect_of(name, cause, order)
        assert tuple(p.name for p in effect.parameters) == cause.names
        if isinstance(effect, NoiseEffect):
            theirs = effect.variance(sightings, hall.sigma, values) / hall.sigma**2 - 1.0
            fits.append(np.abs(theirs - change.variance).max())
            continue
        mine = hall.pointings.readings(change) - hall.pointings.readings()
        mine[:, 1] = wrap(mine[:, 1])
        theirs = effect.shift(sightings, values)
        assert np.abs(mine).max() > 1e-6
        # The catalogue takes the geometry of the ideal tracker: errors of 1e-4 rad change a change by as much.
        fits.append(np.abs(mine - theirs).max() / np.abs(mine).max())
    assert min(fits) < 2e-3


@pytest.mark.parametrize("laws", list(made.SETS))
def test_its_least_squares_agrees_with_the_adjustment(laws: str) -> None:
    """A silent hall with a cause: the chi-square that is left is the strength."""
    halls_made = (made.make("unknown", 200, k, stream(33, k), stream(34, k), laws) for k in range(9))
    there = next(hall for hall in halls_made if hall.truth["stations"] < 6 and hall.change.any())
    silent = there.silent
    left = [
        lt.calibrate(silent.with_readings(silent.readings + share * there.change)).adjustment.chi2
        for share in (0.0, 1.0)
    ]
    assert left[1] - left[0] == pytest.approx(200.0, rel=0.25)


def test_no_name_is_in_two_sets_of_laws_or_in_the_catalogue() -> None:
    names = [name.replace(" ", "-") for laws in made.SETS.values() for name in laws]
    names += [kind.name for kind in CATALOGUE]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("laws", list(made.SETS.values()), ids=list(made.SETS))
def test_every_law_acts_and_says_how_it_is_told(laws: dict[str, Any]) -> None:
    assert len(laws) == 24
    missing = set(laws)
    for number, hall in enumerate(halls(20)):
        for name in sorted(missing):
            try:
                cause = laws[name](hall, stream(35, name, number))
            except LookupError:
                continue
            parts = {k: v for k, v in vars(cause.change).items() if v is not None}
            assert parts and all(np.isfinite(v).all() for v in parts.values())
            assert cause.drivers and causes.CARRIERS[cause.carrier]
            assert set(cause.stations) <= set(hall.stations) and set(cause.targets) <= set(hall.targets)
            if any(v.any() for v in parts.values()):
                missing.discard(name)
    assert not missing


@pytest.mark.parametrize(
    ("name", "laws", "times"),
    [
        ("eleventh", "sixth", {200: 1, 600: 1}),
        ("thirteenth", "seventh", {200: 1, 600: 1}),
        ("fourteenth", "eighth", {90: 1, 200: 1, 600: 1}),
        ("fifteenth", "ninth", {90: 1, 200: 2, 600: 2}),
        ("sixteenth", "tenth", {90: 1, 200: 2, 600: 2}),
        ("seventeenth", "eleventh", {90: 1, 200: 2, 600: 2}),
        ("eighteenth", "twelfth", {90: 1, 200: 2, 600: 2}),
    ],
)
def test_the_plan_asks_every_law_at_its_strengths(
    name: str, laws: str, times: dict[int, int], root: Path, tmp_path: Path
) -> None:
    cases = plan.read_plan(root / "experiments" / "20_concealed_physics" / f"{name}.toml")
    for strength, count in times.items():
        numbers = sorted(c.number for c in cases if (c.kind, c.strength) == ("unknown", strength))
        assert numbers == list(range(24 * count))
    assert all(c.independent and c.laws == laws for c in cases)
    case = next(c for c in cases if (c.kind, c.strength, c.number) == ("unknown", 200, 0))
    conceal.conceal(case, tmp_path / "recordings", tmp_path / "sealed")
    truth = json.loads((tmp_path / "sealed" / f"{case.name}.json").read_text(encoding="utf-8"))
    assert truth["effects"][0]["text"].split("'")[1] == next(iter(made.SETS[laws]))


def test_a_plan_keeps_its_recordings(root: Path, tmp_path: Path) -> None:
    cases = plan.read_plan(root / "experiments" / "20_concealed_physics" / "eleventh.toml")
    case = next(c for c in cases if (c.kind, c.strength, c.number) == ("single", 200, 3))
    for folder in ("a", "b"):
        conceal.conceal(case, tmp_path / folder / "recordings", tmp_path / folder / "sealed")
    for file in (f"recordings/{case.name}/observations.csv", f"sealed/{case.name}.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    truth = json.loads((tmp_path / "a" / "sealed" / f"{case.name}.json").read_text(encoding="utf-8"))
    assert truth["effects"][0]["effect"] == "azimuth-harmonic"
    assert truth["effects"][0]["strength"] == pytest.approx(200.0, rel=1e-2)
    text = (tmp_path / "a" / "recordings" / case.name / "setup.toml").read_text(encoding="utf-8")
    assert not [kind.name for kind in CATALOGUE if kind.name in text]


@pytest.mark.parametrize("line", ['simulator = "none"', 'simulator = "independent"\nlaws = "all"', 'laws = "seventh"'])
def test_a_plan_with_a_wrong_simulator_or_set_of_laws_is_refused(line: str, tmp_path: Path) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(f"seed = 1\n{line}\n", encoding="utf-8")
    with pytest.raises(SystemExit, match="not one of"):
        plan.read_plan(file)


@pytest.mark.parametrize(
    ("effect", "carrier", "driver", "right"),
    [
        ("unknown", "stand about x", "a smooth function of time", (True, True)),
        ("unknown", "elevation", "a smooth function of press_load_kn", (False, True)),
        ("unknown", "stand upwards", "a wave in azimuth, 1 period a turn", (True, False)),
        ("station-bump", "stand", "time", (False, False)),
    ],
)
def test_carrier_and_driver_are_right_in_the_words_of_the_law(
    effect: str, carrier: str, driver: str, right: tuple[bool, bool]
) -> None:
    score = import_module(f"{PLACE}score")
    told_as = {"carrier": causes.CARRIERS["station"], "driver": ("press_load_kn", "load", "time")}
    finding = {"effect": effect, "carrier": carrier, "driver": driver, "where": {"covariates": []}}
    told = score._explained(told_as, finding)
    assert (told["right_carrier"], told["right_driver"]) == right
    assert told["right_carrier_or_driver"] == any(right)
    assert not any(score._explained(told_as, None).values())


def test_scatter_is_told_as_noise() -> None:
    score = import_module(f"{PLACE}score")
    truth = {"kind": "unknown", "effects": [{"words": {"carrier": "noise"}}]}
    assert {"unknown", "turbulence", "station-noise"} <= score._rightly(truth)
    assert score._rightly({"kind": "unknown", "effects": [{}]}) == {"unknown"}
    assert score._rightly({"kind": "clean", "effects": []}) == set()
