"""`ltsim accept`: what a person gives and gets."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.acceptance.network import evaluate_network
from ltsim.acceptance.spec import AcceptanceSettings
from ltsim.acceptance.tested_network import TestedNetwork
from ltsim.adjustment import adjust
from ltsim.cli.main import run
from ltsim.core.errors import InputError, NetworkError
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Station
from ltsim.recordings.specification import Specification

SHEET = {"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"}
PLAN = """test,group,kind,x1_mm,y1_mm,z1_mm,x2_mm,y2_mm,z2_mm
bar,bar,length,3000,-1150,0,3000,1150,0
ball,faces,two-face,2000,0,-1500,,,
"""


def write(folder: Path, text: str, **files: str) -> Path:
    for name, content in files.items():
        (folder / f"{name}.csv").write_text(content, encoding="utf-8")
    file = folder / "mine.toml"
    file.write_text('format = "ltsim-acceptance/1"\n' + text + "\n", encoding="utf-8")
    return file


def test_predicted_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path, 'standard = "asme-b89.4.19-2006"\ninstrument = "leica-at500"')
    assert run(["accept", str(file), "--out", str(tmp_path / "out")]) == 0
    output = capsys.readouterr().out
    assert "passes all 74 tests with a probability of" in output
    assert "No test detects azimuth-second-order-cos, elevation-eccentricity-cos" in output
    content = json.loads((tmp_path / "out" / "accept.json").read_text())
    assert len(content["tests"]) == 74
    assert run(["report", str(tmp_path / "out")]) == 0
    assert "Errors over limits" in (tmp_path / "out" / "report.html").read_text()
    assert run(["accept", str(file), "--out", str(tmp_path / "out")]) == 0, "its own result is replaced"


def test_a_calibrated_instrument_as_it_reads_and_corrected(tmp_path: Path) -> None:
    recording, _ = lt.simulate("paper-workshop-two-face", seed=2)
    assert run(["calibrate", str(_written(recording, tmp_path)), "--out", str(tmp_path / "cal"), "--quiet"]) == 0
    as_read = lt.accept({**SHEET, "calibration": "cal"}, tmp_path)
    corrected = lt.accept({**SHEET, "calibration": "cal", "corrected": True}, tmp_path)
    assert corrected.pass_probability > as_read.pass_probability
    largest = [max(abs(t.error_um) for t in result.tests) for result in (as_read, corrected)]
    assert largest[1] < 0.1 * largest[0]


def _written(recording: object, folder: Path) -> Path:
    lt.write(recording, folder / "rec")  # type: ignore[arg-type]
    return folder / "rec"


def test_measured_errors_are_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = 'tests_file = "plan.csv"\ninstrument = "leica-at500"\nmeasured_errors_file = "found.csv"'
    file = write(tmp_path, text, plan=PLAN, found="test,error_um,U_um\nbar,-12.5,4\nball,30,2\n")
    assert run(["accept", str(file)]) == 0
    assert "All 2 measured errors are within their limits" in capsys.readouterr().out
    file = write(tmp_path, text, plan=PLAN, found="test,error_um,U_um\nbar,-62.5,\nball,30,20\n")
    assert run(["accept", str(file)]) == 1
    output = capsys.readouterr().out
    assert "1 of 2 errors exceeds its limit; the worst is bar: -62.5 um where 45.7 um are permitted" in output
    assert "without an uncertainty and compared with their limits alone: 1 of 2" in output
    file = write(tmp_path, text, plan=PLAN, found="test,error_um\nbar,-2.5\n")
    assert run(["accept", str(file)]) == 1
    output = capsys.readouterr().out
    assert (
        "tests of the plan that are not measured: 1" in output
        and "Measure the other tests of the plan: ball." in output
    )


@pytest.mark.parametrize(
    ("errors", "judgement", "headline", "action"),
    [
        ("bar,-12.5,4\nball,30,2\n", "accepted", "All errors are within the limits.", ""),
        (
            "bar,-62.5,4\nball,30,2\n",
            "rejected",
            "Some errors exceed the limits.",
            "Repeat bar: it stays rejected unless its error is smaller by 12.8",
        ),
        ("bar,-62.5,4\nball,60,30\n", "rejected", "Some errors exceed the limits.", "Repeat bar: it stays rejected"),
        (
            "bar,-62.5,4\nball,90,2\n",
            "rejected",
            "Some errors exceed the limits.",
            "repeat all tests: bar, ball exceed their limits.",
        ),
        (
            "bar,-43.5,4\nball,30,2\n",
            "undecided",
            "No error demonstrably exceeds its limit",
            "an expanded uncertainty of bar below 2.2",
        ),
        (
            "bar,-43.5,4\nball,45,20\n",
            "undecided",
            "No error demonstrably exceeds its limit",
            "all 2 undecided errors would be accepted with uncertainties",
        ),
        (
            "bar,-47.5,4\nball,30,2\n",
            "undecided",
            "No error demonstrably exceeds its limit",
            "rejects the tracker, because this error of 47.5",
        ),
        ("bar,-12.5,4\n", "undecided", "No error demonstrably exceeds its limit", "Measure the other tests"),
        ("bar,-12.5,\nball,30,\n", "accepted", "All errors are within the limits.", ""),
        ("bar,-62.5,\nball,30,\n", "rejected", "Some errors exceed the limits.", "Repeat bar: "),
    ],
)
def test_the_verdict_is_the_same_in_json_terminal_page_and_status(
    errors: str, judgement: str, headline: str, action: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By ISO 14253-1; the limit of the bar is 45.7 um."""
    text = 'tests_file = "plan.csv"\ninstrument = "leica-at500"\nmeasured_errors_file = "found.csv"'
    file, out = write(tmp_path, text, plan=PLAN, found=f"test,error_um,U_um\n{errors}"), tmp_path / "out"
    assert run(["accept", str(file), "--out", str(out)]) == (judgement != "accepted")
    printed = capsys.readouterr().out
    assert (
        f"judgement: {judgement};" in printed and action in printed and ("What to do next" in printed) == bool(action)
    )
    assert json.loads((out / "accept.json").read_text())["judgement"] == judgement
    assert run(["report", str(out), "-q"]) == 0
    page = (out / "report.html").read_text()
    assert headline in page and action in page


