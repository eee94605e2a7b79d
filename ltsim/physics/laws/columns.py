"""Columns of the design matrix for regressors, with one row per pointing, and priors of their coefficients.

The rms of each column is about one.

A smooth curve is a Gaussian process of reduced rank in one covariate. Its columns are a linear function and the first
eigenfunctions of the Laplacian on the range of the covariate. The prior variances of the coefficients are the spectral
density of a squared-exponential kernel (Solin and Sarkka 2020, Hilbert space methods for reduced-rank Gaussian process
regression, eq. 20). For an angle on a full circle the columns are Fourier waves. Curves with other length scales, and
random walks, have the same columns but other prior variances.
"""

from collections.abc import Callable, Sequence
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Floats, Ints
from ltsim.scene.sightings import Sightings

CIRCULAR_COVARIATES = ("azimuth", "circle", "bearing", "nest-direction")
"""Names of the covariates that are angles on a full circle."""
N_CURVE_MODES = 9
"""Number of eigenfunctions of the Laplacian (modes) in a smooth curve that a diagnosis tries. For the shortest length
scale, the prior standard deviation of the last coefficient is a tenth to a third of the first one."""
N_PRODUCT_CURVE_MODES = 4
"""Number of eigenfunctions (modes) of a smooth curve that is a factor of a product, or a law (error as a function of
covariates) of a single target."""
N_FINER_CURVE_MODES = 32
"""Number of eigenfunctions (modes) of a finer curve, which a diagnosis tries in place of the selected smooth curve."""
EIGENFUNCTION_INTERVAL_TO_RANGE_RATIO = 1.25
"""Width of the interval at whose ends all eigenfunctions of a smooth curve are zero, divided by the range of the
covariate. The ratio is above 1, because a smooth curve need not be zero at the ends of the range."""
LENGTH_SCALES_BY_N_CURVE_MODES = {
    N_CURVE_MODES: (0.9, 0.4, 0.18),
    N_PRODUCT_CURVE_MODES: (0.6,),
    N_FINER_CURVE_MODES: (0.07,),
}
"""Length scales of a smooth curve (of the kernel of its Gaussian process), by the number of its eigenfunctions. They
are fractions of half the range of the covariate, or radians for an angle on a full circle."""
MEMORY_COVARIATE_PREFIXES = ("approach-", "move-", "last-", "work-", "wound-", "lapse")
"""Prefixes of the names of covariates that depend on earlier pointings, such as `move-azimuth` (motion since the
previous pointing)."""
FORMULA_FUNCTIONS: dict[str, Callable[[Floats, float], Floats]] = {
    "power": lambda x, k: x**k,
    "abs": lambda x, k: np.abs(x),
    "cos": lambda x, k: np.cos(k * x),
    "sin": lambda x, k: np.sin(k * x),
    "tan": lambda x, k: np.tan(k * x),
    "step": lambda x, k: (x > k).astype(np.float64),
    "ramp": lambda x, k: np.maximum(x - k, 0.0),
    "relaxing": lambda x, k: 1.0 / (1.0 + x / k),
    "saturated": lambda x, k: x / (k + np.abs(x)),
    "decay": lambda x, k: np.exp(-x / k),
    "fading": lambda x, k: np.exp(-np.abs(x) / k),
    "saw": lambda x, k: np.remainder(x / k, 1.0) - 0.5,
    "slack": lambda x, k: np.sign(x) * np.maximum(np.abs(x) - k, 0.0),
    "within": lambda x, k: np.where(np.abs(x) < k, x, 0.0),
    "stuck": lambda x, k: np.where(np.abs(x) < k, np.sign(x), 0.0),
}
"""Functions of a covariate x and a constant k that the formula of a law (error as a function of covariates) may
contain, by the name of the function."""
HYSTERESIS_FUNCTION = "hysteresis"
"""Name of the function with hysteresis, which depends on the order of the pointings. Its constant is half the width
of the loop, in the unit of the covariate."""
MAX_NATURAL_ZERO_FRACTION = 0.02
"""Limit of the ratio of the smallest to the largest absolute value of a covariate. Below it, zero is the reference
value of the covariate. A load, for example, is practically zero in some pointings."""


def has_natural_zero(covariate: Floats) -> bool:
    """True if zero is the reference value of a covariate with n values (n,), because it comes close to zero (a load).

    The reference value of other covariates, such as a temperature, is their mean.
    """
    return bool(np.nanmin(np.abs(covariate)) < MAX_NATURAL_ZERO_FRACTION * np.nanmax(np.abs(covariate)))


