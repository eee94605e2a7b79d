"""Text form of laws, such as ``exp(-station-time / 8 min)``, and its parser."""

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ltsim.core.errors import ModelError
from ltsim.physics.laws.columns import LOW, MODES
from ltsim.physics.laws.law import Law
from ltsim.physics.laws.regressor_library import OPERATORS, READING_COVARIATES
from ltsim.physics.laws.regressors import (
    CLOCKS,
    LEVER,
    PLACE,
    Regressor,
    amounts,
    latch,
    near,
    passage,
    pieces,
    simple,
    switch,
)
from ltsim.physics.laws.responses import RESPONSES
from ltsim.recordings.recording import Recording
from ltsim.scene.regions import SHAPES, Region

ANGLES = ("azimuth", "bearing", "circle", "elevation", "nest-direction")
SECONDS = (*CLOCKS, "lapse")
COVARIATES_IN_METRES = ("distance", "height", "move-distance", "last-distance", "x", "y", "z")
"""Covariates that are displayed in metres; other sets name those in degrees, minutes and seconds."""
PHRASE_OF = {
    "parity": "the parity of the order (every other pointing)",
    "seating-parity": "the parity of the seatings (every other target)",
    "station": "the station",
    "target": "the target",
    "last-target": "the target before",
}
OWNERS = ("station", "target", "last-target")
"""Kinds of objects that may have separate amounts."""
PHRASES: dict[tuple[str, str, float | None], str] = {
    ("constant", "", None): "constant",
    ("smooth", "", None): "a smooth function of {x}",
    ("field", "", None): "the place in the room",
    ("amounts", "", None): "{x}, another at each",
    ("lagging", "", None): "{x} with a lag of {value}",
    ("state", "fades", None): "{x} fading with a time constant of {value}",
    ("state", "forgets", None): "{x} fading over {k} pointings",
    ("state", "every", None): "{x} since every pointing number {k}",
    ("state", "after face", None): "{x} since the last change of face",
    ("state", "after seating", None): "{x} since the last change of target",
    ("state", "after azimuth", None): "{x} since the azimuth last turned back",
    ("state", "after elevation", None): "{x} since the elevation last turned back",
    ("state", "after pause", None): "{x} since the last pause above {value}",
    ("state", "after slew", None): "{x} since the last move-azimuth above {value}",
    ("state", "after tip", None): "{x} since the last move-elevation above {value}",
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
    ("simple", "abs", 1.0): "|{x}|",
    ("simple", "decay", None): "exp(-{x} / {value})",
    ("simple", "fading", None): "exp(-|{x}| / {value})",
    ("simple", "relaxing", None): "1 / (1 + {x} / {value})",
    ("simple", "saturated", None): "saturation({x}, half at {value})",
    ("simple", "hysteresis", None): "hysteresis of {x} (half-width {value})",
    ("simple", "slack", None): "{x} beyond a slack of {value}",
    ("simple", "within", None): "{x} up to {value}",
    ("simple", "stuck", None): "the sign of {x} up to {value}",
    ("simple", "saw", None): "a saw tooth in {x} with a period of {value}",
    ("simple", "step", None): "step({x} above {value})",
    ("simple", "ramp", None): "ramp({x} from {value})",
    ("simple", "power", -1.0): "1/{x}",
    ("simple", "power", None): "{x}^{k}",
    ("simple", "power", 1.0): "{x}",
}
"""Phrase for a kind of regressor, its function and its constant (None: any). In it x is a covariate, k the constant,
and value a constant or a period with its unit.
"""
UNIT_OF = {
    "lagging": "time",
    "fades": "time",
    "after pause": "lapse",
    "after slew": "move-azimuth",
    "after tip": "move-elevation",
}
"""Covariate whose unit the constant of a regressor has, by kind or function."""
MIN_DISPLAYED = {"min": 2.0, "m": 1.0}
"""Smallest displayed value of a unit that has a smaller one: 90 s, but 2 min; 400 mm, but 1 m."""
AT_EACH_SET_UP = ", in its own way at each set-up"
"""Suffix of the regressor of a law with separate coefficients for each set-up."""
RATIO = ", components in the ratio {values}"
"""Suffix of the regressor of a law whose components have a fixed ratio."""
AT_EACH = ", another at each instrument"
"""Suffix of a product whose other factor is separate for each instrument."""
SWITCH = "a switch of {x}, on from {spans}"
SWITCH_LAG = ", followed with a lag of {value}"
START = "the start"
"""Text form of the start of a span that began before the first pointing."""
BETWEEN = {"product": " times ", "pieces": ", "}