def test_the_template_has_every_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["accept", "--show"]) == 0
    lines = [line.removeprefix("# ") for line in capsys.readouterr().out.splitlines()]
    for model in (AcceptanceSettings, Specification):
        missing = set(model.model_fields) - {"source", "range_offset_limit_um", "noise_variance_fraction"}
        assert {key for key in missing if not any(re.match(rf"{key} = |\[{key}\]", line) for line in lines)} == set()


def test_tables_with_semicolons_and_decimal_commas_are_read(tmp_path: Path) -> None:
    """As a German spreadsheet writes them: the same answer as from commas and points."""
    answers = []
    for bar, mark, comma in (("-12.5", ",", "."), ("-12,5", ";", ",")):
        plan = "# drawn up by hand\n" + PLAN.replace(",", mark).replace("1150", f"1150{comma}25")
        errors = mark.join(("test", "error_um", "U_um")) + f"\nbar{mark}{bar}{mark}4\n\nball{mark}30{mark}2\n"
        text = 'tests_file = "plan.csv"\ninstrument = "leica-at500"\nmeasured_errors_file = "found.csv"'
        file = write(tmp_path, text, plan=plan, found=errors)
        answers.append(lt.accept(file).model_dump(exclude={"recording"}))
    assert answers[0] == answers[1]
    assert answers[0]["tests"][0]["error_um"] == -12.5


