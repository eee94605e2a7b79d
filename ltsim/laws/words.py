"""Drivers in words: ``tan(elevation)``, ``exp(-station-time / 8 min)``, ``a smooth function of time``."""

from __future__ import annotations

import numpy as np

from ltsim.laws.drivers import CLOCKS, Driver

ANGLES = ("azimuth", "bearing", "circle", "elevation", "nest-direction")
SECONDS = (*CLOCKS, "lapse")
METRES = ("distance", "height", "move-distance", "last-distance", "x", "y", "z")
PARITIES = {
    "parity": "the parity of the order (every other pointing)",
    "seating-parity": "the parity of the seatings (every other target)",
}
PHRASES: dict[tuple[str, str, float | None], str] = {
    ("constant", "", None): "constant",
    ("smooth", "", None): "a smooth function of {x}",
    ("field", "", None): "the place in the room",
    ("visits", "", None): "the station, another at each",
    ("wave", "turn", 1.0): "a wave in {x}, 1 period a turn",
    ("wave", "turn", None): "a wave in {x}, {k} periods a turn",
    ("wave", "period", None): "a wave in {x} with a period of {value}",
    ("cycle", "turn", 1.0): "a cycle in {x}, 1 period a turn",
    ("cycle", "turn", None): "a cycle in {x}, {k} periods a turn",
    ("cycle", "period", None): "a cycle in {x} with a period of {value}",
    ("simple", "sin", 1.0): "sin({x})",
    ("simple", "sin", None): "sin({k} {x})",
    ("simple", "cos", 1.0): "cos({x})",
    ("simple", "cos", None): "cos({k} {x})",
    ("simple", "tan", 1.0): "tan({x})",
    ("simple", "tan", None): "tan({k} {x})",
    ("simple", "abs", None): "|{x}|",
    ("simple", "decay", None): "exp(-{x} / {value})",
    ("simple", "relaxing", None): "1 / (1 + {x} / {value})",
    ("simple", "saturated", None): "saturation({x}, half at {value})",
    ("simple", "step", None): "step({x} above {value})",
    ("simple", "ramp", None): "ramp({x} from {value})",
    ("simple", "power", -1.0): "1/{x}",
    ("simple", "power", None): "{x}^{k}",
    ("simple", "power", 1.0): "{x}",
}
"""What is said of a kind of driver, its function and its constant (None: any): x is a covariate, k the constant, and
value a constant, or a wave's period, with its unit."""
BETWEEN = {"product": " times ", "pieces": ", "}


def value_of(name: str, value: float, *, clock: bool = True) -> str:
    """A value of a covariate with its unit, in a person's words; without a `clock` time is told by rows."""
    if name.endswith((*ANGLES, "incidence")):
        return f"{np.degrees(value):.3g} deg"
    if name in SECONDS and not clock:
        return f"{value:.3g} rows"
    if name in SECONDS:
        return f"{value / 60:.3g} min" if abs(value) >= 120 else f"{value:.3g} s"
    if name in METRES:
        return f"{1e3 * value:.4g} mm" if abs(value) < 1 else f"{value:.3g} m"
    return f"{value:.4g}"


def describe(driver: Driver, *, clock: bool = True) -> str:
    """A driver in words."""
    if driver.kind in BETWEEN:
        return BETWEEN[driver.kind].join(describe(f, clock=clock) for f in driver.factors)
    name, k, how = "".join(driver.covariates[:1]), driver.constant, driver.function
    if driver.kind in ("wave", "cycle"):
        how = "turn" if name.endswith(ANGLES) else "period"
    phrase = PHRASES.get((driver.kind, how, k)) or PHRASES[driver.kind, how, None]
    value = value_of(name, 2 * np.pi / k if how == "period" else k, clock=clock)
    return phrase.format(x=PARITIES.get(name, name), k=f"{k:.4g}", value=value)
