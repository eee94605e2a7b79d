"""Networks whose equations are singular are refused in one sentence that names what is undetermined."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.structure import raise_for_singular_network
from ltsim.core.errors import LtsimError, NetworkError
from ltsim.recordings.recording import Recording
from tests.campaigns.workshop import workshop
from tests.cli.test_degenerate_networks import network


@pytest.fixture(scope="module")
def recording() -> Recording:
    return workshop()[0]


def refusal(verb: Callable[[Recording], object], recording: Recording) -> str:
    """The sentence with which a verb refuses a recording; empty where it answers."""
    try:
        verb(recording)
    except NetworkError as refused:
        return str(refused)
    return ""


@pytest.mark.parametrize("verb", [lt.adjust, lt.calibrate, lt.diagnose, lt.evaluate], ids=lambda verb: verb.__name__)
@pytest.mark.parametrize("gauge", [True, False])
def test_elevations_alone_are_refused(verb: object, gauge: bool, recording: Recording) -> None:
    if not gauge:
        recording = recording.replace(setup=recording.setup.model_copy(update={"gauge": None}))
    readings = recording.readings.copy()
    readings[:, :2] = np.nan
    with pytest.raises(NetworkError, match="only elevations"):
        verb(recording.with_readings(readings))  # type: ignore[operator]


def test_a_factorisation_that_fails_names_the_weakest_station_and_target(recording: Recording) -> None:
    @raise_for_singular_network
    def broken(recording: Recording) -> None:
        np.linalg.eigvalsh(np.full((3, 3), np.nan))

    readings = recording.readings.copy()
    readings[recording.station == 1, 1:] = np.nan
    readings[recording.target == 4, 0] = np.nan
    with pytest.raises(NetworkError) as refused:
        broken(recording.with_readings(readings))
    assert f"station {recording.stations[1]} has 2" in str(refused.value)
    assert f"target {recording.targets[4]} has" in str(refused.value)


@pytest.mark.long
def test_a_reference_length_of_coincident_targets_is_no_fault(recording: Recording) -> None:
    """Targets in one horizontal plane against a gauge: a contradiction beyond any surprise is told, or refused."""
    readings = recording.readings.copy()
    readings[:, 2] = 0.0
    for verb in (lt.adjust, lt.check):
        assert refusal(verb, recording.with_readings(readings)) != "nan"


def test_a_range_of_zero_is_a_sentence_of_every_verb(recording: Recording) -> None:
    readings = recording.readings.copy()
    readings[3, 0] = 0.0
    for verb in (lt.adjust, lt.check):
        message = refusal(verb, recording.with_readings(readings))
        assert message == "" or "singular" in message


def test_a_set_up_in_the_place_of_a_target_that_it_measures_is_a_sentence(recording: Recording) -> None:
    """A division by zero, and a singular matrix."""
    name, target = recording.stations[0], recording.targets[int(recording.target[recording.station == 0][0])]
    station = recording.station_setup(name).model_copy(update={"over": target})
    setup = recording.setup.model_copy(update={"stations": {**recording.setup.stations, name: station}})
    for verb in (lt.adjust, lt.calibrate, lt.diagnose):
        assert f"station {name} stands over target {target} and measures it" in refusal(
            verb, recording.replace(setup=setup)
        )


def test_coincident_targets_get_no_calibrated_length(recording: Recording) -> None:
    """`calibrate` proposed a bar of length zero between them, which no set-up may have."""
    few = recording.select((recording.station == 0) & (recording.target < 2))
    readings = np.tile(few.readings[:1], (len(few), 1))
    setup = recording.setup.model_copy(update={"gauge": None})
    assert len(lt.calibrate(few.with_readings(readings).replace(setup=setup)).parameters)


def test_an_exact_fit_with_estimated_noise_has_no_outlier() -> None:
    """Residuals of 0 were divided by the estimated sigma0 of 0, a warning of numpy."""
    _, single = network(199)  # one target without noise
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not lt.adjust(single, robust=True, noise_from_data=True).outliers


def test_a_rejected_reading_is_not_tested_without_end() -> None:
    """Two targets at one set-up and a gauge of 1,000 km: `adjust` left the same reading out again and again."""
    _, recording = network(46099)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(LtsimError):
            lt.adjust(recording)
