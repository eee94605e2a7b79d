"""Execution of a campaign: workers compute shards, one process writes them, and an interrupted run can be continued.

A shard is a file with the rows of some trials of one cell, that is, of one combination of factor levels. The rows do
not depend, byte by byte, on the number of workers, on interruptions and on the backend. They may depend in the last
digit on the processor type and the package versions, because compiler and matrix library choose their instructions by
the processor. The manifest contains processor type and package versions.
"""

import os
import platform
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import llvmlite.binding
from joblib import Parallel, delayed, parallel_config

from ltsim.campaigns.calibrators import estimated_effects, estimated_error_model
from ltsim.campaigns.design import Factor, cad_files, cell_label, read_cad_bytes, shared_json_values
from ltsim.campaigns.schema import ManifestFile, ScenarioSettings, number_of_shards
from ltsim.campaigns.shard_rows import ShardTask, load_cell_context, n_rows_of_shard, run_shard_task
from ltsim.campaigns.spec import (
    VALIDATION_STREAM_KEY,
    CampaignCell,
    CampaignFile,
    load_campaign,
    make_campaign_cells,
    path_relative_to_campaign_file,
)
from ltsim.campaigns.statistics import CampaignStatistics
from ltsim.campaigns.stopping import CellAndShardIndex, iterate_stopping_rounds
from ltsim.campaigns.store import CAMPAIGN_FILE_NAME, CampaignFolder, interruption_error
from ltsim.campaigns.true_network import make_campaign_geometry
from ltsim.core.arguments import check_argument_bounds, check_argument_choice
from ltsim.core.errors import InputError, WorkerError, option_text, reraise_as_input_error
from ltsim.core.limits import require_few_effects
from ltsim.core.parallel import run_parallel
from ltsim.core.storage import check_writable, read_whole_file
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.settings import to_toml
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.simulator import ineffective_effect_notes

VERSIONED_PACKAGES = ("ltsim", "numpy", "numba", "pyarrow", "scipy")
"""Packages whose versions may change the last digits of the rows; a campaign is continued only with equal versions."""
EXTENDABLE_CAMPAIGN_KEYS = ("title", "trials", "statistics", "grid", "design", "cells", "stop")
"""Keys of the campaign file that may change when a campaign is continued, because additional trials, levels or
statistics leave existing rows unchanged."""
ProgressCallback = Callable[[int], None]
"""Progress callback; its argument is the number of rows (trials times methods) finished since the last call."""


@dataclass(frozen=True)
class WorkerSettings:
    """Worker processes that compute the shards (files of rows): on this machine, or as workers of a Dask scheduler."""

    n_processes: int = 1
    """Number of worker processes on this machine; ignored with Dask, where the scheduler determines the number."""
    backend: str = "local"
    """Kind of workers: `local` or `dask`."""
    scheduler: str = ""
    """Address of the Dask scheduler, such as ``tcp://127.0.0.1:8786``, or path of its file (``dask scheduler
    --scheduler-file cluster.json``).
    """

    def __post_init__(self) -> None:
        check_argument_bounds(jobs=self.n_processes, required_argument="jobs")
        check_argument_choice("backend", self.backend, ("local", "dask"))
        if self.scheduler and self.backend != "dask":
            raise InputError(
                f"{option_text('scheduler')} is {self.scheduler}, which needs {option_text('backend=dask')}"
            )
        if self.backend == "dask" and not self.scheduler:
            raise InputError(
                f"{option_text('backend=dask')} needs {option_text('scheduler')}, an address such as "
                "tcp://127.0.0.1:8786 or a cluster file"
            )


@dataclass(frozen=True)
class CampaignRunResult:
    """Result of one run of a campaign: folder, numbers of shards (files of rows), and notes for the user."""

    folder: Path
    """Folder of the campaign."""
    n_computed_shards: int
    """Number of shards (files of rows) that this run computed and wrote."""
    n_existing_shards: int
    """Number of shards (files of rows) that were complete before this run."""
    notes: tuple[str, ...]
    """Notes for the user, for example about damaged files of rows that were computed again."""


