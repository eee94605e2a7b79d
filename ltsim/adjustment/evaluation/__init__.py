"""Quality of a recording before and after a calibration: agreement of its stations, and errors at nominal points."""

from ltsim.adjustment.evaluation.criteria import (
    Criteria as Criteria,
    CriteriaEntry as CriteriaEntry,
    evaluate_criteria as evaluate_criteria,
    read_nominal as read_nominal,
    verify_against_nominal as verify_against_nominal,
)
