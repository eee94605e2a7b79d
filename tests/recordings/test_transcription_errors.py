"""One table of slips: a reader refuses them, the effect makes them, the diagnosis mends them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import ModelError, RecordError
from ltsim.physics.effects.wrong_unit import WrongUnit
from ltsim.recordings.native import write_recording
from ltsim.recordings.recording import Recording
from ltsim.recordings.transcription_errors import (
    ERRORS_IN_DEGREES_AND_MILLIMETRES,
    UNIT_AND_CONVENTION_ERRORS,
    WRONG_FACE_ERRORS,
    WrongColumnConversion,
    error_from_lengths,
)
from tests.networks import network

ANGULAR = [
    slip for slip in ERRORS_IN_DEGREES_AND_MILLIMETRES if 0 not in slip.changed_columns and slip.name != "clockwise"
]


def slipped(recording: Recording, slip: WrongColumnConversion) -> Recording:
    return recording.with_readings(slip.with_error(recording.readings))


@pytest.mark.parametrize("slip", [*UNIT_AND_CONVENTION_ERRORS, *WRONG_FACE_ERRORS], ids=lambda slip: slip.name)
def test_corrected_readings_are_the_original_readings(slip: WrongColumnConversion) -> None:
    readings = np.random.default_rng(3).uniform(0.1, 3.0, (9, 3))
    written = slip.with_error(readings)
    np.testing.assert_allclose(slip.without_error(written), readings, rtol=1e-14)
    untouched = [c for c in range(3) if c not in slip.changed_columns]
    np.testing.assert_array_equal(written[:, untouched], readings[:, untouched])


def test_the_effect_knows_every_slip_and_no_other() -> None:
    assert [effect.mistake for effect in WrongUnit.blunders_at_station("S1")] == [
        slip.name for slip in UNIT_AND_CONVENTION_ERRORS
    ]
    with pytest.raises(ModelError, match=r"did you mean .*metre"):
        WrongUnit(("S1",), mistake="metres")


@pytest.mark.parametrize("slip", ANGULAR, ids=lambda slip: slip.name)
def test_lengths_identify_the_transcription_error_of_a_network_on_a_single_face(slip: WrongColumnConversion) -> None:
    recording, _ = network(seed=2)
    wrong = slipped(recording, slip)
    assert error_from_lengths(recording.readings, recording.station, recording.target) is None
    error = error_from_lengths(wrong.readings, recording.station, recording.target)
    assert error is not None
    np.testing.assert_allclose(error.without_error(wrong.readings), recording.readings, atol=1e-12)


def test_a_network_in_gon_on_a_single_face_is_refused_with_a_proposal(tmp_path: Path) -> None:
    recording, _ = network(seed=2)
    gon = next(slip for slip in UNIT_AND_CONVENTION_ERRORS if slip.name == "gon")
    with pytest.raises(RecordError, match="agree if the column contains gon; expected degrees"):
        write_recording(slipped(recording, gon), tmp_path)  # what could not be read back is not written
