"""Choice of the most significant sudden motion of a station among several."""

from collections.abc import Mapping

from ltsim.adjustment.fieldcheck.setup_model import AddedColumnsFit
from ltsim.adjustment.reliability import neg_log_p_chi2
from ltsim.core.rounding import index_of_largest
from ltsim.physics.effects.station_bump import StationBump


def neg_log_p_of_chi2_drop(fit: AddedColumnsFit) -> float:
    """Negative logarithm of the p-value of the decrease of chi-square by a fit, for the declared noise."""
    return float(neg_log_p_chi2(fit.chi2_drop, fit.rank))


def most_significant(fits: Mapping[StationBump, AddedColumnsFit]) -> StationBump:
    """Bump (sudden motion of the station) whose fit has the smallest p-value; of equal p-values the first."""
    return [*fits][index_of_largest([neg_log_p_of_chi2_drop(fit) for fit in fits.values()])]
