"""How good a recording is, before and after calibration: the paper's criteria and verification."""

from ltsim.evaluate.criteria import Comparison, Criteria, Differences, evaluate
from ltsim.evaluate.share_removed import ShareRemoved, share_removed
from ltsim.evaluate.verification import read_nominal, verify

__all__ = [
    "Comparison",
    "Criteria",
    "Differences",
    "ShareRemoved",
    "evaluate",
    "read_nominal",
    "share_removed",
    "verify",
]
