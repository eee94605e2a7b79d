"""Commands `campaign` and `recover`: many simulated trials, and a check that known instrument errors are recovered."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from xml.etree.ElementTree import Element, SubElement, tostring

import typer

import ltsim as lt
from ltsim.campaigns import require_campaign_packages
from ltsim.cli.options import (
    FunctionOptions,
    PairParser,
    ShowTemplateOption,
    bounded_option,
    choice_option,
    parse_toml_value,
)
from ltsim.cli.output_checks import NEW_FILE_OUTPUT, RESULT_FOLDER_OUTPUT, ForceOption
from ltsim.cli.simulate import ScenarioArgument
from ltsim.cli.terminal import ResultFolderTerminal, Terminal, write_line
from ltsim.core.arguments import path_of_file_or_built_in
from ltsim.core.errors import InputError, UserInterruptError
from ltsim.core.storage import with_digest_comment
from ltsim.recordings.files import write_text

if TYPE_CHECKING:
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.results import CampaignResults
    from ltsim.campaigns.summary import SolverComparison


MAX_BATCH_SOLVER_DIFFERENCE = 1e-3
"""Largest permitted difference [sigma] between the estimates of the batch solver and of the full solver in a verified
trial; above it the exit status is 1."""


CampaignFileArgument = Annotated[str | None, typer.Argument(metavar="FILE", help="A campaign file (ltsim-campaign/1).")]
CampaignFolderOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="DIR", help="Folder for the rows; default: FILE without its suffix."),
    RESULT_FOLDER_OUTPUT,
]


@dataclass(frozen=True)
class CampaignOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.campaign`."""

    jobs: Annotated[
        int,
        bounded_option(
            "jobs",
            "Number of worker processes on this machine; the rows do not depend on it. With dask the scheduler's "
            "workers are used.",
            "-j",
        ),
    ] = 1
    backend: Annotated[
        str,
        choice_option(
            "backend", ("local", "dask"), "Processes on this machine (local), or workers of a dask cluster (dask)."
        ),
    ] = "local"
    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler",
            metavar="NAME",
            help="Address of the dask scheduler, such as tcp://host:8786, or the file that the scheduler wrote.",
        ),
    ] = ""
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="True to continue the campaign in the folder. If levels, trials or statistics were added to the "
            "file, only the missing rows and columns are computed.",
        ),
    ] = False
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="New values by key of the file, such as 200 for trials, or by dotted key of the scenario, such as 2 "
            "for work.faces.",
        ),
        PairParser("changes", parse_toml_value),
    ] = None


def campaign(
    file: CampaignFileArgument = None,
    show_example: ShowTemplateOption = False,
    *,
    options: CampaignOptions,
    out: CampaignFolderOption = None,
    force: ForceOption = False,
    terminal: Terminal,
) -> int:
    """Simulate, calibrate and evaluate many trials; after an interruption --resume continues.

    The result files do not depend on the number of jobs, on interruptions and on the backend, on processors of one type
    (named in the manifest). For a cluster, run `dask scheduler --scheduler-file cluster.json` on one machine, `dask
    worker --scheduler-file cluster.json` on each machine that computes, and this command with --backend dask
    --scheduler cluster.json.

    If levels of factors, trials or statistics were added to the campaign file, --resume computes only what is missing.

    Exit status 1 if the batch solver differs from the full solver by more than 0.001 sigma on a verified trial.

    Example: ltsim campaign --show > mine.toml; ltsim campaign mine.toml --jobs 2
    """
    if show_example:
        terminal.print_always((files("ltsim.campaigns") / "example.toml").read_text(encoding="utf-8"))
        return 0
    if file is None:
        raise InputError("ltsim campaign needs a FILE; ltsim campaign --show prints a template")
    require_campaign_packages()
    # Slow imports, which no other command should wait for.
    from ltsim.campaigns.campaign import WorkerSettings, run_campaign
    from ltsim.campaigns.results import CampaignResults
    from ltsim.campaigns.schema import SUMMARY_FILE_NAME
    from ltsim.campaigns.spec import load_campaign
    from ltsim.campaigns.store import CampaignFolder
    from ltsim.campaigns.summary_output import summary_csv_text, summary_json_parts
    from ltsim.campaigns.verbs import rows_folder

    workers = WorkerSettings(options.jobs, options.backend, options.scheduler)
    changes = options.arguments().get("changes")
    path = path_of_file_or_built_in(file)
    folder = rows_folder(path, out)
    settings, scenarios = loaded = load_campaign(path, changes)
    n_calibrations = settings.trials * len(settings.methods) * len(scenarios)
    terminal.print_note_on_compilation()
    try:
        with terminal.show_progress("calibrations", n_calibrations) as advance:
            outcome = run_campaign(
                path,
                folder,
                progress=advance,
                workers=workers,
                force=force,
                resume=options.resume,
                changes=changes,
                loaded=loaded,
            )
    except KeyboardInterrupt:
        n_finished_files = len(CampaignFolder(folder).shard_paths())
        raise UserInterruptError(
            f"{n_finished_files} files with results of finished trials remain in {folder}; continue with --resume"
        ) from None
    del settings, scenarios, loaded  # the statistics need their memory
    results = CampaignResults(folder)
    write_text(folder / SUMMARY_FILE_NAME, summary_csv_text(results))
    for note in outcome.notes:
        terminal.print_note(note)
    terminal.print_json_parts(summary_json_parts(results))
    existing_text = f", {outcome.n_existing_shards} existed already" if outcome.n_existing_shards else ""
    terminal.print_text(f"{outcome.n_computed_shards} files of rows written to {folder}{existing_text}\n")
    if not terminal.is_silent:
        from ltsim.reports.sections.campaign import section_of_results  # after the trials: takes 30 MB

        terminal.print_text(section_of_results(results).terminal_text())
        terminal.print_text(f"\nall statistics: {folder / SUMMARY_FILE_NAME}; a page: ltsim report {folder}")
    failures = [
        solver_difference_sentence(e, results)
        for e in results.solver_comparisons()
        if (e.largest_difference_sigma or 0.0) > MAX_BATCH_SOLVER_DIFFERENCE
    ]
    for failure in failures:
        write_line(failure, sys.stderr)
    return 1 if failures else 0


