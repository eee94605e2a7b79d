"""Tables of a plan; each declaration defines the CSV file, the data frame, and the table in terminal and page."""

from ltsim.core.results import Column, Table, flag_columns, model_columns, number_columns, text_columns
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.planning.plan_entries import ConfusablePair, DetectableSize, TradeoffEntry
from ltsim.planning.planner import LayoutEvaluation, PlannedNetwork

POSITION_COLUMNS = number_columns(
    ".10g",
    ".3f",
    x_mm="x coordinate in the hall frame, rounded to 0.001 mm",
    y_mm="y coordinate in the hall frame, rounded to 0.001 mm",
    z_mm="z coordinate in the hall frame, rounded to 0.001 mm",
)
"""Columns with the coordinates of a position in the hall [mm]."""
PLANNED_STATIONS_TABLE = Table(
    "stations.csv",
    "positions of the tripods",
    (
        *text_columns(station="name of the station"),
        *number_columns(
            display_format=".0f",
            x_mm="x coordinate of the tracker head in the hall frame",
            y_mm="y coordinate of the tracker head in the hall frame",
            z_mm="z coordinate of the tracker head in the hall frame",
            yaw_deg="direction of azimuth zero, counter-clockwise from the x axis",
        ),
        *number_columns(
            sigma_x_um="expected standard deviation of x",
            sigma_y_um="expected standard deviation of y",
            sigma_z_um="expected standard deviation of z",
        ),
        *number_columns(visible_reflectors="number of visible reflectors"),
    ),
)
"""Table of the planned stations with their expected precision."""
PLANNED_REFLECTORS_TABLE = Table(
    "reflectors.csv",
    "reflectors with their expected uncertainty",
    (
        *text_columns(target="name of the reflector"),
        *POSITION_COLUMNS,
        *number_columns(sigma_um="expected point error"),
        *number_columns(
            U_x_um="expanded uncertainty of x, k = 2",
            U_y_um="expanded uncertainty of y, k = 2",
            U_z_um="expanded uncertainty of z, k = 2",
        ),
        *number_columns(
            point_error_mm="point error at the confidence level of the goal",
            tolerance_mm="largest permitted point error",
        ),
        *text_columns(visible_from="names of the stations that see the reflector"),
    ),
)
"""Table of the planned reflectors with their expected precision."""
PLANNED_PARAMETERS_TABLE = Table(
    "parameters.csv",
    "instrument parameters with their expected uncertainty",
    (
        *text_columns(parameter="name of the parameter", unit="unit of the standard deviations"),
        *number_columns(
            sigma="expected standard deviation after calibration",
            sigma_reference="expected standard deviation with the stations of the scenario",
            prior_sigma="standard deviation before any reading",
        ),
        *number_columns(removed_variance_fraction="fraction of the prior variance that the readings remove"),
    ),
)
"""Table of the instrument parameters with their expected standard deviations."""
VISIBILITY_TABLE = Table(
    "visibility.csv",
    "sights between stations and targets",
    (
        *text_columns(
            station="name of the station",
            target="name of the target",
            sees="yes if the station sees the target, otherwise no",
            why_not="reason for a blocked sight",
        ),
        *number_columns(
            distance_mm="distance between station and target",
            elevation_deg="elevation of the beam",
            incidence_deg="angle of incidence on the reflector",
        ),
    ),
)
"""Table of all pairs of a station and a target, with the reason if the line of sight is blocked."""
NOMINAL_POINTS_TABLE = Table(
    "nominals.csv",
    "nominal coordinates of every point in the hall frame, for the tracker's software",
    (*text_columns(name="name of the point"), *POSITION_COLUMNS),
)
"""Table of the nominal coordinates of all points, for import into the software of the tracker."""
WORK_ORDER_TABLE = Table(
    "work-order.csv",
    "every pointing in the order of measurement, with the expected readings",
    (
        *number_columns(step="number of the pointing, from 1"),
        *text_columns(station="name of the station", target="name of the target"),
        *number_columns(
            face="face, 1 or 2", round="number of the round, from 1", minutes="time since the first pointing"
        ),
        *number_columns(
            azimuth_deg="expected azimuth", elevation_deg="expected elevation", distance_mm="expected distance"
        ),
    ),
)
"""Table of all pointings in the order of measurement, with the expected readings."""
TAPE_DISTANCES_TABLE = Table(
    "setups.csv",
    "tape distances that locate the tripods",
    (
        *text_columns(station="name of the station"),
        *(
            Column(f"tape_{i}", "tape distance and its mark; two define the position, the third checks it", "text")
            for i in (1, 2, 3)
        ),
        Column("towards", "direction of azimuth zero", "text", title="azimuth zero looks"),
        Column(
            "height_m",
            "height of the centre of the head above the floor",
            display_format=".2f",
            title="head over floor [m]",
        ),
    ),
)
"""Table of the tape distances that locate the tripods."""
TRADEOFF_TABLE = Table(
    "tradeoff.csv",
    "measuring procedures, each with its best layout",
    (
        *model_columns(TradeoffEntry, "station_count faces repeats pointings hours"),
        *model_columns(TradeoffEntry, "objective_value", objective_value={"title": "objective"}),
        Column(
            "point_error_um",
            "objective in um, if only the point errors of the targets have a weight in it",
            title="weighted point error",
        ),
        *model_columns(TradeoffEntry, "is_efficient", is_efficient={"title": "best for its duration"}),
    ),
)
"""Table of the points of the trade-off curve between cost and quality."""
DETECTABLE_SIZES_TABLE = Table("effects.csv", "minimal detectable sizes of effects", model_columns(DetectableSize))
"""Table of the minimal detectable sizes of effects."""
TOLERANCES_TABLE = Table(
    "tolerances.csv",
    "point errors compared with their tolerances",
    (
        *text_columns(point="name of the point"),
        *number_columns(
            display_format=".5g",
            point_error_mm="point error at the confidence level of the goal",
            tolerance_mm="largest permitted point error",
        ),
        *text_columns(
            tolerance_ratio="point error divided by tolerance, with enough digits to show on which side of 1 it is"
        ),
        *flag_columns(tolerance_met="the tolerance is met"),
    ),
)
"""Table of the points with a tolerance."""
LOSS_CHECKS_TABLE = Table(
    "losses.csv",
    "tolerances after the loss of a station or a sight",
    (
        *text_columns(lost_station_or_sight="lost station or sight"),
        *flag_columns(tolerances_met="all tolerances are met"),
        *text_columns(
            worst_point="point with the largest ratio of error to tolerance",
            tolerance_ratio="ratio of error to tolerance of the worst point",
            unseen_points="points that no station sees any more",
        ),
    ),
)
"""Table of the checks of the tolerances after the loss of a station or a sight."""
REFLECTOR_CHANGES_TABLE = Table(
    "changes.csv",
    "reflectors to move, add or remove",
    (
        *number_columns(number="number of the change on the floor plan"),
        *text_columns(change="reflector that is moved, added or removed, and its new position"),
        *number_columns(
            "r", "+.2f", target_rms_decrease_um="reduction of the weighted point error of all other points"
        ),
        *number_columns("r", "+.1f", gain_percent="reduction of the objective"),
        *text_columns(most_for="parameter, or point, whose standard deviation changes most"),
        *number_columns("r", "+.1f", sigma_percent="change of this standard deviation"),
    ),
)
"""Table of the reported changes (move, addition, removal) of a reflector."""
EXPECTED_DISAGREEMENT_TABLE = Table(
    "expected.csv",
    "expected disagreement of the stations, before and after a calibration",
    (
        *text_columns(layout="this plan, or the reference layout", criterion="disagreement in distance or coordinate"),
        *number_columns(
            "r",
            before_um="mean disagreement before calibration",
            after_um="mean disagreement after calibration",
            improvement_percent="reduction of the mean disagreement",
        ),
    ),
)
"""Table of the expected disagreement of the stations before and after calibration."""
CONFUSABLE_EFFECTS_TABLE = Table(
    "confusable.csv", "pairs of effects that the layout hardly distinguishes", model_columns(ConfusablePair)
)
"""Table of the pairs of effects that the layout hardly distinguishes."""
PLAN_TABLES = (
    NOMINAL_POINTS_TABLE, WORK_ORDER_TABLE, PLANNED_STATIONS_TABLE, PLANNED_REFLECTORS_TABLE, TOLERANCES_TABLE,
    LOSS_CHECKS_TABLE, TRADEOFF_TABLE, PLANNED_PARAMETERS_TABLE, EXPECTED_DISAGREEMENT_TABLE, REFLECTOR_CHANGES_TABLE,
    DETECTABLE_SIZES_TABLE,
    CONFUSABLE_EFFECTS_TABLE, VISIBILITY_TABLE,
)  # fmt: skip
"""Tables that are written as CSV files together with plan.json."""


