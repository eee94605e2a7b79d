"""Tests of the scatter of repeated pointings of one set-up: against the declared noise, and between its targets."""

import numpy as np
from scipy import special

from ltsim.adjustment.fieldcheck.result import BonferroniFamily, CheckItem, two_sided_chi2_p_value
from ltsim.adjustment.fieldcheck.sentences import target_scatter_sentence
from ltsim.adjustment.fieldcheck.setup_model import SetupModel
from ltsim.core.arrays import Floats

MIN_DOF_OF_COMPARED_TARGET = 6.0
"""Smallest number of degrees of freedom of the readings to a target whose scatter is compared with other targets."""


def noise_factors_by_target_scatter(setup_model: SetupModel, test_family: BonferroniFamily) -> Floats | None:
    """Factors (n, 1), at least 1, on the declared noise of n pointings, estimated separately for each target.

    The result is None if the scatter does not differ significantly between the targets (Bartlett's test).
    """
    chi2, dof = setup_model.chi2_and_dof_by_target()
    is_testable = dof >= MIN_DOF_OF_COMPARED_TARGET
    variance, dof_of_target = chi2[is_testable] / np.maximum(dof[is_testable], 1.0), dof[is_testable]
    if is_testable.sum() < 2 or not variance.min() > 0.0:
        return None
    mean_variance = float(dof_of_target @ variance / dof_of_target.sum())
    gain = dof_of_target.sum() * np.log(mean_variance) - dof_of_target @ np.log(variance)
    gain /= 1.0 + (np.sum(1.0 / dof_of_target) - 1.0 / dof_of_target.sum()) / (3.0 * (len(dof_of_target) - 1.0))
    if not special.chdtrc(len(dof_of_target) - 1.0, gain) < test_family.alpha_per_test:
        return None
    scatter_ratio = np.full(len(dof), np.sqrt(mean_variance))
    scatter_ratio[is_testable] = np.sqrt(variance)
    return np.asarray(np.maximum(scatter_ratio, 1.0)[setup_model.recording.target][:, None])


def repeatability_item(setup_model: SetupModel, test_family: BonferroniFamily, noise_text: str) -> CheckItem:
    """Result of the two-sided test that repeated pointings of a set-up scatter as their noise predicts.

    Smaller scatter passes with a remark. `noise_text` is a text on estimated noise, empty for the declared noise.
    """
    name, ratio = setup_model.recording.stations[0], float(np.sqrt(setup_model.chi2 / max(setup_model.dof, 1)))
    if setup_model.dof < 1:
        return CheckItem.from_test(
            name, "closure", True, f"{name}: too few repeated pointings for an estimate of the scatter"
        )
    p, less = two_sided_chi2_p_value(setup_model.chi2, setup_model.dof)
    p = test_family.corrected_p_value(p)
    freedom = f"{setup_model.dof} degrees of freedom"
    noise, remark = ("estimated", f"; {noise_text}") if noise_text else ("declared", "")
    phrase = f"{name}: repeated pointings scatter {ratio:.2f} times the {noise} noise ({freedom})"
    if p >= test_family.false_alarm_rate:
        return CheckItem.from_test(name, "closure", True, f"{phrase}, as expected{remark}", p)
    more = "less" if less else "more"
    return CheckItem.from_test(name, "closure", less, f"{phrase}, {more} than {noise}{remark}", p)


def target_scatter_item(
    setup_model: SetupModel,
    corrected_setup_model: SetupModel,
    test_family: BonferroniFamily,
    noise_text: str,
) -> CheckItem:
    """Result of the scatter test of a set-up whose targets scatter differently, with the names of the noisiest targets.

    `setup_model` is the linear model of the readings as measured, `corrected_setup_model` the one with fitted motions
    and drifts; `noise_text` is a text on estimated noise, empty for the declared noise.
    """
    closure = repeatability_item(corrected_setup_model, test_family, noise_text)
    chi2, dof = corrected_setup_model.chi2_and_dof_by_target()
    listed_targets = np.flatnonzero(dof >= MIN_DOF_OF_COMPARED_TARGET)
    listed_targets = listed_targets[np.argsort(-chi2[listed_targets] / dof[listed_targets], kind="stable")]
    sentence, targets = target_scatter_sentence(setup_model, listed_targets)
    return closure.model_copy(update={"sentence": f"{closure.sentence}: {sentence}", "targets": targets})
