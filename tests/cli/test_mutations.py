"""Verbs on files with slips: an answer or one sentence, in bounded memory and time, whatever the slip.

A failure prints the seed and number of each slip, the file with it, the verb, its status, memory and last lines.
`python -m tests.cli.slips SEED FIRST COUNT` repeats some of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from tests.cli.slips import CASES, change_faults, faults, needs_results

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


def test_changes_of_whole_files_end_in_an_answer_or_a_sentence(process: ProcessPoolExecutor) -> None:
    """A column twice or gone, other line ends: random slips hardly make them, and a reader's fault was missed."""
    quick = [i for i, (_, words) in enumerate(CASES) if words[0] in QUICK and not needs_results(i)]
    problems = process.submit(change_faults, quick).result()
    assert not problems, "\n\n".join(problems)


def test_a_case_of_each_slower_command_ends_in_an_answer_or_a_sentence(process: ProcessPoolExecutor) -> None:
    """The sample whole, with a slip, and with the changes of whole files: no quick case runs these verbs."""
    first = {words[0]: i for i, (_, words) in reversed([*enumerate(CASES)]) if not needs_results(i)}
    assert {"plan", "campaign", "check", "adjust", "recover"} <= {*first}
    chosen = [i for verb, i in first.items() if verb not in (*QUICK, "diagnose")]
    slips = [process.submit(faults, 1, i + again, 1) for i in chosen for again in (0, len(CASES))]
    problems = [fault for slip in slips for fault in slip.result()] + process.submit(change_faults, chosen).result()
    assert not problems, "\n\n".join(problems)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(0, SLIPS, BLOCK))
def test_20000_slips_end_in_an_answer_or_a_sentence(first: int, process: ProcessPoolExecutor) -> None:
    """Each case whole, then slips in all of them in turn: a block is the same in whichever process and order."""
    problems = process.submit(faults, 2, first, BLOCK).result()
    assert not problems, "\n\n".join(problems)
