"""A calibrator of one's own: passes where it is right, fails where it claims too much, is held against tolerances."""

from __future__ import annotations

import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import ltsim as lt
from ltsim.campaigns.recovery_checks import recovery_checks
from ltsim.cli.main import run
from ltsim.core.errors import InputError, ModelError
from ltsim.recordings import Recording
from ltsim.simulation.scenario import scenario_to_toml
from tests.families import family

PROGRAM = Path(__file__).parents[2] / "docs" / "how-to" / "two_faces.py"
ERRORS = {"vertical-index": -12.0, "beam-tilt": 8.0, "transit-tilt": 5.0}
SCENE = lt.scenario("paper-workshop-two-face", {"instrument.errors": ERRORS})


@pytest.fixture
def two_faces(tmp_path: Path) -> Any:
    """The calibrator of the docs as a function of a recording, with sigmas divided by a number."""
    spec = spec_from_file_location("two_faces", PROGRAM)
    assert spec is not None and spec.loader is not None
    program = module_from_spec(spec)
    spec.loader.exec_module(program)

    def calibrate(recording: Recording, certainty: float = 1.0) -> dict[str, tuple[float, float, str]]:
        lt.write(recording, tmp_path / "recording")
        value, sigma = program.estimates(tmp_path / "recording")
        return {n: (v, s / certainty, "urad") for n, v, s in zip(program.NAMES, value, sigma, strict=True)}

    return calibrate


@pytest.mark.long
def test_the_calibrator_of_the_docs_passes_and_fails_with_sigmas_three_times_too_small(two_faces: Any) -> None:
    right = lt.recover(SCENE, trials=30, seed=2, calibrator=two_faces)
    assert right.error_origin == "stated" and {p.parameter for p in right.parameters} == set(ERRORS) and right.passed
    assert [check.sentence() for check in right.failed_checks()] == []
    wrong = lt.recover(SCENE, trials=30, seed=2, calibrator=lambda recording: two_faces(recording, 3.0))
    assert {check.subject for check in wrong.failed_checks() if "coverage" in check.statistic} == {*ERRORS}
    assert {check.subject for check in wrong.failed_checks() if "deviation" in check.statistic} == {*ERRORS}
    np.testing.assert_array_equal(
        right.arrays._attribute_by_trial("estimates"), wrong.arrays._attribute_by_trial("estimates")
    )


def test_tolerances_are_of_the_parameters_that_they_name(two_faces: Any) -> None:
    how = {"trials": 8, "seed": 2, "calibrator": two_faces}
    wide = lt.recover(SCENE, tolerance={"beam-tilt": "2 urad"}, **how)
    assert {check.subject for check in wide.checks} == {"convergence", "beam-tilt"} and not wide.failed_checks()
    narrow = lt.recover(SCENE, tolerance={"beam-tilt": "0.01 arcsec"}, **how).failed_checks()
    assert narrow[0].sentence().startswith("beam-tilt fails: share of errors within 0.01 arcsec")
    for words, says in (({"beam-tilt": "2 mm"}, "expected a quantity"), ({"bean": "2 urad"}, "to none of")):
        with pytest.raises(InputError, match=says):
            lt.recover(SCENE, tolerance=words, **how)


def test_ltsim_is_scored_on_the_same_recordings(two_faces: Any) -> None:
    result = lt.recover(SCENE, trials=6, seed=2, calibrator=two_faces)
    arrays, scores = result.arrays, lt.recover(SCENE, trials=6, seed=2).arrays
    k = scores.parameter_names.index("beam-tilt")
    estimates = [
        trial.ltsim_score.estimates[arrays.parameter_names.index("beam-tilt")]
        for trial in arrays.available_trial_scores
    ]
    assert estimates == pytest.approx([trial.estimates[k] for trial in scores.available_trial_scores], rel=1e-12)
    assert result.ltsim_parameters == scores.parameter_names
    (sentence,) = result.unestimated_parameter_sentences()
    assert (
        f"estimates {len(ERRORS)} parameters" in sentence
        and f"ltsim estimates {len(scores.parameter_names)}" in sentence
    )
    others = [name for name in scores.parameter_names if name not in ERRORS]
    assert f"also {others[0]}, " in sentence and sentence in str(result)
    assert lt.recover(SCENE, trials=2, seed=2).unestimated_parameter_sentences() == []
    table = result.to_dataframe("parameters")
    assert tuple(table["parameter"]) == arrays.parameter_names and np.all(
        table["absolute_error_difference_low"] <= table["absolute_error_difference_high"]
    )