PERMITS_NOTHING = """standard = "asme-b89.4.19-2006"
[specification]
transverse_limit_um = {transverse}
transverse_limit_um_per_m = 0
range_limit_um = {range}
range_limit_um_per_m = 0
"""


@pytest.mark.parametrize(
    ("text", "plan", "measured", "message"),
    [
        ('standard = "asme-b89.4.19-2006"', PLAN, "", "instrument or the table [specification]"),
        ('instrument = "leica-at500"', PLAN, "", "either standard or tests"),
        (
            PERMITS_NOTHING.format(range=0, transverse=1),
            PLAN,
            "",
            "range_limit_um and range_limit_um_per_m should not both be 0",
        ),
        (
            PERMITS_NOTHING.format(range=1, transverse=0),
            PLAN,
            "",
            "transverse_limit_um and transverse_limit_um_per_m should not both be 0",
        ),
        ('instrument = "leica-at5"\nstandard = "asme-b89.4.19-2006"', PLAN, "", "did you mean leica-at500"),
        ('instrument = "leica-at500"\ntests_file = "plan.csv"', PLAN.replace("two-face", "face"), "", "kind is 'face'"),
        (
            'instrument = "leica-at500"\ntests_file = "plan.csv"',
            PLAN.replace("3000,1150", "3000,x"),
            "",
            "row 2, column y2_mm: found 'x', expected a number",
        ),
        (
            'instrument = "leica-at500"\ntests_file = "plan.csv"',
            PLAN.replace("2000,0", "0,0"),
            "",
            "vertical axis of the instrument",
        ),
        (
            'instrument = "leica-at500"\ntests_file = "plan.csv"\nmeasured_errors_file = "found.csv"',
            PLAN,
            "test,error_um\nbat,1\n",
            "row 2: there is no test called 'bat'; did you mean bar",
        ),
    ],
)
def test_wrong_input_is_refused_in_a_sentence(
    text: str, plan: str, measured: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["accept", str(write(tmp_path, text, plan=plan, found=measured))]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_lengths_of_a_standard_that_no_open_text_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = 'standard = "iso-10360-10"\ninstrument = "leica-at500"'
    assert run(["accept", str(write(tmp_path, text))]) == 2
    error_text = capsys.readouterr().err
    assert error_text.endswith(
        "give additional_tests_file = FILE, because the length tests of iso-10360-10 are not built in\n"
    )
    assert run(["accept", str(write(tmp_path, f'{text}\nadditional_tests_file = "plan.csv"', plan=PLAN))]) == 0
    assert "passes all 20 tests" in capsys.readouterr().out


def test_network_method(tmp_path: Path) -> None:
    """A good instrument keeps its maker's limits on its own network; one with a tilted beam does not."""
    sheet = {
        "specification": {
            "transverse_limit_um": 15,
            "transverse_limit_um_per_m": 6,
            "range_limit_um": 20,
            "range_limit_um_per_m": 1,
        }
    }
    verdicts = []
    for tilt in (0.5, 60.0):
        errors = {"draw": False, "beam-tilt": tilt}
        recording, _ = lt.simulate(lt.scenario("paper-workshop-two-face", {"instrument.errors": errors}), seed=4)
        lt.write(recording, tmp_path / f"rec{tilt:g}")
        verdicts.append(lt.accept({**sheet, "recording": f"rec{tilt:g}"}, tmp_path))
    good, bad = verdicts
    assert good.judgement in ("accepted", "undecided")
    assert bad.judgement == "rejected" and "exceed their limits" in bad.sentence
    assert "two-face" in {g.name for g in bad.groups if g.judgement == "rejected"}
    assert np.isfinite(
        [np.nan if t.expanded_uncertainty_um is None else t.expanded_uncertainty_um for t in good.tests]
    ).all()
    assert "without an uncertainty" not in good.sentence and good.decision_rule.startswith("By ISO 14253-1, an error e")
    assert " two-face: " in bad.sentence and " +- 0.0 um where " in bad.sentence
    assert bad.next_actions == (
        "Have the maker adjust the tracker, or correct all readings by ltsim calibrate and ltsim correct. After this "
        "correction no error is rejected.",
    )
    lt.write(lt.correct(recording, lt.calibrate(recording)), tmp_path / "corrected")
    corrected = lt.accept({**sheet, "recording": "corrected"}, tmp_path)
    assert not any(t.judgement == "rejected" for t in corrected.tests)


def test_a_single_station_is_refused(tmp_path: Path) -> None:
    recording, _ = lt.simulate("paper-laboratory", seed=1)
    only = recording.select(recording.station == 0)
    lt.write(only, tmp_path / "one")
    with pytest.raises(NetworkError, match="needs at least two"):
        lt.accept({**SHEET, "recording": "one"}, tmp_path)


@pytest.mark.long
def test_uncertainty_of_a_network_length_holds_over_many_networks():
    """Both ends of a length share most of their errors: U / 2 is the spread of the length's error, for each kind."""
    sheet = Specification(
        transverse_limit_um=15, transverse_limit_um_per_m=6, range_limit_um=20, range_limit_um_per_m=1
    )
    short, long = [], []
    for seed in range(12):
        recording, truth = lt.simulate("paper-workshop", seed=seed)
        outcomes = evaluate_network(recording, sheet).test_outcomes
        ends = {target: truth.target_points[recording.targets.index(target)] for target in recording.targets}
        adjusted = adjust(recording, declared_construction(recording))
        placed = dict(zip(recording.targets, adjusted.state.target_points, strict=True))
        for outcome in outcomes:
            if outcome.group != "lengths from S1":
                continue
            first, second = outcome.name.removeprefix("S1: ").split(" to ")
            true = np.linalg.norm(ends[second] - ends[first])
            estimated = np.linalg.norm(placed[second] - placed[first])
            (short if true < 2.5 else long).append((estimated - true) / (1e-6 * outcome.expanded_uncertainty_um / 2))
    for z in (short, long):
        assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.15), len(z)


