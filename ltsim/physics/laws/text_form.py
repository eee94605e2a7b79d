"""Text form of empirical laws, such as ``exp(-station-time / 8 min)``, and the parser of the text form."""

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ltsim.core.errors import ModelError
from ltsim.physics.laws.columns import N_CURVE_MODES, N_PRODUCT_CURVE_MODES
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressor_library import BUILTIN_COVARIATES, MEMORY_OPERATOR_PREFIXES
from ltsim.physics.laws.regressors import (
    CLOCK_COVARIATES,
    COORDINATE_COVARIATES,
    DEFLECTION_FUNCTION,
    Regressor,
    group_amounts_regressor,
    latch_regressor,
    nearness_regressor,
    path_length_regressor,
    piecewise_regressor,
    scalar_regressor,
    switch_regressor,
)
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.recordings.recording import Recording
from ltsim.scene.regions import REGION_SHAPES, HallRegion

ANGLE_COVARIATES = ("azimuth", "bearing", "circle", "elevation", "nest-direction")
"""Names of the covariates that are displayed in degrees."""
TIME_COVARIATES = (*CLOCK_COVARIATES, "lapse")
"""Names of the covariates that are times, displayed in minutes or seconds."""
LENGTH_COVARIATES = ("distance", "height", "move-distance", "last-distance", "x", "y", "z")
"""Names of the covariates that are displayed in metres or millimetres."""
PHRASE_BY_COVARIATE = {
    "parity": "the parity of the order (every other pointing)",
    "seating-parity": "the parity of the seatings (every other target)",
    "station": "the station",
    "target": "the target",
    "last-target": "the target before",
}
"""Phrases, shown to users, in place of covariate names that are not clear in a sentence."""
GROUP_COVARIATES = ("station", "target", "last-target")
"""Names of covariates that divide pointings into groups, for which an error may have separate values."""
REGRESSOR_TEXT_TEMPLATES: dict[tuple[str, str, float | None], str] = {
    ("constant", "", None): "constant",
    ("smooth", "", None): "a smooth function of {x}",
    ("field", "", None): "the position in the hall",
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
    ("simple", "within", None): "{x} for sizes up to {value}",
    ("simple", "stuck", None): "the sign of {x} for sizes up to {value}",
    ("simple", "saw", None): "a saw tooth in {x} with a period of {value}",
    ("simple", "step", None): "step({x} above {value})",
    ("simple", "ramp", None): "ramp({x} from {value})",
    ("simple", "power", -1.0): "1/{x}",
    ("simple", "power", None): "{x}^{k}",
    ("simple", "power", 1.0): "{x}",
}
"""Templates of the text of a function of covariates by kind, function and constant (None stands for all). `x` is a
covariate, `k` the constant, `value` the constant or a period with its unit."""
UNIT_COVARIATE_BY_FUNCTION = {
    "lagging": "time",
    "fades": "time",
    "after pause": "lapse",
    "after slew": "move-azimuth",
    "after tip": "move-elevation",
}
"""Covariate that gives the constant of a formula its unit, by function. For other functions it is the covariate to
which the function is applied."""
MIN_VALUE_BY_DISPLAY_UNIT = {"min": 2.0, "m": 1.0}
"""Smallest value that is displayed in a unit, by unit; smaller values get a smaller unit (90 s, not 1.5 min)."""
PER_SETUP_SUFFIX = ", separately at each set-up"
"""Suffix of the text form of a law (error as a function of covariates) with separate coefficients for each set-up."""
FIXED_RATIO_SUFFIX = ", components in the ratio {values}"
"""Suffix of the text form of a law (error as a function of covariates) whose components have a fixed ratio."""
PER_INSTRUMENT_SUFFIX = ", separately for each instrument"
"""Suffix of the text form of a regressor (function of covariates) with separate coefficients for each instrument."""
SWITCH_TEMPLATE = "a switch of {x}, on from {spans}"
"""Template of the text form of a switch, which is on in the intervals `spans` of the covariate `x`."""
SWITCH_LAG_SUFFIX = ", followed with a lag of {value}"
"""Suffix of the text form of a switch (on, off) if the error follows the switch with a first-order lag."""
SWITCH_FROM_FIRST_POINTING_TEXT = "the start"
"""Text for the start of the first interval of a switch that is on from the first pointing."""
FACTOR_SEPARATORS = {"product": " times ", "pieces": ", "}
"""Separators between the texts of the parts of a function: of a product, or of a sum of steps and ramps."""
REGION_PHRASE_BY_REGRESSOR = {
    ("passage", ""): "the path through",
    ("passage", DEFLECTION_FUNCTION): "the lever of the path through",
    ("near", ""): "the nearness of targets to",
}
"""Words before the text form of a region of the hall, by the kind and the name of the function."""


