"""The examination of diagnoses: it stands alone, makes what it says, and scores as its rules say."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from experiments.intervals import proportion
from ltsim.adjustment import adjust
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.effects import CATALOGUE
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.effects.nest_lift import NestLift
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState, sightings_at_state

PLACE = "experiments.20_concealed_physics."
hall_of, catalogue, law, made, tracker, score, report, entrants = (
    import_module(PLACE + name)
    for name in ("hall", "laws.catalogue", "law", "make", "tracker", "score", "report", "entrants")
)
PLAN = """seed = 5
laws = ["bearings_and_circles"]
clean = 1
catalogued = { 200 = 1 }
"""


def test_programs_with_earlier_answers_to_the_same_truth_stay_in_the_table(tmp_path: Path) -> None:
    row = {"name": "R1", "kind": "clean", "hall": "hall", "law": "", "strength": 0, "given_law_um": 1.0,
           "plain_um": 1.0, "seconds": 1.0, "answered": True, "p_value": 0.5, "probabilities": []}  # fmt: skip
    head = {"plan": "plan", "sha256": "0", "recordings": 1, "draws_excluded": 0}
    report.write_report({"one": [row | {"detected": True}]}, tmp_path, head)
    report.write_report({"two": [row | {"detected": False}]}, tmp_path, head)
    answers = json.loads((tmp_path / "scores.json").read_text())["entrants"]
    assert [answers[who]["false alarms, hall"]["count"] for who in ("one", "two")] == [1, 0]
    assert [
        r["detected"] for entrant_rows in report.read_rows(tmp_path / report.ROWS).values() for r in entrant_rows
    ] == [True, False]
    report.write_report({"three": [row]}, tmp_path, head | {"sha256": "1"})
    assert list(json.loads((tmp_path / "scores.json").read_text())["entrants"]) == ["three"]
    assert list(report.read_rows(tmp_path / report.ROWS)) == ["three"]


def test_a_program_that_is_not_installed_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not entrants.answer(tmp_path, "gama")
    assert "gama-local is not on the PATH" in capsys.readouterr().out


def halls(number: int) -> list[Any]:
    return [hall_of.draw_hall(np.random.default_rng([31, k])) for k in range(number)]


def read(hall: Any, readings: Any, folder: Path) -> Any:
    import_module(PLACE + "recording").write_recording(hall, readings, hall.lengths, folder)
    return lt.read(folder)


def state_of(hall: Any, recording: Any) -> NetworkState:
    """The truth, in the order in which a reader meets stations, targets and instruments."""
    p = hall.pointings
    stations, targets = ([true_names.index(name) for name in theirs] for true_names, theirs in
                         ((hall.stations, recording.stations), (hall.targets, recording.targets)))  # fmt: skip
    return NetworkState(p.position[stations], p.rotation[stations], p.points[targets], p.constants)


@pytest.mark.long
def test_a_third_party_makes_answers_and_scores_without_ltsim(root: Path, tmp_path: Path) -> None:
    """`ltsim` cannot be imported: recordings, a foreign program's answers and scores are made all the same."""
    (tmp_path / "plan.toml").write_text(PLAN)
    program = tmp_path / "mine.py"
    program.write_text(
        "import json, pathlib, sys\n"
        "assert (pathlib.Path(sys.argv[1]) / 'setup.toml').is_file()\n"
        "answer = {'verdict': 'consistent', 'global_test': {'p_value': 0.5}, 'findings': []}\n"
        "(pathlib.Path(sys.argv[2]) / 'diagnosis.json').write_text(json.dumps(answer))\n"
    )
    (tmp_path / "no" / "ltsim").mkdir(parents=True)
    (tmp_path / "no" / "ltsim" / "__init__.py").write_text("raise ImportError('not installed')\n")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path / 'no'}{os.pathsep}{root}"}
    work = str(tmp_path / "work")
    for words in (
        ["make", str(tmp_path / "plan.toml"), work],
        ["answer", work, "mine", "--command", f"{sys.executable} {program} {{recording}} {{out}}"],
        ["score", work, "mine", "--out", str(tmp_path / "scores")],
    ):
        command = [sys.executable, "-m", "experiments.20_concealed_physics", *words]
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    scores = json.loads((tmp_path / "scores" / "scores.json").read_text())
    mine = scores["entrants"]["mine"]
    assert mine["false alarms, hall"]["count"] == 0
    assert (mine["catalogued hall 200: detected"]["count"], mine["catalogued hall 200: detected"]["total"]) == (0, 12)
    assert "| catalogued hall 200: detected | 0 of 12 " in (tmp_path / "scores" / "table.md").read_text()


