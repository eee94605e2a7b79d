"""Acceptance test in a network: errors of lengths between its adjusted targets, and differences between the faces.

The adjusted targets replace calibrated reference lengths. Errors that `calibrate` identifies in the recording, and that
are no errors of the tracker, such as a moved target, are removed from the tested readings. Possible errors of the
tracker remain in the readings.

References
----------
Wang, Muralikrishnan, Icasio Hernandez, Shakarji, Sawyer, Measurement 165 (2020) 108165.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ltsim.acceptance.files import TestOutcome
from ltsim.acceptance.tested_network import CENTRING_CAUSE_KIND, TestedNetwork
from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.hypothesis import CauseKind
from ltsim.adjustment.identification.recommendations import recommendations_for_causes
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.verbs import calibrate
from ltsim.core.errors import NetworkError
from ltsim.core.notation import names_text
from ltsim.recordings.recording import Recording
from ltsim.recordings.specification import Specification

OUTLIER_CAUSE_KINDS: tuple[CauseKind, ...] = ("outlier", "reflector-seating")
"""Kinds of causes whose pointings are neither adjusted nor tested: outliers, and sights to a badly seated reflector."""
MAX_OUTLIER_ROUNDS = 3
"""Largest number of repeated adjustments of a network, each without the outliers identified before."""
TRACKER_CAUSE_KINDS: tuple[CauseKind, ...] = ("constant-drift", "noise-level", CENTRING_CAUSE_KIND)
"""Kinds of causes of a misfit that may be errors of the tracker. Random displacements at each set-up (`centring`) have
the same effect as errors of the tracker that repeat in all rounds."""


def may_be_tracker_error(cause: CauseTest) -> bool:
    """True for an identified cause of a misfit that may be an error of the tracker itself.

    A change of the elevations may come from the tracker's vertical index. A change of the additive constant of the
    distances at one set-up belongs to a reflector, a change of the scale at one set-up belongs to the air. An error at
    one target is not an error of the tracker.
    """
    is_shift = cause.kind in ("constant-offset", "constant-step")
    is_possible = cause.kind in TRACKER_CAUSE_KINDS or (is_shift and cause.acts_on == "elevation")
    return is_possible and not cause.where.targets


def _treatment_text(cause: CauseTest, treatment_text: str) -> str:
    """Phrase on the treatment of an identified error: `treatment_text`, with another end for centring errors."""
    if cause.kind != CENTRING_CAUSE_KIND:
        return treatment_text
    return treatment_text.partition(",")[0] + ", and the uncertainties of the lengths contain it"


@dataclass(frozen=True)
class NetworkTests:
    """Acceptance tests of a tracker in a network, and the errors that were identified in the recording."""

    test_outcomes: tuple[TestOutcome, ...]
    """Tests of lengths and two-face differences, with their errors and limits."""
    corrected_causes: tuple[CauseTest, ...]
    """Errors in the recording that are no errors of the tracker. They are removed from the tested readings; centring
    errors are not removed, but included in the uncertainties."""
    tracker_causes: tuple[CauseTest, ...]
    """Possible errors of the tracker, which remain in the tested readings."""
    uncorrected_causes: tuple[CauseTest, ...]
    """Errors in the recording that are no errors of the tracker and are not removed; they make the tests invalid."""
    outliers: tuple[CauseTest, ...]
    """Outliers among the readings; their pointings are neither adjusted nor tested."""
    unexplained_noise_ratio: float
    """Ratio of the scatter of the readings to their declared noise if no cause of the scatter is identified; otherwise
    1."""
    n_errors_rejected_after_correction: int = 0
    """Number of test errors that are rejected if the readings are corrected by the estimated instrument constants."""

    @property
    def identified_error_sentences(self) -> tuple[str, ...]:
        """Sentences on the errors identified in the recording, and on their treatment in the tests."""
        cause_groups = (
            (self.uncorrected_causes, "not an error of the tracker, but it remains in the tests, which are invalid"),
            (self.corrected_causes, "not an error of the tracker, and it is removed before the tests"),
            (self.tracker_causes, "possibly an error of the tracker, and it remains in the tests"),
        )
        lines = [
            f"{c.sentence} This is {_treatment_text(c, treatment_text)}."
            for causes, treatment_text in cause_groups
            for c in causes
        ]
        if self.outliers:
            lines.append(f"Pointings with outliers are not tested: {self._outlier_pointings_text}.")
        if self.unexplained_noise_ratio > 1.0:
            lines.append(
                f"The readings scatter {self.unexplained_noise_ratio:.2f} times as much as declared, and the cause "
                "is not identified: the uncertainties of the lengths are multiplied by this factor, and those of the "
                "two-face errors contain the additional scatter."
            )
        return tuple(lines)

    @property
    def _outlier_pointings_text(self) -> str:
        """List of the pointings with outliers: station, target and row; pointings after the third are only counted."""
        names = (f"{t.where.stations[0]} to {t.where.targets[0]} (row {t.rows[0]})" for t in self.outliers)
        return names_text(list(dict.fromkeys(names)), 3)

    @property
    def urgent_actions(self) -> tuple[str, ...]:
        """Actions that make the tests valid, or that separate errors of the tracker from errors of its surroundings."""
        unexplained = ["Run ltsim diagnose to find the cause of the scatter before you judge the tracker."]
        actions = recommendations_for_causes((*self.uncorrected_causes, *self.tracker_causes))
        return (*actions, *(unexplained if self.unexplained_noise_ratio > 1.0 else []))

    @property
    def action_after_rejection(self) -> str:
        """Action after a rejection: adjustment by the maker, or correction by instrument constants if it suffices."""
        count, total = self.n_errors_rejected_after_correction, len(self.test_outcomes)
        maker = "Have the maker adjust the tracker"
        if not count:
            correction = "correct all readings by ltsim calibrate and ltsim correct"
            return f"{maker}, or {correction}. After this correction no error is rejected."
        return (
            f"{maker}. Corrections by ltsim calibrate do not suffice: the test then rejects {count} of {total} errors."
        )

    def further_actions(self, *, is_rejected: bool) -> tuple[str, ...]:
        """Actions for errors that leave the tests valid; outliers are to be measured again unless `is_rejected`."""
        again = [f"Measure again: {self._outlier_pointings_text}."] if self.outliers and not is_rejected else []
        return (*recommendations_for_causes(self.corrected_causes), *again)


def evaluate_network(recording: Recording, instrument_specification: Specification) -> NetworkTests:
    """Tests of a tracker in a network: errors of the lengths that each station measures, and differences between faces.

    The reference lengths come from a network adjustment that also estimates the instrument constants and the errors
    identified in the recording, so that the lengths are free of both. The lengths that a station measures in one face
    contain the errors of the instrument. `instrument_specification` has the limits. NetworkError is raised for a
    network with one station, which has no independent reference lengths, for several instruments, and for a network
    that cannot be adjusted.
    """
    if len(recording.stations) < 2:
        raise NetworkError("the recording has one station; the network method needs at least two")
    if len(recording.instruments) > 1:
        raise NetworkError(f"the recording has {len(recording.instruments)} instruments; an acceptance test needs one")
    calibration, outliers = _calibrate_without_outliers(recording)
    adjustment = calibration.adjustment
    assert adjustment is not None
    adjustment.solution.require_success()
    network = TestedNetwork(adjustment, calibration.uncertainty_factor)
    test_outcomes = network.test_outcomes(instrument_specification)
    if not test_outcomes:
        raise NetworkError("no station measured distance and both angles of two targets; a length needs both ends")
    n_rejected = 0
    if any(entry.judgement == "rejected" for entry in test_outcomes):
        without_constants = replace(network, is_corrected_by_estimated_constants=True).test_outcomes(
            instrument_specification
        )
        n_rejected = sum(entry.judgement == "rejected" for entry in without_constants)
    causes = [test for test in calibration.tests if test.is_fault and test.kind != "outlier"]
    corrected = tuple(c for c in causes if not may_be_tracker_error(c) and network.is_cause_corrected(c))
    tracker = tuple(c for c in causes if may_be_tracker_error(c))
    other_causes = tuple(c for c in causes if c not in corrected and c not in tracker)
    factor = 1.0 if causes else calibration.uncertainty_factor
    return NetworkTests(tuple(test_outcomes), corrected, tracker, other_causes, outliers, factor, n_rejected)


def _calibrate_without_outliers(recording: Recording) -> tuple[Calibration, tuple[CauseTest, ...]]:
    """Calibration without the pointings that contain outliers, and the tests that identified these outliers.

    After each adjustment further outliers are searched for, at most `MAX_OUTLIER_ROUNDS` times.
    """
    outliers: list[CauseTest] = []
    for _ in range(MAX_OUTLIER_ROUNDS):
        calibration = calibrate(recording, advise=False)
        identified = [test for test in calibration.tests if test.kind in OUTLIER_CAUSE_KINDS]
        if not identified:
            break
        outliers += identified
        readings = recording.readings.copy()
        readings[[row - 1 for test in identified for row in test.rows]] = np.nan
        recording = recording.with_readings(readings)
    else:
        calibration = calibrate(recording, advise=False)
    return calibration, tuple(outliers)
