"""Tables of plans, declared once for CSV, data frame, terminal and page."""

from ltsim.core.results import Column, Table, columns_of, flags, numbers, texts
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.planning.plan_entries import ConfusablePair, DetectableSize, OptionEntry
from ltsim.planning.planner import LayoutEvaluation, PlannedNetwork

PLACE = numbers(".10g", ".3f", x_mm="place in the workshop, to 0.001 mm", y_mm="as x_mm", z_mm="as x_mm")
STATIONS = Table(
    "stations.csv",
    "places of the tripods",
    (
        *texts(station="name"),
        *numbers(shown=".0f", x_mm="place in the workshop", y_mm="as x_mm", z_mm="as x_mm"),
        *numbers(shown=".0f", yaw_deg="direction of azimuth zero"),
        *numbers(sigma_x_um="expected standard deviation", sigma_y_um="as x", sigma_z_um="as x"),
        *numbers(visible_reflectors="number of visible reflectors"),
    ),
)
REFLECTORS = Table(
    "reflectors.csv",
    "reflectors with their expected uncertainty",
    (
        *texts(target="name"),
        *PLACE,
        *numbers(sigma_um="expected, of the point"),
        *numbers(U_x_um="expanded uncertainty, k = 2", U_y_um="as U_x_um", U_z_um="as U_x_um"),
        *numbers(within_mm="error at the confidence level of the goal", tolerance_mm="limit of the error"),
        *texts(visible_from="stations from which it is visible"),
    ),
)
PARAMETERS = Table(
    "parameters.csv",
    "instrument parameters with their expected uncertainty",
    (
        *texts(parameter="name", unit="of the sigmas"),
        *numbers(sigma="expected", sigma_reference="with the stations of the scenario", prior_sigma="without data"),
        *numbers(gain="fraction of the prior variance that the data remove"),
    ),
)
VISIBILITY = Table(
    "visibility.csv",
    "sights between stations and targets",
    (
        *texts(station="name", target="name", sees="yes or no", why_not="reason for a blocked sight"),
        *numbers(distance_mm="between them", elevation_deg="of the beam", incidence_deg="on the reflector"),
    ),
)
NOMINALS = Table(
    "nominals.csv",
    "every point in the hall's axes, for the tracker's software",
    (*texts(name="of the point"), *PLACE),
)
WORK = Table(
    "work-order.csv",
    "every pointing in the order of the work, with the expected readings",
    (
        *numbers(step="from 1"),
        *texts(station="name", target="name"),
        *numbers(face="1 or 2", round="from 1", minutes="since the first pointing"),
        *numbers(azimuth_deg="expected", elevation_deg="expected", distance_mm="expected"),
    ),
)
SETUPS = Table(
    "setups.csv",
    "tape measurements to the places of the tripods",
    (
        *texts(station="name"),
        *(
            Column(f"tape_{i}", "distance and its end point; two define the place, the third checks it", "text")
            for i in (1, 2, 3)
        ),
        Column("towards", "direction of azimuth zero", "text", title="azimuth zero looks"),
        Column("height_m", "height of the centre of the head above the floor", shown=".2f", title="head over floor"),
    ),
)
TRADEOFF = Table(
    "tradeoff.csv",
    "ways of working, each with its best layout",
    (
        *columns_of(OptionEntry, "stations faces repeats pointings hours"),
        *columns_of(OptionEntry, "value", value={"title": "objective"}),
        Column("value_um", "objective, if it is only the error of the targets", title="objective"),
        *columns_of(OptionEntry, "efficient", efficient={"title": "best layout in its time"}),
    ),
)
EFFECTS = Table("effects.csv", "minimal detectable sizes of effects", columns_of(DetectableSize))
TOLERANCES = Table(
    "tolerances.csv",
    "points against their tolerances",
    (
        *texts(point="name"),
        *numbers(shown=".5g", within_mm="error at the confidence level of the goal", tolerance_mm="limit of the error"),
        *texts(used="error divided by the limit, with enough digits to show its side of the limit"),
        *flags(met="the tolerance is met"),
    ),
)
LOSSES = Table(
    "losses.csv",
    "tolerances after the loss of a station or a sight",
    (
        *texts(lost="station or sight"),
        *flags(met="all tolerances are met"),
        *texts(
            worst_point="with the largest error over its tolerance",
            used="that ratio",
            unseen="points that are not visible from any station",
        ),
    ),
)
CHANGES = Table(
    "changes.csv",
    "reflectors to move, add or remove",
    (
        *numbers(number="on the floor plan"),
        *texts(change="kind of change"),
        *numbers("r", "+.2f", gain_um="reduction of the rms error of all other points"),
        *numbers("r", "+.1f", gain_percent="reduction of the objective"),
        *texts(most_for="parameter, or point, that gains most"),
        *numbers("r", "+.1f", sigma_percent="change of its standard deviation"),
    ),
)
EXPECTED = Table(
    "expected.csv",
    "the paper's criteria, expected",
    (
        *texts(layout="this plan, or the reference", criterion="name"),
        *numbers("r", before_um="mean, as read", after_um="mean, corrected", improvement_percent="of the mean"),
    ),
)
CONFUSABLE = Table(
    "confusable.csv", "pairs of effects that the layout hardly distinguishes", columns_of(ConfusablePair)
)
TABLES = (
    NOMINALS, WORK, STATIONS, REFLECTORS, TOLERANCES, LOSSES, TRADEOFF, PARAMETERS, EXPECTED, CHANGES, EFFECTS,
    CONFUSABLE, VISIBILITY,
)  # fmt: skip
"""Tables that are written with plan.json."""


def visibility_table(layout: LayoutEvaluation) -> Table:
    """Table `visibility.csv`: every pair of station and target."""
    words, table, survey = layout.table.words(), layout.table, layout.survey
    return VISIBILITY.filled(
        [
            station, target, "no" if words[s][t] else "yes", words[s][t], round(float(table.range_[s, t]) * 1e3, 1),
            round(float(table.elevation[s, t]) / DEGREE, 2), round(float(table.incidence[s, t]) / DEGREE, 2),
        ]
        for s, station in enumerate(survey.station_names)
        for t, target in enumerate(survey.target_names)
    )  # fmt: skip


def work_table(plan: PlannedNetwork) -> Table:
    """Table `work-order.csv`: every pointing with the readings of a perfect instrument."""
    recording = plan.chosen.survey.recording(plan.chosen.information.construction)
    return WORK.filled(
        [
            i + 1, recording.stations[recording.station[i]], recording.targets[recording.target[i]],
            int(recording.face[i]), int(recording.repeat[i]), round(float(recording.time[i]) / 60.0, 2),
            round(float(reading[1]) / DEGREE % 360, 3), round(float(reading[2]) / DEGREE, 3),
            round(float(reading[0]) / MILLIMETRE, 1),
        ]
        for i, reading in enumerate(recording.readings)
    )  # fmt: skip