def test_a_truth_that_was_changed_is_not_scored(tmp_path: Path) -> None:
    main = import_module(PLACE + "__main__")
    (tmp_path / "plan.toml").write_text('seed = 5\nlaws = ["bearings_and_circles"]\nclean = 1\n')
    made.make(made.read_plan(tmp_path / "plan.toml"), tmp_path)
    (tmp_path / made.TRUTH).write_text((tmp_path / made.TRUTH).read_text().replace("clean", "dirty"))
    with pytest.raises(SystemExit, match="checksum"):
        main.score(tmp_path, ["ltsim"], tmp_path, "plan")


@pytest.mark.parametrize("number", range(3))
def test_both_simulators_read_the_same(number: int, tmp_path: Path) -> None:
    hall = halls(number + 1)[number]
    mine = hall.pointings.readings()
    recording = read(hall, mine, tmp_path)
    gap = mine - MeasurementModel(recording, misalignment_construction()).predict(state_of(hall, recording))
    gap[:, 1] = wrap_angle(gap[:, 1])
    assert np.abs(gap).max() < 1e-9
    assert misalignment_construction().parameter_names == tracker.CONSTANTS


def effect_of(name: str, cause: Any, order: int) -> Effect:
    """The catalogue's effect at the place and shape of a cause."""
    kind = next(k for k in CATALOGUE if k.name == name)
    stations, targets, shape = tuple(cause.words["stations"]), tuple(cause.words["targets"]), cause.words["shape"]
    constants: dict[str, Any] = {"stations": stations, "targets": targets}
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
    return NestLift(stations, targets, "normal") if name == "nest-lift" else kind(**constants)


@pytest.mark.parametrize("name", list(catalogue.KNOWN))
def test_a_catalogued_cause_does_what_the_catalogue_says(name: str, tmp_path: Path) -> None:
    faces = 1 if name == "backlash" else 2
    hall = next(h for h in halls(20) if h.pointings.face.max() == faces)
    cause = catalogue.KNOWN[name](hall, np.random.default_rng(32))
    factors = {"um": 1e-6, "urad": 1e-6, "ppm": 1e-6, "um/h": 1e-6 / 3600, "urad/h": 1e-6 / 3600, "": 1.0}
    values = cause.values * [factors[unit] for unit in cause.units]
    recording = read(hall, hall.pointings.readings(), tmp_path)
    sightings = sightings_at_state(recording, state_of(hall, recording))
    change, fits = cause.change, []
    for order in range(3, 7) if name == "azimuth-harmonic" else (3,):
        effect = effect_of(name, cause, order)
        assert tuple(p.name for p in effect.parameters) == cause.names
        if isinstance(effect, NoiseEffect):
            theirs = effect.variance(sightings, hall.sigma, values) / hall.sigma**2 - 1.0
            fits.append(np.abs(theirs - change.variance).max())
            continue
        mine = hall.pointings.readings(change) - hall.pointings.readings()
        mine[:, 1] = wrap_angle(mine[:, 1])
        theirs = effect.reading_change(sightings, values)
        assert np.abs(mine).max() > 1e-6
        # The catalogue takes the geometry of the ideal tracker: errors of 1e-4 rad change a change by as much.
        fits.append(np.abs(mine - theirs).max() / np.abs(mine).max())
    assert min(fits) < 2e-3


@pytest.mark.parametrize(
    ("name", "strength"),
    [
        ("a-warm-curtain-hangs-in-the-gate-while-it-is-open", 200),
        ("one-leg-stands-on-a-soft-tile", 200),
        ("the-upright-bar-was-certified-lying-down", 6),
    ],
)
def test_strength_is_what_the_adjustment_leaves(name: str, strength: int, tmp_path: Path) -> None:
    """Without noise the law leaves its strength in the chi-square of ltsim's adjustment."""
    write = import_module(PLACE + "recording").write_recording
    case = made.Case(33, "unknown", "hall", name, strength, 0, ("used",))
    hall, _, _, change = made.draw_case(case, made.Counter())
    wrong = 0.0 if change.lengths is None else change.lengths
    strengths = []
    for part in (-1.0, 0.0, 1.0):  # either way: what the prior of the constants leaves has no part in the mean
        folder = tmp_path / str(part)
        write(hall, hall.pointings.readings(change.scaled(part)), hall.lengths + part * wrong, folder)
        strengths.append(adjust(lt.read(folder), misalignment_construction()).chi2)
    assert 0.5 * (strengths[0] + strengths[2]) - strengths[1] == pytest.approx(strength, rel=0.1)


