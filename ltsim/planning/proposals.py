"""Result of `next_measurement`: proposals of additional measurements as Python object, next.json and tables."""

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field

from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.identification.recommendations import corrected_faults, recommendations_for_causes
from ltsim.adjustment.remedies.candidates import list_text
from ltsim.adjustment.remedies.next_measurement import MeasurementProposal, RankedProposals
from ltsim.core.results import Column, Table, model_columns, text_columns
from ltsim.physics.effects import effect_title
from ltsim.planning.reflector_changes import to_degrees, to_millimetres
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, SourceEntry, Vector


class MeasurementProposalEntry(Entry):
    """Proposal of an additional measurement."""

    action: str
    """Instruction for the measurement, as a text."""
    kind: str = ""
    """Kind of measurement: pointings, return, station, survey, length or reflectors."""
    minutes: Finite
    """Duration of the measurement [min]."""
    remaining_sigma_fraction: Finite
    """Ratio of the geometric mean of the instrument parameters' standard deviations after the measurement to that
    before; below 1 is better.
    """
    most_improved_parameter: str = ""
    """Instrument parameter whose standard deviation the measurement reduces most."""
    most_improved_sigma_fraction: Finite = 1.0
    """Ratio of the standard deviation of `most_improved_parameter` after the measurement to that before; below 1 is
    better."""
    chi2_differences: dict[str, Finite] = Field(default_factory=dict)
    """Expected difference of chi-square, after the measurement, between each other of the `compared_effects` of the
    result and the first one, by name of the former."""
    separated_effects: tuple[str, ...] = ()
    """Effects that the measurement would separate from the first of the `compared_effects` of the result."""
    separates_all_effects: bool = False
    """True if the measurement would separate all other `compared_effects` of the result from the first one."""
    position_mm: Vector | None = None
    """Position of the head at a new set-up, workshop frame; null for other measurements."""
    yaw_deg: OptionalFloat = None
    """Direction of azimuth zero at a new set-up; null for other measurements."""

    @classmethod
    def from_proposal(cls, proposal: MeasurementProposal) -> Self:
        """Entry of the result file for a proposal."""
        p, there = proposal, proposal.candidate.added_setup_on_floor_plan
        return cls(
            action=p.candidate.instruction,
            kind=p.candidate.kind,
            minutes=round(p.candidate.duration / 60, 2),
            remaining_sigma_fraction=p.remaining_sigma_fraction,
            most_improved_parameter=p.most_improved_parameter,
            most_improved_sigma_fraction=p.most_improved_sigma_fraction,
            chi2_differences=p.expected_chi2_differences,
            separated_effects=p.distinguished_explanations,
            separates_all_effects=p.distinguishes_all,
            position_mm=to_millimetres(there[0]) if there else None,
            yaw_deg=to_degrees(there[1]) if there else None,
        )


PROPOSALS_TABLE = Table(
    "next.csv",
    "proposals of further measurements in the order of benefit",
    model_columns(
        MeasurementProposalEntry,
        "kind minutes remaining_sigma_fraction most_improved_parameter most_improved_sigma_fraction "
        "separated_effects separates_all_effects "
        "action",
        minutes={"title": "time", "unit": "min", "display_format": ".0f"},
        remaining_sigma_fraction={"title": "factor on sigmas", "display_format": ".2f"},
        most_improved_parameter={"title": "most for"},
        most_improved_sigma_fraction={"title": "factor for it", "display_format": ".2f"},
        separated_effects={"kind": "text"},
        separates_all_effects={"kind": "text"},
        action={"title": "measurement"},
    ),
)


def _best_yaw_per_position(proposals: Sequence[MeasurementProposalEntry]) -> tuple[MeasurementProposalEntry, ...]:
    """Proposals without new stations that differ from an earlier one in yaw only."""
    best_by_place: dict[object, MeasurementProposalEntry] = {}
    for number, proposal in enumerate(proposals):
        place = proposal.position_mm if proposal.kind == "station" else None
        best_by_place.setdefault(place or number, proposal)
    return tuple(best_by_place.values())


