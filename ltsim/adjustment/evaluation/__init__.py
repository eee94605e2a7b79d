"""Quality of a recording before and after calibration: the paper's criteria, and verification by nominal points."""

from ltsim.adjustment.evaluation.criteria import (
    Criteria as Criteria,
    CriteriaEntry as CriteriaEntry,
    evaluate_criteria as evaluate_criteria,
    read_nominal as read_nominal,
    verify_against_nominal as verify_against_nominal,
)
