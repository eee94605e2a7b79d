"""Table of tests of every result: accepted hypotheses and outliers, with size and evidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from scipy import special

from ltsim.adjustment.identification.evidence import log_prior_of, occam
from ltsim.adjustment.identification.fit import Fit
from ltsim.adjustment.identification.hypothesis import (
    Correction,
    Exchange,
    Hypothesis,
    NoiseFactor,
    Omission,
    Shift,
)
from ltsim.adjustment.identification.selection import LARGEST_GAIN, Choice, Selection
from ltsim.adjustment.identification.signatures import ReadingShift
from ltsim.adjustment.significance import NOT_EXCLUDED
from ltsim.core.arrays import Floats
from ltsim.core.notation import with_sigma
from ltsim.core.units import ARCSECOND, MICRORADIAN, MILLIMETRE, PPM
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat

T = TypeVar("T")


class Place(Entry):
    """Stations and targets at which a test applies; empty for all."""

    stations: tuple[str, ...] = ()
    """Names of the stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets."""


class Alternative(Entry):
    """Alternative hypothesis that was fitted in place of an accepted one."""

    kind: str
    """Kind of the hypothesis, as `kind` of a test."""
    where: Place
    """Stations or targets at which it acts."""
    probability: Finite
    """Posterior probability."""


class Test(Entry):
    """Test of a hypothesis in the network with all accepted hypotheses."""

    kind: str
    """`outlier`, `constant-offset`, `scale-error`, `target-moved`, `station-bump`, `reference-value` and so on."""
    acts_on: str
    """Observable, `position`, a kind of reference value, or `noise`."""
    where: Place
    """Stations or targets at which it acts."""
    statistic: Finite
    """Decrease of chi-square; for noise and blunders twice the log likelihood ratio."""
    dof: int
    """Number of tested components."""
    p_value: OptionalFloat = None
    """p-value of the statistic, for a single test."""
    estimate: OptionalFloat = None
    """Estimated size."""
    sigma: OptionalFloat = None
    """Standard deviation of the estimate."""
    unit: str = ""
    """Unit of the estimate and of its standard deviation."""
    rows: tuple[int, ...] = ()
    """Rows of the recording, from 1, if they are few."""
    probability: OptionalFloat = None
    """Posterior probability among the alternatives."""
    alternatives: tuple[Alternative, ...] = ()
    """Alternative hypotheses fitted in its place, those with a posterior probability above 1 %."""
    accepted: bool = True
    """True if the hypothesis is part of the model of the result."""
    sentence: str = ""
    """Sentence on the test."""


MOST_OUTLIERS = 20
"""Largest number of outliers with a separate test, the largest first."""
SMR_SIZES = {12.7e-3: ("0.5 inch", "1.5 inch"), 7.94e-3: ("7/8 inch", "1.5 inch"), 4.76e-3: ("0.5 inch", "7/8 inch")}
"""Differences of the radii of common SMRs [m], with the smaller and the larger one."""
PRISM_CONSTANTS = {17.5e-3: "the constant of a mini prism", 34.4e-3: "the constant of a round prism"}
"""Constants of common prisms [m]."""
NEAR = 60e-6
"""Tolerance [m] between an offset and a nominal size, for an offset with a smaller uncertainty."""


def outcomes(selection: Selection) -> tuple[Test, ...]:
    """Tests of a selection: accepted hypotheses, the most probable first, then outliers."""
    fit = selection.fit
    return (*(_accepted(fit, choice) for choice in selection.choices), *_outliers(fit))


def _accepted(fit: Fit, choice: Choice) -> Test:
    h = choice.hypothesis
    size: dict[str, Any] = {}
    drop, rank = max(2.0 * min(choice.gain, LARGEST_GAIN), 0.0), 1
    if isinstance(h.change, Shift):
        values, covariance = fit.estimate(h)
        drop, rank = fit.length(h) ** 2, len(values)
        size = _size(h, values, covariance)
    elif isinstance(h.change, Omission):
        rank = len(h.change.value.sigma)
        miss, unit, factor = _missed(fit, h)
        size = {"estimate": miss / factor, "unit": unit}
    elif isinstance(h.change, NoiseFactor):
        size = {"estimate": noise_factor(fit, h)}
    p = float(special.chdtrc(rank, drop)) if isinstance(h.change, Shift | Omission) else None
    share = choice.probabilities.tolist()
    alternatives = tuple(
        Alternative(kind=other.kind, where=Place(stations=other.stations, targets=other.targets), probability=s)
        for (other, _), s in zip(choice.alternatives, share[1:-1], strict=True)
        if s > NOT_EXCLUDED
    )
    return Test(
        kind=h.kind,
        acts_on=h.acts_on,
        where=Place(stations=h.stations, targets=h.targets),
        statistic=drop,
        dof=rank,
        p_value=p,
        rows=h.rows if len(h.rows) <= MOST_OUTLIERS else (),
        probability=share[0],
        alternatives=alternatives,
        sentence=sentence_of(fit, h),
        **size,
    )


def noise_factor(fit: Fit, hypothesis: Hypothesis) -> float:
    """Factor on the declared standard deviations of an accepted change of the noise."""
    assert isinstance(hypothesis.change, NoiseFactor)
    chosen = hypothesis.change.readings & fit.problem.use
    return float(np.median(fit.problem.sigma[chosen] / fit.network.recording.sigma()[chosen]))


def _size(h: Hypothesis, values: Floats, covariance: Floats) -> dict[str, Any]:
    """Size, standard deviation and unit; of a vector its length."""
    assert isinstance(h.change, Shift)
    unit, factor = ("mm", MILLIMETRE)
    if isinstance(h.change.effect, ReadingShift):
        unit, factor = ("ppm", PPM) if h.kind == "scale-error" else (unit, factor)
        unit, factor = ("arcsec", ARCSECOND) if h.acts_on in ("azimuth", "elevation") else (unit, factor)
    if h.kind == "reference-scale":
        unit, factor = "ppm", PPM
    part, spread = values[:3], covariance[:3, :3]
    size = float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))
    sigma = float(np.sqrt(max(float(part @ spread @ part), 0.0))) / max(abs(size), 1e-300)
    return {"estimate": size / factor, "sigma": sigma / factor, "unit": unit}


def _missed(fit: Fit, h: Hypothesis) -> tuple[float, str, float]:
    """Misclosure of an excluded reference value [SI], and the name and size of its unit of display."""
    assert isinstance(h.change, Omission)
    size = float(np.linalg.norm(fit.gap_of(h.change.value)))
    angular = h.change.value.kind in ("level", "yaw")
    return size, *(
        ("arcsec", ARCSECOND) if angular else ("ppm", PPM) if h.change.value.kind == "scale" else ("mm", MILLIMETRE)
    )


REFERENCE_UNITS = {"level": ("arcsec", ARCSECOND), "yaw": ("arcsec", ARCSECOND), "scale": ("ppm", PPM)}
"""Units of reference values that are no lengths."""
REFERENCES = {
    "point": "The reference coordinates of",
    "difference": "The reference difference",
    "length": "The reference length",
    "level": "The level of",
    "yaw": "The azimuth zero of",
    "mark": "The set-up of",
    "scale": "The scale of",
}


def sentence_of(fit: Fit, h: Hypothesis) -> str:
    """Sentence on an accepted hypothesis with its usual causes."""
    at = ", ".join((*h.stations, *h.targets))
    if isinstance(h.change, Correction | Exchange):
        return h.name
    if isinstance(h.change, NoiseFactor):
        factor = noise_factor(fit, h)
        what = "The readings" if h.acts_on == "noise" else f"The readings of the {h.acts_on}"
        of = f" {'from' if h.stations else 'to'} {at}" if at else ""
        cure = "declare this noise in the set-up" if not at else "measure again, or correct the set-up"
        return f"{what}{of} scatter {factor:.2g} times as much as declared (sigma); {cure}."
    if isinstance(h.change, Omission):
        miss, unit, factor = _missed(fit, h)
        plural = h.change.value.kind == "point"
        verb, them = ("are", "them") if plural else ("is", "it")
        return f"{REFERENCES[h.change.value.kind]} {h.name} {verb} off by {_plain(miss / factor)} {unit}: check {them}."
    values, covariance = fit.estimate(h)
    estimate = _size(h, values, covariance)
    size = f"{with_sigma(abs(estimate['estimate']), estimate['sigma'], estimate['unit'])}"
    more = "long" if estimate["estimate"] > 0 else "short"
    effect = h.change.effect
    if h.kind == "constant-offset" and h.acts_on == "distance":
        cause = usual_size(float(values[0]), float(np.sqrt(covariance[0, 0])))
        cause = cause or ("another SMR or prism" if h.targets else "another SMR, or a wrong distance constant")
        return f"The distances {'to' if h.targets else 'from'} {at} are {size} too {more}: {cause}."
    if h.kind == "constant-offset":
        return f"The elevations from {at} are wrong by {size}: another vertical index at this set-up."
    if h.kind == "scale-error":
        return f"The distances from {at} are {size} too {more}: a wrong atmospheric correction or unit at this set-up."
    if h.kind == "reference-scale":
        causes = "a temperature, an expansion or the scale of the distances is not as declared"
        return f"The reference lengths and the distances differ in scale by {size}: {causes}."
    if h.kind == "reflector-radius":
        cause = usual_radius(float(values[0]), float(np.sqrt(covariance[0, 0]))) or "another SMR radius"
        side = "away from" if values[0] > 0 else "towards"
        return f"At {at} the centres of the SMRs are displaced along the normals {side} their nests by {size}: {cause}."
    if h.kind == "station-drift":
        return f"Station {at} moved at a constant rate during its measurement, by {size} in total."
    between = _between(fit, h)
    if h.kind == "orientation":
        return f"The horizontal circle of {at} was turned by {size} {between}."
    if h.kind == "station-bump":
        turn, spread = values[3:], covariance[3:, 3:]
        length = float(np.linalg.norm(turn))
        sigma = float(np.sqrt(max(float(turn @ spread @ turn), 0.0))) / max(length, 1e-300)
        turned = with_sigma(length / MICRORADIAN, sigma / MICRORADIAN, "urad")
        return f"Station {at} moved {between}, by {size} and {turned}."
    assert isinstance(effect, TargetMoved)
    return f"Target {at} moved {between}, by {size}."


def _between(fit: Fit, h: Hypothesis) -> str:
    """Text of the rows between which a change happened."""
    assert isinstance(h.change, Shift)
    effect, s = h.change.effect, fit.adjustment.sightings
    since = effect.since if isinstance(effect, ReadingShift) else getattr(effect, "time", -np.inf)
    acts = np.ones(len(s), dtype=bool)
    if h.stations:
        acts &= np.isin(s.station, [s.station_names.index(name) for name in h.stations])
    if h.targets:
        acts &= np.isin(s.target, [s.target_names.index(name) for name in h.targets])
    rows = s.order[acts[s.order]]
    at = int(np.searchsorted(s.time[rows], since))
    if not 0 < at < len(rows):
        return "during its measurement"
    return f"between rows {rows[at - 1] + 1} and {rows[at] + 1}"


def _plain(value: float) -> str:
    """Number with four digits, large ones without exponent."""
    return f"{float(f'{value:.4g}'):.12g}"


def usual_size(value: float, sigma: float) -> str:
    """Text of the usual cause of an offset of distances [m]; empty for none."""
    pairs = {
        size: f"the radii of a {small} and a {large} SMR differ by this" for size, (small, large) in SMR_SIZES.items()
    }
    return _near({**pairs, **PRISM_CONSTANTS}, value, sigma) or ""


def usual_radius(value: float, sigma: float) -> str:
    """Text of the SMR that was used in place of another, from the displacement [m] of its centre from the nest.

    It is empty for none.
    """
    pair = _near(SMR_SIZES, value, sigma)
    if pair is None:
        return ""
    used, assumed = reversed(pair) if value > 0 else pair
    return f"a {used} SMR in place of a {assumed} one"


def _near(usual: Mapping[float, T], value: float, sigma: float) -> T | None:
    """Entry of the usual size [m] within `NEAR` of a value; None if there is none or the sigma is larger."""
    close = [entry for size, entry in usual.items() if abs(abs(value) - size) < NEAR and sigma < NEAR]
    return close[0] if close else None


def _outliers(fit: Fit) -> list[Test]:
    """Tests of rejected readings, the largest first, each against its prediction by all readings in use."""
    recording, tests = fit.recording, list[Test]()
    at = np.argwhere(fit.outliers)
    at = at[np.argsort(-np.abs(fit.whitened[fit.outliers]))][:MOST_OUTLIERS]
    for i, k in at.tolist():
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        unit, factor = ("mm", MILLIMETRE) if k == 0 else ("arcsec", ARCSECOND)
        value, sigma = float(fit.residuals[i, k]), float(fit.problem.sigma[i, k] * fit.prediction_spread[i, k])
        drop = (value / sigma) ** 2
        sentence = (
            f"The {OBSERVABLES[k]} from {station} to {target} (row {i + 1}) is off by "
            f"{with_sigma(abs(value) / factor, sigma / factor, unit)}: measure it again."
        )
        moved = _moved_instead(fit, i, drop)
        tests.append(
            Test(
                kind="outlier",
                acts_on=OBSERVABLES[k],
                where=Place(stations=(station,), targets=(target,)),
                statistic=drop,
                dof=1,
                p_value=float(special.chdtrc(1, drop)),
                estimate=value / factor,
                sigma=sigma / factor,
                unit=unit,
                rows=(i + 1,),
                probability=1.0 - moved,
                alternatives=(Alternative(kind="target-moved", where=Place(targets=(target,)), probability=moved),)
                if moved > NOT_EXCLUDED
                else (),
                sentence=sentence,
            )
        )
    return tests


def _moved_instead(fit: Fit, row: int, drop: float) -> float:
    """Probability that the target of an outlier has moved, which is possible if it is the last pointing."""
    s = fit.adjustment.sightings
    same = np.flatnonzero(s.target == s.target[row])
    if same[np.argmax(s.time[same])] != row or len(same) < 2:
        return 0.0
    w = float(np.sqrt(drop))
    odds = log_prior_of("target-moved", len(s)) - log_prior_of("outlier", int(fit.whole.use.sum()))
    odds += float(occam(w, 3)) - float(occam(w, 1)) + 0.5 * float(np.nansum(fit.adjustment.w[row] ** 2))
    return 1.0 / (1.0 + float(np.exp(-odds)))
