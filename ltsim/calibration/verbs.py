"""Public functions for calibration: `calibrate`, `evaluate`, `verify` and `history`."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from ltsim.adjustment.evaluation import (
    Criteria,
    evaluate_criteria as criteria_of,
    read_nominal,
    verify_against_nominal as verified,
)
from ltsim.adjustment.snooping import screen_gross_errors
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.calibration_series import CalibrationSeries
from ltsim.calibration.correct import incidence_reading_changes
from ltsim.calibration.distance import OBJECTIVE_NORM_BY_DISTANCE_METHOD, calibrate_distance
from ltsim.calibration.files import CalibrationSource, load_calibration, read_calibration
from ltsim.calibration.history import History
from ltsim.calibration.network import calibrate_network
from ltsim.calibration.prior_information import EarlierCalibrationPrior, ParameterSelection
from ltsim.calibration.reported_uncertainty import with_reported_uncertainty
from ltsim.calibration.requested_effects import RequestedEffect
from ltsim.core.arguments import check_argument_choice, check_mapping_argument
from ltsim.core.errors import LtsimError, ModelError, RecordError, option_text
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import SizedEffect, effect_tuple, make_effect, name_tuple
from ltsim.physics.laws.text_form import parse_law
from ltsim.physics.model.construction import GeometricErrorModel, make_construction as construction_called
from ltsim.recordings import Recording
from ltsim.recordings.exchange import RecordingSource, load_recording, read

NO_PRIOR_OPTION_VALUE = "none"
"""Value of the option `prior` for a calibration without prior information."""


def calibrate(
    recording: RecordingSource,
    *,
    method: str = "network",
    construction: str | GeometricErrorModel | None = None,
    robust: bool = False,
    noise_from_data: bool = False,
    datum: str | Sequence[str] | None = None,
    parameters: str | Sequence[str] | None = None,
    without: str | Sequence[str] = (),
    hold: Mapping[str, float] | None = None,
    prior: CalibrationSource | History | None = None,
    harmonics: int | None = None,
    degree: int | None = None,
    box: float | None = None,
    with_effects: str | Effect | Sequence[str | Effect] = (),
    advise: bool = True,
) -> Calibration:
    """Calibration of the instruments of a recording: parameters, uncertainties and undetermined combinations.

    Parameters
    ----------
    recording : Recording, str or Path
    method : {`network`, `distance`, `distance-l1`, `equation-9`, `equation-9-l1`}
        Rigorous network adjustment (`network`); or agreement of distances between targets as measured from several
        stations (Sensors 2021, 21, 7479), for the determined combinations of parameters, by least squares (`distance`)
        or least absolute deviations (`distance-l1`); or for all parameters, which fits undetermined combinations to the
        noise (`equation-9`, `equation-9-l1`).
    construction : {`misalignment`, `dh`, `steering-mirror`} or GeometricErrorModel, optional
        Misalignments with the source in the head (`misalignment`, 16 parameters) or with a steering mirror
        (`steering-mirror`, 21), or the Denavit-Hartenberg chain of Sensors 2021, 21, 7479 (`dh`, 78); default: the
        model declared in `setup.toml`.
    robust : bool
        True to exclude outlying readings. For method `network` only.
    noise_from_data : bool
        True to estimate the noise of readings. For method `network` only.
    datum : str or sequence of str, optional
        Targets that define the datum by inner constraints. For method `network` only.
    parameters : str or sequence of str, optional
        Parameters to estimate, by name or by a common beginning of several names (`azimuth-eccentricity`);
        ``NAME@INSTRUMENT`` means the parameter of one instrument. All other parameters are fixed at zero.
    without : str or sequence of str
        Parameters that are fixed at zero.
    hold : mapping of str to float, optional
        Parameters that are fixed at a value, each in its unit; several can be given.
    prior : Calibration, History, str or Path, optional
        Estimates of earlier calibrations with their covariance, in place of the prior in `setup.toml`. The value `none`
        means no prior: the readings alone determine how far the correction is shrunk. For method `network` only.
    harmonics : int, optional
        Order of the harmonics in the errors of the axes of a D-H chain, 0 to 4; default 2.
    degree : int, optional
        Degree of the polynomials in the errors of the range axis of a D-H chain, 0 to 9; default 2.
    box : float, optional
        Bound on every parameter in prior sigmas, with the methods `equation-9` and `equation-9-l1`.
    with_effects : str, Effect or sequence of them
        Physical effects that are also estimated: `NAME` (from `ltsim effects`) or `NAME:WHERE,...` with stations,
        targets, and shape parameters such as `law=visit` in the effect's units; the readings determine those not given.
        Empirical laws, which describe changes of the readings by functions such as `vertical index ~ time:S3`, are
        given as a diagnosis reports them. Several can be given. For method `network` only.
    advise : bool
        True to report the further measurements that would determine the undetermined combinations.

    Raises
    ------
    ModelError
        If a method or construction does not exist, or an option cannot be combined with the method.
    NetworkError
        When the network cannot be solved.
    ConvergenceError
        When the adjustment does not converge.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, truth = lt.simulate("paper-workshop", seed=7)
    >>> found = lt.calibrate(recording)
    >>> found.fit.dof, found.fit.status
    (318, 'converged')
    >>> found.to_dataframe("parameters").columns.tolist()
    ['parameter', 'instrument', 'value', 'sigma', 'unit', 'prior_sigma', 'held', 'applied_value']
    """
    check_mapping_argument("hold", hold)
    check_argument_choice("method", method, ("network", *OBJECTIVE_NORM_BY_DISTANCE_METHOD))
    if isinstance(construction, GeometricErrorModel):
        if harmonics is not None or degree is not None:
            raise ModelError("harmonics and degree can be set only if construction is a name, such as 'dh'")
        built: GeometricErrorModel | None = construction
    else:
        built = _named_construction(construction, harmonics, degree)
    has_no_prior = isinstance(prior, str) and prior == NO_PRIOR_OPTION_VALUE
    earlier_calibration_prior = None if prior is None or has_no_prior else EarlierCalibrationPrior.from_source(prior)
    parameter_names = None if parameters is None else name_tuple(parameters)
    choice = ParameterSelection(
        parameter_names, name_tuple(without), dict(hold or {}), earlier_calibration_prior, has_no_prior
    )
    datum_names = None if datum is None else name_tuple(datum)
    options: dict[str, Any] = {"robust": robust, "noise_from_data": noise_from_data, "datum": datum_names}
    effects = effect_tuple(with_effects)
    if box is not None and not method.startswith("equation-9"):
        raise ModelError(f"{option_text('box')} needs the method equation-9 or equation-9-l1, not {method}")
    source = load_recording(recording)
    if method == "network":
        requested_effects = [parse_requested_effect(asked, source) for asked in effects]
        return with_reported_uncertainty(
            calibrate_network(
                source,
                built,
                recommend_measurements=advise,
                parameter_selection=choice,
                requested_effects=requested_effects,
                **options,
            )
        )
    if any(options.values()) or prior is not None or effects:
        listed = ", ".join(map(option_text, ("robust", "noise_from_data", "datum", "prior")))
        raise ModelError(
            f"{listed} and {option_text('with_effects')} need {option_text('method')} network, not {method}"
        )
    return with_reported_uncertainty(
        calibrate_distance(
            source, built, method=method, advise=advise, parameter_selection=choice, bound_in_prior_sigmas=box
        )
    )


def parse_requested_effect(effect_or_text: str | Effect | SizedEffect, recording: Recording) -> RequestedEffect:
    """Requested effect from an effect or its text; fields with their default value are determined from the readings.

    Raises ModelError for an effect with a size, because its size is estimated.
    """
    if isinstance(effect_or_text, SizedEffect):
        name = effect_or_text.effect.name
        raise ModelError(
            f"the effect {name} has a size, but sizes are estimated here; give the effect without its size"
        )
    if isinstance(effect_or_text, str):
        return _parse_effect_text(effect_or_text, recording)
    fixed_names = {f.name for f in fields(effect_or_text) if getattr(effect_or_text, f.name) != f.default}
    return RequestedEffect(effect_or_text, frozenset(fixed_names))


def _parse_effect_text(text: str, recording: Recording) -> RequestedEffect:
    """Requested effect from a text: an empirical law, or `NAME:WHERE,...` with stations, targets, shape parameters."""
    name, _, rest = text.partition(":")
    carrier, is_law, driver = name.partition("~")
    places: dict[str, tuple[str, ...]] = {"stations": (), "targets": ()}
    constants: dict[str, Any] = {}
    for item in filter(None, (part.strip() for part in rest.split(","))):
        key, is_constant, value = item.partition("=")
        if is_constant:
            try:
                constants[key.strip()] = float(value)
            except ValueError:
                constants[key.strip()] = value.strip()
        elif item in recording.stations or item in recording.targets:
            places["stations" if item in recording.stations else "targets"] += (item,)
        else:
            listed = ", ".join(recording.stations)
            raise ModelError(f"'{text}': '{item}' is not a station ({listed}), a target or NAME=VALUE")
    if is_law and constants:
        raise ModelError(
            f"'{text}': the shape parameters of an empirical law belong in its text and cannot be given separately"
        )
    if is_law:
        return RequestedEffect(parse_law(carrier.strip(), driver.strip(), recording, **places))
    fixed_names = {kind for kind, named in places.items() if named} | set(constants)
    return RequestedEffect(make_effect(name.strip(), places, constants), frozenset(fixed_names))


def _named_construction(name: str | None, harmonics: int | None, degree: int | None) -> GeometricErrorModel | None:
    """Geometric error model with the given name; None for the model that `setup.toml` declares.

    `harmonics` and `degree` are options of the model `dh`.
    """
    if name is not None:
        return construction_called(name, harmonics, degree)
    if harmonics is not None or degree is not None:
        raise ModelError(f"{option_text('harmonics')} and {option_text('degree')} need the construction dh")
    return None


def evaluate(recording: RecordingSource, calibration: CalibrationSource | None = None) -> Criteria:
    """Disagreement of the stations in distances and coordinates, before and after a calibration.

    Parameters
    ----------
    recording : Recording, str or Path
    calibration : Calibration, str or Path, optional
        Calibration that is applied for the values after calibration; by default there are no such values.

    Raises
    ------
    NetworkError
        If fewer than two stations have common targets.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, _ = lt.simulate("paper-workshop", seed=7)
    >>> criteria = lt.evaluate(recording, lt.calibrate(recording))
    >>> criteria.distance.improvement_percent > 10
    True
    """
    source = load_recording(recording)
    use = ~screen_gross_errors(source).is_gross_pointing
    if calibration is None:
        return Criteria.from_criteria(source, criteria_of(source, row_mask=use))
    corrections = load_calibration(calibration)
    change = incidence_reading_changes(source, corrections)
    parameter_values = corrections.applied_values_for(source)
    return Criteria.from_criteria(
        source, criteria_of(source, corrections.construction, parameter_values, reading_changes=change, row_mask=use)
    )


def verify(recording: RecordingSource, nominal: str | Path, calibration: CalibrationSource) -> Criteria:
    """Errors of a recording of points with nominal coordinates, before and after a calibration.

    Parameters
    ----------
    recording : Recording, str or Path
    nominal : str or Path
        Table ``target,x_mm,y_mm,z_mm`` of nominal points from a coordinate measuring machine.
    calibration : Calibration, str or Path

    Examples
    --------
    >>> import ltsim as lt
    >>> from pathlib import Path
    >>> from ltsim.simulation.truth import nominal_points_csv
    >>> found = lt.calibrate(lt.simulate("paper-workshop", seed=7).recording)
    >>> laboratory, truth = lt.simulate("paper-laboratory", seed=7)
    >>> _ = Path("cmm.csv").write_text(nominal_points_csv(truth))
    >>> lt.verify(laboratory, "cmm.csv", found).to_dataframe()["criterion"].tolist()
    ['distance', 'coordinate']
    """
    source, corrections = load_recording(recording), load_calibration(calibration)
    change = incidence_reading_changes(source, corrections)
    parameter_values = corrections.applied_values_for(source)
    points = read_nominal(Path(nominal))
    return Criteria.from_criteria(
        source, verified(source, points, corrections.construction, parameter_values, reading_changes=change)
    )


def history(
    sources: Iterable[RecordingSource | Calibration] | Mapping[str, RecordingSource | Calibration],
    *,
    instrument: str | None = None,
    dates: str | Sequence[str] | None = None,
    **options: Any,
) -> History:
    """History of one instrument over several calibrations: parameters in chronological order, and their changes.

    Parameters
    ----------
    sources : iterable of Calibration, Recording, str or Path, or mapping of str to these
        Calibrations, or recordings, which are calibrated first with the `options` of `calibrate`. A mapping gives their
        labels.
    instrument : str, optional
        Name of the instrument, if a calibration has several instruments.
    dates : sequence of str, optional
        Date of each calibration in ISO form; default the dates of the recordings.

    Raises
    ------
    RecordError
        For fewer than two calibrations, or for different instruments.

    Examples
    --------
    >>> import ltsim as lt
    >>> spring, autumn = (lt.simulate("paper-workshop", seed=s).recording for s in (1, 2))
    >>> course = lt.history([spring, autumn])
    >>> course.change_since_first.dof > 0
    True
    """
    if isinstance(sources, Mapping):
        named = [(label, _load_labelled(label, source, options)[1]) for label, source in sources.items()]
    else:
        named = [_load_labelled(str(number), source, options) for number, source in enumerate(sources, start=1)]
    return History.from_series(
        CalibrationSeries.from_labelled(named, instrument, None if dates is None else name_tuple(dates))
    )


def _load_labelled(
    label: str, source: RecordingSource | Calibration, options: dict[str, Any]
) -> tuple[str, Calibration]:
    """Label and calibration of a source, with `options` of `calibrate`; the label of a file is its name."""
    if isinstance(source, Calibration):
        return label, source
    if isinstance(source, Recording):
        recording = source
    else:
        path = Path(source)
        label = path.stem
        if path.suffix == ".json" or (path / "calibration.json").is_file():
            return label, read_calibration(path)
        recording = read(path)
    try:
        return label, calibrate(recording, advise=False, **options)
    except LtsimError as problem:
        raise RecordError(f"{label} cannot be calibrated: {problem}") from None
