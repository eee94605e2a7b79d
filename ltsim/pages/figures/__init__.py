"""Each a function from data to a matplotlib Figure."""

from ltsim.pages.figures.budget import budget as budget
from ltsim.pages.figures.by_factor import Swept as Swept, by_factor as by_factor
from ltsim.pages.figures.by_setting import Mean as Mean, by_setting as by_setting
from ltsim.pages.figures.correlation import correlation as correlation
from ltsim.pages.figures.criteria import Criterion as Criterion, criteria as criteria
from ltsim.pages.figures.displacements import (
    displacements as displacements,
    enlargement as enlargement,
)
from ltsim.pages.figures.distributions import Distribution as Distribution, distributions as distributions
from ltsim.pages.figures.floor_plan import floor_plan as floor_plan
from ltsim.pages.figures.found import (
    MOST_MARKED as MOST_MARKED,
    hidden_and_found as hidden_and_found,
    whereabouts as whereabouts,
)
from ltsim.pages.figures.parameters import ParameterRow as ParameterRow, parameters as parameters
from ltsim.pages.figures.reflector_changes import reflector_changes as reflector_changes
from ltsim.pages.figures.residuals import (
    USUAL as USUAL,
    driver_curve as driver_curve,
    residuals_by_covariate as residuals_by_covariate,
    residuals_by_station as residuals_by_station,
    signature as signature,
)
from ltsim.pages.figures.sigmas import SigmaRow as SigmaRow, sigmas as sigmas
from ltsim.pages.figures.trade_off import Layout as Layout, trade_off as trade_off
from ltsim.pages.figures.visibility import visibility as visibility
