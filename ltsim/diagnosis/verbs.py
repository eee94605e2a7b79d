"""Public function of the diagnosis: search for unmodelled causes of misfit in a recording."""

from pathlib import Path

from ltsim.calibration.calibration import Calibration
from ltsim.calibration.history import History
from ltsim.calibration.prior_information import EarlierCalibrationPrior
from ltsim.core.arguments import check_argument_bounds
from ltsim.diagnosis.diagnose import diagnose as diagnosis_of
from ltsim.diagnosis.diagnosis import Diagnosis
from ltsim.recordings.exchange import RecordingSource, load_recording


def diagnose(
    recording: RecordingSource,
    *,
    level: float = 0.05,
    seed: int = 0,
    history: Calibration | History | str | Path | None = None,
    held_out: bool | None = None,
) -> Diagnosis:
    """Diagnosis of a recording: agreement with the model, or probable causes of the mismatch with their probabilities.

    Parameters
    ----------
    recording : Recording, str or Path
    level : float
        False-alarm rate: probability that a recording without unmodelled effects is reported, at least 0.001.
    seed : int
        Seed of the random draws of simulated recordings, from which the p-value of the recording is computed.
    history : Calibration, History, str or Path, optional
        Earlier calibration of the instruments, or the calibration history of an instrument, or the file of either. An
        instrument constant that differs from its earlier values by more than their scatter and uncertainties explain is
        reported.
    held_out : bool, optional
        True for 5-fold cross-validation: the whole search is repeated without each fold of pointings, and the selected
        model predicts the fold. This takes five more searches. Effects that predict the folds worse than no effect are
        reported as improbable. False for none. The default None, as on the command line, is True for a network with up
        to 500 unknowns.

    Raises
    ------
    RecordError
        When the history cannot be read, or is of other instruments.
    NetworkError
        When the network cannot be solved.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> diagnosis = lt.diagnose(recording)
    >>> diagnosis.verdict, len(diagnosis.findings)
    ('consistent', 0)
    """
    check_argument_bounds(level=level, seed=seed, required_argument="level seed")
    earlier = None if history is None else EarlierCalibrationPrior.from_source(history)
    return diagnosis_of(load_recording(recording), level=level, seed=seed, history=earlier, held_out=held_out)