def run_campaign(
    file: Path,
    folder: Path,
    *,
    workers: WorkerSettings | None = None,
    resume: bool = False,
    force: bool = False,
    changes: Mapping[str, Any] | None = None,
    tables: Mapping[str, Any] | None = None,
    loaded: tuple[CampaignFile, tuple[Scenario, ...]] | None = None,
    progress: ProgressCallback = lambda trials: None,
) -> CampaignRunResult:
    """Run, continuation or extension (`resume`), or restart (`force`) of a campaign in `folder`.

    `tables`, if given, replaces the content of the campaign file `file`. `changes` are new values of its keys. `loaded`
    is the result of `load_campaign` for these arguments, if the caller has it. `progress` is called with the number of
    rows (trials times methods) that were finished since the last call.
    """
    with reraise_as_input_error():
        check_writable(folder, is_folder=True)
    campaign, scenarios = loaded or load_campaign(file, changes, tables)
    factors, cells = make_campaign_cells(campaign, scenarios, file)
    notes, store = _ineffective_effect_notes(campaign, factors, cells, file), CampaignFolder(folder)
    sources = _input_file_contents(campaign, cells, file, copies_file=not changes and tables is None)
    taken = [] if store.has_campaign or force else store.conflicting_files(sources)
    if taken:
        raise InputError(
            f"{folder}: the folder contains {', '.join(taken)} but no campaign; name another {option_text('out')}, "
            f"or replace them with {option_text('force=True')}"
        )
    chosen_workers = workers or WorkerSettings()
    if chosen_workers.backend == "dask":
        with _dask_cluster(chosen_workers):
            pass  # a scheduler without an answer is an error before anything is written
    with store.lock():
        if force and not resume:
            store.remove_campaign()
        existing_manifest = store.manifest_to_continue(resume=resume) if store.has_campaign else None
        if existing_manifest is not None:
            campaign, cells = _extended_campaign(store, existing_manifest, campaign, cells, file)
            notes += _environment_change_notes(store, existing_manifest)
        manifest = _make_manifest(campaign, factors, cells)
        made_here = {name: getattr(manifest, name) for name in ("commit", "processor", "versions")}
        if existing_manifest is None or existing_manifest.model_copy(update=made_here) != manifest:
            store.write_manifest(manifest, sources)
        del existing_manifest, manifest, sources  # the trials need their memory
        store.remove_unfinished_files()
        done, existing = 0, 0
        for wanted in iterate_stopping_rounds(campaign, len(cells), partial(_confidence_half_widths, folder)):
            waiting, damaged = _pending_tasks_and_notes(store, campaign, cells, wanted, progress)
            notes += damaged
            done, existing = done + len(waiting), existing + len(wanted) - len(waiting)
            try:
                for task, content in _computed_shards(waiting, chosen_workers, store):
                    store.write_shard(task.cell, task.shard, content)
                    progress(n_rows_of_shard(campaign, task.shard))
            except WorkerError as problem:
                raise interruption_error(folder, problem) from None
            load_cell_context.cache_clear()
        store.sort_digests()
    n_reused = len(cells) * campaign.n_shards_per_cell - done - existing
    if n_reused:
        share = n_reused / (len(cells) * campaign.n_shards_per_cell)
        notes.append(f"{folder}: [stop] made {n_reused} files of rows ({100 * share:.0f} % of all) unnecessary")
    return CampaignRunResult(folder, done, existing, tuple(notes))


def _input_file_contents(
    campaign: CampaignFile, cells: Sequence[CampaignCell], file: Path, *, copies_file: bool
) -> dict[str, bytes]:
    """Contents of the input files to be stored with the rows, by name: scenarios, points, CAD files, campaign file.

    If `copies_file` is true, `file` is copied; otherwise the campaign file is written from `campaign`.
    """
    names = (campaign.scenario, campaign.validation_points)
    named = [path for name in names if name and (path := path_relative_to_campaign_file(name, file))]
    contents = {path.name: read_whole_file(path) for path in named}
    root = (named[0] if named else file).resolve().parent
    scenarios = (place for cell in cells for place in (cell.scenario, cell.validation_scenario) if place is not None)
    for path in cad_files(scenarios):
        resolved_path = path.resolve()
        is_in_folder = resolved_path.is_relative_to(root)
        name = resolved_path.relative_to(root).as_posix() if is_in_folder else path.name
        contents[name] = read_cad_bytes(path)
    settings = campaign.model_dump(mode="json", by_alias=True, exclude_none=True)
    return contents | {CAMPAIGN_FILE_NAME: read_whole_file(file) if copies_file else to_toml(settings).encode()}


