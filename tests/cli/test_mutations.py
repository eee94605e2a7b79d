"""Verbs on files with slips: an answer or one sentence, in bounded memory and time, whatever the slip.

A failure prints the seed and number of each slip, the file with it, the verb, its status, memory and last lines.
`python -m tests.cli.slips SEED FIRST COUNT` repeats some of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from tests.cli.slips import CASES, faults, needs_results

BLOCK, SLIPS = 100, 20_000
QUICK = ("convert", "bench", "simulate", "accept")
"""Verbs that take less than 0.2 s."""


@pytest.fixture(scope="module")
def process() -> Iterator[ProcessPoolExecutor]:
    """One process for all blocks, whose signals, folder and memory no other test shares."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield pool


def test_slips_in_samples_that_no_verb_makes_end_in_an_answer_or_a_sentence(process: ProcessPoolExecutor) -> None:
    """Each sample whole, and with one slip, through the quick verbs."""
    quick = [i for i, (_, words) in enumerate(CASES) if words[0] in QUICK and not needs_results(i)]
    assert len(quick) > 15
    slips = [process.submit(faults, 1, i + again, 1) for i in quick for again in (0, len(CASES))]
    problems = [fault for slip in slips for fault in slip.result()]
    assert not problems, "\n\n".join(problems)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(0, SLIPS, BLOCK))
def test_20000_slips_end_in_an_answer_or_a_sentence(first: int, process: ProcessPoolExecutor) -> None:
    """Each case whole, then slips in all of them in turn: a block is the same in whichever process and order."""
    problems = process.submit(faults, 2, first, BLOCK).result()
    assert not problems, "\n\n".join(problems)
