"""Network adjustment: from a recording to poses, targets and parameters with their covariance."""

from ltsim.adjust.adjustment import Adjustment as Adjustment, Outlier as Outlier
from ltsim.adjust.estimate import adjust as adjust
