"""Options of the commands that estimate, test and compare, which are arguments of the public functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from ltsim.cli.options import (
    FunctionOptions,
    PairParser,
    bounded_option,
    choice_option,
    name_list_option,
    parse_number,
    split_names,
)

RobustOption = Annotated[
    bool,
    typer.Option(
        "--robust", help="True to exclude outlying readings; each excluded reading is tested again at the end."
    ),
]
NoiseFromDataOption = Annotated[
    bool,
    typer.Option(
        "--noise-from-data", help="True to estimate the noise of each observable and instrument from the residuals."
    ),
]


@dataclass(frozen=True)
class CheckOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.check`."""

    level: Annotated[
        float,
        bounded_option(
            "level",
            "Probability of a false alarm in the whole recording, for the declared noise and a tracker within "
            "specification.",
        ),
    ] = 0.01


@dataclass(frozen=True)
class AdjustOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.adjust`."""

    robust: RobustOption = False
    noise_from_data: NoiseFromDataOption = False
    datum: Annotated[
        str | None,
        name_list_option(
            "datum", "Targets that define the datum by inner constraints. Default: the selection in setup.toml."
        ),
        split_names,
    ] = None


@dataclass(frozen=True)
class CalibrateOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.calibrate`."""

    method: Annotated[
        str,
        choice_option(
            "method",
            ("network", "distance", "distance-l1", "equation-9", "equation-9-l1"),
            "Rigorous network adjustment (network); or agreement of distances between targets as measured from several "
            "stations (Sensors 2021, 21, 7479), for the determined combinations of parameters, by least squares "
            "(distance) or least absolute deviations (distance-l1); or for all parameters, which fits undetermined "
            "combinations to the noise (equation-9, equation-9-l1).",
        ),
    ] = "network"
    construction: Annotated[
        str | None,
        choice_option(
            "construction",
            ("misalignment", "dh", "steering-mirror"),
            "Misalignments with the source in the head (misalignment, 16 parameters) or with a steering mirror "
            "(steering-mirror, 21), or the Denavit-Hartenberg chain of Sensors 2021, 21, 7479 (dh, 78); default: the "
            "model declared in setup.toml.",
        ),
    ] = None
    robust: Annotated[
        bool, typer.Option("--robust", help="True to exclude outlying readings. For method network only.")
    ] = False
    noise_from_data: Annotated[
        bool,
        typer.Option("--noise-from-data", help="True to estimate the noise of readings. For method network only."),
    ] = False
    datum: Annotated[
        str | None,
        name_list_option("datum", "Targets that define the datum by inner constraints. For method network only."),
        split_names,
    ] = None
    parameters: Annotated[
        str | None,
        name_list_option(
            "parameters",
            "Parameters to estimate, by name or by a common beginning of several names (azimuth-eccentricity); "
            "NAME@INSTRUMENT means the parameter of one instrument. All other parameters are fixed at zero.",
        ),
        split_names,
    ] = None
    without: Annotated[str | None, name_list_option("without", "Parameters that are fixed at zero."), split_names] = (
        None
    )
    hold: Annotated[
        list[str] | None,
        typer.Option(
            "--hold",
            metavar="NAME=VALUE",
            help="Parameters that are fixed at a value, each in its unit; several can be given.",
        ),
        PairParser("hold", parse_number),
    ] = None
    prior: Annotated[
        str | None,
        typer.Option(
            "--prior",
            metavar="FILE|none",
            help="Estimates of earlier calibrations with their covariance, in place of the prior in setup.toml. The "
            "value none means no prior: the readings alone determine how far the correction is shrunk. For method "
            "network only.",
        ),
    ] = None
    harmonics: Annotated[
        int | None,
        typer.Option(
            "--harmonics",
            metavar="N",
            help="Order of the harmonics in the errors of the axes of a D-H chain, 0 to 4; default 2.",
        ),
    ] = None
    degree: Annotated[
        int | None,
        typer.Option(
            "--degree",
            metavar="N",
            help="Degree of the polynomials in the errors of the range axis of a D-H chain, 0 to 9; default 2.",
        ),
    ] = None
    box: Annotated[
        float | None,
        typer.Option(
            "--box",
            metavar="N",
            help="Bound on every parameter in prior sigmas, with the methods equation-9 and equation-9-l1.",
        ),
    ] = None
    with_effects: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="EFFECT[:WHERE,...]",
            help="Physical effects that are also estimated: NAME (from ltsim effects) or NAME:WHERE,... with stations, "
            "targets, and shape parameters such as law=visit in the effect's units; the readings determine those not "
            "given. Empirical laws, which describe changes of the readings by functions such as vertical index ~ "
            "time:S3, are given as a diagnosis reports them. Several can be given. For method network only.",
        ),
        tuple,
    ] = None


@dataclass(frozen=True)
class DiagnoseOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.diagnose`."""

    level: Annotated[
        float,
        bounded_option(
            "level",
            "False-alarm rate: probability that a recording without unmodelled effects is reported, at least 0.001.",
        ),
    ] = 0.05
    seed: Annotated[
        int,
        bounded_option(
            "seed",
            "Seed of the random draws of simulated recordings, from which the p-value of the recording is computed.",
        ),
    ] = 0
    history: Annotated[
        str | None,
        typer.Option(
            "--history",
            metavar="FILE",
            help="Earlier calibration of the instruments, or the calibration history of an instrument, or the file of "
            "either. An instrument constant that differs from its earlier values by more than their scatter and "
            "uncertainties explain is reported.",
        ),
    ] = None


