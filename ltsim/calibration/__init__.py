"""Calibration: instrument parameters from a recording, what could not be determined, and the corrected recording."""

from ltsim.calibration.calibration import (
    Calibration as Calibration,
    Combination as Combination,
    Fit as Fit,
    OutlierRow as OutlierRow,
    StationPose as StationPose,
)
from ltsim.calibration.correct import correct as correct
from ltsim.calibration.distance import calibrate_distance as calibrate_distance
from ltsim.calibration.files import read_calibration as read_calibration, write_calibration as write_calibration
from ltsim.calibration.network import adjust as adjust, calibrate_network as calibrate_network
