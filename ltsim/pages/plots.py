"""The picture of each result, for `plot()`."""

from __future__ import annotations

from functools import singledispatch
from typing import Any, cast

from matplotlib.figure import Figure

from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import history_file
from ltsim.calibration.history import History
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.errors import ModelError
from ltsim.evaluation.criteria import Criteria
from ltsim.fieldcheck.check import Check
from ltsim.pages.figures.floor_plan import floor_plan
from ltsim.pages.figures.parameters import criteria_figure, history_figure, parameter_figure
from ltsim.pages.figures.points import check_figure, displacement_figure
from ltsim.pages.figures.residuals import residuals_by_covariate
from ltsim.pages.residuals import Residuals
from ltsim.pages.sections.diagnosis import finding_drawing
from ltsim.pages.workshop import from_scenario
from ltsim.planning.files import planned_scenario
from ltsim.planning.planner import Plan
from ltsim.results import Result
from ltsim.tasks.comparison import Comparison


@singledispatch
def figure_of(result: Result) -> Figure:
    """The picture of a result; raises ModelError for one that has none."""
    if type(result).__module__ == "ltsim.campaigns.statistics":  # not registered: its packages may be missing
        from ltsim.pages.sections.campaign import campaign_figure

        return campaign_figure(cast(Any, result))
    raise ModelError(f"a {type(result).__name__} has no picture of its own; lt.report makes a page of its folder")


@figure_of.register
def _(result: Calibration) -> Figure:
    if not result.names:
        raise ModelError("an adjustment without instrument parameters has no picture; lt.report makes a page of it")
    return parameter_figure(result.parameters)


@figure_of.register
def _(result: Criteria) -> Figure:
    if result.distance.after is None:
        raise ModelError("criteria without a calibration have no before and after to draw")
    return criteria_figure(result.table())


@figure_of.register
def _(result: Check) -> Figure:
    return check_figure(result)


@figure_of.register
def _(result: Diagnosis) -> Figure:
    """The curve or the residuals of the first finding; of a consistent recording its residuals."""
    before, after = (Residuals.from_adjustment(a) for a in (result.baseline, result.adjusted))
    for finding in result.findings[:1]:
        draw = finding_drawing(finding, before, after)
        if draw is not None:
            return draw()
    return residuals_by_covariate(after)


@figure_of.register
def _(result: Comparison) -> Figure:
    return displacement_figure(result)


@figure_of.register
def _(result: History) -> Figure:
    content = history_file(result)
    known = [course for course in content.parameters if course.constant.dof]
    if not known:
        raise ModelError("no parameter of these calibrations is known better than by its guarantee; there is no course")
    return history_figure([c.label for c in content.calibrations], known)


@figure_of.register
def _(result: Plan) -> Figure:
    """The floor with the chosen layout, as floor.png of a plan's folder."""
    return floor_plan(from_scenario(planned_scenario(result)), coordinates=True, ground=result.file.floor)
