"""Layouts a second of the planner, for the paper's size: 5 stations, 28 reflectors, 16 parameters.

    python -m benchmarks.layouts            # about a minute

Layouts are drawn on the floor of the built-in plan `paper-workshop`, each with all places and turns of its own. For
each: rules of the floor, who sees whom, all readings linearised at the new places, targets and poses eliminated, and
the objective (determinant of the parameters' covariance). The other lines are the step of the search: one station
exchanged for set-ups of a table that was linearised before.

Two processes work at once, by the wall clock between a common start and the last one's end; the processor time beside
it does not depend on who else works on the machine.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.synchronize import Barrier

import numpy as np
from threadpoolctl import threadpool_limits

from ltsim.core.randomness import random_stream
from ltsim.planning.loading import load_plan
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_inputs import layout_objective, make_search_space

PROCESSES, BATCH, SECONDS, REPEATS = 2, 64, 4.0, 3
Rate = tuple[int, float, float]


def searcher(faces: int) -> LayoutSearcher:
    """The search of the built-in plan."""
    file, scenario = load_plan("paper-workshop")
    site = make_search_space(file, scenario, n_stations=5, n_faces=faces)
    return LayoutSearcher(site, layout_objective(file, site.survey))


def from_scratch(search: LayoutSearcher, number: int) -> int:
    """A batch of layouts, everything computed anew; how many of them may be."""
    draw, count = random_stream(2, "layouts", number), search.n_stations
    grid = search.normal_blocks_of_grid(0).setup_positions
    position = grid[draw.integers(0, len(grid), (BATCH, count))] + draw.uniform(-0.05, 0.05, (BATCH, count, 3))
    yaw = draw.uniform(0, 2 * np.pi, (BATCH, count))
    flat = position.reshape(-1, 3)
    is_visible = search.search_space.is_visible(flat)
    good = search.search_space.is_feasible(position, is_visible.reshape(BATCH, count, -1))
    blocks = search.scorer.normal_blocks(flat, yaw.ravel(), is_visible=is_visible)
    reduced = search.scorer.evaluate_layouts(blocks, np.arange(BATCH * count).reshape(BATCH, count))
    values = search.objective.objective_values(reduced, search.construction.n_parameters)
    return int(np.sum(np.isfinite(values) & good))


def exchanged(search: LayoutSearcher, number: int) -> int:
    """One station of a layout replaced by every set-up of the table."""
    draw, table = random_stream(3, "exchange", number), search.normal_blocks_of_grid(0)
    chosen = draw.integers(0, len(table.setup_positions), search.n_stations)
    search.best_replacement(table.select(chosen), int(draw.integers(search.n_stations)), table)
    return len(table.setup_positions)


def worker(kind: str, faces: int, number: int, together: Barrier, results: multiprocessing.Queue[Rate]) -> None:
    """Layouts, wall clock and processor time of one process."""
    with threadpool_limits(1):
        search, step = searcher(faces), {"scratch": from_scratch, "exchange": exchanged}[kind]
        step(search, 10_000 + number)
        together.wait()
        begin, used, done, round_ = time.perf_counter(), time.process_time(), 0, 0
        while time.perf_counter() - begin < SECONDS:
            step(search, 1_000 * number + round_)
            done += BATCH if kind == "scratch" else len(search.normal_blocks_of_grid(0).setup_positions)
            round_ += 1
        results.put((done, time.perf_counter() - begin, time.process_time() - used))


def measured(kind: str, faces: int) -> tuple[float, float]:
    """Layouts a second of all processes by the wall clock, and of one by its processor time: the best runs."""
    best = (0.0, 0.0)
    for _ in range(REPEATS):
        together = multiprocessing.Barrier(PROCESSES)
        results: multiprocessing.Queue[Rate] = multiprocessing.Queue()
        every = [
            multiprocessing.Process(target=worker, args=(kind, faces, n, together, results)) for n in range(PROCESSES)
        ]
        for process in every:
            process.start()
        rows: list[Rate] = [results.get() for _ in every]
        for process in every:
            process.join()
        wall = sum(done for done, _, _ in rows) / max(seconds for _, seconds, _ in rows)
        best = max(best[0], wall), max(best[1], *(done / used for done, _, used in rows))
    return best


def main() -> None:
    """Print a table."""
    print(f"load before: {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors, {PROCESSES} processes")
    print("| layouts of 5 stations, 28 reflectors | a second, two processes, wall clock | a second of processor time |")
    print("|---|---|---|")
    for kind, words in (("scratch", "all anew"), ("exchange", "one station exchanged")):
        for faces in (1, 2):
            wall, rate = measured(kind, faces)
            print(f"| {words}, {'one face' if faces == 1 else 'two faces'} | {wall:,.0f} | {rate:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
