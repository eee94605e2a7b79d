"""Laws about laser, range meter and circuits."""

from ..law import Change, Draw, Hall, law, np, reads, varies


@law("distance", "incidence")
def phase_walks_as_the_return_grows_weak(h: Hall, rng: Draw) -> Change:
    """The phase of the range meter walks with the logarithm of the light that comes back from far or oblique balls."""
    light = np.maximum(np.cos(h.incidence), 0.05) ** 2 / h.distance**2
    return reads(h, "distance", -np.log(light / light.max()))


@law("distance")
def amplifier_switches_its_gain_beyond_a_distance(h: Hall, rng: Draw) -> Change:
    """Beyond a certain distance the amplifier goes to its higher gain, which delays the signal by a little."""
    return varies(h, "range-offset", (h.distance > np.quantile(h.distance, rng.uniform(0.3, 0.7))).astype(float))


@law("temperature")
def laser_hops_between_modes_as_it_warms(h: Hall, rng: Draw) -> Change:
    """The laser is pulled along as the hall warms until it hops back to the next mode: its frequency is a sawtooth."""
    return varies(h, "range-scale", np.mod(h.warmth / rng.uniform(0.3, 0.6) + rng.random(), 1.0))


@law("time")
def loose_fibre_plug_wanders(h: Hall, rng: Draw) -> Change:
    """The plug of the fibre in the range meter is loose, and its path length does a random walk."""
    return varies(h, "range-offset", h.walk(rng))


@law("time")
def lamps_beat_with_the_sampling_of_the_circle(h: Hall, rng: Draw) -> Change:
    """Flicker of the hall's lamps reaches the read heads, and beats slowly with the rate at which they are sampled."""
    return reads(h, "azimuth", np.sin(2 * np.pi * (h.time / rng.uniform(240.0, 700.0) + rng.random())))


@law("time")
def battery_of_one_tracker_runs_down(h: Hall, rng: Draw) -> Change:
    """One tracker works off batteries: the null of its detector moves as one runs down, and returns with the next."""
    life = rng.uniform(2400.0, 5400.0)
    used = np.mod(h.time + rng.uniform(0.0, life), life) / life
    return varies(h, "beam-offset-lateral", h.one_tracker(rng) * used**3)


@law("time", "distance")
def welder_leaks_into_the_range_meter(h: Hall, rng: Draw) -> Change:
    """While a welder works its pick-up adds to the signal, and turns its phase the more the weaker the return is."""
    return reads(h, "distance", h.windows(rng) * (h.distance / h.distance.max()) ** 2)


@law("approach", may="distance")
def photodiode_is_still_charged_from_a_bright_target(h: Hall, rng: Draw) -> Change:
    """After a near and bright target the photodiode stays charged for a while, and the next range comes out short."""
    bright = 1.0 / (1.0 + h.distance**2 / 4.0)
    before = np.where(h.order > 0, bright - h.change(bright), 0.0)
    return reads(h, "distance", -before * np.exp(-h.gap / rng.uniform(15.0, 60.0)))