class NextMeasurement(ResultFile):
    """Result of `next_measurement`, the content of `next.json`, which `plan --after` writes."""

    FILE: ClassVar[str] = "next.json"
    format: Literal["ltsim-next/1"] = "ltsim-next/1"
    """Format and version of this file."""
    diagnosis: str = ""
    """Result of the diagnosis that preceded the ranking, as a sentence; empty without a diagnosis."""
    compared_effects: tuple[str, ...] = ()
    """Effects that each explain the recording, and that the measurement should separate."""
    compared_places: tuple[str, ...] = ()
    """Stations and targets at which the `compared_effects` act; empty if they act on the whole recording."""
    present_chi2_differences: dict[str, Finite] = Field(default_factory=dict)
    """Difference of chi-square, in the present recording, between each other of the `compared_effects` and the first
    one, by name of the former."""
    advice: str = ""
    """Action that the user should take first, as a sentence."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of the identified causes of a misfit of the recording, and of its outliers."""
    site: str = ""
    """Plan whose permitted floor, obstacles and lines of sight new stations respect; empty without a plan."""
    proposals: tuple[MeasurementProposalEntry, ...] = Field(min_length=1)
    """Proposals of additional measurements in the order of the ranking, the best first; for each position of a new
    station only the best yaw."""

    @classmethod
    def from_ranking(
        cls,
        ranking: RankedProposals,
        source: SourceEntry | None = None,
        tests: Sequence[CauseTest] = (),
        *,
        site: str = "",
    ) -> Self:
        """Result from a ranking of proposals for the recording `source`, with stations checked on the plan `site`.

        `tests` are those of the identified causes of a misfit of the recording.
        """
        return cls(
            recording=source,
            compared_effects=ranking.compared_explanations,
            compared_places=ranking.compared_places,
            present_chi2_differences=ranking.present_chi2_differences,
            advice=ranking.advice_sentence,
            tests=tuple(tests),
            site=site,
            proposals=_best_yaw_per_position(
                [MeasurementProposalEntry.from_proposal(proposal) for proposal in ranking.proposals]
            ),
        )

    def _lines(self) -> list[str]:
        titles = [effect_title(name) for name in self.compared_effects]
        question = f" between {list_text(titles)}" if titles else ""
        next_line = f"Next measurement{question} (best of {len(self.proposals)} proposals): {self.proposals[0].action}"
        return [*self.cause_sentences, *self.urgent_actions, next_line]

    @property
    def cause_sentences(self) -> tuple[str, ...]:
        """Sentences on the identified causes of a misfit of the recording, without single outliers; empty for none."""
        return tuple(test.sentence for test in corrected_faults(self._other_causes) if test.sentence)

    @property
    def urgent_actions(self) -> tuple[str, ...]:
        """Actions against the causes of a misfit and single outliers, which precede other measurements."""
        return tuple(recommendations_for_causes(self._other_causes))

    @property
    def _other_causes(self) -> list[CauseTest]:
        """Identified causes without those at the places of the compared effects, which are other names for them."""
        places = [{*test.where.stations, *test.where.targets} for test in self.tests]
        is_compared = [bool(names) and names <= {*self.compared_places} for names in places]
        return [test for test, compared in zip(self.tests, is_compared, strict=True) if not compared]

    def _tables(self) -> Mapping[str, Callable[[], Table]]:
        return {"proposals": self._proposals_table, "separation": self._chi2_differences_table}

    def _proposals_table(self) -> Table:
        return PROPOSALS_TABLE.with_rows(
            {**vars(p), "separated_effects": " ".join(p.separated_effects)} for p in self.proposals
        )

    def _chi2_differences_table(self) -> Table:
        """Table of chi-square differences between the first effect and each other one: at present, after proposals."""
        rivals = self.compared_effects[1:]
        against = tuple(
            Column(f"chi2_against_{name}", "expected difference of chi-square", n_digits=3) for name in rivals
        )
        columns = (
            *text_columns(measurement="action"),
            *against,
            *text_columns(decides="yes if it separates all of them"),
        )
        table_rows = [["current recording", *(self.present_chi2_differences.get(name, 0.0) for name in rivals), ""]]
        table_rows += [
            [
                p.action,
                *(p.chi2_differences.get(name, 0.0) for name in rivals),
                "yes" if p.separates_all_effects else "no",
            ]
            for p in self.proposals
            if p.chi2_differences
        ]
        return Table("separation.csv", "separation of the explanations", columns).with_rows(table_rows)
