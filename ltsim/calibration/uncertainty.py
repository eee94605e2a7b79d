"""Entries and sentences on the errors that the standard deviations of a calibration do or do not include."""

from collections.abc import Sequence
from typing import Protocol

from ltsim.calibration.schema import NoiseRow
from ltsim.core.notation import number_text
from ltsim.recordings.result_file import Entry, NotNegative, Positive

MAX_ESTIMATED_NOISE_FRACTION_FOR_GLOBAL_TEST = 0.9
"""Limit of the fraction of the redundancy with estimated noise. If it is exceeded, the global test is not valid,
because the estimation of the noise makes chi-square equal to the redundancy."""


class HiddenError(Entry):
    """Error that moves the targets without changing the readings, so that no standard deviation includes it."""

    error_text: str
    """Text for users that names the error and its size."""
    rms_target_error_um: NotNegative
    """Rms displacement [um] of the targets by the error, after the best rigid fit."""


class UncertaintyEntry(Entry):
    """Errors that the standard deviations of a result do or do not include."""

    noise_text: str = ""
    """Text for users on the standard deviations of the readings in the fit, and on their source."""
    constants_included: bool = True
    """True if the instrument constants were estimated, or `setup.toml` declares the instrument corrected, so that the
    standard deviations include them."""
    uncertainty_factor: Positive = 1.0
    """Factor that all standard deviations contain: sigma0 if the readings contradict the model, otherwise 1."""
    air_text: str = ""
    """Text for users on the errors of the air that the standard deviations of targets and stations include; empty
    for short ranges."""
    hidden_errors: tuple[HiddenError, ...] = ()
    """Errors that move the targets noticeably without changing the readings, the largest first. No standard
    deviation includes them."""


class ReportedUncertainty(Protocol):
    """Interface of a result that states which errors its standard deviations include (see `UncertaintyEntry`)."""

    @property
    def noise_text(self) -> str: ...  # noqa: D102
    @property
    def uncertainty_factor(self) -> float: ...  # noqa: D102
    @property
    def air_text(self) -> str: ...  # noqa: D102
    @property
    def hidden_errors(self) -> tuple[HiddenError, ...]: ...  # noqa: D102
    @property
    def constants_included(self) -> bool: ...  # noqa: D102


def uncertainty_sentences(result: ReportedUncertainty) -> list[str]:
    """Sentences for users on the standard deviations of a result: noise, factor, errors that they do not include."""
    sentences = [f"Noise of the readings (one sigma): {result.noise_text}."] if result.noise_text else []
    if result.uncertainty_factor > 1.0:
        model = "the model" if result.constants_included else "the model without instrument constants"
        sentences.append(
            f"The readings contradict {model}: all standard deviations are multiplied by sigma0 = "
            f"{number_text(result.uncertainty_factor, 3)}. If a single cause produces the contradiction, "
            "coordinates may have larger errors."
        )
    if not result.constants_included:
        sentences.append(
            "The standard deviations do not include errors of the instrument, because the instrument constants were "
            "not estimated. Use ltsim calibrate, or declare the instrument corrected."
        )
    if result.air_text:
        sentences.append(
            f"The standard deviations of targets and stations include the {result.air_text}. Change these values in "
            "the table [air] of setup.toml."
        )
    if result.hidden_errors:
        sizes = "; ".join(
            f"{error.error_text}: {number_text(error.rms_target_error_um, 2)} um (rms)"
            for error in result.hidden_errors
        )
        sentences.append(
            f"The following errors displace the targets without changing the readings, and the standard deviations do "
            f"not include them: {sizes}."
        )
    return sentences


def is_noise_estimated(noise: Sequence[NoiseRow]) -> bool:
    """True if most of the noise was estimated from the residuals, so that the global test is not valid."""
    redundancy = sum(n.redundancy for n in noise)
    redundancy_estimated = sum(n.redundancy for n in noise if n.factor_sigma is not None)
    return redundancy_estimated > MAX_ESTIMATED_NOISE_FRACTION_FOR_GLOBAL_TEST * redundancy
