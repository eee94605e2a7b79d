"""Calibration: instrument parameters from a recording, what could not be determined, and the corrected recording."""

from ltsim.calibrate.calibration import (
    Calibration as Calibration,
    Combination as Combination,
    Fit as Fit,
    OutlierRow as OutlierRow,
    StationPose as StationPose,
)
from ltsim.calibrate.correct import correct as correct
from ltsim.calibrate.distance import calibrate_distance as calibrate_distance
from ltsim.calibrate.files import read_calibration as read_calibration, write_calibration as write_calibration
from ltsim.calibrate.network import adjust_network as adjust_network, calibrate_network as calibrate_network