def scaled_to_unit_rms(column: Floats) -> Floats:
    """Column (n, 1) of n values divided by their rms; a column of zeros is returned unchanged."""
    largest = float(np.max(np.abs(column), initial=0.0))
    if not largest > 0.0:
        return column
    scaled: Floats = np.ldexp(column, -int(np.frexp(largest)[1]))  # the squares of scaled values are finite
    return scaled / float(np.sqrt(np.mean(scaled**2)))


N_HARMONICS_OF_CYCLE = 5
"""Number of harmonics in a periodic function of any shape (cycle) that a diagnosis tries."""


def fourier_columns(phase: Floats, n_harmonics: int) -> Floats:
    """Cosines and sines (n, 2 n_harmonics) of 1 to `n_harmonics` times n phases (n,) [rad]; the rms is about one."""
    return np.sqrt(2.0) * _unit_phasors(phase, n_harmonics).view(np.float64)


def _unit_phasors(phase: Floats, n_harmonics: int) -> NDArray[np.complex128]:
    """Complex numbers exp(i k phase), (n, n_harmonics), for n phases (n,) [rad] and k = 1 to `n_harmonics`."""
    first_harmonic = np.broadcast_to(np.exp(1j * phase)[:, None], (len(phase), n_harmonics))
    return np.cumprod(first_harmonic, axis=1)


