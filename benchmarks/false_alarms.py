"""Rate of false alarms of the diagnosis in recordings without an effect; 5 % are expected in small and in large halls.

    python -m benchmarks.false_alarms small 400 --jobs 2     # the paper's workshop: 130 unknowns, exact products
    python -m benchmarks.false_alarms large 400 --jobs 2     # 160 targets: above 500 unknowns, sampled products
    python -m benchmarks.false_alarms large 400 --first 1000 # other recordings
    python -m benchmarks.false_alarms small 100 --held-out   # diagnoses forced to report: does the held-out error fall?

Instruments, positions and noise are drawn anew for each recording, and so are the simulated recordings with which it
is compared. If all recordings were compared with the same 300 simulated ones, the random error of these (1.3 % at 5 %)
would be common to all p-values. Reflectors have no error of incidence.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

import ltsim as lt
from ltsim.simulation.builtin import builtin_text

COLUMNS, LEVELS = np.linspace(300.0, 5700.0, 16).tolist(), np.linspace(200.0, 5800.0, 5).tolist()
LIMITS = (0.01, 0.05, 0.1)


def hall(size: str) -> str:
    """Scenario text: the paper's workshop without errors of incidence, small or with 160 targets and four stations."""
    text = builtin_text("paper-workshop").replace("incidence_error = true", "incidence_error = false")
    if size == "small":
        return text
    head = re.sub(r"\[stations\.S5\].*", "", text.partition("[targets.")[0], flags=re.DOTALL)
    places = [(50.0, x, z) for z in LEVELS for x in COLUMNS] + [(x, 50.0, z) for z in LEVELS for x in COLUMNS]
    names = (f"W{i:03d}" for i in range(len(places)))
    return head + "".join(f"[targets.{n}]\nposition_mm = {list(p)}\n" for n, p in zip(names, places, strict=True))


def p_value_of_search(seed: int, file: Path) -> tuple[float, int]:
    """p-value of the search on one recording without an effect, and the number of unknowns of its adjustment."""
    diagnosis = lt.diagnose(lt.simulate(file, seed=seed)[0], seed=seed, held_out=False)
    return diagnosis.global_test.search_p_value, diagnosis.baseline_adjustment.solution.system.design.shape[1]


def held_out_error_falls(seed: int, file: Path) -> bool | None:
    """True if the findings of a diagnosis that is forced to report lower the held-out error; None without findings."""
    diagnosis = lt.diagnose(lt.simulate(file, seed=seed)[0], level=0.999, held_out=True)
    before, after = diagnosis.fit.before.held_out_rms, diagnosis.fit.after.held_out_rms
    return None if before is None or after is None or not diagnosis.findings else after < before


def main() -> None:
    """Diagnose recordings without an effect, and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", choices=("small", "large"))
    parser.add_argument("recordings", type=int)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--held-out", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.recordings)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hall.toml"
        file.write_text(hall(options.size), encoding="utf-8")
        with ProcessPoolExecutor(options.jobs) as pool:
            if options.held_out:
                falls = [fall for fall in pool.map(partial(held_out_error_falls, file=file), seeds) if fall is not None]
                counts = f"{sum(falls)} of {len(falls)}"
                print(f"{options.size}: the held-out error falls in {counts} diagnoses with findings")
                return
            p_values = list(pool.map(partial(p_value_of_search, file=file), seeds))
    p = np.array([value for value, _ in p_values])
    unknowns = min(n for _, n in p_values)
    print(f"{options.size}: {options.recordings} recordings without an effect, with {unknowns} unknowns or more")
    for limit in LIMITS:
        count = int(np.sum(p <= limit))
        low, high = binomtest(count, len(p)).proportion_ci(method="exact")
        print(f"  p <= {limit:.2f}: {count} ({100 * count / len(p):.1f} %, {100 * low:.1f} to {100 * high:.1f})")


if __name__ == "__main__":
    main()
