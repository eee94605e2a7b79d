"""How good a recording is, before and after calibration: the paper's criteria and verification."""

from ltsim.evaluation.criteria import (
    Comparison as Comparison,
    Criteria as Criteria,
    Differences as Differences,
    evaluate as evaluate,
)
from ltsim.evaluation.share_removed import ShareRemoved as ShareRemoved
from ltsim.evaluation.verification import read_nominal as read_nominal, verify as verify
