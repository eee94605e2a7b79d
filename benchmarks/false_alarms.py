"""How often does a diagnosis alarm where nothing is hidden? 5 % is asked, in small halls and in large ones.

    python -m benchmarks.false_alarms small 400 --jobs 2     # the paper's workshop: 130 unknowns, products are exact
    python -m benchmarks.false_alarms large 400 --jobs 2     # 160 targets on its walls: above 500 unknowns, sampled
    python -m benchmarks.false_alarms large 400 --first 1000 # others of these
    python -m benchmarks.false_alarms small 100 --held-out   # forced to explain noise: does the held-out error fall?

Instruments, places and noise are drawn anew for every recording, and so are the recordings that each is compared with:
with the same 300 for all, their own chance (1.3 % at 5 %) would stand in every answer alike. Reflectors are without
their error of incidence.
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
    """The paper's workshop without its reflectors' error, as it is or with many targets seen from four stations."""
    text = builtin_text("paper-workshop").replace("incidence_error = true", "incidence_error = false")
    if size == "small":
        return text
    head = re.sub(r"\[stations\.S5\].*", "", text.partition("[targets.")[0], flags=re.DOTALL)
    places = [(50.0, x, z) for z in LEVELS for x in COLUMNS] + [(x, 50.0, z) for z in LEVELS for x in COLUMNS]
    names = (f"W{i:03d}" for i in range(len(places)))
    return head + "".join(f"[targets.{n}]\nposition_mm = {list(p)}\n" for n, p in zip(names, places, strict=True))


def chance(seed: int, file: Path) -> tuple[float, int]:
    """The p-value of the search on one clean recording, compared with its own draws, and how many unknowns it has."""
    diagnosis = lt.diagnose(lt.simulate(file, seed=seed)[0], seed=seed, held_out=False)
    return diagnosis.global_test.search_p_value, diagnosis.baseline_adjustment.solution.system.design.shape[1]


def fell(seed: int, file: Path) -> bool | None:
    """Whether what a search is forced to find in a clean recording lowers the held-out error; None: found nothing."""
    diagnosis = lt.diagnose(lt.simulate(file, seed=seed)[0], level=0.999, held_out=True)
    before, after = diagnosis.fit.before.held_out_rms, diagnosis.fit.after.held_out_rms
    return None if before is None or after is None or not diagnosis.findings else after < before


def main() -> None:
    """Diagnose clean recordings and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", choices=("small", "large"))
    parser.add_argument("recordings", type=int)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--held-out", action="store_true")
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.recordings)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hall.toml"
        file.write_text(hall(given.size), encoding="utf-8")
        with ProcessPoolExecutor(given.jobs) as pool:
            if given.held_out:
                each = [f for f in pool.map(partial(fell, file=file), seeds) if f is not None]
                print(f"{given.size}: the held-out error falls in {sum(each)} of {len(each)} with something told")
                return
            p_values = list(pool.map(partial(chance, file=file), seeds))
    p = np.array([value for value, _ in p_values])
    print(f"{given.size}: {given.recordings} clean recordings of {min(n for _, n in p_values)} unknowns and more")
    for limit in LIMITS:
        count = int(np.sum(p <= limit))
        low, high = binomtest(count, len(p)).proportion_ci(method="exact")
        print(f"  p <= {limit:.2f}: {count} ({100 * count / len(p):.1f} %, {100 * low:.1f} to {100 * high:.1f})")


if __name__ == "__main__":
    main()