REGION_PHRASES = {
    ("passage", ""): "the path through",
    ("passage", LEVER): "the lever of the path through",
    ("near", ""): "the nearness of targets to",
}
"""Phrase before a region, by kind of regressor and its function."""


def value_of(name: str, value: float, *, clock: bool = True) -> str:
    """Text of a covariate's value with its unit; without a `clock`, time is given in rows."""
    units = _units(name, clock)
    *larger, last = units
    unit = next((u for u in larger if abs(value) >= MIN_DISPLAYED[u] * units[u]), last)
    digits = 4 if unit in ("mm", "") else 3
    return f"{value / units[unit]:.{digits}g} {unit}".rstrip()


def _units(name: str, clock: bool) -> dict[str, float]:
    """Units of display of a covariate [SI], the larger one first."""
    if name.endswith((*ANGLES, "incidence")):
        return {"deg": np.pi / 180.0}
    if name in SECONDS:
        return {"min": 60.0, "s": 1.0} if clock else {"rows": 1.0}
    return {"m": 1.0, "mm": 1e-3} if name in COVARIATES_IN_METRES else {"": 1.0}


def describe(driver: Regressor, *, clock: bool = True) -> str:
    """Text form of a regressor."""
    if driver.is_per_instrument:
        return describe(driver.factors[0], clock=clock) + AT_EACH
    if driver.kind in BETWEEN:
        return BETWEEN[driver.kind].join(describe(f, clock=clock) for f in driver.factors)
    if driver.region is not None:
        return f"{REGION_PHRASES[driver.kind, driver.function]} {region_words(driver.region)}"
    if driver.kind == "switch":
        return _switch_words(driver, clock=clock)
    if driver.kind == "latch":
        above, below = (value_of(driver.covariates[0], k, clock=clock) for k in (driver.constant, driver.released))
        return f"a latch of {driver.covariates[0]}, set above {above}, released below {below}"
    name, k, how = "".join(driver.covariates[-1:]), driver.constant, driver.function
    if driver.kind in ("wave", "cycle"):
        how = "turn" if name.endswith(ANGLES) else "period"
    phrase = PHRASES.get((driver.kind, how, k)) or PHRASES[driver.kind, how, None]
    unit = UNIT_OF.get(how, UNIT_OF.get(driver.kind, name))
    value = value_of(unit, 2 * np.pi / k if how == "period" else k, clock=clock)
    return phrase.format(x=PHRASE_OF.get(name, name), k=f"{k:.4g}", value=value)


def _switch_words(driver: Regressor, *, clock: bool) -> str:
    """Text form of a switch: the spans in which it is on; the first may have no start and the last no end."""
    name = driver.covariates[0]
    values = [value_of(name, factor.constant, clock=clock) for factor in driver.factors]
    if driver.factors[0].constant == -np.inf:
        values[0] = START
    spans = [f"{on} to {off}" for on, off in zip(values[::2], [*values[1::2], "the end"], strict=False)]
    lag = SWITCH_LAG.format(value=value_of("time", driver.constant, clock=clock)) if driver.constant else ""
    return SWITCH.format(x=name, spans=", ".join(spans)) + lag


def law_suffix(law: Law) -> str:
    """Text after the regressor of a law: separate coefficients for each set-up, ratio of the components."""
    ratio = RATIO.format(values=" / ".join(f"{value:.4g}" for value in law.direction)) if law.direction else ""
    return (AT_EACH_SET_UP if law.each else "") + ratio


def region_words(region: Region) -> str:
    """Text form of a region of the hall."""
    at = ", ".join(f"{axis} {value:.4g} m" for axis, value in zip(region.axes, region.centre, strict=True))
    return f"a {SHAPES[region.axes]} at {at}, width {region.width:.4g} m"


