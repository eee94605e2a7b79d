"""Quality of a recording before and after calibration: the paper's criteria, and verification."""

from ltsim.adjustment.evaluation.criteria import (
    Criteria as Criteria,
    CriteriaEntry as CriteriaEntry,
    evaluate as evaluate,
    read_nominal as read_nominal,
    verify as verify,
)