def _ineffective_effect_notes(
    campaign: CampaignFile, factors: Sequence[Factor], cells: Sequence[CampaignCell], file: Path
) -> list[str]:
    """Notes on declared effects that change no reading; raises InputError if every trial would fail."""
    unused_settings = []
    for method in campaign.methods:
        estimated_error_model(method)
        estimated_effects(method)
    for number, cell in enumerate(cells, start=1):
        where = f"cell {number} ({cell_label(factors, cell.levels)})"
        with reraise_as_input_error(f"{file}: {where}"):
            geometry = make_campaign_geometry(cell.scenario, campaign.seed)
            require_few_effects(max(len(method.effects) for method in campaign.methods), len(geometry.sightings))
            unused_settings += [f"{where}: {note}" for note in ineffective_effect_notes(geometry)]
            if cell.validation_scenario is not None:
                make_campaign_geometry(cell.validation_scenario, campaign.seed, VALIDATION_STREAM_KEY)
    return unused_settings


def _extended_campaign(
    store: CampaignFolder,
    manifest: ManifestFile,
    campaign: CampaignFile,
    cells: tuple[CampaignCell, ...],
    file: Path,
) -> tuple[CampaignFile, tuple[CampaignCell, ...]]:
    """Content and cells of the campaign of a `manifest`, with the additions in the campaign file.

    Existing cells (combinations of factor levels) keep their numbers. InputError is raised if the file would change
    existing rows.
    """
    before, ordered, cells_by_digest = manifest.settings, list[CampaignCell](), dict[str, list[CampaignCell]]()
    for cell in cells:
        cells_by_digest.setdefault(cell.digest, []).append(cell)
    for old in manifest.cells:
        if not (same := cells_by_digest.get(old.digest)):
            now = campaign.model_dump(mode="json", by_alias=True)
            changed = [key for key in now if key not in EXTENDABLE_CAMPAIGN_KEYS and before.get(key) != now[key]] or [
                "the scenario"
            ]
            raise InputError(
                f"{file}: the file was changed since this campaign started ({', '.join(changed)}); "
                f"its rows in {store.folder} stay: continue with {store.folder / CAMPAIGN_FILE_NAME}, or start "
                f"again with another {option_text('out')}"
            )
        ordered.append(same.pop(0))
    remaining = [*chain.from_iterable(cells_by_digest.values())]
    if [*manifest.cells[0].levels] != [*cells[0].levels]:
        raise InputError(
            f"{file}: the file varies {', '.join(cells[0].levels) or 'nothing'}, but the campaign in {store.folder} "
            f"varies {', '.join(manifest.cells[0].levels) or 'nothing'}: "
            f"a different factor needs another {option_text('out')}"
        )
    statistics = tuple(dict.fromkeys((*before.get("statistics", ()), *campaign.statistics)))
    extension = {"trials": max(campaign.trials, manifest.trials), "statistics": statistics}
    extended = campaign.model_copy(update=extension)
    try:
        number_of_shards(extended.trials, extended.trials_per_shard, len(ordered) + len(remaining))
    except ValueError as problem:
        raise InputError(f"{store.folder}: {problem}") from None
    return extended, (*ordered, *remaining)


def _environment_change_notes(store: CampaignFolder, manifest: ManifestFile) -> list[str]:
    """Notes on changes since the campaign of `manifest` started: another commit of ltsim, or another processor type.

    InputError is raised for other versions of the packages in `VERSIONED_PACKAGES`.
    """
    then, today = manifest.versions, _package_versions()
    for name in VERSIONED_PACKAGES:
        if then.get(name) != today[name]:
            before = safe_excerpt(str(then.get(name)))
            raise InputError(
                f"{store.folder}: the campaign was started with {name} {before}; rows may differ with {today[name]}; "
                f"continue with the same version, or start again with another {option_text('out')}"
            )
    notes = []
    if (begun := manifest.commit) != (now := git_commit_of_checkout()):
        before, after = (f"commit {code} of ltsim" if code else "an installed ltsim" for code in (begun, now))
        notes.append(f"started with {before}, continued with {after}; if the solver changed, rows may differ")
    if (built := manifest.processor) != (here := processor_type()):
        notes.append(f"started on a processor of type {built}, continued on {here}; last digits of rows may differ")
    return [f"{store.folder}: the campaign was {note}" for note in notes]


def _package_versions() -> dict[str, str]:
    return {"python": platform.python_version()} | {name: version(name) for name in VERSIONED_PACKAGES}


def processor_type() -> str:
    """Type of the processor of this machine; equal types and package versions give identical bytes of rows."""
    return str(llvmlite.binding.get_host_cpu_name())


def git_commit_of_checkout() -> str | None:
    """Git commit of the ltsim checkout from which the package runs; None for an installed package.

    An installed package may lie inside the checkout of another project. In this case git does not track the package
    there, or the root of the checkout is not the folder of the package.
    """
    package = Path(__file__).parents[1]
    git_arguments = (["rev-parse", "--show-toplevel"], ["ls-files", "--error-unmatch", __file__], ["rev-parse", "HEAD"])
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        top, _, head = (
            subprocess.run(
                ["git", *words], cwd=package, env=environment, capture_output=True, text=True, timeout=10, check=True
            ).stdout.strip()
            for words in git_arguments
        )
        return head if Path(top).samefile(package.parent) else None
    except (OSError, subprocess.SubprocessError):
        return None


