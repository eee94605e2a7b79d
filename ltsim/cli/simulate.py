"""Commands `simulate`, `inject` and `demo`: simulated recording, injected effect, demonstration."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.campaigns import require_campaign_packages
from ltsim.cli.options import FunctionOptions, ReadingOptionsWithFrame, RecordingArgument, bounded_option
from ltsim.cli.output_checks import (
    COMPARED_FILE_OUTPUT,
    EMPTY_FOLDER_OUTPUT,
    NEW_FILE_OUTPUT,
    RECORDING_OUTPUT,
    RESULT_FOLDER_OUTPUT,
    ForceOption,
    check_new_file,
    check_recording_folder,
    write_outputs,
)
from ltsim.cli.terminal import Terminal
from ltsim.core.errors import InputError, ModelError
from ltsim.core.storage import path_in_folder
from ltsim.recordings.files import write_text, write_texts
from ltsim.simulation.builtin import builtin_names, builtin_text

if TYPE_CHECKING:
    from ltsim.recordings import Recording


ScenarioArgument = Annotated[
    str, typer.Argument(metavar="SCENARIO", help=f"A scenario file, or one of: {', '.join(builtin_names())}.")
]
RecordingFolderOption = Annotated[
    Path | None, typer.Option("--out", metavar="REC", help="Folder of the recording."), RECORDING_OUTPUT
]
TruthFileOption = Annotated[
    Path | None,
    typer.Option("--truth", metavar="FILE", help="File for the true values, which no calibrator reads."),
    COMPARED_FILE_OUTPUT,
]
NominalFileOption = Annotated[
    Path | None,
    typer.Option("--nominal", metavar="FILE", help="File for the nominal points, for ltsim verify."),
    COMPARED_FILE_OUTPUT,
]
PositionsPerTrialOption = Annotated[
    bool,
    typer.Option(
        "--per-trial", help="Draw new positions of stations and targets, as in a campaign with geometry per trial."
    ),
]
ShowScenarioOption = Annotated[bool, typer.Option("--show", help="Print the scenario as a file to edit, and stop.")]
InjectedEffectsArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="EFFECT...",
        help="Effects of the catalogue, or laws (changes of a reading as a function of a variable) written as "
        "'RESPONSE ~ REGRESSOR', such as 'vertical index ~ time'. After a colon, give stations, targets and NAME=VALUE "
        "of constants and parameters, with commas between: range-step:S3,range-step=50. Values that are not "
        "given are drawn at random.",
    ),
]
InjectionFolderOption = Annotated[
    Path | None,
    typer.Option(
        "--out", metavar="REC2", help="Folder of the changed recording or, with --curve, of the detection curve."
    ),
    RESULT_FOLDER_OUTPUT,
]
InjectedValuesFileOption = Annotated[
    Path | None,
    typer.Option("--truth", metavar="FILE", help="File for the injected values, which no diagnosis reads."),
    COMPARED_FILE_OUTPUT,
]
DetectionCurveOption = Annotated[
    bool,
    typer.Option(
        "--curve", help="Inject the effect at six strengths; report how often it is detected, located and named."
    ),
]

SimulationSeedOption = Annotated[
    int, bounded_option("seed", "Seed of all random draws: equal seed and trial give the same recording.")
]


@dataclass(frozen=True)
class SimulateOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.simulate`."""

    seed: SimulationSeedOption = 0
    trial: Annotated[
        int,
        bounded_option(
            "trial",
            "Number of the trial in a campaign of this scenario and seed. The calibration of the recording "
            "equals the row of that trial in the campaign's results.",
        ),
    ] = 0


