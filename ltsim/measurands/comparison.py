"""Comparison of two epochs: congruence test, displaced points, comparison.json and displacements.csv.

References
----------
Pelzer, Zur Analyse geodaetischer Deformationsmessungen (1971): the congruence test.
Baarda, A testing procedure for use in geodetic networks (1968): tests of points, minimal detectable displacements.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy import special

from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.recommendations import corrected_faults
from ltsim.adjustment.reliability import noncentrality
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.notation import listing
from ltsim.core.probability import p_relation_text
from ltsim.core.results import Column, Table, number_columns
from ltsim.core.units import MICROMETRE, MILLIMETRE, PPM
from ltsim.measurands.displacement_fit import DisplacementFit, WhitenedDifferences, coordinate_rows
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, SourceEntry, Vector

DISPLACEMENTS_TABLE = Table(
    "displacements.csv",
    "displacement of each common point from the first epoch to the second",
    (
        Column("target", "name", "text"),
        Column("moved", "True if the point moved", "flag"),
        *number_columns(".4f", x_mm="coordinate in the first epoch", y_mm="as x_mm", z_mm="as x_mm"),
        *(Column(f"d{a}_um", "displacement, second minus first epoch", sigma_column=f"s{a}_um") for a in "xyz"),
        *(Column(f"s{a}_um", f"standard deviation of d{a}_um") for a in "xyz"),
        *number_columns("", ".1f", a_um="semi-axis of the 95 % confidence ellipsoid", b_um="as a_um", c_um="as a_um"),
        Column(
            "p_value", "p-value of the hypothesis of no displacement, corrected for the number of points", "p_value"
        ),
        *number_columns("", ".0f", detectable_um="displacement detected in any direction with a probability of 80 %"),
    ),
)


class Displacement(Entry):
    """Displacement of a point between two epochs, with its uncertainty and its test."""

    target: str
    """Name of the target."""
    moved: bool
    """True if the displacement of the target is significant."""
    position_mm: Vector
    """Position in the first epoch [mm]."""
    displacement_um: Vector
    """Displacement, second minus first epoch [um], in the frame that the stable points define."""
    sigma_um: Vector
    """Standard deviation of each component of the displacement [um]."""
    covariance_um2: tuple[Vector, Vector, Vector]
    """Covariance of the components of the displacement [um^2]."""
    semi_axes_um: Vector
    """Semi-axes of the 95 % error ellipsoid of the displacement [um], the largest first."""
    p_value: Finite
    """p-value of the hypothesis that the point did not move, corrected for the number of tested points. The
    displacements of all other displaced points are estimated together with this one."""
    detectable_um: tuple[Finite, Finite]
    """Smallest displacements that are detected with a probability of 80 % [um]: in the most favourable direction and in
    the least favourable one."""
    point_chi2: OptionalFloat = None
    """Chi-square of the coordinate difference of this point between the epochs, from this point alone; null if the
    epochs have separate frames."""

    @property
    def table_row(self) -> list[Any]:
        """Row of this displacement in the table displacements.csv."""
        numbers = *self.position_mm, *self.displacement_um, *self.sigma_um, *self.semi_axes_um
        return [self.target, self.moved, *numbers, self.p_value, self.detectable_um[1]]


class Comparison(ResultFile):
    """Result of `compare`, with the content of `comparison.json`; `recording` is the recording of the first epoch."""

    FILE: ClassVar[str] = "comparison.json"
    format: Literal["ltsim-comparison/1"] = "ltsim-comparison/1"
    """Format and version of this file."""
    second_recording: SourceEntry | None
    """Recording of the second epoch: name, size and digest of its data; null for a list of coordinates."""
    sentence: str
    """Result in one sentence: the points that moved."""
    significance_level: Finite
    """Significance level: probability that at least one point is reported as displaced although none is."""
    statistic: Finite
    """Chi-square of the congruence test, the global test of the hypothesis that no point is displaced."""
    dof: int
    """Degrees of freedom of the global test."""
    p_value: Finite
    """p-value of the global test."""
    p_value_without_moved_points: Finite
    """p-value of the global test of the points that are not displaced."""
    scale_ppm: OptionalFloat = None
    """Scale of the second epoch relative to the first [ppm]; null if it was not estimated."""
    notes: tuple[str, ...] = ()
    """Notes on the epochs: identified errors of the recordings, undetermined motions of the network, exchanged point
    names, a common motion of all points."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of the identified causes of a misfit of the first recording, and of its outliers."""
    second_tests: tuple[CauseTest, ...] = ()
    """Tests of the identified causes of a misfit of the second recording, and of its outliers."""
    has_common_rigid_motion: bool = False
    """True if one rigid motion of all points explains most displacements: the lists may have different frames."""
    displacements: tuple[Displacement, ...] = Field(min_length=1)
    """Displacement and test of each point that both epochs contain, in the order of the first recording."""

    def _lines(self) -> list[str]:
        return [
            self.sentence,
            *self.notes,
            f"hypothesis of no displacement: {p_relation_text(self.p_value)} for all points, "
            f"{p_relation_text(self.p_value_without_moved_points)} for the points that did not move",
        ]

    @property
    def faults(self) -> list[CauseTest]:
        """Errors of both recordings that the model corrects."""
        return corrected_faults((*self.tests, *self.second_tests))

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"displacements": lambda: DISPLACEMENTS_TABLE.with_rows(d.table_row for d in self.displacements)}

    @property
    def moved_points(self) -> tuple[str, ...]:
        """Names of the points that moved."""
        return tuple(d.target for d in self.displacements if d.moved)


