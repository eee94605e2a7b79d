"""Transformation of a measured network to the axes of a plan (the site), by targets that are points of the plan."""

from __future__ import annotations

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.remedies.candidates import FloorPlanTransform
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, NetworkError, option_text
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, align_robustly, rotation_about_z
from ltsim.physics.model.measurement import NetworkState
from ltsim.planning.search_space import SearchSpace
from ltsim.recordings import Recording

MAX_MEDIAN_POINT_MISFIT = 0.1
"""Limit of the median distance [m] between adjusted targets and plan points of the same names. Below it they count as
the same points: reflectors are placed within centimetres of their planned points, and in different axes the distance is
metres."""
MAX_NOMINAL_POSITION_ERROR = 0.5
"""Limit of the distance [m] between the nominal position of a station in setup.toml and its adjusted position on the
site. Below it the axes count as equal: nominal positions are accurate to decimetres, and in different axes the distance
is metres."""


def with_station_poses_on_site(
    recording: Recording, adjustment: Adjustment, search_space: SearchSpace, site_name: str
) -> Recording:
    """Recording whose set-up has the adjusted positions and yaws of the stations, in the axes of a site.

    `adjustment` is the network adjustment whose model contains the identified causes of a misfit. The axes are
    determined by the targets that have names of points of the plan. With fewer than `MIN_POINTS_FOR_POSE` such targets
    the nominal positions of the stations must be in these axes, and the recording is returned unchanged. `search_space`
    is that of the plan, `site_name` the name of the plan in errors.

    Raises
    ------
    InputError
        For a recording without common points and nominal positions, for common points that do not fit, and for nominal
        positions in other axes than those of the site.
    """
    nominal = {n: s.position_mm for n, s in recording.setup.stations.items() if s.position_mm is not None}
    plan = _site_transformation_from_points(
        recording, adjustment.state, search_space, adjustment.undetermined_targets, site_name
    )
    if plan is None and not nominal:
        raise InputError(
            f"{option_text('site')} needs positions on the floor plan; set position_mm of the stations in setup.toml, "
            "or name targets as in the plan"
        )
    positions = (plan or FloorPlanTransform.from_recording(recording, adjustment.state)).positions_on_plan(
        adjustment.state.station_positions
    )
    if plan is None:
        _require_on_allowed_floor(recording, positions, search_space, site_name)
        return recording
    stations = dict(recording.setup.stations)
    for name, place, rotation in zip(recording.stations, positions, adjustment.state.station_rotations, strict=True):
        _require_same_axes(name, nominal.get(name), place, site_name)
        pose = {"position_mm": tuple((place / MILLIMETRE).tolist()), "yaw_deg": plan.yaw_on_plan(rotation) / DEGREE}
        stations[name] = recording.station_setup(name).model_copy(update=pose)
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def _site_transformation_from_points(
    recording: Recording, state: NetworkState, search_space: SearchSpace, undetermined: tuple[str, ...], site_name: str
) -> FloorPlanTransform | None:
    """Transformation from the network to the site by points with equal names; None if there are too few such points.

    The rotation is about the vertical of the network. `state` holds the adjusted coordinates. Targets named in
    `undetermined` are not used.
    """
    point_by_name = dict(zip(search_space.survey.target_names, search_space.survey.target_points, strict=True))
    names = [name for name in recording.targets if name in point_by_name and name not in undetermined]
    if len(names) < MIN_POINTS_FOR_POSE:
        return None
    target_points = state.target_points[[recording.targets.index(name) for name in names]]
    there = np.array([point_by_name[name] for name in names])
    try:
        rotation, _ = align_robustly(target_points, there)
    except NetworkError:  # points on a line
        return None
    turn = rotation_about_z(float(np.arctan2(rotation[1, 0], rotation[0, 0])))
    shift = np.median(there - target_points @ turn.T, axis=0)
    plan = FloorPlanTransform(turn, shift, has_plan=True)
    misfit = np.linalg.norm(plan.positions_on_plan(target_points) - there, axis=1)
    if np.median(misfit) > MAX_MEDIAN_POINT_MISFIT:
        worst = int(np.argmax(misfit))
        raise InputError(
            f"{site_name}: {len(names)} targets of the recording have names of points of this plan, but other "
            f"positions: {names[worst]} is {misfit[worst]:.2f} m off; give the plan of this hall, or rename the points"
        )
    return plan


def _require_same_axes(
    station: str, nominal_mm: tuple[float, float, float] | None, position: Floats, site_name: str
) -> None:
    """Check that the nominal position of a station, if there is one, has the axes of the site; raises InputError.

    `position` (3,) [m] is the adjusted position of the station on the site, to which `nominal_mm` must be near.
    """
    if nominal_mm is None:
        return
    nominal = np.array(nominal_mm) * MILLIMETRE
    if np.linalg.norm(nominal - position) > MAX_NOMINAL_POSITION_ERROR:
        raise InputError(
            f"setup.toml places station {station} at {_position_text(nominal)}, but the points of {site_name} place it "
            f"at {_position_text(position)}: the axes differ; set position_mm and yaw_deg in the axes of this plan"
        )


def _require_on_allowed_floor(
    recording: Recording, positions: Floats, search_space: SearchSpace, site_name: str
) -> None:
    """Check that at least one station of the recording stands on the permitted floor of the site; raises InputError.

    `positions` (S, 3) [m] are those of the S stations in the axes of the site.
    """
    if not search_space.is_allowed(positions, needs_clearance=False).any():
        raise InputError(
            f"no station of the recording stands on the permitted floor of {site_name}: {recording.stations[0]} is at "
            f"{_position_text(positions[0])}; set position_mm and yaw_deg in the axes of this plan"
        )


def _position_text(position: Floats) -> str:
    """Text of the horizontal coordinates of a position (3,) [m], for errors."""
    return f"({position[0]:.2f}, {position[1]:.2f}) m"