def make_visibility_table(layout: LayoutEvaluation) -> Table:
    """Table `visibility.csv` of a layout, with one row for each pair of a station and a target."""
    words, table, survey = layout.visibility.reason_texts(), layout.visibility, layout.survey
    return VISIBILITY_TABLE.with_rows(
        [
            station, target, "no" if words[s][t] else "yes", words[s][t], round(float(table.ranges[s, t]) * 1e3, 1),
            round(float(table.elevations[s, t]) / DEGREE, 2), round(float(table.incidence_angles[s, t]) / DEGREE, 2),
        ]
        for s, station in enumerate(survey.station_names)
        for t, target in enumerate(survey.target_names)
    )  # fmt: skip


def make_work_order_table(plan: PlannedNetwork) -> Table:
    """Table `work-order.csv` of a plan, with one row for each pointing and the readings of a perfect instrument."""
    recording = plan.layout.survey.noise_free_recording(plan.layout.expected_precision.construction)
    return WORK_ORDER_TABLE.with_rows(
        [
            i + 1, recording.stations[recording.station[i]], recording.targets[recording.target[i]],
            int(recording.face[i]), int(recording.repeat[i]), round(float(recording.time[i]) / 60.0, 2),
            round(float(reading[1]) / DEGREE % 360, 3), round(float(reading[2]) / DEGREE, 3),
            round(float(reading[0]) / MILLIMETRE, 1),
        ]
        for i, reading in enumerate(recording.readings)
    )  # fmt: skip