@dataclass(frozen=True)
class EpochDifference:
    """Coordinate differences of the points in two aligned epochs, their covariance, and the free motions.

    Free motions are rigid motions of all points that an epoch does not determine. The covariance of a free network is
    singular along its free motions; a variance added along them makes it regular and does not change results.
    """

    point_names: Sequence[str]
    """Names of the points that both epochs contain."""
    coordinate_differences: Floats
    """Differences of the coordinates, second minus first epoch, point by point, shape (coordinates,) [m]."""
    covariance: Floats
    """Covariance of the coordinate differences, shape (coordinates, coordinates) [m^2]."""
    free_motions: Floats
    """Displacements of the points by a unit of each free motion, shape (coordinates, free motions). Free motions are
    the rigid motions of all points that an epoch does not determine."""
    compared_axes: Ints
    """Indices of the compared coordinate axes; 0 is x."""
    first_epoch_points: Floats
    """Coordinates of the points in the first epoch, shape (points, 3) [m]."""
    estimates_scale: bool = False
    """True if the last free motion is the scale of the second epoch."""

    @property
    def n_points(self) -> int:
        """Number of points."""
        return len(self.first_epoch_points)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the global test: coordinate differences minus free motions."""
        return len(self._whitening_root) - self.free_motions.shape[1]

    def chi2_of_point(self, point: int) -> float | None:
        """Chi-square of the coordinate difference of the point with index `point`, from this point alone.

        The result is None if the epochs have separate frames, because one point then determines no difference.
        """
        if self.free_motions.shape[1]:
            return None
        point_rows = coordinate_rows([point], len(self.compared_axes))
        return float(
            self.coordinate_differences[point_rows]
            @ np.linalg.solve(self.covariance[np.ix_(point_rows, point_rows)], self.coordinate_differences[point_rows])
        )

    @cached_property
    def _whitening_root(self) -> Floats:
        scale = np.sqrt(np.diag(self.covariance))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        # Directions that neither epoch measured at all say nothing.
        keep = values > 1e-12 * values[-1]
        return (vectors[:, keep] / np.sqrt(values[keep])).T / scale

    @cached_property
    def whitened_differences(self) -> WhitenedDifferences:
        """Differences, whitened by the root of their inverse covariance."""
        return WhitenedDifferences(
            self._whitening_root, self.coordinate_differences, self.free_motions, len(self.compared_axes)
        )


def congruence_test(
    difference: EpochDifference,
    stable_mask: Bools,
    alpha: float,
    epoch_sources: tuple[SourceEntry, SourceEntry],
) -> Comparison:
    """Comparison of two epochs by a congruence test at the significance level `alpha`.

    Points outside the mask `stable_mask` (points,) are tested for displacements. `epoch_sources` are the sources of the
    two epochs.
    """
    tested = np.flatnonzero(~stable_mask)
    moved = _find_moved_points(difference, tested, alpha)
    fit = difference.whitened_differences.fit(moved)
    displacements = tuple(
        _displacement_of_point(difference, i, fit, len(tested), alpha) for i in range(difference.n_points)
    )
    statistic, dof, remaining = (
        difference.whitened_differences.fit(()).sum_of_squares,
        difference.dof,
        difference.dof - len(difference.compared_axes) * len(moved),
    )
    scale = float(fit.estimate[0][difference.free_motions.shape[1] - 1]) if difference.estimates_scale else None
    return Comparison(
        recording=epoch_sources[0],
        second_recording=epoch_sources[1],
        sentence=_result_sentence(displacements),
        significance_level=alpha,
        statistic=statistic,
        dof=dof,
        p_value=float(special.chdtrc(dof, max(statistic, 0.0))),
        p_value_without_moved_points=float(special.chdtrc(remaining, max(fit.sum_of_squares, 0.0)))
        if remaining > 0
        else 1.0,
        scale_ppm=None if scale is None else scale / PPM,
        displacements=displacements,
    )


def _find_moved_points(difference: EpochDifference, tested_indices: Ints, alpha: float) -> list[int]:
    """Indices of the displaced points, at the significance level `alpha` for all `tested_indices` together.

    Points with a significant displacement are added one by one. After each addition every displaced point is tested
    again, with the displacements of the other displaced points in the model.
    """
    limit = float(special.chdtri(len(difference.compared_axes), alpha / max(len(tested_indices), 1)))
    max_moved = max(0, difference.n_points - (len(difference.compared_axes) if difference.free_motions.shape[1] else 0))
    return difference.whitened_differences.find_moved_points(tested_indices.tolist(), limit, max_moved)


def _displacement_of_point(
    difference: EpochDifference, point: int, fit: DisplacementFit, n_tested: int, alpha: float
) -> Displacement:
    """Displacement of the point with index `point` relative to the stable points, and its test.

    The displacements of the moved points of `fit` are in the model. The p-value is corrected for `n_tested` tested
    points. The detectable displacement refers to the significance level `alpha`.
    """
    count, a = max(n_tested, 1), len(difference.compared_axes)
    values, joint, drop = fit.displacement(point)
    needed = noncentrality(a, alpha=alpha / count)
    visible = np.sqrt(needed * np.clip(np.linalg.eigvalsh(joint), 0.0, None)) / MICROMETRE
    shift, covariance = np.zeros(3), np.zeros((3, 3))
    shift[difference.compared_axes] = values
    covariance[np.ix_(difference.compared_axes, difference.compared_axes)] = joint
    factor = float(2.0 * special.gammaincinv(0.5 * a, 1.0 - GLOBAL_TEST_LEVEL))
    semi_axes = np.sqrt(factor * np.clip(np.linalg.eigvalsh(covariance), 0.0, None))[::-1]
    return Displacement(
        target=difference.point_names[point],
        moved=point in fit.moved,
        position_mm=(difference.first_epoch_points[point] / MILLIMETRE).tolist(),
        displacement_um=(shift / MICROMETRE).tolist(),
        sigma_um=(np.sqrt(np.diag(covariance)) / MICROMETRE).tolist(),
        covariance_um2=(covariance / MICROMETRE**2).tolist(),
        semi_axes_um=(semi_axes / MICROMETRE).tolist(),
        p_value=float(min(1.0, count * special.chdtrc(a, max(drop, 0.0)))),
        detectable_um=(float(visible[0]), float(visible[-1])),
        point_chi2=difference.chi2_of_point(point),
    )


def _result_sentence(displacements: Sequence[Displacement]) -> str:
    size_by_target = {d.target: float(np.linalg.norm(d.displacement_um)) for d in displacements if d.moved}
    if not size_by_target:
        sure = max(d.detectable_um[1] for d in displacements)
        return f"no point moved; a displacement of {sure:.0f} um of any point would be detected with 80 % probability"
    names_by_size = sorted(size_by_target, key=lambda name: -size_by_target[name])
    names = listing([f"{name} by {size_by_target[name]:.0f} um" for name in names_by_size])
    return f"{len(names_by_size)} of {len(displacements)} points moved: {names}"