def test_uncertainty_of_a_network_length_is_that_of_the_whole_normal_matrix():
    recording, _ = lt.simulate("paper-workshop", seed=7)
    nests = {n: t.model_copy(update={"nest_normal": None}) for n, t in recording.setup.targets.items()}
    recording = recording.replace(setup=recording.setup.model_copy(update={"targets": nests}))  # no incidence errors
    adjustment = adjust(recording, declared_construction(recording))
    design = np.asarray(adjustment.solution.system.design)
    covariance = np.linalg.inv(design.T @ design)
    points, at = adjustment.state.target_points, adjustment.problem.unknowns.target_columns
    sheet = Specification(
        transverse_limit_um=15, transverse_limit_um_per_m=6, range_limit_um=20, range_limit_um_per_m=1
    )
    uncertainties = {
        e.name: 1e-6 * e.expanded_uncertainty_um
        for e in evaluate_network(recording, sheet).test_outcomes
        if e.expanded_uncertainty_um is not None
    }
    for a, b in ((0, 1), (0, 12), (5, 20)):
        along = (points[b] - points[a]) / np.linalg.norm(points[b] - points[a])
        form = np.zeros(len(covariance))
        form[at[a]], form[at[b]] = -along, along
        u = np.sqrt(form @ covariance @ form)
        assert uncertainties[f"S1: {recording.targets[a]} to {recording.targets[b]}"] == pytest.approx(2 * u, rel=1e-3)


GOOD_TRACKER = {"instrument.errors": {"draw": False, "beam-tilt": 0.5}}
LIMITS = Specification(transverse_limit_um=15, transverse_limit_um_per_m=6, range_limit_um=20, range_limit_um_per_m=1)