def test_a_large_hall_has_above_500_unknowns() -> None:
    hall = hall_of.draw_hall(np.random.default_rng(3), "large")
    assert 6 * (len(hall.stations) - 1) + 3 * len(hall.targets) + 16 * len(hall.trackers) > 500
    sighted = np.unique(np.stack([hall.pointings.station, hall.pointings.target]), axis=1)[1]
    assert np.bincount(sighted).min() >= 3


def test_every_law_acts_somewhere_and_names_what_exists() -> None:
    laws, words = law.laws_of(("used", "fresh")), score.GEOMETRY | {"time", "approach", "temperature"}
    missing, columns = set(laws), {hall_of.WARMTH, hall_of.LOAD}
    for number, hall in enumerate(halls(20)):
        for name in sorted(missing):
            try:
                change = laws[name].draw(hall, np.random.default_rng([35, number]))
            except LookupError:
                continue
            if any(part.any() for part in change.parts.values()):
                missing.discard(name)
            assert all(np.isfinite(part).all() for part in change.parts.values()), name
    assert not missing
    for entry in laws.values():
        assert {w for item in (*entry.follows, entry.optional) for w in item} <= words | columns, entry.name


def finding(**more: Any) -> dict[str, Any]:
    where = {"observables": ["elevation"], "stations": [], "targets": [], "instruments": [], "covariates": ["time"]}
    bare = {"effect": "unknown", "carrier": "elevation", "where": where, "parameters": [], "equivalents": []}
    content = copy.deepcopy(bare | {"evidence": {"probability": 0.8}})
    for key, value in more.items():
        (content["where"] if key in where else content)[key] = value
    return content


HIDDEN = {
    "carriers": ["elevation"], "strengths": [1.0, 2.0, 97.0, 0.0], "follows": [["time"], ["height", "place"]],
    "may": ["distance"], "stations": [], "targets": [], "instruments": [],
}  # fmt: skip


@pytest.mark.parametrize(
    ("reported", "observable", "all_covariates", "outside"),
    [
        (finding(covariates=["time", "height"]), True, True, False),
        (finding(covariates=["time", "place", "distance"]), True, True, False),
        (finding(), True, False, False),
        (finding(covariates=["time", "height", "face"]), True, False, False),
        (finding(covariates=[]), True, False, True),
        (finding(covariates=["time", "height"], outside=True), True, False, True),
        (finding(covariates=[], observables=["azimuth"]), False, False, False),
        (finding(effect="index-drift", covariates=["time", "height"]), False, False, False),
        (finding(carrier="vertical index", covariates=["time"]), True, True, False),
    ],
)
def test_a_law_is_scored_by_the_rules(
    reported: dict[str, Any], observable: bool, all_covariates: bool, outside: bool
) -> None:
    row = score._law_scores(HIDDEN, reported)
    assert (row["observable"], row["all_covariates"], row["outside"]) == (observable, all_covariates, outside)
    assert row["covariates_or_outside"] == (all_covariates or outside)


def test_a_motion_is_right_as_itself_or_by_its_observables() -> None:
    hidden = HIDDEN | {"carriers": ["station"], "follows": [["time"]], "strengths": [50.0, 0.0, 50.0, 0.0]}
    assert score.observable_right(hidden, finding(carrier="lean of the stand", observables=[]))
    assert score.observable_right(hidden, finding(observables=["distance", "elevation"]))
    assert not score.observable_right(hidden, finding())


def test_intervals_are_wider_where_recordings_of_a_law_are_correlated() -> None:
    hits, alone = [True] * 15 + [False] * 15, [str(k) for k in range(30)]
    independent, clustered = proportion(hits, alone), proportion(hits, [str(k // 5) for k in range(30)])
    assert clustered["design_effect"] == pytest.approx(5.0) and independent["design_effect"] == 1.0
    assert clustered["high"] - clustered["low"] > 1.8 * (independent["high"] - independent["low"])
    assert proportion([True] * 30, alone)["low"] > proportion([True] * 30, ["a", "b", "c"] * 10)["low"]


def test_intervals_hold_what_they_say() -> None:
    """400 examinations of 40 laws, each right in a share of its own and asked 4 times: 95 % +- 3 % hold the truth."""
    rng, held = np.random.default_rng(4), 0
    for _ in range(400):
        rates = np.repeat(rng.beta(2.0, 1.0, 40), 4)
        part = proportion((rng.random(160) < rates).tolist(), [str(k // 4) for k in range(160)])
        held += part["low"] <= 2 / 3 <= part["high"]
    assert 0.92 <= held / 400 <= 0.985
