"""One figure a file: each a function from data to a matplotlib Figure."""

from ltsim.report.figures.budget import budget as budget
from ltsim.report.figures.by_factor import Swept as Swept, by_factor as by_factor
from ltsim.report.figures.by_setting import Mean as Mean, by_setting as by_setting
from ltsim.report.figures.check import check_figure as check_figure
from ltsim.report.figures.correlation import correlation as correlation
from ltsim.report.figures.criteria import Criterion as Criterion, criteria as criteria
from ltsim.report.figures.displacements import displacements as displacements, enlargement as enlargement
from ltsim.report.figures.distributions import Distribution as Distribution, distributions as distributions
from ltsim.report.figures.driver_curve import driver_curve as driver_curve
from ltsim.report.figures.evidence import Candidate as Candidate, evidence as evidence
from ltsim.report.figures.floor_plan import floor_plan as floor_plan
from ltsim.report.figures.parameters import ParameterRow as ParameterRow, parameters as parameters
from ltsim.report.figures.reflector_changes import reflector_changes as reflector_changes
from ltsim.report.figures.residuals_by_covariate import residuals_by_covariate as residuals_by_covariate
from ltsim.report.figures.residuals_by_station import residuals_by_station as residuals_by_station
from ltsim.report.figures.sigmas import SigmaRow as SigmaRow, sigmas as sigmas
from ltsim.report.figures.signature import signature as signature
from ltsim.report.figures.sky import sky as sky
from ltsim.report.figures.trade_off import Layout as Layout, trade_off as trade_off
from ltsim.report.figures.visibility import visibility as visibility
from ltsim.report.figures.z_scores import (
    ALLOWED as ALLOWED,
    ZScores as ZScores,
    coverage as coverage,
    uncovered as uncovered,
    z_scores as z_scores,
)