@dataclass(frozen=True)
class HistoryOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.history`."""

    instrument: Annotated[
        str | None,
        typer.Option(
            "--instrument", metavar="NAME", help="Name of the instrument, if a calibration has several instruments."
        ),
    ] = None
    dates: Annotated[
        str | None,
        name_list_option("dates", "Date of each calibration in ISO form; default the dates of the recordings."),
        split_names,
    ] = None
    robust: RobustOption = False
    noise_from_data: NoiseFromDataOption = False


@dataclass(frozen=True)
class CompareOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.compare`."""

    stable: Annotated[
        str | None,
        name_list_option(
            "stable",
            "Names of points that are certain not to have moved; they are not tested. By default "
            "the test determines which points are stable.",
        ),
        split_names,
    ] = None
    free: Annotated[
        bool,
        typer.Option(
            "--free",
            help="True if two lists of coordinates have different frames, so that the second is aligned to the first.",
        ),
    ] = False
    scaled: Annotated[
        bool,
        typer.Option(
            "--scale",
            help="True to estimate the scale of the second epoch, which another temperature or instrument may have "
            "changed.",
        ),
    ] = False
    same_instrument: Annotated[
        bool,
        typer.Option(
            "--same-instrument",
            help="True if one tracker with unchanged errors measured both recordings. Errors that the readings do not "
            "determine then displace both epochs equally, and do not count as differences.",
        ),
    ] = False
    calibrate: Annotated[
        bool,
        typer.Option(
            "--calibrate/--no-calibrate", help="True to estimate the instrument parameters in each recording."
        ),
    ] = True
    robust: RobustOption = False
    level: Annotated[
        float,
        bounded_option(
            "level", "Significance level: probability that at least one point is reported as moved although none moved."
        ),
    ] = 0.05


@dataclass(frozen=True)
class UncertaintyOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.uncertainty`."""

    seed: Annotated[int | None, bounded_option("seed", "Seed of all random draws; default from the task file.")] = None


@dataclass(frozen=True)
class BenchOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.bench`."""

    probe_direction: Annotated[
        float,
        typer.Option(
            "--probe-direction",
            metavar="N",
            help="Angle [deg] from the interferometer to the probe, counted against the rotation of the table.",
        ),
    ] = 90.0
    length_sigma: Annotated[
        float, bounded_option("length_sigma", "Standard deviation [um] of a length measured by the interferometer.")
    ] = 0.1