def _make_manifest(campaign: CampaignFile, factors: Sequence[Factor], cells: Sequence[CampaignCell]) -> ManifestFile:
    scenarios = (cell.scenario.model_dump(mode="json", by_alias=True) for cell in cells)
    return ManifestFile(
        title=campaign.title,
        seed=campaign.seed,
        trials=campaign.trials,
        trials_per_shard=campaign.trials_per_shard,
        methods=tuple(method.title for method in campaign.methods),
        factors=tuple(factors),
        cells=tuple(cell.manifest_entry(cell_index, factors) for cell_index, cell in enumerate(cells)),
        versions=_package_versions(),
        processor=processor_type(),
        commit=git_commit_of_checkout(),
        settings=campaign.model_dump(mode="json", by_alias=True),
        scenarios=tuple(map(ScenarioSettings.model_validate, shared_json_values(scenarios))),
    )


def _pending_tasks_and_notes(
    store: CampaignFolder,
    campaign: CampaignFile,
    cells: Sequence[CampaignCell],
    shard_keys: list[CellAndShardIndex],
    progress: ProgressCallback,
) -> tuple[list[ShardTask], list[str]]:
    """Tasks for the shards of `shard_keys` that are missing or incomplete, and notes on damaged shards.

    A damaged shard is renamed and computed again. `progress` is called with the number of rows of each complete shard.
    """
    waiting, notes, digests = [], [], store.recorded_shard_digests()
    for cell, shard in shard_keys:
        task = ShardTask(
            campaign, cells[cell].scenario, cells[cell].digest, cell, shard, cells[cell].validation_scenario
        )
        state = store.shard_status(cell, shard, task.shard_metadata, n_rows_of_shard(campaign, shard), digests)
        if state == "complete":
            if store.shard_path(cell, shard).relative_to(store.folder).as_posix() not in digests:
                store.record_digest(cell, shard)
            progress(n_rows_of_shard(campaign, shard))
            continue
        if state == "damaged":
            aside = store.quarantine_shard(cell, shard)
            notes.append(f"{store.shard_path(cell, shard)} is damaged: moved to {aside.name} and computed again")
        waiting.append(task)
    return waiting, notes


def _confidence_half_widths(folder: Path, statistic: str, n_shards: int) -> dict[tuple[int, str], float]:
    """Half-width of the 95 % confidence interval of a mean from the first `n_shards` shards, by cell and method."""
    return {
        (s.cell, s.method): 0.5 * (s.high - s.low)
        for s in CampaignStatistics(folder, n_shards).statistic_summaries(statistic)
    }


def _computed_shards(
    tasks: list[ShardTask], workers: WorkerSettings, store: CampaignFolder
) -> Iterator[tuple[ShardTask, bytes]]:
    """Pairs of a task and the file of rows (shard) that it computed, as bytes, in the order of completion."""
    pending_tasks = (
        replace(
            t, existing_rows=store.read_rows(t.cell, t.shard) if store.shard_path(t.cell, t.shard).exists() else None
        )
        for t in tasks
    )
    if workers.backend == "local":
        jobs = min(workers.n_processes, max(len(tasks), 1))
        yield from run_parallel(run_shard_task, ((task,) for task in pending_tasks), jobs, keeps_order=False)
        return
    with _dask_cluster(workers):
        pool = Parallel(n_jobs=-1, return_as="generator_unordered", batch_size=1)
        yield from pool(delayed(run_shard_task)(task) for task in pending_tasks)


@contextmanager
def _dask_cluster(workers: WorkerSettings) -> Iterator[None]:
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise InputError("the dask backend needs the extra 'cluster': pip install ltsim[cluster]") from None
    try:
        connect: Any = Client
        place = "scheduler_file" if Path(workers.scheduler).is_file() else "address"
        client = connect(**{place: workers.scheduler}, timeout=30)
    except (OSError, ValueError) as problem:
        raise InputError(f"no dask scheduler answers at {workers.scheduler} ({problem})") from None
    with client, parallel_config(backend="dask", wait_for_workers_timeout=60):
        try:
            yield
        except KilledWorker:
            raise WorkerError(
                "several workers were killed at the same shard, possibly because memory ran out"
            ) from None
