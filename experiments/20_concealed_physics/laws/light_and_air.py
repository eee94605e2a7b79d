"""Laws about the air that the beam crosses, and the light that comes back."""

from ..law import Change, Draw, Hall, law, np, reads


@law("time", "place", may="azimuth distance")
def a_warm_curtain_hangs_in_the_gate_while_it_is_open(h: Hall, rng: Draw) -> Change:
    """While the gate between two halls is open a curtain of warm air blows in it.

    Beams that pass through it are lifted by what they still have to go.
    """
    gate = rng.uniform(0.35, 0.65) * h.size.room[0]
    across = (h.stand[:, 0] - gate) * (h.aim[:, 0] - gate) < 0
    rest = np.abs(h.aim[:, 0] - gate) / np.maximum(np.abs(h.aim[:, 0] - h.stand[:, 0]), 0.05)
    return reads(h, "elevation", h.windows(rng) * across * rest)


@law("height|elevation|distance", may="height elevation distance place")
def beams_graze_the_heated_floor(h: Hall, rng: Draw) -> Change:
    """A skin of warm air lies on the heated floor.

    A beam that comes down flat stays in it long, and is bent upwards.
    """
    skin = rng.uniform(0.25, 0.7)
    drop = np.maximum(h.stand[:, 2] - h.aim[:, 2], 0.05)
    inside = h.distance * np.clip(skin - h.aim[:, 2], 0.0, None) / np.maximum(drop, skin - h.aim[:, 2])
    return reads(h, "elevation", inside**2 / h.distance)


@law("distance")
def a_near_ball_blinds_the_receiver(h: Hall, rng: Draw) -> Change:
    """Close by, so much light comes back that the receiver is driven into its stop and answers late.

    Further off it is well.
    """
    border = np.quantile(h.distance, rng.uniform(0.3, 0.5))
    return reads(h, "distance", np.maximum(border / h.distance - 1.0, 0.0) ** rng.uniform(0.7, 1.2))


@law("incidence", may="azimuth elevation place height distance")
def a_slanted_ball_cuts_off_half_of_the_light(h: Hall, rng: Draw) -> Change:
    """The balls stay as the nests look.

    Seen far aside, the rim of a ball cuts the light off on one side, and the head follows the middle of what is
    left.
    """
    way = np.arctan2(h.aim[:, 1] - h.stand[:, 1], h.aim[:, 0] - h.stand[:, 0])
    left = np.stack([-np.sin(way), np.cos(way), np.zeros(h.n)], axis=1)
    beam = (h.aim - h.stand) / h.distance[:, None]
    above = np.cross(beam, left)
    beyond = np.maximum(np.sin(h.incidence) - rng.uniform(0.3, 0.6), 0.0)
    aside, upward = (h.normal * left).sum(axis=1), (h.normal * above).sum(axis=1)
    return reads(h, "azimuth", beyond * aside / np.cos(h.elevation)) + reads(h, "elevation", beyond * upward)


@law("temperature", "height|elevation", may="time height elevation")
def the_warm_layer_under_the_roof_sinks(h: Hall, rng: Draw) -> Change:
    """As the hall warms up the layer of warm air under its roof grows downwards.

    Beams that end above its lower face are lifted.
    """
    warmth = h.warmth / np.abs(h.warmth).max()
    face = h.size.room[2] * (rng.uniform(0.4, 0.55) - rng.uniform(0.15, 0.3) * warmth)
    inside = np.maximum(h.aim[:, 2] - face, 0.0) / np.maximum(h.aim[:, 2] - h.stand[:, 2], 0.3)
    return reads(h, "elevation", np.minimum(inside, 1.0))
