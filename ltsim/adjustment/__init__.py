"""Network adjustment: station poses, target coordinates and parameters with covariances, from a recording."""

from ltsim.adjustment.adjustment import Adjustment as Adjustment, FlaggedReading as FlaggedReading
from ltsim.adjustment.estimate import adjust as adjust
