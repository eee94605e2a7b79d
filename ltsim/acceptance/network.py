"""Errors of lengths and two-face differences in a network, whose adjusted targets replace calibrated lengths.

Errors that `calibrate` identifies in the recording and that are not the tracker's, such as a moved target, are removed
from the tested readings. Possible errors of the tracker remain in them.

References
----------
Wang, Muralikrishnan, Icasio Hernandez, Shakarji, Sawyer, Measurement 165 (2020) 108165.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ltsim.acceptance.files import TestEntry
from ltsim.acceptance.tested_network import CENTRING_KIND, TestedNetwork
from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.hypothesis import CauseKind
from ltsim.adjustment.identification.recommendations import recommendations_for_causes
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.verbs import calibrate
from ltsim.core.errors import NetworkError
from ltsim.core.notation import listing
from ltsim.recordings.recording import Recording
from ltsim.recordings.specification import Specification

MAX_OUTLIER_ROUNDS = 3
"""Largest number of adjustments in which outliers are identified."""
TRACKER_CAUSE_KINDS: tuple[CauseKind, ...] = ("constant-drift", "noise-level", CENTRING_KIND)
"""Kinds of causes that may be errors of the tracker. Random displacements at each set-up (`centring`) have the same
effect as errors of the tracker that repeat in all rounds.
"""


def may_be_tracker_error(cause: CauseTest) -> bool:
    """True for an identified cause that may be an error of the tracker itself.

    Elevations change with the tracker's vertical index. A constant of the distances that differs at one set-up is that
    of a reflector, and a scale that differs there is that of the air. An error at one target is none of the tracker.
    """
    is_shift = cause.kind in ("constant-offset", "constant-step")
    is_possible = cause.kind in TRACKER_CAUSE_KINDS or (is_shift and cause.acts_on == "elevation")
    return is_possible and not cause.where.targets


def _treatment_text(cause: CauseTest, treatment_text: str) -> str:
    """Text on the treatment of a cause; for centring errors it states that the uncertainties contain them."""
    if cause.kind != CENTRING_KIND:
        return treatment_text
    return treatment_text.partition(",")[0] + ", and the uncertainties of the lengths contain it"


@dataclass(frozen=True)
class NetworkTests:
    """Tests of a tracker by a network, with the errors that were identified in the recording."""

    entries: tuple[TestEntry, ...]
    """Errors of lengths and two-face differences, with their limits."""
    corrected_causes: tuple[CauseTest, ...]
    """Errors of the recording that are no errors of the tracker. They are removed from the tested readings; centring
    errors are in the uncertainties instead.
    """
    tracker_causes: tuple[CauseTest, ...]
    """Possible errors of the tracker, which remain in the tested readings."""
    uncorrected_causes: tuple[CauseTest, ...]
    """Errors of the recording that are not removed; the tests are not valid with them."""
    outliers: tuple[CauseTest, ...]
    """Outlying readings, whose pointings are neither adjusted nor tested."""
    unexplained_noise_ratio: float
    """Ratio of the scatter of the readings to the declared noise if no cause of it is identified; otherwise 1."""
    n_rejected_without_constants: int = 0
    """Number of errors beyond their limits after the correction of the readings by the estimated constants."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the errors in the recording, and on their treatment."""
        cause_groups = (
            (self.uncorrected_causes, "no error of the tracker, but it remains in the tests, which are not valid"),
            (self.corrected_causes, "no error of the tracker, and it is removed before the tests"),
            (self.tracker_causes, "possibly an error of the tracker, and it remains in the tests"),
        )
        lines = [
            f"{c.sentence} This is {_treatment_text(c, treatment_text)}."
            for causes, treatment_text in cause_groups
            for c in causes
        ]
        if self.outliers:
            lines.append(f"Pointings with outlying readings are not tested: {self._outlier_names}.")
        if self.unexplained_noise_ratio > 1.0:
            lines.append(
                f"The readings scatter {self.unexplained_noise_ratio:.2f} times as much as declared, and the cause "
                "is not identified: the uncertainties of the lengths are multiplied by this factor, and those of the "
                "two-face errors contain the additional scatter."
            )
        return tuple(lines)

    @property
    def _outlier_names(self) -> str:
        """Stations, targets and rows of the pointings with outlying readings, the first three by name."""
        names = (f"{t.where.stations[0]} to {t.where.targets[0]} (row {t.rows[0]})" for t in self.outliers)
        return listing(list(dict.fromkeys(names)), 3)

    @property
    def urgent_actions(self) -> tuple[str, ...]:
        """Actions without which the tests are not valid, or which separate the tracker from its surroundings."""
        unexplained = ["Run ltsim diagnose to find the cause of the scatter before you judge the tracker."]
        actions = recommendations_for_causes((*self.uncorrected_causes, *self.tracker_causes))
        return (*actions, *(unexplained if self.unexplained_noise_ratio > 1.0 else []))

    @property
    def constants_action(self) -> str:
        """Action after a rejection, by the number of errors beyond their limits without the instrument's constants."""
        count, total = self.n_rejected_without_constants, len(self.entries)
        maker = "Have the maker adjust the tracker"
        if not count:
            correction = "correct all readings by ltsim calibrate and ltsim correct"
            return f"{maker}, or {correction}. After this correction no error is rejected."
        return (
            f"{maker}. Corrections by ltsim calibrate do not suffice: the test then rejects {count} of {total} errors."
        )

    def further_actions(self, *, is_rejected: bool) -> tuple[str, ...]:
        """Actions after errors that do not impair the tests; outliers are measured again unless others are rejected."""
        again = [f"Measure again: {self._outlier_names}."] if self.outliers and not is_rejected else []
        return (*recommendations_for_causes(self.corrected_causes), *again)


