"""Fresh laws about software, tables and corrections."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("temperature")
def the_temperature_is_rounded_before_it_corrects_the_range(h: Hall, rng: Draw) -> Change:
    """The program takes the temperature in coarse steps; what rounding takes away is missing from the correction."""
    steps = h.warmth / rng.choice([0.5, 1.0]) + rng.random()
    return varies(h, "range-scale", steps - np.round(steps))


@law("azimuth", may="face")
def one_entry_of_the_azimuth_table_is_wrong(h: Hall, rng: Draw) -> Change:
    """One entry of the table that corrects the azimuth is mistyped; the program interpolates to it from both sides."""
    off = h.circle - rng.uniform(-np.pi, np.pi)
    off = np.abs(np.arctan2(np.sin(off), np.cos(off)))
    return reads(h, "azimuth", rng.choice([-1.0, 1.0]) * np.maximum(1.0 - off / rng.uniform(0.25, 0.6), 0.0))


@law("elevation")
def the_sag_correction_stops_at_the_end_of_its_table(h: Hall, rng: Draw) -> Change:
    """The correction of the sag was tabulated for moderate elevations; outside, the last value is used again."""
    end = rng.uniform(0.12, 0.40)
    return varies(h, "vertical-index", h.elevation - np.clip(h.elevation, -end, end))


@law("time", may="approach")
def rounding_piles_up_until_the_next_self_check(h: Hall, rng: Draw) -> Change:
    """An integer filter of the beam's direction loses a digit with each pointing; a self-check sets it right again."""
    every = int(rng.integers(15, 48))
    return varies(h, "beam-tilt", rng.choice([-1.0, 1.0]) * np.mod(h.order + rng.integers(every), every) / every)


@law("time")
def straight_lines_stand_for_the_curved_drift_of_the_zero(h: Hall, rng: Draw) -> Change:
    """The zero of the range is referenced from time to time and interpolated by straight lines; its drift is curved."""
    part = np.mod(h.time / rng.uniform(1000.0, 2800.0) + rng.random(), 1.0)
    return varies(h, "range-offset", 4.0 * part * (1.0 - part))


@law("distance")
def far_reflectors_are_ranged_with_another_modulation(h: Hall, rng: Draw) -> Change:
    """Beyond a certain distance the meter changes to a slower modulation, whose zero was never compared."""
    return reads(h, "distance", rng.choice([-1.0, 1.0]) * (h.distance > rng.uniform(3.5, 6.5)))
