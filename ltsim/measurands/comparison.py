"""Comparison of two epochs (measurements of the same points at different times) by a congruence test.

The result is written to comparison.json and displacements.csv.

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
from ltsim.core.notation import names_text
from ltsim.core.probability import p_value_relation_text
from ltsim.core.results import Column, Table, number_columns
from ltsim.core.units import MICROMETRE, MILLIMETRE, PPM
from ltsim.measurands.displacement_fit import DisplacementFit, WhitenedDifferences, coordinate_indices
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, ResultSource, Vector

DISPLACEMENTS_TABLE = Table(
    "displacements.csv",
    "displacement of each common point from the first epoch to the second",
    (
        Column("target", "name of the target", "text"),
        Column("moved", "True if the point moved", "flag"),
        *number_columns(".4f", **{f"{a}_mm": f"{a} coordinate in the first epoch" for a in "xyz"}),
        *(Column(f"d{a}_um", f"displacement along {a}, second minus first", sigma_column=f"s{a}_um") for a in "xyz"),
        *(Column(f"s{a}_um", f"standard deviation of d{a}_um") for a in "xyz"),
        *number_columns("", ".1f", a_um="longest semi-axis of the 95 % confidence ellipsoid"),
        *number_columns(
            "", ".1f", b_um="middle semi-axis of the ellipsoid", c_um="shortest semi-axis of the ellipsoid"
        ),
        Column("p_value", "p-value of the hypothesis that this point did not move, corrected for all tests", "p_value"),
        *number_columns(
            "", ".0f", detectable_um="displacement that is detected in any direction with 80 % probability"
        ),
    ),
)
"""Table displacements.csv: displacement of each point between two epochs, with its test."""


class Displacement(Entry):
    """Displacement of a point between two epochs, with its uncertainty and the test whether the point moved."""

    target: str
    """Name of the target."""
    moved: bool
    """True if the displacement of the target is significant."""
    position_mm: Vector
    """Position of the point in the first epoch [mm]."""
    displacement_um: Vector
    """Displacement [um], second minus first epoch, in the frame that the stable points define."""
    sigma_um: Vector
    """Standard deviations of the displacement along x, y and z [um]."""
    covariance_um2: tuple[Vector, Vector, Vector]
    """Covariance matrix of the displacement along x, y and z [um^2]."""
    semi_axes_um: Vector
    """Semi-axes of the 95 % error ellipsoid of the displacement [um], the largest first."""
    p_value: Finite
    """p-value of the hypothesis that the point did not move, corrected for the number of tested points. In the test,
    the displacements of all other moved points are estimated too."""
    detectable_um: tuple[Finite, Finite]
    """Smallest displacements [um] that are detected with a probability of 80 %: in the most favourable direction, and
    in the least favourable direction."""
    point_chi2: OptionalFloat = None
    """Chi-square (3 degrees of freedom in three dimensions) of the coordinate difference of this point alone; null if
    the epochs have separate frames."""

    @property
    def table_row(self) -> list[Any]:
        """Row of this displacement in the table displacements.csv."""
        numbers = *self.position_mm, *self.displacement_um, *self.sigma_um, *self.semi_axes_um
        return [self.target, self.moved, *numbers, self.p_value, self.detectable_um[1]]


class Comparison(ResultFile):
    """Result of `compare`, the content of `comparison.json`; `recording` is the recording of the first epoch."""

    FILE: ClassVar[str] = "comparison.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"displacements": DISPLACEMENTS_TABLE}
    format: Literal["ltsim-comparison/1"] = "ltsim-comparison/1"
    """Format and version of this file."""
    second_recording: ResultSource | None
    """Recording of the second epoch: name, size and digest of its data; null for a list of coordinates."""
    sentence: str
    """Sentence with the points that moved, or with the displacement that would have been detected."""
    significance_level: Finite
    """Significance level: probability that at least one point is reported as moved although none moved."""
    statistic: Finite
    """Chi-square of the congruence test, which is the global test of the hypothesis that no point moved."""
    dof: int
    """Degrees of freedom of the congruence test."""
    p_value: Finite
    """p-value of the congruence test with all points."""
    p_value_without_moved_points: Finite
    """p-value of the congruence test with only the points that did not move significantly."""
    scale_ppm: OptionalFloat = None
    """Scale of the second epoch relative to the first [ppm]; null if it was not estimated."""
    notes: tuple[str, ...] = ()
    """Notes on the epochs: errors identified in the recordings, undetermined motions of the network, exchanged point
    names, a common motion of all points."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of the possible causes of a misfit of the first recording, and of its outliers."""
    second_tests: tuple[CauseTest, ...] = ()
    """Tests of the possible causes of a misfit of the second recording, and of its outliers."""
    has_common_rigid_motion: bool = False
    """True if one rigid motion of all points explains most displacements, so that the two lists of coordinates may have
    different frames."""
    displacements: tuple[Displacement, ...] = Field(min_length=1)
    """Displacement and test of each point that both epochs contain, in the order of the first recording."""

    def _summary_lines(self) -> list[str]:
        return [
            self.sentence,
            *self.notes,
            f"test of the hypothesis that no point moved: {p_value_relation_text(self.p_value)} for all points, "
            f"{p_value_relation_text(self.p_value_without_moved_points)} for the points that did not move",
        ]

    @property
    def corrected_faults(self) -> list[CauseTest]:
        """Tests of the errors in the two recordings that the model corrects."""
        return corrected_faults((*self.tests, *self.second_tests))

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"displacements": lambda: DISPLACEMENTS_TABLE.with_rows(d.table_row for d in self.displacements)}

    @property
    def moved_points(self) -> tuple[str, ...]:
        """Names of the points that moved significantly."""
        return tuple(d.target for d in self.displacements if d.moved)


