"""Network adjustment: from a recording to poses, targets and parameters with their covariance."""

from ltsim.adjust.adjustment import Adjustment, Outlier
from ltsim.adjust.estimate import adjust

__all__ = ["Adjustment", "Outlier", "adjust"]