EXAMPLES = (
    "constant",
    "time^2",
    "sin(2 elevation)",
    "exp(-time / 8 min)",
    "step(time above 47 min)",
    "a wave in x with a period of 400 mm",
    "a smooth function of circle",
    "face times distance",
    "the path through a ball at x 2 m, y 1 m, z 1.5 m, width 0.5 m",
    "work-elevation since the last change of face",
    "a latch of distance, set above 5.2 m, released below 4.1 m",
    "a switch of time, on from 5 min to 20 min, 35 min to the end",
)
"""Examples of the text form of a regressor."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_GROUPS = {"x": "(?P<x>.+)", "k": f"(?P<k>{_NUMBER})", "value": f"(?P<value>{_NUMBER}) ?(?P<unit>[a-z]*)"}
_REGION = re.compile(
    rf"(?P<through>{'|'.join(REGION_PHRASES.values())}) a (?P<shape>{'|'.join(SHAPES.values())}) "
    rf"at (?P<at>.+), width (?P<width>{_NUMBER}) m"
)
_COORDINATE = re.compile(rf"([xyz]) ({_NUMBER}) m")
_RATIO = re.compile(rf"(?P<words>.+){RATIO.format(values=f'(?P<values>{_NUMBER}(?: / {_NUMBER})*)')}")
_LATCH = re.compile(r"a latch of (?P<x>.+), set above (?P<above>.+), released below (?P<below>.+)")
_LAG = SWITCH_LAG.format(value=rf"(?P<value>{_NUMBER}) (?P<unit>[a-z]+)")
_SWITCH = re.compile(rf"a switch of (?P<x>.+), on from (?P<spans>.+?)(?:{_LAG})?")
_STEPS = re.compile(r", (?=step\(|ramp\()")


def read_law(
    carrier: str, words: str, recording: Recording, *, stations: tuple[str, ...] = (), targets: tuple[str, ...] = ()
) -> Law:
    """Law from its response and the text form of its regressor (see `describe`), at some places; raises ModelError."""
    if carrier not in RESPONSES:
        raise ModelError(f"there is no response called '{carrier}'; responses are {', '.join(RESPONSES)}")
    ratio = _RATIO.fullmatch(words)
    direction = tuple(map(float, ratio["values"].split(" / "))) if ratio else ()
    words = ratio["words"] if ratio else words
    driver, each = read_regressor(words.removesuffix(AT_EACH_SET_UP), recording), words.endswith(AT_EACH_SET_UP)
    if each and (stations or targets):
        raise ModelError(f"'{words}' applies to all set-ups, not to {', '.join((*stations, *targets))}")
    owned = [f for f in (driver, *driver.factors) if f.covariates == ("target",)]
    driver = Regressor("product", factors=(driver,)) if owned == [driver] else driver
    if not targets and owned:
        raise ModelError(f"'{words}' applies to targets, which follow the law: {carrier} ~ {words}:TARGET,TARGET")
    if targets or any(factor.kind == "wave" for factor in driver.factors):  # a group tilts, the whole may bend
        orders = {PLACE: 1.0, ("target",): float(len(targets))}
        factors = (
            replace(f, around=targets, constant=orders[f.covariates]) if f.covariates in orders else f
            for f in driver.factors
        )
        driver = replace(driver, factors=tuple(factors))
    law = Law(recording.stations if each else stations, targets, RESPONSES[carrier][0], driver, each=each)
    if direction and len(direction) != law.components:
        raise ModelError(f"'{words}': expected a ratio of {law.components} components, not of {len(direction)}")
    return replace(law, direction=direction)


def read_regressor(words: str, recording: Recording, modes: int = MODES) -> Regressor:
    """Regressor from its text form, the inverse of `describe`; `modes` applies to a smooth one. Raises ModelError."""
    factors, steps = words.split(BETWEEN["product"]), _STEPS.split(words)
    if words.endswith(AT_EACH):
        by_instrument = amounts("instrument", len(recording.instruments))
        return Regressor(
            "product", factors=(read_regressor(words.removesuffix(AT_EACH), recording, LOW), by_instrument)
        )
    if match := _REGION.fullmatch(words):
        region = _read_region(words, match)
        kind, function = next(key for key, through in REGION_PHRASES.items() if through == match["through"])
        return near(region) if kind == "near" else passage(region, function)
    if len(factors) > 1:
        return Regressor("product", factors=tuple(read_regressor(factor.strip(), recording, LOW) for factor in factors))
    if len(steps) > 1:
        return pieces([read_regressor(step, recording) for step in steps])
    further = recording.circumstances
    covariates = (*READING_COVARIATES, *further, *(f"{how}-{name}" for how in OPERATORS for name in further))
    if match := _SWITCH.fullmatch(words):
        return _read_switch(words, match, recording)
    if match := _LATCH.fullmatch(words):
        return _read_latch(words, match, recording)
    names = {"": ""} | {PHRASE_OF.get(name, name): name for name in (*covariates, *OWNERS)}
    for (kind, how, constant), phrase in PHRASES.items():
        pattern = re.sub(r"\\{(\w+)\\}", lambda group: _GROUPS[group[1]], re.escape(phrase))
        if not (match := re.fullmatch(pattern, words)):
            continue
        groups: dict[str, str] = match.groupdict()
        name = names.get(groups.get("x", ""))
        if name is None or (how == "turn" and not name.endswith(ANGLES)) or (name in OWNERS) != (kind == "amounts"):
            continue
        many = len(np.unique(recording.station)) if name == "station" else len(recording.targets)
        k = constant or {"smooth": modes, "field": 2.0, "amounts": many}.get(kind, 1.0 if kind == "state" else 0.0)
        if "k" in groups or "value" in groups:
            k = _constant(words, UNIT_OF.get(how, UNIT_OF.get(kind, name)), groups, recording.has_clock)
            if k <= 0.0 and how not in ("step", "ramp", "power"):
                raise ModelError(f"'{words}': expected a number above zero")
        along = PLACE if kind == "field" else (name,) if name else ()
        constant = 2 * np.pi / k if how == "period" else k
        return Regressor(kind, along, how if kind in ("simple", "state") else "", constant)
    raise ModelError(
        f"'{words}' is not a regressor of this recording; expected words such as {'; '.join(EXAMPLES)}; with one of "
        f"{', '.join(covariates)}"
    )


def _read_switch(words: str, match: re.Match[str], recording: Recording) -> Regressor:
    """Switch from its text form; raises ModelError."""
    name, edges, lag = match["x"], list[Regressor](), 0.0
    is_covariate = name in {*READING_COVARIATES, *recording.circumstances}
    ends = [end for span in match["spans"].split(", ") for end in span.split(" to ")]
    for text in ends[:-1] if ends[-1] == "the end" else ends:
        if text == START and not edges:
            edges.append(simple(name, "step", -np.inf))
            continue
        value = re.fullmatch(_GROUPS["value"], text)
        if value is None or not is_covariate:
            raise ModelError(f"'{words}': expected words such as '{EXAMPLES[-1]}'")
        edges.append(simple(name, "step", _constant(words, name, value.groupdict(), recording.has_clock)))
    if any(edge.constant >= later.constant for edge, later in itertools.pairwise(edges)):
        raise ModelError(f"'{words}': expected times that increase")
    if match["value"]:
        lag = _constant(words, "time", {"value": match["value"], "unit": match["unit"]}, recording.has_clock)
    return replace(switch(edges), constant=lag)


def _read_latch(words: str, match: re.Match[str], recording: Recording) -> Regressor:
    """Latch from its text form; raises ModelError."""
    name, thresholds = match["x"], []
    for text in (match["above"], match["below"]):
        value = re.fullmatch(_GROUPS["value"], text)
        if value is None or name not in {*READING_COVARIATES, *recording.circumstances}:
            raise ModelError(f"'{words}': expected words such as '{EXAMPLES[-2]}'")
        thresholds.append(_constant(words, name, value.groupdict(), recording.has_clock))
    if thresholds[1] >= thresholds[0]:
        raise ModelError(f"'{words}': expected a release below the threshold that sets it")
    return latch(name, thresholds[0], thresholds[1])


def _read_region(words: str, match: re.Match[str]) -> Region:
    """Region from its text form; raises ModelError."""
    axes = next(axes for axes, shape in SHAPES.items() if shape == match["shape"])
    centre = dict(_COORDINATE.findall(match["at"]))
    if "".join(centre) != axes or float(match["width"]) <= 0.0:
        expected = region_words(Region(axes, (1.0,) * len(axes), 0.5))
        raise ModelError(f"'{words}': expected a region such as '{expected}'")
    return Region(axes, tuple(map(float, centre.values())), float(match["width"]))


def _constant(words: str, name: str, groups: Mapping[str, str], clock: bool) -> float:
    """Number in a text form, in SI."""
    if "k" in groups:
        return float(groups["k"])
    units, unit = _units(name, clock), groups["unit"]
    if unit not in units:
        raise ModelError(
            f"'{words}': expected a value of {name} {' or '.join(f'in {u}' if u else 'alone' for u in units)}"
        )
    return float(groups["value"]) * units[unit]