def smooth_curve_columns(name: str, covariate: Floats, n_modes: int) -> Floats:
    """Columns (n, k) of a smooth curve in a covariate with n values `covariate` (n,) and the name `name`.

    The k columns are a linear function and `n_modes` eigenfunctions of the Laplacian. For an angle on a full circle
    (`CIRCULAR_COVARIATES`) they are cosine and sine of (n_modes + 1) // 2 multiples of the angle.
    """
    if name in CIRCULAR_COVARIATES:
        return fourier_columns(covariate, (n_modes + 1) // 2)
    low, high = float(covariate.min()), float(covariate.max())
    half_range = max(0.5 * (high - low), 1e-300)
    u = (covariate - 0.5 * (low + high)) / half_range
    waves = _unit_phasors(
        0.5 * np.pi * (u + EIGENFUNCTION_INTERVAL_TO_RANGE_RATIO) / EIGENFUNCTION_INTERVAL_TO_RANGE_RATIO, n_modes
    ).imag / np.sqrt(EIGENFUNCTION_INTERVAL_TO_RANGE_RATIO)
    return np.hstack([np.sqrt(3.0) * u[:, None], np.sqrt(2.0) * waves])


@cache
def smooth_curve_sigmas(is_circular: bool, n_modes: int) -> tuple[Floats, ...]:
    """Prior standard deviations (k,) of the k coefficients of a smooth curve: one array per length scale.

    `is_circular` is True for an angle on a full circle. The last array is the prior of a random walk; this array is
    omitted for an angle on a full circle, and if `n_modes` is `N_PRODUCT_CURVE_MODES`.
    """
    spreads = []
    if is_circular:
        orders = np.repeat(np.arange(1, n_modes // 2 + 1 + n_modes % 2), 2)
        spreads = [np.exp(-0.25 * (orders * scale) ** 2) for scale in LENGTH_SCALES_BY_N_CURVE_MODES[n_modes]]
    else:
        rates = 0.5 * np.pi * np.arange(1, n_modes + 1) / EIGENFUNCTION_INTERVAL_TO_RANGE_RATIO
        spreads = [
            np.concatenate([[0.5], np.exp(-0.25 * (rates * scale) ** 2)])
            for scale in LENGTH_SCALES_BY_N_CURVE_MODES[n_modes]
        ]
        spreads += (
            [np.concatenate([[0.5], 1.0 / np.arange(1, n_modes + 1)])] if n_modes != N_PRODUCT_CURVE_MODES else []
        )
    return tuple(spread / np.linalg.norm(spread) for spread in spreads)


def function_column(sightings: Sightings, covariate: str, function_name: str, constant: float) -> Floats:
    """Column (n, 1), with an rms of one, of a function of a covariate in n pointings.

    `function_name` is a key of `FORMULA_FUNCTIONS`, or `HYSTERESIS_FUNCTION`; `constant` is the constant of the
    function.
    """
    x = sightings.covariate_values[covariate]
    if function_name == HYSTERESIS_FUNCTION:
        slack = play_operator(x[sightings.measurement_order], constant)
        values = np.empty_like(x)
        values[sightings.measurement_order] = slack - x[sightings.measurement_order]
        return scaled_to_unit_rms((values - values.mean())[:, None])
    if function_name == "power" and covariate in sightings.covariates and not has_natural_zero(x):
        x = x - x.mean()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values = FORMULA_FUNCTIONS[function_name](x, constant)
    return scaled_to_unit_rms(np.nan_to_num(values, posinf=0.0, neginf=0.0)[:, None])


def play_operator(input_values: Floats, half_width: float) -> Floats:
    """Output (n,) of a play operator (mechanical hysteresis) for a sequence of n inputs (n,).

    The output stays constant until the input differs from it by `half_width`, and then follows the input at this
    distance (Krasnosel'skii and Pokrovskii, Systems with hysteresis, 1989).
    """
    output = np.empty_like(input_values)
    present_value = float(input_values[0]) if len(input_values) else 0.0
    for i, value in enumerate(input_values.tolist()):
        present_value = min(max(present_value, value - half_width), value + half_width)
        output[i] = present_value
    return output


def polynomial_field_columns(
    sightings: Sightings, names: Sequence[str], origin_targets: Sequence[str], *, is_quadratic: bool
) -> Floats:
    """Columns (n, 4) or (n, 10) in n pointings of a linear or quadratic polynomial of the target's position.

    The four columns are a constant and three scaled coordinates. If `is_quadratic`, six products of two coordinates
    follow. The coordinates are the covariates `names` minus their mean over the pointings to `origin_targets` (all
    targets if empty).
    """
    place = np.stack([sightings.covariate_values[name] for name in names], axis=1)
    ids = [i for name in origin_targets for i in sightings.target_indices_by_name[name]]
    near = np.isin(sightings.target, ids) if ids else slice(None)
    place = place - place[near].mean(axis=0)
    place = place / max(float(place[near].std()), 1e-300)
    more = (
        [place[:, [a]] * place[:, [b]] for a, b in combinations_with_replacement(range(3), 2)] if is_quadratic else []
    )
    return np.hstack([np.ones((len(place), 1)), place, *more])


def first_order_lag_columns(sightings: Sightings, covariate: str, time_constant: float) -> Floats:
    """Columns (n, 2) in n pointings: a covariate after a first-order lag, and the covariate minus its lagged value.

    Each column has an rms of one. `time_constant` [s] is the time constant of the lag.
    """
    x = sightings.covariate_values[covariate]
    x = np.abs(x) if covariate.startswith(MEMORY_COVARIATE_PREFIXES) else x - x.mean()
    lagged = lagged_values(x, sightings, time_constant)
    return np.hstack([scaled_to_unit_rms(lagged[:, None]), scaled_to_unit_rms((x - lagged)[:, None])])


def lagged_values(unlagged_values: Floats, sightings: Sightings, time_constant: float) -> Floats:
    """Values (n,) of a quantity in n pointings after a first-order lag, from its `unlagged_values` (n,).

    The lag has the time constant `time_constant` [s]. Before the first pointing the quantity is taken as constant.
    """
    row_order = sightings.measurement_order
    share = -np.expm1(-np.diff(sightings.time[row_order], prepend=sightings.time[row_order[0]]) / time_constant)
    lagged = np.empty_like(unlagged_values)
    present_value = float(unlagged_values[row_order[0]])
    for row, value, gain in zip(row_order.tolist(), unlagged_values[row_order].tolist(), share.tolist(), strict=True):
        present_value += gain * (value - present_value)
        lagged[row] = present_value
    return lagged


def group_means(columns: Floats, groups: Ints) -> Floats:
    """Columns (n, k) in which the value of each of n pointings is replaced by the mean over its group.

    `columns` (n, k) are the original columns, and `groups` (n,) the indices of the groups of the pointings.
    """
    is_member = indicator_columns(groups, np.unique(groups)) > 0
    means: Floats = is_member @ ((is_member.T @ columns) / is_member.sum(axis=0)[:, None])
    return means


def indicator_columns(group_indices: Ints, column_groups: Ints | Sequence[int]) -> Floats:
    """Indicator columns (n, k) of k groups of pointings: 1 for the pointings of the group, 0 for the others.

    `group_indices` (n,) are the groups of the n pointings, `column_groups` (k,) the groups of the columns.
    """
    return (group_indices[:, None] == np.asarray(column_groups)).astype(np.float64)
