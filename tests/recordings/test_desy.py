"""A real tracker, where its recordings lie beside the checkout: parameters of one set-up serve the other."""

from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment.fieldcheck.setup_model import two_face_pairs
from ltsim.calibration.correct import correct
from ltsim.calibration.files import read_calibration, write_calibration
from ltsim.calibration.network import calibrate_network
from ltsim.recordings import Hints, read

DATA = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "desy-girder-at960"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the DESY recordings are not beside the checkout")


@pytest.fixture(scope="module")
def text():
    return read(DATA / "Polar_measurements_20Sep21.txt", hints=Hints(azimuth="clockwise"))


@pytest.fixture(scope="module")
def report():
    return read(DATA / "SA_CompositeReport_20Sep21.csv")


@pytest.mark.long
def test_report_and_text_give_the_same_instrument(text, report):
    calibration, other = (calibrate_network(r, recommend_measurements=False) for r in (text, report))
    assert calibration.fit.status == other.fit.status == "converged"
    assert other.instruments == ("Leica AT960-930",)
    assert np.all(np.abs(calibration.estimates - other.estimates) < 2.5 * calibration.sigma)
    tilt = calibration.construction.parameter_index("beam-tilt")
    assert calibration.estimates[0, tilt] > 4 * calibration.sigma[0, tilt]


@pytest.mark.parametrize("number", [0, 1])
def test_parameters_of_a_set_up_reduce_the_two_face_differences_of_the_other(text, number, tmp_path):
    write_calibration(calibrate_network(text.select(text.station == number), recommend_measurements=False), tmp_path)
    other = text.select(text.station != number)
    before = two_face_pairs(other)
    after = two_face_pairs(correct(other, read_calibration(tmp_path)))
    share = 1.0 - after.median_absolute_half_differences / before.median_absolute_half_differences
    assert share[1] > 0.2
    assert share[2] > 0.7
