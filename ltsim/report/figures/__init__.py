"""One figure a file: each a function from data to a matplotlib Figure."""

from ltsim.report.figures.budget import budget
from ltsim.report.figures.by_setting import Mean, by_setting
from ltsim.report.figures.check import check_figure
from ltsim.report.figures.correlation import correlation
from ltsim.report.figures.criteria import Criterion, criteria
from ltsim.report.figures.displacements import displacements, enlargement
from ltsim.report.figures.distributions import Distribution, distributions
from ltsim.report.figures.driver_curve import driver_curve
from ltsim.report.figures.evidence import Candidate, evidence
from ltsim.report.figures.floor_plan import floor_plan
from ltsim.report.figures.parameters import ParameterRow, parameters
from ltsim.report.figures.power import PowerCurve, power
from ltsim.report.figures.residuals_by_covariate import residuals_by_covariate
from ltsim.report.figures.residuals_by_station import residuals_by_station
from ltsim.report.figures.sigmas import SigmaRow, sigmas
from ltsim.report.figures.signature import signature
from ltsim.report.figures.sky import sky
from ltsim.report.figures.trade_off import Layout, trade_off
from ltsim.report.figures.visibility import visibility
from ltsim.report.figures.z_scores import ZScores, coverage, z_scores

__all__ = [
    "Candidate",
    "Criterion",
    "Distribution",
    "Layout",
    "Mean",
    "ParameterRow",
    "PowerCurve",
    "SigmaRow",
    "ZScores",
    "budget",
    "by_setting",
    "check_figure",
    "correlation",
    "coverage",
    "criteria",
    "displacements",
    "distributions",
    "driver_curve",
    "enlargement",
    "evidence",
    "floor_plan",
    "parameters",
    "power",
    "residuals_by_covariate",
    "residuals_by_station",
    "sigmas",
    "signature",
    "sky",
    "trade_off",
    "visibility",
    "z_scores",
]
