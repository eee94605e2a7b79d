"""Calibration: instrument parameters from a recording, what could not be determined, and the corrected recording."""

from ltsim.calibrate.calibration import Calibration, Combination, Fit, OutlierRow, StationPose
from ltsim.calibrate.correct import correct
from ltsim.calibrate.distance import calibrate_distance
from ltsim.calibrate.files import read_calibration, write_calibration
from ltsim.calibrate.network import adjust_network, calibrate_network

__all__ = [
    "Calibration",
    "Combination",
    "Fit",
    "OutlierRow",
    "StationPose",
    "adjust_network",
    "calibrate_distance",
    "calibrate_network",
    "correct",
    "read_calibration",
    "write_calibration",
]