@pytest.mark.parametrize("cause", ["The distances from S3 are 0.2", "Target T06 moved"])
def test_errors_of_the_recording_are_no_errors_of_the_tracker(cause: str):
    """A wrong SMR constant at one set-up and a moved target reject no test of a good tracker."""
    recording, _ = lt.simulate(lt.scenario("paper-workshop-two-face", GOOD_TRACKER), seed=4)
    if cause.startswith("Target"):
        network = adjust(recording)
        effect = TargetMoved((), ("T06",), time=float(recording.time[recording.station == 2].min()))
        change = effect.reading_change(network.sightings, np.array([0.3e-3, -0.2e-3, 0.3e-3]))
    else:
        change = np.where((recording.station == 2)[:, None], [-0.25e-3, 0.0, 0.0], 0.0)
    clean, faulty = (
        evaluate_network(r, LIMITS) for r in (recording, recording.with_readings(recording.readings + change))
    )
    assert clean.corrected_causes == clean.uncorrected_causes == ()
    assert len(faulty.corrected_causes) == 1 and faulty.identified_error_sentences[0].startswith(cause)
    assert faulty.identified_error_sentences[0].endswith(
        "This is not an error of the tracker, and it is removed before the tests."
    )
    assert not [t.name for t in faulty.test_outcomes if t.judgement == "rejected"]
    lengths = [
        (a, b)
        for a, b in zip(clean.test_outcomes, faulty.test_outcomes, strict=True)
        if b.expanded_uncertainty_um is not None
    ]
    assert max(abs(b.error_um - a.error_um) / (b.expanded_uncertainty_um or np.nan) for a, b in lengths) < 1.0
    assert faulty.further_actions(is_rejected=False)[0].startswith(("Check the SMR", "Inspect the nest"))


def test_possible_error_of_the_tracker_remains_in_the_tests():
    """A vertical index that differs at one set-up may be the tracker's: the tests of this set-up contain it."""
    recording, _ = lt.simulate(lt.scenario("paper-workshop-two-face", GOOD_TRACKER), seed=4)
    readings = recording.readings + np.where((recording.station == 1)[:, None], [0.0, 0.0, 60e-6], 0.0)
    tests = evaluate_network(recording.with_readings(readings), LIMITS)
    assert tests.corrected_causes == () and tests.tracker_causes[0].where.stations == ("S2",)
    assert "possibly an error of the tracker, and it remains in the tests" in tests.identified_error_sentences[0]
    rejected = [t.name for t in tests.test_outcomes if t.judgement == "rejected"]
    assert {name.partition(":")[0] for name in rejected} == {"S2"}
    assert 0 < tests.n_errors_rejected_after_correction <= len(rejected)
    assert "Corrections by ltsim calibrate do not suffice" in tests.action_after_rejection


def test_centring_is_in_the_uncertainty_of_a_network_length():
    """A declared displacement of each reflector at each set-up is no error of the tracker: U holds it at both ends."""
    recording, _ = lt.simulate("paper-workshop-two-face", seed=4)
    setup = recording.setup.model_copy(update={"centring": (CentringUncertainty(sigma_mm=0.1),)})
    entries = evaluate_network(recording.replace(setup=setup), LIMITS).test_outcomes
    expanded = np.array([t.expanded_uncertainty_um for t in entries if t.group != "two-face"])
    assert max(t.expanded_uncertainty_um or 0.0 for t in entries if t.group == "two-face") < 0.1, (
        "it is the same in both faces"
    )
    assert np.all(expanded >= 2 * np.sqrt(2) * 100) and np.all(expanded < 2 * np.sqrt(2) * 100 * 1.5)


