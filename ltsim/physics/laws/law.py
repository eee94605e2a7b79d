"""Empirical law: a response that depends on a regressor at a place, as an effect; and short formulas for it.

Laws are tested, refitted and plotted like the effects of the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.signature import Parameter, Tunable
from ltsim.physics.laws.columns import CIRCULAR, FINE, LOW, MODES, indicator_columns
from ltsim.physics.laws.places import MIN_GROUP
from ltsim.physics.laws.regressor_library import MAX_VISITS, WAVE_STEP, is_near_several
from ltsim.physics.laws.regressors import CLOCKS, CONSTANT, Regressor, pieces, simple, smooth, switch
from ltsim.physics.laws.responses import RESPONSES, ResponseTerm
from ltsim.physics.laws.states import EVERY, FADES, FORGETS
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.sightings import Sightings

MAX_MEMBERS = 12
"""Largest number of targets in a group whose motions may differ from each other."""
FACE_SIGN = simple("face", "power")
"""Regressor with the sign of the face: an elevation error proportional to it is the vertical index."""
MAX_ATOM_VALUES = 41
"""Largest number of values of a covariate at which steps and ramps are tried."""
SET_UP_KINDS = ("reading", "instrument", "circle", "stand")
"""Kinds of responses that may differ between set-ups in size."""
ANGULAR_COVARIATES = ("elevation", "incidence", "nest-direction", "last-azimuth", "last-elevation")
"""Angles whose sines, cosines and tangents are tried."""
MAX_SWITCH_TIMES = 60
"""Largest number of times at which a switch is tried."""
MAX_MOVED_PIECES, PIECE_MOVES = 4, 6
"""Largest number of steps and ramps that are moved individually, and the number of gaps between covariate values by
which they move; it is also the smallest distance between them, since a few pointings do not determine a law.
"""
SCALED_FUNCTIONS = (
    "decay",
    "fading",
    "relaxing",
    "saturated",
    "lagging",
    "hysteresis",
    "saw",
    "slack",
    "within",
    "stuck",
    FADES,
    FORGETS,
)
"""Functions and kinds whose constant is first determined to within a factor."""
THRESHOLD_STEPS = np.array([-0.06, -0.02, 0.02, 0.06])
"""Moves of the thresholds of a latch, as fractions of the span of its covariate."""
SAW_PERIODS = np.array([1.0, 0.5, 0.25, 0.125])
"""Periods of saw-tooth functions, as fractions of a covariate's span."""
SPAN_FRACTIONS = np.array([0.05, 0.15, 0.5])
"""Constants of decays and saturations, as fractions of a covariate's span."""


