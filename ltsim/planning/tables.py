"""Tables of plans and of next measurements, each declared once: CSV, data frame, terminal and page."""

from ltsim.core.results import Table, columns_of, flags, numbers, texts
from ltsim.planning.schema import AlikeEntry, DetectableSize, OptionEntry, ProposalEntry

PLACE = numbers(".10g", ".3f", x_mm="place in the workshop, to 0.001 mm", y_mm="as x_mm", z_mm="as x_mm")
STATIONS = Table(
    "stations.csv",
    "where the tripod goes",
    (
        *texts(station="name"),
        *numbers(shown=".0f", x_mm="place in the workshop", y_mm="as x_mm", z_mm="as x_mm"),
        *numbers(shown=".0f", yaw_deg="where azimuth zero looks to"),
        *numbers(sigma_x_um="expected standard deviation", sigma_y_um="as x", sigma_z_um="as x"),
        *numbers(reflectors_seen="how many it sees"),
    ),
)
REFLECTORS = Table(
    "reflectors.csv",
    "reflectors and how well they become known",
    (
        *texts(target="name"),
        *PLACE,
        *numbers(sigma_um="expected, of the point"),
        *numbers(U_x_um="expanded uncertainty, k = 2", U_y_um="as U_x_um", U_z_um="as U_x_um"),
        *numbers(within_mm="distance that its error keeps at the goal's level", tolerance_mm="what that may be"),
        *texts(seen_from="stations that see it"),
    ),
)
PARAMETERS = Table(
    "parameters.csv",
    "how well the instrument becomes known",
    (
        *texts(parameter="name", unit="of the sigmas"),
        *numbers(sigma="expected", sigma_of_own_layout="with the scenario's own stations", prior_sigma="without data"),
        *numbers(gain="share of the prior variance that the data remove"),
    ),
)
VISIBILITY = Table(
    "visibility.csv",
    "which station sees which target",
    (
        *texts(station="name", target="name", sees="yes or no", why_not="what is in the way"),
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
    "every pointing in the order of the work, with what the tracker should show",
    (
        *numbers(step="from 1"),
        *texts(station="name", target="name"),
        *numbers(face="1 or 2", round="from 1", minutes="since the first pointing"),
        *numbers(azimuth_deg="expected", elevation_deg="expected", distance_mm="expected"),
    ),
)
TRADEOFF = Table(
    "tradeoff.csv",
    "ways of working, each with the best layout found for it",
    columns_of(OptionEntry, "stations faces repeats pointings hours value efficient"),
)
EFFECTS = Table("effects.csv", "smallest effects that would be found", columns_of(DetectableSize))
NEXT = Table(
    "next.csv",
    "proposals of further measurements, the best first",
    columns_of(
        ProposalEntry,
        "kind minutes sharper serves serves_factor tells_apart decides do",
        tells_apart={"kind": "text"},
        decides={"kind": "text"},
    ),
)
TOLERANCES = Table(
    "tolerances.csv",
    "points against their tolerances",
    (
        *texts(point="name"),
        *numbers(shown=".5g", within_mm="distance that its error keeps at the goal's level", tolerance_mm="its limit"),
        *texts(used="the first over the second, with the digits that show the side of the limit"),
        *flags(kept="the tolerance is kept"),
    ),
)
LOSSES = Table(
    "losses.csv",
    "tolerances when a station or a sight is lost",
    (
        *texts(lost="station, or sight"),
        *flags(kept="all tolerances hold"),
        *texts(worst_point="with the largest error over its tolerance", used="that ratio", unseen="seen from nowhere"),
    ),
)
CHANGES = Table(
    "changes.csv",
    "reflectors to move, to add, to leave out",
    (
        *numbers(number="on the floor plan"),
        *texts(change="what is done"),
        *numbers("r", "+.2f", gain_um="fall of the error of all other points, root mean square"),
        *numbers("r", "+.1f", gain_percent="fall of the plan's objective"),
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
ALIKE = Table("alike.csv", "effects that the layout can hardly tell from each other", columns_of(AlikeEntry))
TABLES = (
    NOMINALS, WORK, STATIONS, REFLECTORS, TOLERANCES, LOSSES, TRADEOFF, PARAMETERS, EXPECTED, CHANGES, EFFECTS, ALIKE,
    VISIBILITY,
)  # fmt: skip
"""Beside plan.json."""
