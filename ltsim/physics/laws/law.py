"""Empirical law: a response that depends on a regressor at a place, as an effect; and short formulas for it.

Laws are tested, refitted and plotted like the effects of the catalogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.physics.effects.signature import Parameter, Tunable
from ltsim.physics.laws.columns import FINE, LOW, MODES, indicator_columns
from ltsim.physics.laws.places import MIN_GROUP
from ltsim.physics.laws.regressor_library import LAG_TIMES, MAX_VISITS, WAVE_STEP, is_near_several
from ltsim.physics.laws.regressors import CLOCKS, CONSTANT, Regressor, pieces, simple, smooth, switch
from ltsim.physics.laws.responses import RESPONSES, ResponseTerm
from ltsim.physics.laws.short_regressors import short_regressors
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
MAX_SWITCH_EDGES = 60
"""Largest number of values of a covariate at which a switch is tried."""
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
    direction : tuple of float
        Fixed ratio of the components of the response, in `each` set-up: a unit vector (c,) or (c S,). All of them then
        share one set of coefficients; empty where each component has its own.
    """

    stations: tuple[str, ...] = ()
    targets: tuple[str, ...] = ()
    carrier: ResponseTerm = RESPONSES["distance"][0]
    driver: Regressor = CONSTANT
    instruments: tuple[str, ...] = ()
    scale: int = 0
    each: bool = False
    direction: tuple[float, ...] = ()

    name = "unknown"

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients, one per component of the response, set-up and column of the regressor, with priors."""
        spread = self.driver.spreads[self.scale] * self.carrier.size
        spreads = spread * np.sqrt(self.components) if self.direction else np.tile(spread, self.components)
        return tuple(
            Parameter(f"coefficient {i + 1}", self.carrier.unit, "coefficient", float(s)) for i, s in enumerate(spreads)
        )

    @property
    def components(self) -> int:
        """Number of components of the response, at all set-ups if they differ by set-up."""
        return len(self.carrier.ways) * (len(self.stations) if self.each else 1)

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
        moved = self.along_direction(RESPONSES[self.carrier.name][1](sightings), sightings)
        design: Floats = moved[:, :, :, None] * self.columns(sightings)[:, None, None, :]
        return design.reshape(len(sightings), 3, -1)

    def along_direction(self, moved: Floats, sightings: Sightings, rows: Ints | None = None) -> Floats:
        """Change (r, ..., 1) of readings along the law's direction from that by each component (r, ..., c).

        The pointings of the readings are `rows` (r,), all in order if None; without a direction nothing is changed.
        """
        if not self.direction:
            return moved
        ratios = np.reshape(self.direction, (len(self.carrier.ways), -1)).T
        if self.each:
            at = np.full(len(sightings.station_names), -1)
            at[[sightings.station_names.index(name) for name in self.stations]] = np.arange(len(self.stations))
            which = at[sightings.station if rows is None else sightings.station[rows]]
            ratios = np.where(which[:, None] >= 0, ratios[which], 0.0)
        along: Floats = np.einsum("r...c,rc->r...", moved, np.broadcast_to(ratios, (len(moved), ratios.shape[1])))
        return along[..., None]

    def columns(self, sightings: Sightings) -> Floats:
        """Regressor columns (n, k) of each component of the response, zero at other places.

        (n, S k) for separate set-ups whose ratio is not fixed.
        """
        columns = self.driver.columns(sightings, moving=self.carrier.kind == "target")
        columns = columns * self.mask(sightings)[:, None]
        if not self.each or self.direction:
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
        if self._movable_steps is not None:
            return self._with_moved_pieces(sightings, self._movable_steps)
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

    @property
    def _movable_steps(self) -> Regressor | None:
        """Steps and ramps, or switch, whose edges a local search moves; with a region of the hall that is moved."""
        several = [f for f in (self.driver, *self.driver.factors) if f.kind in ("pieces", "switch")]
        few = [f for f in several if f.kind == "switch" or len(f.factors) <= MAX_MOVED_PIECES]
        return few[0] if few and self.driver.hall_region is None else None

    def _with_moved_pieces(self, sightings: Sightings, steps: Regressor) -> list[Law]:
        """Laws with one step or ramp moved to another gap between the values of its covariate."""
        x = np.unique(sightings.quantities[steps.covariates[0]][self.mask(sightings) > 0])
        gaps = np.searchsorted(x, [piece.constant for piece in steps.factors])
        laws = []
        for i, piece in enumerate(steps.factors):
            for k in range(max(gaps[i] - PIECE_MOVES, 1), min(gaps[i] + PIECE_MOVES, len(x) - 1) + 1):
                if (
                    np.isfinite(piece.constant)
                    and np.abs(np.delete(gaps, i) - k).min(initial=PIECE_MOVES) >= PIECE_MOVES
                ):
                    moved = replace(piece, constant=float(0.5 * (x[k - 1] + x[k])))
                    made = replace(steps, factors=(*steps.factors[:i], moved, *steps.factors[i + 1 :]))
                    laws.append(self._with_factor(steps, made))
        return laws + [self._with_factor(steps, replace(steps, constant=time)) for time in _other_lags(steps)]

    def _with_factor(self, old: Regressor, new: Regressor) -> Law:
        """Copy of the law with its regressor, or a factor of it, replaced."""
        if self.driver == old:
            return replace(self, driver=new)
        factors = tuple(new if factor == old else factor for factor in self.driver.factors)
        return replace(self, driver=replace(self.driver, factors=factors))

    def formulas(self, sightings: Sightings) -> list[Law]:
        """Short formulas that may replace a smooth law."""
        if self.driver.kind == "smooth":
            return [replace(self, driver=d, scale=0) for d in short_regressors(sightings, self.driver.covariates[0])]
        if self.driver.function == "decay":
            return [replace(self, driver=replace(self.driver, function="relaxing"))]
        if self.driver.kind != "product":
            return []
        options = [
            list(short_regressors(sightings, f.covariates[0], few=True)) if f.kind == "smooth" else [f]
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
        """Copy of the law with steps and ramps in place of its smooth regressor."""
        made, driver = pieces(steps), self.driver
        if driver.kind == "product":
            made = replace(driver, factors=tuple(made if f.kind == "smooth" else f for f in driver.factors))
        return replace(self, driver=made, scale=0)

    @property
    def switched_factor(self) -> Regressor | None:
        """Curve or wave that a switch of the same covariate may replace; None if there is none.

        It is the regressor itself, or the factor of a product that depends on time.
        """
        if self.driver.kind in ("smooth", "wave"):
            return self.driver
        replaced = (f for f in self.driver.factors if f.kind in ("smooth", "wave") and f.covariates == ("time",))
        return next(replaced, None) if self.driver.kind == "product" else None

    def edges(self, sightings: Sightings) -> list[Regressor]:
        """Values of the covariate at which a switch may act; times for a law that depends on a region of the hall."""
        replaced = self.switched_factor
        if replaced is None and not self.is_in_the_hall:
            return []
        name = replaced.covariates[0] if replaced else "time"
        x = np.unique(sightings.quantities[name][self.mask(sightings) > 0])
        x = x[np.unique(np.linspace(0, len(x) - 1, MAX_SWITCH_EDGES).round().astype(int))]
        return [simple(name, "step", float(edge)) for edge in 0.5 * (x[1:] + x[:-1])]

    def in_steps(self, steps: Sequence[Regressor]) -> Law:
        """Copy of the law with an amount of its own after each of several steps."""
        return replace(self, driver=self._gated(pieces(steps)), scale=0)

    def switched(self, edges: Sequence[Regressor]) -> Law:
        """Copy of the law with a switch as its regressor, or as the first factor of it."""
        return replace(self, driver=self._gated(switch(edges)), scale=0)

    def _gated(self, gate: Regressor) -> Regressor:
        """Regressor with a gate in place of the factor that it replaces; that of a region is multiplied by it."""
        if self.is_in_the_hall:
            return Regressor("product", factors=(self.driver, gate))
        others = [f for f in self.driver.factors if f != self.switched_factor]
        return Regressor("product", factors=(gate, *others)) if others else gate

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
        if self.direction:
            ratios = np.array(self.direction)
            mean = np.kron(ratios, mean).astype(np.float64)
            covariance = np.kron(np.outer(ratios, ratios), covariance).astype(np.float64)
        shape = (ways, len(mean) // (ways * k), k)
        means, spread = mean.reshape(shape), covariance.reshape(*shape, *shape)
        columns = self.driver.columns(sightings)
        if self.each:
            rows = [sightings.station == sightings.station_names.index(name) for name in self.stations]
            size = [float(np.sum((columns[r] @ means[:, i].T) ** 2)) for i, r in enumerate(rows)]
        top = int(np.argmax(size)) if self.each else 0
        law = replace(self, stations=(self.stations[top],), each=False, direction=()) if self.each else self
        moved = columns[law.mask(sightings) > 0] @ means[:, top].T
        moved = moved - moved.mean(axis=0) if self.driver.kind != "constant" else moved
        way = np.linalg.svd(moved, full_matrices=False)[2][0]
        way = np.eye(ways)[np.argmax(np.sum(moved**2, axis=0))] if self.carrier.units else way
        way = way * np.sign(way[np.argmax(np.abs(way))])
        return law, way, means[:, top], spread[:, top, :, :, top, :]


def _other_lags(steps: Regressor) -> list[float]:
    """Time constants [s] of the lag of a switch in time, other than its own."""
    if steps.kind != "switch" or steps.covariates != ("time",):
        return []
    return [0.0, *(steps.constant * s for s in (0.6, 1.7))] if steps.constant else list(LAG_TIMES)
