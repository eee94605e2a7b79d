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


@dataclass(frozen=True)
class CheckOptions(FunctionOptions):
    """Options of `lt.check`."""

    level: Annotated[
        float,
        bounded_option(
            "level",
            "Probability of at least one false alarm in the whole recording, if noise and specification are correct.",
        ),
    ] = 0.01


@dataclass(frozen=True)
class AdjustOptions(FunctionOptions):
    """Options of `lt.adjust`."""

    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="True to exclude outlying readings; each excluded reading is tested again at the end."
        ),
    ] = False
    noise_from_data: Annotated[
        bool,
        typer.Option(
            "--noise-from-data", help="True to estimate the noise of each observable and instrument from the residuals."
        ),
    ] = False
    datum: Annotated[
        str | None,
        name_list_option(
            "datum", "Targets that define the datum by inner constraints. Default: the selection in the set-up."
        ),
        split_names,
    ] = None


@dataclass(frozen=True)
class CalibrateOptions(FunctionOptions):
    """Options of `lt.calibrate`."""

    method: Annotated[
        str,
        choice_option(
            "method",
            ("network", "distance", "distance-l1", "equation-9", "equation-9-l1"),
            "Rigorous network adjustment (network); minimum of the paper's distance objective over the "
            "determined combinations of parameters, by least squares (distance) or least absolute deviations "
            "(distance-l1); or its minimum over all parameters, which fits undetermined combinations to the "
            "noise (equation-9, equation-9-l1).",
        ),
    ] = "network"
    construction: Annotated[
        str | None,
        choice_option(
            "construction",
            ("misalignment", "dh", "steering-mirror"),
            "Misalignments with the source in the head (misalignment, 16 parameters) or with a steering mirror "
            "(steering-mirror, 21), or the paper's Denavit-Hartenberg chain (dh, 78); default: the model "
            "declared in the set-up.",
        ),
    ] = None
    robust: Annotated[bool, typer.Option("--robust", help="Options of adjust, for method network only.")] = False
    noise_from_data: Annotated[
        bool, typer.Option("--noise-from-data", help="Options of adjust, for method network only.")
    ] = False
    datum: Annotated[
        str | None, name_list_option("datum", "Options of adjust, for method network only."), split_names
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
            help="Estimates of earlier calibrations with their covariance, in place of the prior of the set-up. With "
            "none there is no prior, and the readings alone determine the shrinkage of the correction. For "
            "method network only.",
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
            help="Effects of the catalogue that are also estimated, NAME or NAME:WHERE,... with stations, targets, "
            "and shape parameters such as law=visit in the effect's units; the readings determine those not "
            "given. Laws have the form that a diagnosis reports, vertical index ~ time:S3. Several can be given. "
            "For method network only.",
        ),
        tuple,
    ] = None


@dataclass(frozen=True)
class DiagnoseOptions(FunctionOptions):
    """Options of `lt.diagnose`."""

    level: Annotated[
        float,
        bounded_option("level", "False-alarm rate of the whole search on a recording without effects, at least 0.001."),
    ] = 0.05
    seed: Annotated[
        int,
        bounded_option(
            "seed", "Seed of the random draws of simulated recordings, from which the p-value of the search follows."
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
    """Options of `lt.history`."""

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
    robust: Annotated[
        bool,
        typer.Option(
            "--robust", help="True to exclude outlying readings; each excluded reading is tested again at the end."
        ),
    ] = False
    noise_from_data: Annotated[
        bool,
        typer.Option(
            "--noise-from-data", help="True to estimate the noise of each observable and instrument from the residuals."
        ),
    ] = False


@dataclass(frozen=True)
class CompareOptions(FunctionOptions):
    """Options of `lt.compare`."""

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
    robust: Annotated[
        bool,
        typer.Option("--robust", help="True to exclude outliers; each excluded reading is tested again at the end."),
    ] = False
    level: Annotated[
        float,
        bounded_option(
            "level", "Significance level: probability that at least one point is reported as moved although none moved."
        ),
    ] = 0.05


@dataclass(frozen=True)
class UncertaintyOptions(FunctionOptions):
    """Options of `lt.uncertainty`."""

    seed: Annotated[int | None, bounded_option("seed", "Seed of all random draws; default from the task file.")] = None


@dataclass(frozen=True)
class BenchOptions(FunctionOptions):
    """Options of `lt.bench`."""

    probe_direction: Annotated[
        float,
        typer.Option(
            "--probe-direction",
            metavar="N",
            help="Angle from the interferometer to the probe, counted against the rotation of the roundness table.",
        ),
    ] = 90.0
    length_sigma: Annotated[
        float, bounded_option("length_sigma", "Standard deviation of a length measured by the interferometer.")
    ] = 0.1