@dataclass(frozen=True)
class Law(Tunable):
    """Empirical law: a response that depends on a regressor, optionally at some stations or targets only.

    Attributes
    ----------
    stations, targets : tuple of str
        Where it acts; empty for everywhere.
    carrier : ResponseTerm
    driver : Regressor
    instruments : tuple of str
        Named where the stations are those of one instrument.
    scale : int
        Which of the driver's sets of prior deviations holds.
    each : bool
        Every set-up has coefficients of its own.
    """

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    carrier: ResponseTerm = RESPONSES["distance"][0]
    driver: Regressor = CONSTANT
    instruments: tuple[str, ...] = ()
    scale: int = 0
    each: bool = False

    name = "unknown"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients, one per component of the response, set-up and column of the regressor, with priors."""
        spread = self.driver.spreads[self.scale] * self.carrier.size
        spreads = np.tile(spread, len(self.carrier.ways) * (len(self.stations) if self.each else 1))
        return tuple(
            Parameter(f"coefficient {i + 1}", self.carrier.unit, "coefficient", float(s)) for i, s in enumerate(spreads)
        )

    @property
    def observables(self) -> tuple[str, ...]:
        """Observables that the law changes."""
        return self.carrier.observables or OBSERVABLES

    @property
    def covariates(self) -> tuple[str, ...]:
        """Covariates that the law depends on, as named in files."""
        return self.driver.covariate_labels

    def design(self, sightings: Sightings) -> Floats:
        """Change (n, 3, k) of the raw readings per unit of each coefficient."""
        moved = RESPONSES[self.carrier.name][1](sightings)
        design: Floats = moved[:, :, :, None] * self.columns(sightings)[:, None, None, :]
        return design.reshape(len(sightings), 3, -1)

    def columns(self, sightings: Sightings) -> Floats:
        """Regressor columns (n, k) of each component of the response, zero at other places.

        (n, S k) for separate set-ups.
        """
        columns = self.driver.columns(sightings, moving=self.carrier.kind == "target")
        columns = columns * self.mask(sightings)[:, None]
        if not self.each:
            return columns
        at = indicator_columns(sightings.station, [sightings.station_names.index(name) for name in self.stations])
        return (at[:, :, None] * columns[:, None, :]).reshape(len(sightings), -1)

    @property
    def is_in_the_hall(self) -> bool:
        """True if it follows a region of the hall at all times."""
        return self.driver.region is not None

    def at_all_times(self) -> Law:
        """The law of a region without its switch."""
        first, *others = self.driver.factors or (self.driver,)
        gated = first.region is not None and [f.kind for f in others] == ["switch"]
        return replace(self, driver=first) if gated else self

    @property
    def source_position(self) -> tuple[float, ...]:
        """Centre [m] of the region of the hall on which the law depends; empty if there is none."""
        return self.driver.hall_region.centre if self.driver.hall_region else ()

    @property
    def hall_axes(self) -> str:
        """Axes of the coordinates of `source_position`."""
        return self.driver.hall_region.axes if self.driver.hall_region else ""

    def centred_at(self, centre: tuple[float, ...]) -> Law:
        """Copy of the law with another region."""
        region = self.driver.hall_region
        return self if region is None else replace(self, driver=self.driver.through(replace(region, centre=centre)))

    def finer(self, sightings: Sightings) -> list[Law]:
        """Variants of the law with a frequency, step, constant or region slightly changed, for a local search."""
        driver = self.driver
        if driver.kind in ("wave", "cycle"):
            step = 2 * np.pi * WAVE_STEP / float(np.ptp(sightings.quantities[driver.covariates[0]]))
            rates = driver.constant + step * np.linspace(-0.9, 0.9, 19)
            return [replace(self, driver=replace(driver, constant=float(r))) for r in rates if r > 0]
        if (driver.kind == "pieces" and len(driver.factors) <= MAX_MOVED_PIECES) or driver.kind == "switch":
            return self._with_moved_pieces(sightings)
        if driver.hall_region is not None:
            near = any(f.kind == "near" for f in (driver, *driver.factors))
            moved = [r for r in driver.hall_region.neighbours() if not near or is_near_several(r, sightings)]
            return [replace(self, driver=driver.through(region)) for region in moved]
        if driver.function in SCALED_FUNCTIONS or driver.kind in SCALED_FUNCTIONS:
            return [replace(self, driver=replace(driver, constant=driver.constant * s)) for s in (0.6, 0.8, 1.25, 1.7)]
        if driver.kind == "latch":
            return self._with_moved_thresholds(sightings)
        if driver.function == EVERY:
            return [replace(self, driver=replace(driver, constant=driver.constant + k)) for k in (-1.0, 1.0)]
        return []

    def _with_moved_thresholds(self, sightings: Sightings) -> list[Law]:
        """Laws with one threshold of the latch moved."""
        driver = self.driver
        steps = np.ptp(sightings.quantities[driver.covariates[0]]) * THRESHOLD_STEPS
        moved = [replace(driver, constant=driver.constant + float(step)) for step in steps]
        moved += [replace(driver, released=driver.released + float(step)) for step in steps]
        return [replace(self, driver=d) for d in moved if d.released < d.constant]

    def _with_moved_pieces(self, sightings: Sightings) -> list[Law]:
        """Laws with one step or ramp moved to another gap between the values of its covariate."""
        factors = self.driver.factors
        x = np.unique(sightings.quantities[self.driver.covariates[0]][self.mask(sightings) > 0])
        gaps = np.searchsorted(x, [piece.constant for piece in factors])
        laws = []
        for i, piece in enumerate(factors):
            for k in range(max(gaps[i] - PIECE_MOVES, 1), min(gaps[i] + PIECE_MOVES, len(x) - 1) + 1):
                if np.abs(np.delete(gaps, i) - k).min(initial=PIECE_MOVES) >= PIECE_MOVES:
                    moved = replace(piece, constant=float(0.5 * (x[k - 1] + x[k])))
                    laws.append(self._of_steps([*factors[:i], moved, *factors[i + 1 :]]))
        return laws

    def formulas(self, sightings: Sightings) -> list[Law]:
        """Short formulas that may replace a smooth law."""
        if self.driver.kind == "smooth":
            return [replace(self, driver=d, scale=0) for d in _short_regressors(sightings, self.driver.covariates[0])]
        if self.driver.function == "decay":
            return [replace(self, driver=replace(self.driver, function="relaxing"))]
        if self.driver.kind != "product":
            return []
        options = [
            list(_short_regressors(sightings, f.covariates[0], few=True)) if f.kind == "smooth" else [f]
            for f in self.driver.factors
        ]
        return [replace(self, driver=Regressor("product", factors=factors), scale=0) for factors in product(*options)]

    def forms(self, sightings: Sightings) -> dict[str, list[list[Law]]]:
        """Forms that the law may have, by kind, each with its scales: the curve, short formulas, a finer curve."""
        driver, forms = self.driver, {"curve": [self], "formula": self.formulas(sightings)}
        if driver.kind == "smooth":
            finer = smooth(driver.covariates[0], FINE if driver.constant > LOW else MODES)
            forms["fine"] = [replace(self, driver=finer)]
        if MIN_GROUP <= len(self.targets) <= MAX_MEMBERS and self.carrier.kind == "target":
            forms["members"] = [replace(self, driver=driver.per_target(self.targets), scale=0)]
        if driver.kind == "wave":
            forms["cycle"] = [replace(self, driver=replace(driver, kind="cycle"))]
        return {
            kind: [[replace(law, scale=k) for k in range(len(law.driver.spreads))] for law in laws]
            for kind, laws in forms.items()
            if laws
        }

    def atoms(self, sightings: Sightings) -> list[Regressor]:
        """Steps and ramps that may replace a smooth regressor."""
        curved = [f for f in (self.driver, *self.driver.factors) if f.kind == "smooth"]
        if len(curved) != 1:
            return []
        name = curved[0].covariates[0]
        x = np.unique(sightings.quantities[name][self.mask(sightings) > 0])
        x = x[np.unique(np.linspace(0, len(x) - 1, MAX_ATOM_VALUES).round().astype(int))]
        edges = 0.5 * (x[1:] + x[:-1])
        return [simple(name, function, float(edge)) for function in ("step", "ramp") for edge in edges]

    def in_pieces(self, steps: Sequence[Regressor]) -> Law:
        """Copy of the law with steps and ramps in place of its smooth regressor, or as factors of that of a region."""
        made, driver = pieces(steps), self.driver
        if driver.region is not None:
            made = Regressor("product", factors=(driver, made))
        elif driver.kind == "product":
            made = replace(driver, factors=tuple(made if f.kind == "smooth" else f for f in driver.factors))
        return replace(self, driver=made, scale=0)

    def _of_steps(self, steps: Sequence[Regressor]) -> Law:
        return self.switched(steps) if self.driver.kind == "switch" else self.in_pieces(steps)

    def edges(self, sightings: Sightings) -> list[Regressor]:
        """Times at which a switch may act, for a law that depends on time alone or on a region of the hall."""
        follows_clock = self.driver.covariates == ("time",) and self.driver.kind in ("smooth", "wave")
        if not follows_clock and not self.is_in_the_hall:
            return []
        x = np.unique(sightings.time[self.mask(sightings) > 0])
        x = x[np.unique(np.linspace(0, len(x) - 1, MAX_SWITCH_TIMES).round().astype(int))]
        return [simple("time", "step", float(edge)) for edge in 0.5 * (x[1:] + x[:-1])]

    def switched(self, edges: Sequence[Regressor]) -> Law:
        """Copy of the law with a switch as its regressor; that of a region is multiplied by the switch."""
        gate = switch(edges)
        driver = gate if not self.is_in_the_hall else Regressor("product", factors=(self.driver, gate))
        return replace(self, driver=driver, scale=0)

    def as_constant(self, sightings: Sightings) -> Law:
        """Law of the vertical index that is equivalent to this law of the elevation; the law itself if there is none.

        It is equivalent if the error changes sign with the face, or is constant on a single face.
        """
        if self.carrier.name != "elevation":
            return self
        index, driver = replace(RESPONSES["vertical index"][0], size=self.carrier.size), self.driver
        names = {*driver.covariates, *(n for f in driver.factors for n in f.covariates)}
        single_face = not np.ptp(sightings.face)
        if single_face and names <= {*CLOCKS, *sightings.covariates}:
            return replace(self, carrier=index)
        face, *rest = driver.factors or (driver, CONSTANT)
        return replace(self, carrier=index, driver=rest[0]) if face == FACE_SIGN and len(rest) == 1 else self

    def at_each(self, sightings: Sightings) -> Law | None:
        """Law with separate coefficients for each set-up; None if that is not possible."""
        stations = tuple(sightings.station_names)
        confined = len(self.stations) > 1 or self.targets or self.instruments
        once = self.driver.kind in ("product", "amounts") or self.carrier.kind not in SET_UP_KINDS
        if confined or once or len(stations) < 2:
            return None
        return replace(self, stations=stations, each=True) if len(stations) <= MAX_VISITS else None

    def along(self, mean: Floats, covariance: Floats, sightings: Sightings) -> tuple[Law, Floats, Floats, Floats]:
        """Law at the set-up of its largest effect, main direction (c,), coefficients (c, k) and their covariance.

        For components with different units the main direction is one of the components.
        """
        ways, k = len(self.carrier.ways), self.driver.size
        shape = (ways, len(mean) // (ways * k), k)
        means, spread = mean.reshape(shape), covariance.reshape(*shape, *shape)
        columns = self.driver.columns(sightings)
        if self.each:
            rows = [sightings.station == sightings.station_names.index(name) for name in self.stations]
            size = [float(np.sum((columns[r] @ means[:, i].T) ** 2)) for i, r in enumerate(rows)]
        top = int(np.argmax(size)) if self.each else 0
        law = replace(self, stations=(self.stations[top],), each=False) if self.each else self
        moved = columns[law.mask(sightings) > 0] @ means[:, top].T
        moved = moved - moved.mean(axis=0) if self.driver.kind != "constant" else moved
        way = np.linalg.svd(moved, full_matrices=False)[2][0]
        way = np.eye(ways)[np.argmax(np.sum(moved**2, axis=0))] if self.carrier.units else way
        way = way * np.sign(way[np.argmax(np.abs(way))])
        return law, way, means[:, top], spread[:, top, :, :, top, :]


def _short_regressors(sightings: Sightings, name: str, *, few: bool = False) -> Iterator[Regressor]:
    """Short regressors in a covariate; fewer (`few`) if several covariates are tried together."""
    times = SPAN_FRACTIONS * float(np.ptp(sightings.quantities[name]))
    circular = name in CIRCULAR
    if circular:
        for order in range(1, 4 if few else 7):
            yield Regressor("wave", (name,), constant=float(order))
    tried: list[tuple[str, Sequence[float] | Floats]] = [] if circular and few else [("power", (1.0, 2.0))]
    if name in ANGULAR_COVARIATES and not (circular and few):
        tried += [("sin", (1.0, 2.0, 3.0)), ("cos", (1.0, 2.0, 3.0)), ("tan", (1.0,))]
    tried += [("decay", times)] if name == "lapse" else []
    if not few:
        tried.append(("saw", SAW_PERIODS * float(np.ptp(sightings.quantities[name]))))
        tried.append(("power", (3.0, -1.0) if name == "distance" else (3.0,)))
        tried += [("decay", times)] if name in CLOCKS else []
        tried += [("relaxing", times)] if name in (*CLOCKS, "lapse") else []
        tried += [("abs", (1.0,)), ("saturated", times), ("fading", times)] if name.startswith("move-") else []
        tried += [("within", times), ("stuck", times)] if name.startswith("move-") else []
        tried += [("slack", times)] if name.startswith(("move-", "wound-")) else []
    for function, constants in tried:
        for constant in constants:
            yield simple(name, function, float(constant))