def covariate_value_text(covariate: str, value: float, *, has_clock: bool = True) -> str:
    """Text of a value [SI] of a covariate with its display unit; without a clock, times count pointings."""
    units = _si_per_display_unit(covariate, has_clock)
    *larger, last = units
    unit = next((u for u in larger if abs(value) >= MIN_VALUE_BY_DISPLAY_UNIT[u] * units[u]), last)
    digits = 4 if unit in ("mm", "") else 3
    return f"{value / units[unit]:.{digits}g} {unit}".rstrip()


def _si_per_display_unit(covariate: str, has_clock: bool) -> dict[str, float]:
    """Display units of a covariate, with their values in SI units, from the largest to the smallest."""
    if covariate.endswith((*ANGLE_COVARIATES, "incidence")):
        return {"deg": np.pi / 180.0}
    if covariate in TIME_COVARIATES:
        return {"min": 60.0, "s": 1.0} if has_clock else {"rows": 1.0}
    return {"m": 1.0, "mm": 1e-3} if covariate in LENGTH_COVARIATES else {"": 1.0}


def regressor_text(regressor: Regressor, *, has_clock: bool = True) -> str:
    """Text form of a function of covariates, such as ``exp(-time / 8 min)``; without a clock, times count rows."""
    if regressor.has_curve_per_instrument:
        return regressor_text(regressor.factors[0], has_clock=has_clock) + PER_INSTRUMENT_SUFFIX
    if regressor.kind in FACTOR_SEPARATORS:
        return FACTOR_SEPARATORS[regressor.kind].join(regressor_text(f, has_clock=has_clock) for f in regressor.factors)
    if regressor.region is not None:
        return f"{REGION_PHRASE_BY_REGRESSOR[regressor.kind, regressor.function]} {region_text(regressor.region)}"
    if regressor.kind == "switch":
        return _switch_text(regressor, has_clock=has_clock)
    if regressor.kind == "latch":
        above, below = (
            covariate_value_text(regressor.covariates[0], k, has_clock=has_clock)
            for k in (regressor.constant, regressor.release_threshold)
        )
        return f"a latch of {regressor.covariates[0]}, set above {above}, released below {below}"
    name, k, how = "".join(regressor.covariates[-1:]), regressor.constant, regressor.function
    if regressor.kind in ("wave", "cycle"):
        how = "turn" if name.endswith(ANGLE_COVARIATES) else "period"
    phrase = (
        REGRESSOR_TEXT_TEMPLATES.get((regressor.kind, how, k)) or REGRESSOR_TEXT_TEMPLATES[regressor.kind, how, None]
    )
    unit = UNIT_COVARIATE_BY_FUNCTION.get(how, UNIT_COVARIATE_BY_FUNCTION.get(regressor.kind, name))
    value = covariate_value_text(unit, 2 * np.pi / k if how == "period" else k, has_clock=has_clock)
    return phrase.format(x=PHRASE_BY_COVARIATE.get(name, name), k=f"{k:.4g}", value=value)


def _switch_text(regressor: Regressor, *, has_clock: bool) -> str:
    """Text form of a switch: the intervals in which it is on; the first and the last may be unbounded."""
    name = regressor.covariates[0]
    values = [covariate_value_text(name, factor.constant, has_clock=has_clock) for factor in regressor.factors]
    if regressor.factors[0].constant == -np.inf:
        values[0] = SWITCH_FROM_FIRST_POINTING_TEXT
    spans = [f"{on} to {off}" for on, off in zip(values[::2], [*values[1::2], "the end"], strict=False)]
    lag = (
        SWITCH_LAG_SUFFIX.format(value=covariate_value_text("time", regressor.constant, has_clock=has_clock))
        if regressor.constant
        else ""
    )
    return SWITCH_TEMPLATE.format(x=name, spans=", ".join(spans)) + lag


