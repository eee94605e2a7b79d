"""Laws about bearings, circles, counterweights and drives inside the head."""

from ..law import Change, Draw, Hall, law, np, reads, varies


def _played(values: np.ndarray, half: float) -> np.ndarray:
    """(n,) What follows values with a play of half a width to either side."""
    found, at = np.zeros(len(values)), float(values[0])
    for row, value in enumerate(values.tolist()):
        at = min(max(at, value - half), value + half)
        found[row] = at
    return found


@law("elevation|height", may="approach time height elevation face")
def a_loose_counterweight_drops_when_the_head_looks_up(h: Hall, rng: Draw) -> Change:
    """A counterweight came loose.

    It slides back when the head looks up steeply or goes over the top, and only slides home when the head looks
    well down again.
    """
    low, high = np.quantile(h.elevation, [rng.uniform(0.2, 0.35), rng.uniform(0.6, 0.75)])
    over = (h.change(h.back) != 0.0) & (h.elevation > low)
    return varies(h, "vertical-index", h.latched(np.where(over, high + 1.0, h.elevation), low, high))


@law("azimuth", may="face")
def a_dented_race_tips_the_head(h: Hall, rng: Draw) -> Change:
    """The race of the standing bearing has a dent from a fall.

    The head nods each time the loaded ball rolls into it.
    """
    middle, width = rng.uniform(-np.pi, np.pi), rng.uniform(0.2, 0.5)
    off = np.arctan2(np.sin(h.circle - middle), np.cos(h.circle - middle))
    return reads(h, "elevation", -(1.0 - 2.0 * h.back) * np.exp(-0.5 * (off / width) ** 2))


@law("elevation|height", may="face elevation height")
def a_fingerprint_on_the_elevation_circle(h: Hall, rng: Draw) -> Change:
    """Somebody touched the glass circle.

    Where the front face reads it, the lines are blurred first one way, then the other.
    """
    middle, width = np.quantile(h.elevation, rng.uniform(0.3, 0.7)), rng.uniform(0.12, 0.3)
    off = (h.elevation - middle) / width
    return reads(h, "elevation", (1.0 - h.back) * off * np.exp(0.5 - 0.5 * off**2))


@law("approach", may="azimuth time")
def the_head_is_read_before_it_has_come_to_rest(h: Hall, rng: Draw) -> Change:
    """After a wide turn the servo creeps up to its goal.

    Whoever presses the key soon reads an angle that is still short.
    """
    return reads(h, "azimuth", -h.swing * np.exp(-(h.gap - 9.0) / rng.uniform(3.0, 7.0)))


@law("approach", may="azimuth time")
def the_seal_drags_the_circle_along(h: Hall, rng: Draw) -> Change:
    """The rubber seal sticks to the ring of the circle, and twists it until it slides.

    Short turns give little, long ones all.
    """
    most, at, found = rng.uniform(0.7, 1.8), 0.0, np.zeros(h.n)
    for row in range(h.n):
        at = 0.0 if h.order[row] == 0 else min(max(at + float(h.swing[row]), -most), most)
        found[row] = at
    return reads(h, "azimuth", found)


@law("temperature", may="time azimuth")
def the_circle_slides_on_its_cold_hub(h: Hall, rng: Draw) -> Change:
    """Hub and glass circle do not grow alike.

    The circle sticks at first and is then pushed off centre by the warmth.
    """
    warmth = h.warmth
    half = rng.uniform(0.1, 0.25) * float(np.ptp(warmth))
    return varies(h, str(rng.choice(["azimuth-eccentricity-cos", "azimuth-eccentricity-sin"])), _played(warmth, half))