def solver_difference_sentence(comparison: SolverComparison, results: CampaignResults) -> str:
    """Sentence on a combination of factor levels (cell) in which batch solver and full solver differ too much."""
    cell = results.manifest.cells[comparison.cell].label
    return (
        f"cell {comparison.cell + 1} ({cell}), {comparison.method}: the batch solver differs from the full solver by "
        f"up to {comparison.largest_difference_sigma:.2g} sigma on {comparison.verified_trials} verified trials, "
        f"limit {MAX_BATCH_SOLVER_DIFFERENCE:g}; "
        'set solver = "single" for the method to use the full solver'
    )


RecoverJobsOption = Annotated[
    int | None,
    bounded_option("jobs", "Number of processes; default: one per core, or a single one if the trials are few.", "-j"),
]


JunitFileOption = Annotated[
    Path | None,
    typer.Option("--junit", metavar="FILE", help="Also write the checks as JUnit XML, for CI."),
    NEW_FILE_OUTPUT,
]
TRUE_ERROR_ORIGIN_TEXTS = {"drawn": "drawn from the prior", "stated": "given by the scenario"}
"""Text that says where the true instrument errors come from, by the field `error_origin` of a recovery."""
MIN_TRIALS_FOR_SEVERAL_PROCESSES = 100
"""Smallest number of trials for several processes by default; for fewer trials one process is faster."""


@dataclass(frozen=True)
class RecoverOptions(FunctionOptions):
    """Command-line options that become keyword arguments of the Python function `lt.recover`."""

    trials: Annotated[int, bounded_option("trials", "Number of simulated recordings, at least two.", "-n")] = 200
    method: Annotated[
        str,
        typer.Option(
            "--method",
            metavar="NAME",
            help="Calibration method of ltsim's calibrator, with the same names as for calibrate.",
        ),
    ] = "network"
    construction: Annotated[
        str | None,
        typer.Option(
            "--construction",
            metavar="NAME",
            help="Geometric error model of ltsim's calibrator; default the model of the scenario.",
        ),
    ] = None
    with_effects: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="EFFECT[:WHERE,...]",
            help="Effects that ltsim's calibrator also estimates, in the same form as for calibrate.",
        ),
        tuple,
    ] = None
    calibrator: Annotated[
        str | None,
        typer.Option(
            "--calibrator",
            metavar="'CMD {recording} {out}'",
            help="External calibrator, compared with ltsim's calibrator: a command CMD {recording} {out} that reads a "
            "recording and writes parameters as JSON. In Python it can also be a function of a recording that "
            "returns value, sigma (or None) and unit of each parameter by name. Parameters of effects have names "
            "such as head-sag:sag. A trial without a valid result (an error, no file, a value that is not "
            "finite) fails; the run ends after three failed trials.",
        ),
    ] = None
    tolerance: Annotated[
        list[str] | None,
        typer.Option(
            "--tolerance",
            metavar="NAME=QUANTITY",
            help="Limit that 95 % of the errors of a parameter must not exceed, such as 2 urad for beam-tilt; only "
            "parameters with a tolerance are then checked.",
        ),
        PairParser("tolerance", lambda text: text.strip("'\"")),
    ] = None
    allow_unchecked: Annotated[
        bool,
        typer.Option(
            "--allow-unchecked",
            help="True to pass although a parameter cannot be checked, because it has neither a declared standard "
            "deviation nor a tolerance.",
        ),
    ] = False
    errors: Annotated[
        str | None,
        choice_option(
            "errors",
            ("drawn", "stated"),
            "Instrument errors that are drawn from the prior distribution of the instrument parameters, or given by "
            "the scenario; default stated if the scenario gives any.",
        ),
    ] = None
    seed: Annotated[
        int,
        bounded_option(
            "seed",
            "Seed of all random draws. Trial N equals trial N of simulate with this seed and the geometry per-trial.",
        ),
    ] = 0


