"""Fresh laws about sun, air, air conditioning and weather sensors."""

from ..law import UP, Change, Draw, Hall, law, leans, moves, np, reads, scatters, varies


@law("time")
def the_sun_warms_one_leg_after_another(h: Hall, rng: Draw) -> Change:
    """The sun wanders round the hall, and every stand bends away from it the more the longer it has stood there."""
    bearing = rng.uniform(-np.pi, np.pi) + 2 * np.pi * h.time / 28800.0
    axis = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(h.n)])
    return leans(h, 1.0 - np.exp(-h.since_setup / rng.uniform(400.0, 1500.0)), axis)


@law("height")
def warm_air_lies_under_the_roof(h: Hall, rng: Draw) -> Change:
    """The air is warmer under the roof than at the weather station, so high beams are corrected too little."""
    return varies(h, "range-scale", 0.5 * (h.aim + h.stand)[:, 2] - 1.0)


@law("height", "distance")
def a_cold_floor_bends_low_beams(h: Hall, rng: Draw) -> Change:
    """Cold air lies on the floor, and beams that end in it are bent downwards in proportion to their length."""
    return reads(h, "elevation", h.distance * np.exp(-h.aim[:, 2] / rng.uniform(0.3, 1.0)))


@law("place", "distance", may="azimuth")
def a_heated_wall_bends_beams_sideways(h: Hall, rng: Draw) -> Change:
    """Radiators along one wall bend beams that run beside it sideways, in proportion to their length."""
    middle, along = 0.5 * (h.aim + h.stand), (h.aim - h.stand)[:, 0]
    return reads(h, "azimuth", along * np.exp(-middle[:, 1] / rng.uniform(0.8, 2.0)))


@law("time", "place", may="distance")
def a_fan_shakes_beams_that_cross_its_jet(h: Hall, rng: Draw) -> Change:
    """While the fan of the air conditioning runs, beams through its jet of cold air dance."""
    middle = 0.5 * (h.aim + h.stand)[:, 0]
    near = np.exp(-(((middle - rng.uniform(0.3, 0.7) * h.size.room[0]) / 1.5) ** 2))
    return scatters(h, "azimuth elevation", h.windows(rng) * near)


@law("time", may="place")
def a_gate_was_opened(h: Hall, rng: Draw) -> Change:
    """A gate at the end of the hall was opened for a delivery, and the air took some time to warm again."""
    since = h.time - rng.uniform(0.2, 0.7) * h.time[-1]
    return varies(h, "range-scale", np.where(since > 0.0, np.exp(-np.abs(since) / rng.uniform(400.0, 1500.0)), 0.0))


@law("temperature", may="time")
def the_weather_is_read_once_a_setup(h: Hall, rng: Draw) -> Change:
    """The operator takes the air's temperature when a set-up begins, and what it does afterwards is not corrected."""
    return varies(h, "range-scale", h.warmth - h.warmth[h.starts])


@law("temperature", may="time")
def the_weather_station_is_late(h: Hall, rng: Draw) -> Change:
    """The thermometer of the weather station sits in a thick case and follows the air with a delay."""
    return varies(h, "range-scale", h.warmth - h.lagging(h.warmth, rng.uniform(600.0, 2400.0)))


@law("press_load_kn", may="time")
def the_press_breathes_on_the_thermometer(h: Hall, rng: Draw) -> Change:
    """The thermometer for the air hangs beside the press and shows its heat, some minutes late."""
    return varies(h, "range-scale", h.lagging(h.load, rng.uniform(200.0, 900.0)))


@law("press_load_kn", may="time")
def oil_mist_dims_the_beam(h: Hall, rng: Draw) -> Change:
    """Under high load the press sprays oil mist, and the weakened light makes the distance scatter."""
    return scatters(h, "distance", h.load**2)


@law("temperature", may="time")
def the_housing_bends_while_it_warms(h: Hall, rng: Draw) -> Change:
    """While the temperature changes the outside of the housing runs ahead of its inside and shifts the beam upwards."""
    return varies(h, "beam-offset-vertical", h.warmth - h.lagging(h.warmth, rng.uniform(800.0, 2500.0)))


@law("temperature", may="time")
def a_bimetal_snaps_the_index(h: Hall, rng: Draw) -> Change:
    """A strained spring at the elevation circle snaps over when it gets warm and back only when it is rather cold."""
    return varies(h, "vertical-index", h.latched(h.warmth, *np.quantile(h.warmth, [0.3, 0.6])))


@law("temperature", "height", may="time place")
def the_steel_wall_grows_upwards(h: Hall, rng: Draw) -> Change:
    """The steel wall stands on the floor and grows with the temperature of the hall, its high nests most."""
    return moves(h, h.group("wall") * h.warmth * h.aim[:, 2], UP)


@law("temperature", "place", may="time")
def the_slab_bows(h: Hall, rng: Draw) -> Change:
    """The upper side of the floor slab follows the air and the lower does not, so its middle heaves, much later."""
    x = h.aim[:, 0] / h.size.room[0]
    return moves(h, h.group("floor") * 4.0 * x * (1.0 - x) * h.lagging(h.warmth, rng.uniform(900.0, 3000.0)), UP)


@law("time")
def the_compressor_warms_the_trackers_foot(h: Hall, rng: Draw) -> Change:
    """While the compressor runs its exhaust warms the tracker, whose transit axis wanders off and comes back late."""
    return varies(h, "transit-offset", h.lagging(h.windows(rng), rng.uniform(150.0, 500.0)))


@law("azimuth|place", may="elevation time")
def a_low_sun_blinds_the_spot_detector(h: Hall, rng: Draw) -> Change:
    """A low sun shines through a window, and where the tracker looks towards it the spot detector is noisy."""
    beam = (h.aim - h.stand) / h.distance[:, None]
    bearing = rng.uniform(-np.pi, np.pi)
    return scatters(h, "azimuth elevation", np.exp(6.0 * (beam @ [np.cos(bearing), np.sin(bearing), 0.0] - 1.0)))
