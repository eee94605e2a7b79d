"""Layouts per second of the planner, for the size of the paper: 5 stations, 28 reflectors, 16 parameters.

    python -m benchmarks.layouts            # about a minute

Layouts are drawn on the floor of the built-in plan `paper-workshop`, each with new positions and orientations. The
steps for each layout are: rules of the floor, visibility, linearisation of all readings, elimination of targets and
poses, and the objective (determinant of the covariance of the parameters). The other rows of the table are the step of
the search, which exchanges one station for set-ups of a table that was linearised before.

Two processes run at the same time. The wall-clock time is that between their common start and the end of the last; the
processor time does not depend on other programs on the computer.
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
    """Layout search of the built-in plan."""
    file, scenario = load_plan("paper-workshop")
    site = make_search_space(file, scenario, n_stations=5, n_faces=faces)
    return LayoutSearcher(site, layout_objective(file, site.survey))


def from_scratch(search: LayoutSearcher, number: int) -> int:
    """Number of feasible layouts in a random batch, for which everything is computed anew."""
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


def exchange_station(search: LayoutSearcher, number: int) -> int:
    """Number of set-ups in the table, after one station of a layout has been replaced by each of them."""
    draw, table = random_stream(3, "exchange", number), search.normal_blocks_of_grid(0)
    chosen = draw.integers(0, len(table.setup_positions), search.n_stations)
    search.best_replacement(table.select(chosen), int(draw.integers(search.n_stations)), table)
    return len(table.setup_positions)


def worker(kind: str, faces: int, number: int, together: Barrier, results: multiprocessing.Queue[Rate]) -> None:
    """Put the number of layouts, wall-clock time and processor time [s] of one process into the queue."""
    with threadpool_limits(1):
        search, step = searcher(faces), {"scratch": from_scratch, "exchange": exchange_station}[kind]
        step(search, 10_000 + number)
        together.wait()
        begin, used, done, round_ = time.perf_counter(), time.process_time(), 0, 0
        while time.perf_counter() - begin < SECONDS:
            step(search, 1_000 * number + round_)
            done += BATCH if kind == "scratch" else len(search.normal_blocks_of_grid(0).setup_positions)
            round_ += 1
        results.put((done, time.perf_counter() - begin, time.process_time() - used))


def layout_rates(kind: str, faces: int) -> tuple[float, float]:
    """Layouts per second by the wall clock, of all processes, and by processor time, of one; best of several runs."""
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
    """Run all cases, and print the table."""
    print(f"load before: {os.getloadavg()[0]:.1f}, {os.cpu_count()} processors, {PROCESSES} processes")
    heads = ("layouts of 5 stations, 28 reflectors", "per second, two processes", "per second of processor time")
    print("| " + " | ".join(heads) + " |")
    print("|---|---|---|")
    for kind, label in (("scratch", "everything computed anew"), ("exchange", "one station exchanged")):
        for faces in (1, 2):
            wall, rate = layout_rates(kind, faces)
            print(f"| {label}, {'one face' if faces == 1 else 'two faces'} | {wall:,.0f} | {rate:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