def law_suffix(law: EmpiricalLaw) -> str:
    """Text after the function in the text form of an error law: coefficients per set-up, ratio of components."""
    values = " / ".join(f"{r:.4g}" for r in law.component_ratio)
    ratio = FIXED_RATIO_SUFFIX.format(values=values) if values else ""
    return (PER_SETUP_SUFFIX if law.has_coefficients_per_setup else "") + ratio


def region_text(region: HallRegion) -> str:
    """Text form of a region of the hall."""
    centre = ", ".join(f"{axis} {value:.4g} m" for axis, value in zip(region.bounded_axes, region.centre, strict=True))
    return f"a {REGION_SHAPES[region.bounded_axes]} at {centre}, width {region.width:.4g} m"


TEXT_FORM_EXAMPLES = (
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
"""Examples of the text form of a regressor (function of covariates), for messages."""
_NUMBER_PATTERN = r"[-+]?(?:\d++(?:\.\d*+)?+|\.\d++)(?:e[-+]?\d++)?+"
_PLACEHOLDER_PATTERNS = {
    "x": "(?P<x>.+)",
    "k": f"(?P<k>{_NUMBER_PATTERN})",
    "value": f"(?P<value>{_NUMBER_PATTERN}) ?(?P<unit>[a-z]*)",
}
_REGION_PATTERN = re.compile(
    rf"(?P<through>{'|'.join(REGION_PHRASE_BY_REGRESSOR.values())}) a (?P<shape>{'|'.join(REGION_SHAPES.values())}) "
    rf"at (?P<at>.+), width (?P<width>{_NUMBER_PATTERN}) m"
)
_COORDINATE_PATTERN = re.compile(rf"([xyz]) ({_NUMBER_PATTERN}) m")
_RATIO_PATTERN = re.compile(
    rf"(?P<words>.+){FIXED_RATIO_SUFFIX.format(values=f'(?P<values>{_NUMBER_PATTERN}(?: / {_NUMBER_PATTERN})*)')}"
)
_LATCH_PATTERN = re.compile(r"a latch of (?P<x>.+), set above (?P<above>.+), released below (?P<below>.+)")
_LAG_PATTERN = SWITCH_LAG_SUFFIX.format(value=rf"(?P<value>{_NUMBER_PATTERN}) (?P<unit>[a-z]+)")
_SWITCH_PATTERN = re.compile(rf"a switch of (?P<x>.+), on from (?P<spans>.+?)(?:{_LAG_PATTERN})?")
_STEP_SEPARATOR = re.compile(r", (?=step\(|ramp\()")


def parse_law(
    response_name: str,
    regressor_text: str,
    recording: Recording,
    *,
    stations: tuple[str, ...] = (),
    targets: tuple[str, ...] = (),
) -> EmpiricalLaw:
    """Error law from the name of the changed quantity and the text of the function of covariates that it follows.

    The law acts at the given stations and targets, or at all. Raises ModelError for an unknown name or text.
    """
    if response_name not in RESPONSE_AND_DESIGN_BY_NAME:
        raise ModelError(
            f"no quantity is called '{response_name}'; expected one of {', '.join(RESPONSE_AND_DESIGN_BY_NAME)}"
        )
    ratio = _RATIO_PATTERN.fullmatch(regressor_text)
    direction = tuple(map(float, ratio["values"].split(" / "))) if ratio else ()
    regressor_text = ratio["words"] if ratio else regressor_text
    regressor = parse_regressor(regressor_text.removesuffix(PER_SETUP_SUFFIX), recording)
    has_coefficients_per_setup = regressor_text.endswith(PER_SETUP_SUFFIX)
    if has_coefficients_per_setup and (stations or targets):
        raise ModelError(f"'{regressor_text}' applies to all set-ups, not only to {', '.join((*stations, *targets))}")
    target_factors = [f for f in (regressor, *regressor.factors) if f.covariates == ("target",)]
    regressor = Regressor("product", factors=(regressor,)) if target_factors == [regressor] else regressor
    if not targets and target_factors:
        raise ModelError(
            f"'{regressor_text}' needs the names of its targets after a colon: "
            f"'{response_name} ~ {regressor_text}:TARGET,TARGET'"
        )
    if targets or any(factor.kind == "wave" for factor in regressor.factors):  # linear for a group, quadratic for all
        orders = {COORDINATE_COVARIATES: 1.0, ("target",): float(len(targets))}
        factors = (
            replace(f, field_or_amount_targets=targets, constant=orders[f.covariates]) if f.covariates in orders else f
            for f in regressor.factors
        )
        regressor = replace(regressor, factors=tuple(factors))
    law = EmpiricalLaw(
        recording.stations if has_coefficients_per_setup else stations,
        targets,
        RESPONSE_AND_DESIGN_BY_NAME[response_name][0],
        regressor,
        has_coefficients_per_setup=has_coefficients_per_setup,
    )
    if direction and len(direction) != law.n_setup_components:
        raise ModelError(
            f"'{regressor_text}' has a ratio of {len(direction)} components; expected {law.n_setup_components}"
        )
    return replace(law, component_ratio=direction)


def parse_regressor(text: str, recording: Recording, n_modes: int = N_CURVE_MODES) -> Regressor:
    """Function of covariates from its text, such as ``exp(-time / 8 min)``; a curve has `n_modes` eigenfunctions.

    Raises ModelError for a text that is no regressor of the recording.
    """
    factors, steps = text.split(FACTOR_SEPARATORS["product"]), _STEP_SEPARATOR.split(text)
    if text.endswith(PER_INSTRUMENT_SUFFIX):
        by_instrument = group_amounts_regressor("instrument", len(recording.instruments))
        return Regressor(
            "product",
            factors=(
                parse_regressor(text.removesuffix(PER_INSTRUMENT_SUFFIX), recording, N_PRODUCT_CURVE_MODES),
                by_instrument,
            ),
        )
    if match := _REGION_PATTERN.fullmatch(text):
        region = _parse_hall_region(text, match)
        kind, function = next(key for key, through in REGION_PHRASE_BY_REGRESSOR.items() if through == match["through"])
        return nearness_regressor(region) if kind == "near" else path_length_regressor(region, function)
    if len(factors) > 1:
        return Regressor(
            "product",
            factors=tuple(parse_regressor(factor.strip(), recording, N_PRODUCT_CURVE_MODES) for factor in factors),
        )
    if len(steps) > 1:
        return piecewise_regressor([parse_regressor(step, recording) for step in steps])
    further = recording.regressor_covariates
    covariates = (*BUILTIN_COVARIATES, *further, *(f"{p}-{n}" for p in MEMORY_OPERATOR_PREFIXES for n in further))
    if match := _SWITCH_PATTERN.fullmatch(text):
        return _parse_switch(text, match, recording)
    if match := _LATCH_PATTERN.fullmatch(text):
        return _parse_latch(text, match, recording)
    names = {"": ""} | {PHRASE_BY_COVARIATE.get(name, name): name for name in (*covariates, *GROUP_COVARIATES)}
    for (kind, how, constant), phrase in REGRESSOR_TEXT_TEMPLATES.items():
        pattern = re.sub(r"\\{(\w+)\\}", lambda group: _PLACEHOLDER_PATTERNS[group[1]], re.escape(phrase))
        if not (match := re.fullmatch(pattern, text)):
            continue
        groups: dict[str, str] = match.groupdict()
        name = names.get(groups.get("x", ""))
        if (
            name is None
            or (how == "turn" and not name.endswith(ANGLE_COVARIATES))
            or (name in GROUP_COVARIATES) != (kind == "amounts")
        ):
            continue
        count = len(np.unique(recording.station)) if name == "station" else len(recording.targets)
        k = constant or {"smooth": n_modes, "field": 2.0, "amounts": count}.get(kind, 1.0 if kind == "state" else 0.0)
        if "k" in groups or "value" in groups:
            unit_covariate = UNIT_COVARIATE_BY_FUNCTION.get(how, UNIT_COVARIATE_BY_FUNCTION.get(kind, name))
            k = _parse_constant(text, unit_covariate, groups, recording.has_clock)
            if k <= 0.0 and how not in ("step", "ramp", "power"):
                raise ModelError(f"'{text}' has an invalid constant; expected a constant above zero")
        along = COORDINATE_COVARIATES if kind == "field" else (name,) if name else ()
        constant = 2 * np.pi / k if how == "period" else k
        return Regressor(kind, along, how if kind in ("simple", "state") else "", constant)
    raise ModelError(
        f"'{text}' is not a function of covariates of this recording; expected a text such as "
        f"{'; '.join(TEXT_FORM_EXAMPLES)}; with one of the covariates "
        f"{', '.join(covariates)}"
    )


def _parse_switch(law_text: str, match: re.Match[str], recording: Recording) -> Regressor:
    """Switch (on, off) from its text form and the `match` of the text; raises ModelError for unordered values."""
    name, edges, lag = match["x"], list[Regressor](), 0.0
    is_covariate = name in {*BUILTIN_COVARIATES, *recording.regressor_covariates}
    ends = [end for span in match["spans"].split(", ") for end in span.split(" to ")]
    for text in ends[:-1] if ends[-1] == "the end" else ends:
        if text == SWITCH_FROM_FIRST_POINTING_TEXT and not edges:
            edges.append(scalar_regressor(name, "step", -np.inf))
            continue
        value = re.fullmatch(_PLACEHOLDER_PATTERNS["value"], text)
        if value is None or not is_covariate:
            raise ModelError(f"'{law_text}' is not a switch; expected a text such as '{TEXT_FORM_EXAMPLES[-1]}'")
        edges.append(
            scalar_regressor(name, "step", _parse_constant(law_text, name, value.groupdict(), recording.has_clock))
        )
    if any(edge.constant >= later.constant for edge, later in itertools.pairwise(edges)):
        raise ModelError(f"'{law_text}' is not a switch; expected values in increasing order")
    if match["value"]:
        lag = _parse_constant(law_text, "time", {"value": match["value"], "unit": match["unit"]}, recording.has_clock)
    return replace(switch_regressor(edges), constant=lag)


def _parse_latch(law_text: str, match: re.Match[str], recording: Recording) -> Regressor:
    """Latch (on above one threshold, off below another) from its text form; raises ModelError for bad thresholds."""
    name, thresholds = match["x"], []
    for text in (match["above"], match["below"]):
        value = re.fullmatch(_PLACEHOLDER_PATTERNS["value"], text)
        if value is None or name not in {*BUILTIN_COVARIATES, *recording.regressor_covariates}:
            raise ModelError(f"'{law_text}' is not a latch; expected a text such as '{TEXT_FORM_EXAMPLES[-2]}'")
        thresholds.append(_parse_constant(law_text, name, value.groupdict(), recording.has_clock))
    if thresholds[1] >= thresholds[0]:
        raise ModelError(f"'{law_text}' is not a latch; expected a release threshold below the set threshold")
    return latch_regressor(name, thresholds[0], thresholds[1])


def _parse_hall_region(text: str, match: re.Match[str]) -> HallRegion:
    """Region of the hall from its text form; raises ModelError for missing coordinates or a width of zero."""
    axes = next(axes for axes, shape in REGION_SHAPES.items() if shape == match["shape"])
    centre = dict(_COORDINATE_PATTERN.findall(match["at"]))
    if "".join(centre) != axes or float(match["width"]) <= 0.0:
        expected = region_text(HallRegion(axes, (1.0,) * len(axes), 0.5))
        raise ModelError(f"'{text}' has no valid region of the hall; expected a region such as '{expected}'")
    return HallRegion(axes, tuple(map(float, centre.values())), float(match["width"]))


def _parse_constant(text: str, covariate: str, groups: Mapping[str, str], has_clock: bool) -> float:
    """Constant [SI] from the `groups` of a matched text form; raises ModelError for a wrong unit of `covariate`."""
    if "k" in groups:
        return float(groups["k"])
    units, unit = _si_per_display_unit(covariate, has_clock), groups["unit"]
    if unit not in units:
        unit_text = " or ".join(f"in {u}" if u else "without a unit" for u in units)
        raise ModelError(f"'{text}' has a wrong unit; expected a value of {covariate} {unit_text}")
    return float(groups["value"]) * units[unit]