def recover(
    scenario: ScenarioArgument,
    jobs: RecoverJobsOption = None,
    junit: JunitFileOption = None,
    *,
    options: RecoverOptions,
    terminal: ResultFolderTerminal,
) -> None:
    """Check in many trials that injected instrument errors are recovered: simulate, calibrate, compare.

    The instrument errors are those of the scenario; if the scenario gives none, they are drawn from the prior. The
    checks test the z-scores of every parameter, chi-square, targets and stations. For drawn errors the z-scores must be
    standard normal. For given errors their standard deviation must not exceed 1, and the intervals must have the
    nominal coverage. Exit status 1 if a check fails, or if a parameter of your calibrator has neither sigma nor
    tolerance and cannot be checked. Writes recovery.json and trials.csv to --out.

    Example: ltsim recover paper-workshop --trials 1000 --jobs 2
    """
    from ltsim.campaigns.recovery import Recovery
    from ltsim.campaigns.recovery_checks import RECOVERY_FALSE_ALARM_RATE

    terminal.check_overwrite(Recovery)
    workers = (
        (1 if options.trials < MIN_TRIALS_FOR_SEVERAL_PROCESSES else os.cpu_count() or 1) if jobs is None else jobs
    )
    with terminal.show_progress("trials", options.trials) as step:
        result = lt.recover(scenario, progress=step, jobs=workers, **options.arguments())
    result = terminal.write_result(result)
    if junit is not None:
        write_text(junit, with_digest_comment(junit_xml(result, str(scenario))))
    terminal.print_json(result.content())
    if result.trials_with_result > 1:
        table = result.table("parameters")
        terminal.print_text(table.text())
        if "absolute error difference" in table.headings:
            meaning = " ".join(table.meanings["absolute error difference"].split())
            terminal.print_text(f"absolute error difference: {meaning[0].lower()}{meaning[1:]}.")
        for sentence in result.unestimated_parameter_sentences():
            terminal.print_text(sentence)
    for sentence in result.failure_sentences():
        write_line(sentence, sys.stderr)
    if not result.passed:
        raise typer.Exit(1)
    chance_text = f" (a correct model fails this check in {100 * RECOVERY_FALSE_ALARM_RATE:.0f} % of runs)"
    false_alarm_text = (
        "" if result.tolerances or len(result.unchecked_parameters) == len(result.parameters) else chance_text
    )
    trials_text = f"{result.trials} trials, errors {TRUE_ERROR_ORIGIN_TEXTS[result.error_origin]}"
    terminal.print_text(f"{trials_text}: {result.verdict_text()}{false_alarm_text}")


def junit_xml(result: Recovery, suite_name: str) -> str:
    """JUnit XML with the checks of a recovery: one test case per check, with value and limits of its statistic.

    The run time is divided evenly among the test cases. `suite_name` is the name of the scenario.
    """
    checks, unchecked = result.checks, result.unchecked_parameters
    failed, seconds = len(result.failed_checks()), result.arrays.run_time_s
    seconds_text = f"{seconds / len(checks):.3f}"
    n_failures = 0 if result.allow_unchecked else len(unchecked)
    suite_counts = {
        "tests": str(len(checks) + len(unchecked)),
        "failures": str(failed + n_failures),
        "errors": "0",
        "skipped": str(len(unchecked) - n_failures),
        "time": f"{seconds:.3f}",
    }
    root = Element("testsuite", {"name": f"ltsim recover {suite_name}", **suite_counts})
    for check in checks:
        case = SubElement(
            root, "testcase", classname=f"recover.{check.subject}", name=check.statistic, time=seconds_text
        )
        properties = SubElement(case, "properties")
        for name in ("value", "lower_limit", "upper_limit"):
            SubElement(properties, "property", name=name, value=f"{getattr(check, name):.6g}")
        if not check.passed:
            SubElement(case, "failure", message=result.failure_reason(check)).text = check.sentence()
    for name in unchecked:
        case = SubElement(root, "testcase", classname=f"recover.{name}", name="not checked", time="0.000")
        SubElement(
            case, "failure" if n_failures else "skipped", message=f"{name} is not checked: some trials have no sigma"
        )
    return tostring(root, encoding="unicode", xml_declaration=True) + "\n"
