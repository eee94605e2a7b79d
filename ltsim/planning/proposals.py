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
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat, ResultFile, ResultSource, Vector


class MeasurementProposalEntry(Entry):
    """Proposal of an additional measurement with its duration and expected benefit."""

    action: str
    """Instruction to the user who makes the measurement."""
    kind: str = ""
    """Kind of measurement: pointings (from the last station), return (repetition of a previous set-up), station (new
    set-up), survey (all stations measured again), length (calibration of a distance) or reflectors (additional
    targets)."""
    minutes: Finite
    """Duration of the measurement [min]."""
    remaining_sigma_fraction: Finite
    """Ratio of standard deviations after the measurement to those before (geometric mean over the instrument
    parameters); below 1 is better."""
    most_improved_parameter: str = ""
    """Instrument parameter whose standard deviation the measurement reduces most."""
    most_improved_sigma_fraction: Finite = 1.0
    """Standard deviation of `most_improved_parameter` after the measurement divided by that before; below 1 is better.
    """
    chi2_differences: dict[str, Finite] = Field(default_factory=dict)
    """Expected chi-square after the measurement if the model contains a further effect of
    `NextMeasurement.compared_effects`, minus chi-square if it contains the first effect, by name of the further
    effect."""
    separated_effects: tuple[str, ...] = ()
    """Further effects of `NextMeasurement.compared_effects` that the measurement would distinguish from the first
    effect."""
    separates_all_effects: bool = False
    """True if the measurement would distinguish all further effects of `NextMeasurement.compared_effects` from the
    first effect."""
    position_mm: Vector | None = None
    """Position of the tracker head [mm] at a new set-up, in the workshop frame; null for other measurements."""
    yaw_deg: OptionalFloat = None
    """Direction of azimuth zero [deg] at a new set-up, counter-clockwise from the x axis of the workshop frame; null
    for other measurements."""

    @classmethod
    def from_proposal(cls, proposal: MeasurementProposal) -> Self:
        """Entry of next.json for a proposal of an additional measurement."""
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
    "proposals of additional measurements, the best first",
    model_columns(
        MeasurementProposalEntry,
        "kind minutes remaining_sigma_fraction most_improved_parameter most_improved_sigma_fraction "
        "separated_effects separates_all_effects "
        "action",
        minutes={"title": "time", "unit": "min", "display_format": ".0f"},
        remaining_sigma_fraction={"title": "factor on sigmas", "display_format": ".2f"},
        most_improved_parameter={"title": "most improved parameter"},
        most_improved_sigma_fraction={"title": "factor on its sigma", "display_format": ".2f"},
        separated_effects={"kind": "text"},
        separates_all_effects={"kind": "text"},
        action={"title": "measurement"},
    ),
)
"""Table next.csv: proposed measurements, the most beneficial first."""


def _best_yaw_per_position(proposals: Sequence[MeasurementProposalEntry]) -> tuple[MeasurementProposalEntry, ...]:
    """Proposals without those new stations that differ from a better proposal only in their yaw.

    `proposals` has the best proposal first.
    """
    best_by_place: dict[object, MeasurementProposalEntry] = {}
    for number, proposal in enumerate(proposals):
        place = proposal.position_mm if proposal.kind == "station" else None
        best_by_place.setdefault(place or number, proposal)
    return tuple(best_by_place.values())


class NextMeasurement(ResultFile):
    """Result of `next_measurement` (`ltsim plan --after`), the content of `next.json`."""

    FILE: ClassVar[str] = "next.json"
    COMPANION_TABLES: ClassVar[Mapping[str, Table]] = {"proposals": PROPOSALS_TABLE}
    format: Literal["ltsim-next/1"] = "ltsim-next/1"
    """Format and version of this file."""
    diagnosis: str = ""
    """Sentence with the result of the diagnosis that preceded the ranking; empty without a diagnosis."""
    compared_effects: tuple[str, ...] = ()
    """Names of effects each of which alone explains the recording; the proposed measurements should distinguish
    them."""
    compared_places: tuple[str, ...] = ()
    """Stations and targets at which the `compared_effects` act; empty if they act on the whole recording."""
    present_chi2_differences: dict[str, Finite] = Field(default_factory=dict)
    """Chi-square of the present recording if the model contains a further effect of `compared_effects`, minus
    chi-square if it contains the first effect, by name of the further effect."""
    advice: str = ""
    """Sentence with the action that the user should take first."""
    tests: tuple[CauseTest, ...] = ()
    """Tests of the identified causes of a misfit of the recording, and of its outliers."""
    site: str = ""
    """Name of the plan whose floor, obstacles and lines of sight limit new stations; empty without a plan."""
    proposals: tuple[MeasurementProposalEntry, ...] = Field(min_length=1)
    """Proposals of additional measurements, the best first; for each position of a new station only the best yaw."""

    @classmethod
    def from_ranking(
        cls,
        ranking: RankedProposals,
        source: ResultSource | None = None,
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

    def _summary_lines(self) -> list[str]:
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
        """Identified causes at other stations and targets than the compared effects.

        A cause at the station or target of a compared effect is left out, because it describes the same change of the
        readings.
        """
        places = [{*test.where.stations, *test.where.targets} for test in self.tests]
        is_compared = [bool(names) and names <= {*self.compared_places} for names in places]
        return [test for test, compared in zip(self.tests, is_compared, strict=True) if not compared]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {"proposals": self._proposals_table, "separation": self._chi2_differences_table}

    def _proposals_table(self) -> Table:
        return PROPOSALS_TABLE.with_rows(
            {**vars(p), "separated_effects": " ".join(p.separated_effects)} for p in self.proposals
        )

    def _chi2_differences_table(self) -> Table:
        """Table of chi-square with each further compared effect minus that with the first, now and after proposals."""
        rivals = self.compared_effects[1:]
        against = tuple(
            Column(f"chi2_against_{name}", "expected difference of chi-square", n_digits=3) for name in rivals
        )
        columns = (
            *text_columns(measurement="action"),
            *against,
            *text_columns(decides="yes if the measurement distinguishes all effects"),
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
        return Table("separation.csv", "separation of the compared effects", columns).with_rows(table_rows)
