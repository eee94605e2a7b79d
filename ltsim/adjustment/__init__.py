"""Network adjustment: from a recording to poses, targets and parameters with their covariance."""

from ltsim.adjustment.adjustment import Adjustment as Adjustment, FlaggedReading as FlaggedReading
from ltsim.adjustment.estimate import adjust as adjust