@dataclass(frozen=True)
class EpochDifference:
    """Coordinate differences of points between two aligned epochs, with covariance and free motions.

    Free motions are rigid motions of all points that an epoch does not determine. The covariance of a free network is
    singular along its free motions. A variance added along them makes it regular and does not change results.
    """

    point_names: Sequence[str]
    """Names of the points that both epochs contain."""
    coordinate_differences: Floats
    """Differences of the coordinates, second minus first epoch, point by point, shape (coordinates,) [m]."""
    covariance: Floats
    """Covariance of the coordinate differences, shape (coordinates, coordinates) [m^2]."""
    displacements_per_free_motion: Floats
    """Displacements of the coordinates by a unit of each free motion, shape (coordinates, free motions). A free motion
    is a rigid motion of all points that an epoch does not determine."""
    axis_indices: Ints
    """Indices of the compared coordinate axes: 0 for x, 1 for y, 2 for z."""
    first_epoch_points: Floats
    """Coordinates of the points in the first epoch, shape (points, 3) [m]."""
    estimates_scale: bool = False
    """True if the last column of `displacements_per_free_motion` is not a motion but the scale of the second epoch."""

    @property
    def n_points(self) -> int:
        """Number of points that the epochs have in common."""
        return len(self.first_epoch_points)

    @property
    def dof(self) -> int:
        """Degrees of freedom of the congruence test: number of coordinate differences minus number of free motions."""
        return len(self._whitening_root) - self.displacements_per_free_motion.shape[1]

    def chi2_of_single_point(self, point: int) -> float | None:
        """Chi-square of the coordinate difference of the point with index `point`, from this point alone.

        The result is None if the epochs have separate frames, because a single point then determines no difference.
        """
        if self.displacements_per_free_motion.shape[1]:
            return None
        point_rows = coordinate_indices([point], len(self.axis_indices))
        return float(
            self.coordinate_differences[point_rows]
            @ np.linalg.solve(self.covariance[np.ix_(point_rows, point_rows)], self.coordinate_differences[point_rows])
        )

    @cached_property
    def _whitening_root(self) -> Floats:
        """Matrix (rows, coordinates) that whitens coordinate differences, without unmeasured directions."""
        scale = np.sqrt(np.diag(self.covariance))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        # Directions that no epoch measured contain no information.
        keep = values > 1e-12 * values[-1]
        return (vectors[:, keep] / np.sqrt(values[keep])).T / scale

    @cached_property
    def whitened_differences(self) -> WhitenedDifferences:
        """Coordinate differences between the epochs, whitened by a root of their inverse covariance matrix."""
        return WhitenedDifferences(
            self._whitening_root,
            self.coordinate_differences,
            self.displacements_per_free_motion,
            len(self.axis_indices),
        )


def congruence_test(
    difference: EpochDifference,
    stable_mask: Bools,
    alpha: float,
    epoch_sources: tuple[ResultSource, ResultSource],
) -> Comparison:
    """Comparison of two epochs by a congruence test at the significance level `alpha`.

    Points for which `stable_mask` (points,) is False are tested for displacements. `epoch_sources` describe the data of
    the first and of the second epoch.
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
        difference.dof - len(difference.axis_indices) * len(moved),
    )
    scale = (
        float(fit.estimate[0][difference.displacements_per_free_motion.shape[1] - 1])
        if difference.estimates_scale
        else None
    )
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
    """Indices of the points that moved, at the significance level `alpha` for all tests of `tested_indices` together.

    Points with a significant displacement are added one by one. At the end each of these points is tested again, with
    the displacements of the other moved points in the model.
    """
    limit = float(special.chdtri(len(difference.axis_indices), alpha / max(len(tested_indices), 1)))
    n_fixed = len(difference.axis_indices) if difference.displacements_per_free_motion.shape[1] else 0
    max_moved = max(0, difference.n_points - n_fixed)
    return difference.whitened_differences.find_moved_points(tested_indices.tolist(), limit, max_moved)


def _displacement_of_point(
    difference: EpochDifference, point: int, fit: DisplacementFit, n_tested: int, alpha: float
) -> Displacement:
    """Displacement of the point with index `point` relative to the stable points, and its test.

    The displacements of the moved points of `fit` are in the model. The p-value is corrected for `n_tested` tested
    points. The detectable displacement refers to the significance level `alpha`.
    """
    count, a = max(n_tested, 1), len(difference.axis_indices)
    values, joint, drop = fit.displacement(point)
    needed = noncentrality(a, alpha=alpha / count)
    visible = np.sqrt(needed * np.clip(np.linalg.eigvalsh(joint), 0.0, None)) / MICROMETRE
    shift, covariance = np.zeros(3), np.zeros((3, 3))
    shift[difference.axis_indices] = values
    covariance[np.ix_(difference.axis_indices, difference.axis_indices)] = joint
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
        point_chi2=difference.chi2_of_single_point(point),
    )


def _result_sentence(displacements: Sequence[Displacement]) -> str:
    """Sentence with the points that moved, or with the displacement that would have been detected."""
    size_by_target = {d.target: float(np.linalg.norm(d.displacement_um)) for d in displacements if d.moved}
    if not size_by_target:
        sure = max(d.detectable_um[1] for d in displacements)
        return f"no point moved; a displacement of any point by {sure:.0f} um is detected with 80 % probability"
    names_by_size = sorted(size_by_target, key=lambda name: -size_by_target[name])
    names = names_text([f"{name} by {size_by_target[name]:.0f} um" for name in names_by_size])
    return f"{len(names_by_size)} of {len(displacements)} points moved: {names}"