def test_uncertainty_of_a_two_face_error_is_that_of_what_is_not_the_tracker():
    """U is 0 in a recording that agrees with its declared noise, and grows by scatter beyond it and by corrections."""
    recording, _ = lt.simulate(lt.scenario("paper-workshop-two-face", GOOD_TRACKER), seed=4)

    def expanded(tested: Recording) -> dict[str, float]:
        entries = evaluate_network(tested, LIMITS).test_outcomes
        return {
            t.name: t.expanded_uncertainty_um
            for t in entries
            if t.group == "two-face" and t.expanded_uncertainty_um is not None
        }

    clean = expanded(recording)
    assert len(clean) == 140 and set(clean.values()) == {0.0}

    instrument = recording.setup.instrument
    half = {name: value / 2 for name, value in instrument.noise.model_dump().items()}
    noise = instrument.noise.model_copy(update=half)
    setup = recording.setup.model_copy(update={"instrument": instrument.model_copy(update={"noise": noise})})
    noisy = recording.replace(setup=setup)
    first = np.flatnonzero((recording.station == 0) & (recording.target == 0))
    factor = adjust(noisy).sigma0
    across = noisy.reading_sigmas()[first, 2].max() * recording.readings[first[0], 0] * np.sqrt(2.0)
    u = 2e6 * np.sqrt(factor**2 - 1) * across
    assert factor > 1.8 and expanded(noisy)["S1: T01 two-face"] == pytest.approx(u, rel=0.1)

    shots = (recording.station == 2) & (recording.target == 5)
    moment = float(recording.time[shots].mean())
    moved = adjust(recording, declared_construction(recording), effects=[TargetMoved((), ("T06",), time=moment)])
    entries = TestedNetwork(moved, 1.0).test_outcomes(LIMITS)
    corrected = {
        t.name: t.expanded_uncertainty_um or 0.0
        for t in entries
        if t.group == "two-face" and (t.expanded_uncertainty_um or 0) > 0.1
    }
    assert corrected.keys() == {"S3: T06 two-face"}
    columns = moved.problem.unknowns.effect_columns
    design = np.asarray(moved.solution.system.design)
    covariance = np.linalg.inv(design.T @ design)[np.ix_(columns, columns)]
    low, _, high = 2e6 * np.sqrt(np.linalg.eigvalsh(covariance))
    assert low < corrected["S3: T06 two-face"] <= high


def test_outlying_readings_are_neither_adjusted_nor_tested():
    """A pointing that is 1 mm off, in both faces, rejects no test of a good tracker and is named."""
    recording, _ = lt.simulate(lt.scenario("paper-workshop-two-face", GOOD_TRACKER), seed=4)
    readings = recording.readings.copy()
    readings[(recording.station == 3) & (recording.target == 9), 0] += 1e-3
    tests = evaluate_network(recording.with_readings(readings), LIMITS)
    assert not [t.name for t in tests.test_outcomes if t.judgement == "rejected"]
    assert not [t.name for t in tests.test_outcomes if t.name == "S4: T10" or "S4: T10 to" in t.name]
    assert "Pointings with outliers are not tested: S4 to T10 (row" in " ".join(tests.identified_error_sentences)


def test_several_instruments_are_refused():
    """A judgement is that of one tracker, and an error at its only set-up may be its own."""
    recording, _ = lt.simulate("paper-workshop", seed=1)
    stations = {name: Station(instrument=f"T{i % 2}") for i, name in enumerate(recording.stations)}
    setup = recording.setup.model_copy(
        update={"stations": stations, "instruments": dict.fromkeys(("T0", "T1"), recording.setup.instrument)}
    )
    with pytest.raises(NetworkError, match="has 2 instruments; an acceptance test needs one"):
        evaluate_network(recording.replace(setup=setup), LIMITS)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"ranges_m": np.linspace(1.0, 50.0, 2001).tolist()}, "with 20000 trials each, expected at most 2000 tests"),
        ({"ranges_m": np.linspace(1.0, 50.0, 200).tolist(), "trials": 10_000_000}, "3e.08 draws in all"),
    ],
)
def test_tests_and_draws_of_a_prediction_are_bounded(keys: dict[str, object], says: str) -> None:
    """100,000 ranges took 3.3 GB, then all memory."""
    with pytest.raises(InputError, match=says):
        lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500", **keys})