def simulate(
    scenario: ScenarioArgument,
    *,
    options: SimulateOptions,
    out: RecordingFolderOption = None,
    truth: TruthFileOption = None,
    nominal: NominalFileOption = None,
    per_trial: PositionsPerTrialOption = False,
    show: ShowScenarioOption = False,
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Simulate one recording of a virtual hall.

    Example: ltsim simulate paper-workshop --out my-recording --truth truth.json --seed 7
    """
    if show:
        terminal.print_always(_complete_scenario_text(scenario))
        return
    if out is None:
        raise InputError("ltsim simulate needs --out REC, the folder of the recording; --show prints the scenario")
    from ltsim.simulation.truth import nominal_points_csv

    recording, simulated_truth = lt.simulate(
        scenario, geometry="per-trial" if per_trial else "shared", **options.arguments()
    )
    nominal_content = nominal_points_csv(simulated_truth) if nominal is not None else ""
    outputs: dict[Path, Callable[[Path], None]] = {out: partial(lt.write, recording)}
    if truth is not None:
        outputs[truth] = partial(lt.write, simulated_truth)
    if nominal is not None:
        outputs[nominal] = partial(write_text, text=nominal_content)
    write_outputs(outputs, force=force)
    terminal.print_notes(recording.notes)
    terminal.print_json({"pointings": len(recording), "stations": len(recording.stations), **options.arguments()})
    terminal.print_text(recording.headline)
    terminal.print_text(f"written to {out}" + (f", true values to {truth}" if truth else ""))


def _complete_scenario_text(scenario: str) -> str:
    """Text of a scenario with all keys: the commented file of a built-in scenario, or a file with defaults added."""
    text = builtin_text(scenario) if scenario in builtin_names() else ""
    if text and "\nbase = " not in text:
        return text
    from ltsim.simulation.scenario import load_scenario, scenario_to_toml

    return scenario_to_toml(load_scenario(scenario))


@dataclass(frozen=True)
class InjectOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.inject`."""

    noncentrality: Annotated[
        float | None,
        bounded_option(
            "noncentrality",
            "Noncentrality to which each effect is scaled: weighted sum of squares of the part of the effect "
            "that remains in the residuals. By default the effects are not scaled.",
        ),
    ] = None
    seed: Annotated[int, bounded_option("seed", "Seed of all random draws.")] = 0
    injections: Annotated[
        int,
        bounded_option(
            "injections", "Number of injections at each noncentrality; after each injection the recording is diagnosed."
        ),
    ] = 5


def inject(
    source: RecordingArgument,
    causes: InjectedEffectsArgument,
    *,
    options: InjectOptions,
    out: InjectionFolderOption = None,
    truth: InjectedValuesFileOption = None,
    curve: DetectionCurveOption = False,
    reading_options: ReadingOptionsWithFrame,
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Add the effects of faults to the readings of a recording, by the exact model.

    Example: ltsim inject my-recording range-step:S3 --noncentrality 100 --out injected --truth injected.json
    """
    if curve and len(causes) != 1:
        raise ModelError(f"--curve needs one EFFECT, {len(causes)} are given")
    if curve:
        file = None if out is None else out / "curve.csv"
        if file is not None:
            check_new_file(file, force)
        recording = reading_options.read_and_report(source, terminal)
        return _run_injection_curve(terminal, recording, causes[0], file, options)
    if out is None:
        raise ModelError("ltsim inject has no output: give --out with a folder for the changed recording, or --curve")
    check_recording_folder(out, force)
    recording = reading_options.read_and_report(source, terminal)
    injected_recording, injected_values = lt.inject(
        recording, *causes, noncentrality=options.noncentrality, seed=options.seed
    )
    outputs: dict[Path, Callable[[Path], None]] = {out: partial(lt.write, injected_recording)}
    if truth is not None:
        outputs[truth] = partial(
            write_text, text=json.dumps(injected_values.to_json(), indent=1, allow_nan=False) + "\n"
        )
    write_outputs(outputs, force=force)
    terminal.print_json(
        {
            "pointings": len(injected_recording),
            "injected": len(injected_values.injected_effects),
            "seed": options.seed,
        }
    )
    if truth is None:
        terminal.print_text(repr(injected_values))
    terminal.print_text(f"written to {out}" + (f", injected values to {truth}" if truth else ""))
    return None


def _run_injection_curve(
    terminal: Terminal, recording: Recording, effect_specification: str, file: Path | None, options: InjectOptions
) -> None:
    """Output of the detection curve of one effect: printed and, if a file is given, written as CSV.

    `effect_specification` is the text of the effect on the command line.
    """
    with terminal.show_progress("injecting and diagnosing"):
        detection_curve = lt.injection_curve(
            recording, effect_specification, injections=options.injections, seed=options.seed
        )
    table = detection_curve.table()
    terminal.print_json({"background": list(detection_curve.effects_without_injection), "curve": table.json_rows()})
    terminal.print_text(detection_curve._summary_lines()[0])
    terminal.print_text(table.text())
    if file is not None:
        write_text(file, table.csv_text())
        terminal.print_text(f"written to {file}")


DemoFolderOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder for all files of the demonstration."), EMPTY_FOLDER_OUTPUT
]

DEMO_EFFECTS: tuple[dict[str, Any], ...] = tuple(
    {"name": "smr-offset", "stations": [station], "values": {"radius-difference": size}}
    for station, size in (("S2", 0.2), ("S3", -0.25), ("S4", 0.25), ("S5", -0.2))
)
"""Effects for the demonstration, which injects one of them at random: an SMR of another radius at one station."""

DEMO_TITLE = "Demonstration: a fault is injected into a simulated hall, and diagnosed"
"""Title of the page of the demonstration."""
DEMO_CAMPAIGN_TEMPLATE = """format = "ltsim-campaign/1"
title = "Calibrations of drawn instruments in the paper's workshop"
scenario = "paper-workshop"
seed = {seed}
trials = 500

[[methods]]
name = "network"

[[methods]]
name = "distance"
method = "distance"
"""
"""Content of the campaign file of the demonstration, with a replacement field for the seed."""


@dataclass(frozen=True)
class DemoOptions(FunctionOptions):
    """Command-line options of `ltsim demo` that become keyword arguments of the Python function `lt.simulate`."""

    seed: SimulationSeedOption = 0


def demo(
    *,
    options: DemoOptions,
    out: DemoFolderOption = Path("ltsim-demo"),
    force: ForceOption = False,
    terminal: Terminal,
) -> None:
    """Simulate, calibrate, repeat with many simulated instruments, inject a fault, diagnose it, and write one report.

    Example: ltsim demo --out ltsim-demo
    """
    require_campaign_packages()
    for name, output_rule in DEMO_OUTPUTS.items():
        path_in_folder(out, name)
        output_rule.check(out / name, True)
    outcomes = []
    terminal.print_note_on_compilation()
    for number, (title, step) in enumerate(DEMO_STEPS.items(), start=1):
        start_time = time.perf_counter()
        with terminal.show_progress(title):
            outcome = step(out, options.seed)
        duration_s = time.perf_counter() - start_time
        terminal.print_text(f"{number}. {title} ({duration_s:.1f} s)\n   {outcome}")
        outcomes.append({"step": title, "outcome": outcome, "seconds": round(duration_s, 2)})
    terminal.print_json({"folder": str(out), "steps": outcomes})


def simulate_workshop(demo_folder: Path, seed: int) -> str:
    """Text on the size of a recording of the scenario `paper-workshop`, which is simulated and written to files."""
    recording, truth = lt.simulate("paper-workshop", seed=seed)
    lt.write(recording, demo_folder / "workshop" / "recording")
    lt.write(truth, demo_folder / "workshop" / "truth.json")
    return (
        f"{len(recording.stations)} stations, {len(recording.targets)} reflectors, {len(recording)} pointings; "
        "the instrument's errors are drawn from its specification"
    )


def calibrate_workshop(demo_folder: Path, seed: int) -> str:
    """Summary of a calibration from the recording of `simulate_workshop`; the calibration is written to a file."""
    from ltsim.reports.sections import result_section

    recording, _ = lt.simulate("paper-workshop", seed=seed)
    calibration = lt.calibrate(recording)
    lt.write(calibration, demo_folder / "workshop")
    return result_section(calibration).summary


def diagnose_injected_effect(demo_folder: Path, seed: int) -> str:
    """Text on an effect that is injected into a second recording, and on the diagnosis of this recording."""
    from ltsim.core.randomness import random_stream
    from ltsim.physics.effects import effect_title

    entry = DEMO_EFFECTS[int(random_stream(seed, "demo", "hidden").integers(len(DEMO_EFFECTS)))]
    recording, truth = lt.simulate("paper-workshop-two-face", seed=seed, changes={"effects": [entry]})
    folder = demo_folder / "concealed"
    diagnosis = lt.diagnose(recording, seed=seed, held_out=True)
    lt.write(diagnosis, folder, recording=recording)
    lt.write(truth, folder / "truth.json")
    return f"injected: {effect_title(entry['name'])} ({entry['stations'][0]}); blind diagnosis: {diagnosis.summary}"


def run_demo_campaign(demo_folder: Path, seed: int) -> str:
    """Summary of a campaign that calibrates 500 simulated instruments with two methods.

    The methods are the network adjustment and the minimum of the distance objective of Sensors 2021, 21, 7479.
    """
    from ltsim.reports.sections.campaign import campaign_section

    write_texts(demo_folder, {"campaign.toml": DEMO_CAMPAIGN_TEMPLATE.format(seed=seed)})
    results = lt.campaign(demo_folder / "campaign.toml", force=True)
    write_texts(demo_folder / "campaign", {"summary.csv": results.table("summary").csv_text()})
    return campaign_section(demo_folder / "campaign").summary


def write_demo_page(demo_folder: Path, seed: int) -> str:
    """Text with the path of the report page about all results of the demonstration, which is written here."""
    return f"open {lt.report(demo_folder, title=DEMO_TITLE, about={'instrument': 'simulated'})}"


DEMO_STEPS: dict[str, Callable[[Path, int], str]] = {
    "simulate the paper's workshop": simulate_workshop,
    "calibrate the instrument from this recording": calibrate_workshop,
    "repeat the calibration on 500 drawn instruments, with two methods": run_demo_campaign,
    "inject a fault into another recording, and diagnose this recording": diagnose_injected_effect,
    "write one page about all results": write_demo_page,
}
"""Steps of the demonstration in order: title, and function of output folder and random seed that returns a text on the
outcome.
"""
DEMO_OUTPUTS = {
    "workshop/recording": RECORDING_OUTPUT,
    "workshop/truth.json": NEW_FILE_OUTPUT,
    "concealed": RESULT_FOLDER_OUTPUT,
    "concealed/truth.json": NEW_FILE_OUTPUT,
    "campaign.toml": NEW_FILE_OUTPUT,
    "campaign": RESULT_FOLDER_OUTPUT,
    "report.html": NEW_FILE_OUTPUT,
}
"""Kind of each output file or folder of the demonstration, by path; all are checked before the first step."""