def test_effects_are_recovered_by_name() -> None:
    scene = lt.scenario(SCENE, {"effects": [{"name": "head-sag", "draw": True}]})
    recovery = lt.recover(scene, trials=12, seed=3, with_effects=["head-sag"], errors="drawn")
    effect = [p.parameter for p in recovery.parameters if p.parameter.startswith("head-sag:")]
    assert effect and not [check for check in recovery.failed_checks() if check.subject in effect]


def test_a_program_is_called_with_a_recording_and_its_answer_is_checked(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene, program = tmp_path / "scene.toml", tmp_path / "mine.py"
    scene.write_text(scenario_to_toml(SCENE))
    answer: dict[str, Any] = {"parameters": [{"name": "beam-tilt", "value": 8.0, "unit": "urad"}]}
    text = (
        "import sys, os; assert os.path.isfile(sys.argv[1] + '/observations.csv'); open(sys.argv[2], 'w').write({!r})"
    )
    command = ["recover", str(scene), "-n", "2", "--calibrator", f"{sys.executable} {program} {{recording}} {{out}}"]
    program.write_text(text.format(json.dumps(answer)))
    assert run([*command, "--tolerance", "beam-tilt='1 urad'", "--out", str(tmp_path / "out"), "-q"]) == 0
    assert "0,beam-tilt,urad,8.0,8.0,," in (tmp_path / "out" / "trials.csv").read_text()
    answer["parameters"][0]["unit"] = "furlong"
    program.write_text(text.format(json.dumps(answer)))
    assert run(command) == 1
    error = capfd.readouterr().err
    assert (
        "'furlong' is not a unit, expected one of um, mm, cm" in error and "or '' for a number without a unit" in error
    )
    program.write_text("raise SystemExit('my own reason')")
    assert run([*command, "-q"]) == 1
    error_text = capfd.readouterr().err
    assert "convergence fails" in error_text
    assert "trial 1: '" in error_text and "ended with status 1; its last line was: my own reason" in error_text
    assert run([*command[:-1], "mine"]) == 2 and "lacks {recording}" in capfd.readouterr().err
    assert run([*command[:-1], "no-such-program {recording} {out}"]) == 2


def test_checks_are_a_function_of_estimate_sigma_and_truth() -> None:
    rng = np.random.default_rng(1)
    truth, sigma = rng.normal(0, 5, (200, 2)), np.full((200, 2), 0.5)
    estimate = truth + sigma * rng.standard_normal((200, 2))
    assert all(check.passed for check in recovery_checks(estimate, sigma, truth, names=["a", "b"]))
    assert not all(check.passed for check in recovery_checks(estimate, sigma / 3, truth))
    (only,) = recovery_checks(estimate, None, truth, names=["a", "b"], tolerance={"b": 2.0})
    assert only.subject == "b" and only.passed
    with pytest.raises(ModelError, match="to none of"):
        recovery_checks(estimate, None, truth, tolerance={"b": 2.0})


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, "the result contains no parameter"),
        ({"beam-tilt": (1.0, 0.0, "urad")}, "sigma of beam-tilt is 0.0, it should be greater than 0"),
        ({"beam-tilt": (float("nan"), 1.0, "urad")}, "value of beam-tilt is nan, it should be a finite number"),
        ({"beam-tilt": 3.0}, "beam-tilt is 3.0"),
        ({"bean": (1.0, 1.0, "urad")}, "trial 1: the calibrator gives 'bean', but the parameters"),
        ({"beam-tilt": (1.0, 1.0, "mm")}, "trial 1: the calibrator's beam-tilt is in mm, expected urad"),
    ],
)
def test_a_result_that_is_not_as_documented_is_a_failed_trial(given: Any, reason: str) -> None:
    recovery = lt.recover(SCENE, trials=2, calibrator=lambda recording: given)
    assert not recovery.passed and recovery.trials_with_result == 0
    assert recovery.failed_checks()[0].subject == "convergence"
    assert reason in recovery.failure_sentences()[0]


BROKEN_PROGRAMS = {
    "nan": (
        'open(out, "w").write(\'{"parameters": [{"name": "beam-tilt", "value": NaN, "unit": "urad"}]}\')',
        "the number NaN",
    ),
    "zero": (
        'open(out, "w").write(\'{"parameters": [{"name": "beam-tilt", "value": 1, "sigma": 0, "unit": "urad"}]}\')',
        "sigma of beam-tilt is 0, it should be greater than 0",
    ),
    "no file": ("pass", "there is no file at {out}"),
    "no JSON": ('open(out, "w").write("beam-tilt=-14")', "the file at {out} is not JSON"),
    "no value": ('open(out, "w").write(\'{"parameters": [{"name": "beam-tilt"}]}\')', "'value' is missing"),
    "numbers": ('open(out, "w").write(\'{"parameters": [1, 2]}\')', "no list of parameters with name, value and unit"),
    "crash": ('raise RuntimeError("no licence")', "status 1; its last line was: RuntimeError: no licence"),
}
"""Program of a calibrator, and the reason that its result is not valid, by name."""


