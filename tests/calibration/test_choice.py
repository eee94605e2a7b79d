"""Calibration as the person decides: which parameters are estimated, which are held, and what was known before."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import LtsimError
from ltsim.physics.model.construction import dh_construction, misalignment_construction
from ltsim.recordings import Recording, read, write
from ltsim.recordings.setup import Instrument, Prior
from tests.networks import drawn, network

VALUES = drawn(misalignment_construction(), 3)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return network(faces=2, seed=3, values=VALUES)[0]


def with_prior(recording: Recording, **parameters: float) -> Recording:
    prior = Prior(parameters={name.replace("__", "."): value for name, value in parameters.items()})
    return recording.replace(setup=recording.setup.model_copy(update={"instrument": Instrument(prior=prior)}))


@pytest.mark.parametrize("method", ["network", "distance"])
def test_only_chosen_parameters_are_estimated(recording: Recording, method: str) -> None:
    calibration = lt.calibrate(recording, method=method, parameters=["beam-tilt", "azimuth-eccentricity"], advise=False)
    free = [
        name
        for name, held in zip(calibration.instrument_parameter_names, calibration.is_fixed[0], strict=True)
        if not held
    ]
    assert free == ["beam-tilt", "azimuth-eccentricity-cos", "azimuth-eccentricity-sin"]
    assert np.all(calibration.estimates[calibration.is_fixed] == 0.0)
    assert np.all(calibration.sigma[calibration.is_fixed] == 0.0)
    assert np.all(calibration.sigma[~calibration.is_fixed] > 0.0)


@pytest.mark.long
def test_holding_at_the_truth_is_as_good_as_leaving_the_parameter_out(recording: Recording) -> None:
    """Held at zero, a parameter that is zero changes nothing against a construction that lacks it."""
    whole = misalignment_construction()
    fewer = whole.with_parameter_subset(range(8))
    held = lt.calibrate(recording, parameters=whole.parameter_names[:8], advise=False)
    without = lt.calibrate(recording, construction=fewer, advise=False)
    assert held.fit.dof == without.fit.dof
    assert held.fit.chi2 == pytest.approx(without.fit.chi2, rel=1e-9)
    assert held.estimates[0, :8] == pytest.approx(without.estimates[0], rel=1e-6)
    assert held.sigma[0, :8] == pytest.approx(without.sigma[0], rel=1e-9)


@pytest.mark.parametrize("method", ["network", "distance", "distance-l1"])
def test_a_parameter_stays_at_the_value_at_which_it_is_held(recording: Recording, method: str) -> None:
    calibration = lt.calibrate(
        recording, method=method, hold={"beam-tilt": 2.5}, without=["transit-tilt"], advise=False
    )
    tilt = calibration.instrument_parameter_names.index("beam-tilt")
    assert calibration.estimates[0, tilt] == pytest.approx(2.5e-6, rel=1e-12)
    assert calibration.is_fixed[0].sum() == 2
    assert not any("beam-tilt" in c.combination for c in calibration.undetermined)


def test_a_calibration_as_prior_is_as_if_both_had_been_measured(recording: Recording) -> None:
    """Two recordings of one instrument: the second with the first as its prior says what both say together."""
    other = network(faces=2, seed=4, values=VALUES)[0]
    first = lt.calibrate(recording, advise=False)
    second = lt.calibrate(other, advise=False)
    chained = lt.calibrate(other, prior=first, advise=False)
    unit = np.outer(first.prior_sigma, first.prior_sigma)
    information = [np.linalg.inv(c.covariance / unit) for c in (first, second)]
    both = np.linalg.inv(information[0] + information[1] - np.eye(16))
    values = both @ sum(
        n @ (c.estimates[0] / c.prior_sigma[0]) for n, c in zip(information, (first, second), strict=True)
    )
    assert chained.has_history_prior
    assert np.sqrt(np.diag(both)) == pytest.approx(chained.sigma[0] / first.prior_sigma[0], rel=1e-3)
    gap = (values * first.prior_sigma[0] - chained.estimates[0]) / chained.sigma[0]
    assert np.max(np.abs(gap)) < 0.05


def test_a_prior_of_a_single_parameter_is_in_its_unit(recording: Recording, tmp_path: Path) -> None:
    narrow = with_prior(recording, **{"beam-tilt": 0.5})
    write(narrow, tmp_path / "rec")
    calibration = lt.calibrate(read(tmp_path / "rec"), advise=False)
    tilt = calibration.instrument_parameter_names.index("beam-tilt")
    assert calibration.prior_sigma[0, tilt] == pytest.approx(0.5e-6)
    assert calibration.prior_sigma[0, tilt + 1] == pytest.approx(14.544e-6, rel=1e-4)


def test_instruments_have_separate_priors_and_choices(recording: Recording) -> None:
    tables = {"A": Instrument(), "B": Instrument(prior=Prior(parameters={"beam-tilt": 1.0}))}
    stations = {s: {"instrument": "A" if k < 3 else "B"} for k, s in enumerate(recording.stations)}
    content = recording.setup.model_dump(by_alias=True) | {
        "instruments": {k: v.model_dump() for k, v in tables.items()},
        "stations": stations,
    }
    two = recording.replace(setup=type(recording.setup).model_validate(content))
    calibration = lt.calibrate(two, without=["vertical-index@B"], advise=False)
    tilt, index = (
        calibration.instrument_parameter_names.index("beam-tilt@A"),
        calibration.construction.parameter_index("vertical-index"),
    )
    assert calibration.prior_sigma[:, tilt] == pytest.approx([14.544e-6, 1e-6], rel=1e-4)
    assert calibration.is_fixed[:, index].tolist() == [False, True]


WRONG = {
    "an unknown name": ({"without": ["beam-tlit"]}, "did you mean beam-tilt"),
    "an unknown instrument": ({"without": ["beam-tilt@X"]}, "no instrument called .X."),
    "a value for several": ({"hold": {"azimuth-eccentricity": 1.0}}, "several parameters"),
    "nothing left": ({"parameters": ["beam-tilt"], "without": ["beam-tilt"]}, "all parameters are fixed"),
    "orders of another construction": ({"construction": "misalignment", "harmonics": 3}, "harmonics and degree"),
    "an order out of bounds": ({"construction": "dh", "harmonics": 9}, "expected 0 to 4"),
    "a prior and distances": ({"method": "distance", "prior": "x"}, "x"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_choices_are_refused_in_a_sentence(recording: Recording, case: str) -> None:
    options, words = WRONG[case]
    with pytest.raises(LtsimError, match=words):
        lt.calibrate(recording, advise=False, **options)


def test_a_prior_of_a_parameter_that_does_not_exist_is_refused(recording: Recording) -> None:
    with pytest.raises(LtsimError, match="did you mean beam-tilt"):
        lt.calibrate(with_prior(recording, **{"beam-tlit": 1.0}), advise=False)


@pytest.mark.parametrize(("harmonics", "degree", "size"), [(0, 1, 24), (3, 2, 102), (4, 3, 132)])
def test_the_order_of_the_harmonics_is_an_option(harmonics: int, degree: int, size: int) -> None:
    from ltsim.physics.model.construction import construction_for_parameters, make_construction

    built = make_construction("dh", harmonics, degree)
    assert built.n_parameters == size
    assert construction_for_parameters("dh", built.parameter_names).parameter_names == built.parameter_names


@pytest.mark.long
def test_the_command_line_has_the_same_choices(recording: Recording, tmp_path: Path, capsys) -> None:
    write(recording, tmp_path / "rec")
    first = ["calibrate", str(tmp_path / "rec"), "--out", str(tmp_path / "first"), "-q"]
    assert run([*first, "--without", "elevation-second-order", "--hold", "beam-tilt=2.5"]) == 0
    content = json.loads((tmp_path / "first" / "calibration.json").read_text())
    held = {row["name"]: row["value"] for row in content["parameters"] if row["held"]}
    assert set(held) == {"beam-tilt", "elevation-second-order-cos", "elevation-second-order-sin"}
    assert held["beam-tilt"] == pytest.approx(2.5)
    again = lt.calibrate(tmp_path / "rec", prior=tmp_path / "first", advise=False)
    assert again.has_history_prior
    assert not again.is_fixed.any()
    capsys.readouterr()
    assert run(["calibrate", str(tmp_path / "rec"), "--parameters", "vertical-index,beam-offset"]) == 0
    held = [line.split() for line in capsys.readouterr().out.splitlines() if "yes" in line.split()]
    assert len(held) == 13 and {row[1] for row in held} == {"0"}
    assert run(["calibrate", str(tmp_path / "rec"), "--hold", "beam-tilt"]) == 2
    assert "expected NAME=VALUE" in capsys.readouterr().err


def test_a_history_is_a_prior_and_takes_only_calibrations_without_a_prior(recording: Recording, tmp_path: Path) -> None:
    calibrations = [lt.calibrate(network(faces=2, seed=s, values=VALUES)[0], without=["transit-offset"], advise=False)
           for s in (5, 6, 7)]  # fmt: skip
    history = lt.history(calibrations)
    assert len(history.parameters) == 15
    file = tmp_path / "history.json"
    file.write_text(json.dumps(history.content()))
    results = [lt.calibrate(recording, prior=source, advise=False) for source in (history, file)]
    assert results[0].estimates == pytest.approx(results[1].estimates, rel=1e-6)
    assert np.all(results[0].sigma[0] <= 1.01 * lt.calibrate(recording, advise=False).sigma[0])
    with pytest.raises(LtsimError, match="independent of each other"):
        lt.history([results[0], results[1]])


def test_an_extra_coefficient_that_contradicts_its_prior_is_reported_and_estimated() -> None:
    built = dh_construction()
    at = built.parameter_index("J1.eX_sin2")
    values = np.zeros(built.n_parameters)
    values[at] = 5e-6
    recording = network(faces=2, seed=2, values=values, construction=built)[0]
    calibration = lt.calibrate(recording, construction="dh", advise=False)
    assert abs(calibration.estimates[0, at] - 5e-6) < 3 * calibration.sigma[0, at]
    notes = [note for note in calibration.notes if note.startswith("J1.eX_sin2: ")]
    assert "contradicts its declared prior of 0.242 urad" in notes[0]
    wider = lt.calibrate(with_prior(recording, J1__eX_sin2=10.0), construction="dh", advise=False)
    assert abs(wider.estimates[0, at] - 5e-6) < 3 * wider.sigma[0, at]
    assert wider.sigma[0, at] < 1e-6
    assert not any("contradict" in note for note in wider.notes)
