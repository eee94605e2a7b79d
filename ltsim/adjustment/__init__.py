"""Network adjustment: from a recording to poses, targets and parameters with their covariance."""

from ltsim.adjustment.adjustment import Adjustment as Adjustment, Outlier as Outlier
from ltsim.adjustment.estimate import adjust as adjust
