"""A calibrator of one's own: passes where it is right, fails where it claims too much, is held against tolerances."""

from __future__ import annotations

import json
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.campaigns.recovery_checks import recovery_checks
from ltsim.cli.main import run
from ltsim.errors import ModelError, RecordError, SetupError
from ltsim.recording import Recording
from ltsim.simulation.scenario import scenario_to_toml

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


def test_the_calibrator_of_the_docs_passes_and_fails_with_sigmas_three_times_too_small(two_faces: Any) -> None:
    right = lt.recover(SCENE, trials=30, seed=2, calibrator=two_faces)
    assert right.errors == "stated" and right.names == tuple(ERRORS)
    assert [check.sentence() for check in right.failures()] == []
    wrong = lt.recover(SCENE, trials=30, seed=2, calibrator=lambda recording: two_faces(recording, 3.0))
    assert {check.what for check in wrong.failures()} == {*ERRORS}
    assert all("coverage" in check.statistic for check in wrong.failures())
    np.testing.assert_array_equal(right._stacked("estimate"), wrong._stacked("estimate"))


def test_tolerances_are_of_the_parameters_that_they_name(two_faces: Any) -> None:
    how = {"trials": 12, "seed": 2, "calibrator": two_faces}
    wide = lt.recover(SCENE, tolerance={"beam-tilt": "2 urad"}, **how)
    assert {check.what for check in wide.checks()} == {"convergence", "beam-tilt"} and not wide.failures()
    narrow = lt.recover(SCENE, tolerance={"beam-tilt": "0.01 arcsec"}, **how).failures()
    assert narrow[0].sentence().startswith("beam-tilt fails: share of errors within 0.01 arcsec")
    for words, says in (({"beam-tilt": "2 mm"}, "expected a quantity"), ({"bean": "2 urad"}, "of none of")):
        with pytest.raises(SetupError, match=says):
            lt.recover(SCENE, tolerance=words, **how)


def test_ltsim_stands_beside_it_on_the_same_recordings(two_faces: Any) -> None:
    found = lt.recover(SCENE, trials=6, seed=2, calibrator=two_faces)
    own = lt.recover(SCENE, trials=6, seed=2)
    k = own.names.index("beam-tilt")
    beside = [trial.other.estimate[1] for trial in found.converged]
    assert beside == pytest.approx([trial.estimate[k] for trial in own.converged], rel=1e-12)
    table = found.to_dataframe("parameters")
    assert list(table["parameter"]) == list(ERRORS) and np.all(table["larger_low"] <= table["larger_high"])


def test_effects_are_recovered_by_name() -> None:
    scene = lt.scenario(SCENE, {"effects": [{"name": "head-sag", "draw": True}]})
    found = lt.recover(scene, trials=12, seed=3, with_effects=["head-sag"], errors="drawn")
    effect = [name for name in found.names if name.startswith("head-sag:")]
    assert effect and not [check for check in found.failures() if check.what in effect]


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
    assert run(command) == 2 and "'furlong' is no unit" in capfd.readouterr().err
    program.write_text("raise SystemExit('my own reason')")
    assert run([*command, "-q"]) == 1
    said = capfd.readouterr().err
    assert "convergence fails" in said and "my own reason" in said
    assert run([*command[:-1], "mine"]) == 2 and "lacks {recording}" in capfd.readouterr().err
    assert run([*command[:-1], "no-such-program {recording} {out}"]) == 2


def test_checks_are_a_function_of_estimate_sigma_and_truth() -> None:
    rng = np.random.default_rng(1)
    truth, sigma = rng.normal(0, 5, (200, 2)), np.full((200, 2), 0.5)
    estimate = truth + sigma * rng.standard_normal((200, 2))
    assert all(check.passed for check in recovery_checks(estimate, sigma, truth, names=["a", "b"]))
    assert not all(check.passed for check in recovery_checks(estimate, sigma / 3, truth))
    (only,) = recovery_checks(estimate, None, truth, names=["a", "b"], tolerance={"b": 2.0})
    assert only.what == "b" and only.passed
    with pytest.raises(ModelError, match="of none of"):
        recovery_checks(estimate, None, truth, tolerance={"b": 2.0})


def test_a_result_that_is_not_as_documented_is_a_sentence() -> None:
    for given in ({}, {"beam-tilt": (1.0, -1.0, "urad")}, {"beam-tilt": 3.0}):
        with pytest.raises(RecordError, match=r"^the calibrator's result of trial 0"):
            lt.recover(SCENE, trials=2, calibrator=lambda recording, given=given: given)