@pytest.mark.parametrize(
    "name", family(sorted(BROKEN_PROGRAMS, key=lambda name: name not in ("nan", "no file", "crash")), 3)
)
def test_broken_output_of_a_program_is_a_failed_test_case_with_its_reason(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene, program, junit = (tmp_path / file for file in ("scene.toml", "mine.py", "junit.xml"))
    scene.write_text(scenario_to_toml(SCENE))
    body, reason = BROKEN_PROGRAMS[name]
    program.write_text(f"import sys\nprint('warm', file=sys.stderr)\nout = sys.argv[2]\n{body}\n")
    command = ["recover", str(scene), "-n", "9", "--calibrator", f"{sys.executable} {program} {{recording}} {{out}}"]
    command += ["--out", str(tmp_path / "out"), "--junit", str(junit), "-q"]
    assert run(command) == 1
    (failure,) = ElementTree.parse(junit).getroot().findall("testcase/failure")
    message = failure.attrib["message"]
    assert reason in message and "mine.py" in message and "trial 2: " in message
    assert ("its last line was: warm" in message) == (name != "crash")
    assert message in capfd.readouterr().err
    assert json.loads((tmp_path / "out" / "recovery.json").read_text())["last_failure_reason"] == message
    assert run(command) == 1
    junit.write_text(junit.read_text().replace("testcase", "case"))
    assert run(command) == 2


def constant(value: float, sigma: float | None, unit: str = "urad") -> Any:
    return lambda recording: {"beam-tilt": (value, sigma, unit), "transit-tilt": (5.0, 3.0, "urad")}


def test_a_parameter_without_a_sigma_is_not_checked_and_does_not_pass() -> None:
    silent = lt.recover(SCENE, trials=3, seed=2, calibrator=constant(1000.0, None))
    assert silent.unchecked_parameters == ("beam-tilt",) and not silent.failed_checks() and not silent.passed
    assert (
        silent.verdict_text()
        == "1 of 2 parameters are recovered within its declared uncertainty, the others are not checked"
    )
    assert silent.failure_sentences()[-1].startswith(
        "beam-tilt is not checked: the calibrator does not declare the standard deviation in every trial"
    )
    assert (
        "allow_unchecked=True" in silent.failure_sentences()[-1]
        and "recovered within" not in repr(silent).splitlines()[1]
    )
    allowed = lt.recover(SCENE, trials=3, seed=2, calibrator=constant(8.0, None), allow_unchecked=True)
    assert allowed.passed and "allow_unchecked" not in allowed.failure_sentences()[-1]
    assert allowed.parameters[0].coverage_95 is None and allowed.parameters[1].coverage_95 is not None
    judged = lt.recover(SCENE, trials=3, calibrator=constant(1000.0, None), tolerance={"beam-tilt": "2 urad"})
    assert not judged.unchecked_parameters and not judged.passed
    limited = lt.recover(SCENE, trials=3, seed=2, calibrator=constant(8.0, None), tolerance={"beam-tilt": "99 urad"})
    assert limited.verdict_text() == (
        "1 of 2 parameters (beam-tilt) is recovered within the given tolerances, the others have no tolerance and are "
        "not checked"
    )
    nothing = lt.recover(SCENE, trials=2, calibrator=lambda recording: {"beam-tilt": (8.0, None, "urad")})
    assert nothing.verdict_text() == "no parameter is checked" and not nothing.passed


def test_of_many_parameters_without_a_sigma_three_are_named() -> None:
    values = dict.fromkeys(("beam-tilt", "transit-tilt", "range-offset", "range-scale"), (0.0, None))
    units = dict(zip(values, ("urad", "urad", "um", "ppm"), strict=True))
    silent = {name: (*given, units[name]) for name, given in values.items()}
    recovery = lt.recover("paper-workshop", trials=2, calibrator=lambda recording: silent)
    sentence = recovery.failure_sentences()[-1]
    assert len(recovery.unchecked_parameters) == 4
    assert sentence.startswith("4 of 4 parameters (")
    assert " and 1 more) are not checked: the calibrator does not declare" in sentence


def test_a_sigma_in_a_part_of_the_trials_is_none() -> None:
    sigmas = iter([3.0, None, 3.0])
    recovery = lt.recover(SCENE, trials=3, calibrator=lambda recording: {"beam-tilt": (8.0, next(sigmas), "urad")})
    assert recovery.unchecked_parameters == ("beam-tilt",) and not recovery.passed


def test_a_shift_inside_the_intervals_fails_by_its_mean(two_faces: Any) -> None:
    def shifted(recording: Recording) -> dict[str, tuple[float, float, str]]:
        estimates = two_faces(recording)
        value, sigma, unit = estimates["beam-tilt"]
        return estimates | {"beam-tilt": (value + 0.9 * sigma, sigma, unit)}

    failures = lt.recover(SCENE, trials=20, seed=2, calibrator=shifted).failed_checks()
    assert {(check.subject, check.statistic) for check in failures} == {("beam-tilt", "mean z-score")}


def test_units_and_order_may_differ_from_trial_to_trial_but_not_the_parameters() -> None:
    answers = iter([{"beam-tilt": (8e-6, 3e-6, "rad"), "transit-tilt": (5.0, 3.0, "urad")},
                    {"transit-tilt": (5.0, 3.0, "urad"), "beam-tilt": (0.008, 0.003, "mrad")}])  # fmt: skip
    arrays = lt.recover(SCENE, trials=2, calibrator=lambda recording: next(answers)).arrays
    assert (
        arrays.available_trial_scores[0].parameter_units
        == arrays.available_trial_scores[1].parameter_units
        == ("urad", "urad")
    )
    np.testing.assert_allclose(
        [trial.estimates for trial in arrays.available_trial_scores], [arrays.available_trial_scores[0].true_values] * 2
    )
    answers = iter([{"beam-tilt": (8.0, 3.0, "urad")}, {"transit-tilt": (5.0, 3.0, "urad")}])
    partial = lt.recover(SCENE, trials=2, calibrator=lambda recording: next(answers))
    assert partial.trials_with_result == 1
    assert partial.failure_sentences()[0] == "trial 1: the calibrator gives beam-tilt only in some of the trials"


@pytest.mark.parametrize("jobs", family([1, 2]))
def test_three_failures_of_a_calibrator_end_the_run(jobs: int, tmp_path: Path) -> None:
    program = tmp_path / "mine.py"
    program.write_text("raise RuntimeError('license server not reachable')")
    command = f"{sys.executable} {program} {{recording}} {{out}}"
    recovery = lt.recover(SCENE, trials=40, calibrator=command, jobs=jobs)
    assert recovery.trials == 3 and not recovery.passed
    assert recovery.failure_sentences()[0].startswith("the run ended after 3 failures of the calibrator: trial 2: '")
    assert "status 1; its last line was: RuntimeError: license server not reachable" in recovery.failure_sentences()[0]
    assert lt.recover(SCENE, trials=5, calibrator=lambda recording: None).trials == 3


def test_checks_of_arrays_cannot_pass_with_nothing_to_judge_by() -> None:
    empty, two = np.zeros((1, 2)), np.zeros((2, 2))
    for estimate, sigma, says in (
        (two, None, "neither sigma nor tolerance"),
        (empty, empty + 1, "expected 2 or more"),
        (two, empty + 1, "give one sigma per estimate"),
    ):
        with pytest.raises(ModelError, match=says):
            recovery_checks(estimate, sigma, estimate)


def test_junit_and_json_hold_what_is_not_checked(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene, program = tmp_path / "scene.toml", tmp_path / "mine.py"
    scene.write_text(scenario_to_toml(SCENE))
    answer = json.dumps({"parameters": [{"name": "beam-tilt", "value": 1e3, "unit": "urad"}]})
    program.write_text(f"import sys; open(sys.argv[2], 'w').write({answer!r})")
    out, junit = tmp_path / "out", tmp_path / "junit.xml"
    command = ["recover", str(scene), "-n", "2", "--calibrator", f"{sys.executable} {program} {{recording}} {{out}}"]
    command += ["--out", str(out), "--junit", str(junit)]
    assert run(command) == 1
    printed = capfd.readouterr()
    assert "beam-tilt is not checked" in printed.err and "recovered within" not in printed.out
    content = json.loads((out / "recovery.json").read_text())
    assert content["unchecked_parameters"] == ["beam-tilt"] and not content["passed"]
    assert 'failures="1"' in junit.read_text() and "beam-tilt is not checked" in junit.read_text()
    assert run([*command, "--allow-unchecked", "--force"]) == 0
    printed = capfd.readouterr()
    assert "no parameter is checked\n" in printed.out and "--allow-unchecked" not in printed.err
    assert 'failures="0"' in junit.read_text() and 'skipped="1"' in junit.read_text()
    assert run([*command[:3], "1"]) == 2