def evaluate_network(recording: Recording, instrument_specification: Specification) -> NetworkTests:
    """Errors of lengths measured by each station, relative to the adjusted network, and differences between faces.

    The network is adjusted together with the instrument's constants and with the errors identified in the recording, so
    that its lengths contain neither. The lengths of each station in one face are compared with them. They contain the
    errors of the instrument. Raises NetworkError for a network with one station, which has no independent lengths, for
    several instruments, and for a network that cannot be adjusted.
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
    test_entries = network.test_entries(instrument_specification)
    if not test_entries:
        raise NetworkError("no station measured the distance and both angles of two targets; a length needs both ends")
    n_rejected = 0
    if any(entry.judgement == "rejected" for entry in test_entries):
        without_constants = replace(network, is_corrected_for_constants=True).test_entries(instrument_specification)
        n_rejected = sum(entry.judgement == "rejected" for entry in without_constants)
    causes = [test for test in calibration.tests if test.is_fault and test.kind != "outlier"]
    corrected = tuple(c for c in causes if not may_be_tracker_error(c) and network.is_corrected(c))
    tracker = tuple(c for c in causes if may_be_tracker_error(c))
    other_causes = tuple(c for c in causes if c not in corrected and c not in tracker)
    factor = 1.0 if causes else calibration.uncertainty_factor
    return NetworkTests(tuple(test_entries), corrected, tracker, other_causes, outliers, factor, n_rejected)


def _calibrate_without_outliers(recording: Recording) -> tuple[Calibration, tuple[CauseTest, ...]]:
    """Calibration without the pointings in which outliers are identified, and the tests of the outliers.

    Outliers are identified again without the first ones, at most `MAX_OUTLIER_ROUNDS` times.
    """
    outliers: list[CauseTest] = []
    for _ in range(MAX_OUTLIER_ROUNDS):
        calibration = calibrate(recording, advise=False)
        identified = [test for test in calibration.tests if test.kind == "outlier"]
        if not identified:
            break
        outliers += identified
        readings = recording.readings.copy()
        readings[[row - 1 for test in identified for row in test.rows]] = np.nan
        recording = recording.with_readings(readings)
    else:
        calibration = calibrate(recording, advise=False)
    return calibration, tuple(outliers)
