"""Curvature of the earth in a network: plumb lines that differ between stations, and vertical refraction."""

import numpy as np

from ltsim.core.units import EARTH_RADIUS, MILLIMETRE
from ltsim.recordings.recording import Recording

MIN_CURVATURE_ANGLE_SIGMAS = 0.1
"""Limit of the angle between a level surface and the horizontal plane over the longest line of sight, divided by the
standard deviation of an elevation. Above it, the adjustment models the curvature of the earth."""

DEFAULT_REFRACTION_AND_SIGMA = 0.13, 0.1
"""Coefficient of refraction near the ground (radius of the earth divided by the radius of the ray) and its standard
deviation: mean value of Gauss; Brunner 1984, Geodetic Refraction."""


def with_earth_curvature(recording: Recording) -> Recording:
    """Recording whose set-up models the earth's curvature (key `curved`) and refraction, where they are significant.

    A set-up that declares `curved` remains unchanged, and a declared refraction is used. Over a line of sight of length
    d, a level surface departs from the horizontal plane by d^2 / (2 R), with the radius R of the earth. This is an
    angle of d / (2 R). The curvature is modelled if the angle exceeds `MIN_CURVATURE_ANGLE_SIGMAS` standard deviations
    of an elevation. Refraction changes the angle by its fraction k (the coefficient of refraction). Refraction is
    modelled if the angle, multiplied by the sum of k and its standard deviation, exceeds the same number of standard
    deviations.
    """
    setup = recording.setup
    is_levelled = np.array([recording.station_setup(name).levelled for name in recording.stations])[recording.station]
    if "curved" in setup.model_fields_set or not is_levelled.any():
        return recording
    horizontal_length = np.where(is_levelled, recording.readings[:, 0] * np.cos(recording.readings[:, 2]), np.nan)
    angle_in_sigmas = float(
        np.nanmax(horizontal_length / (2.0 * EARTH_RADIUS) / recording.reading_sigmas()[:, 2], initial=0.0)
    )
    if not angle_in_sigmas > MIN_CURVATURE_ANGLE_SIGMAS:
        return recording
    setup_changes: dict[str, object] = {"curved": True}
    longest = float(np.nanmax(horizontal_length))
    drop = longest**2 / (2.0 * EARTH_RADIUS) / MILLIMETRE
    note = (
        f"the plumb lines of the set-ups follow the curved earth: over the longest sight, {longest:.4g} m, a level "
        f"surface departs from the horizontal plane by {drop:.2g} mm (for parallel plumb lines set curved = false in "
        "setup.toml)"
    )
    if setup.refraction is None and sum(DEFAULT_REFRACTION_AND_SIGMA) * angle_in_sigmas > MIN_CURVATURE_ANGLE_SIGMAS:
        setup_changes["refraction"] = DEFAULT_REFRACTION_AND_SIGMA
        note += (
            f"; the coefficient of refraction is estimated from {DEFAULT_REFRACTION_AND_SIGMA[0]:g} +- "
            f"{DEFAULT_REFRACTION_AND_SIGMA[1]:g}, which bends that sight by "
            f"{DEFAULT_REFRACTION_AND_SIGMA[0] * drop:.2g} +- {DEFAULT_REFRACTION_AND_SIGMA[1] * drop:.2g} mm "
            "(for other values set refraction = [value, sigma] in setup.toml)"
        )
    return recording.replace(setup=setup.model_copy(update=setup_changes), notes=(*recording.notes, note))
