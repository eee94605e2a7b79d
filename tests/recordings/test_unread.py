"""Field books that are not read are named, with what to export instead."""

from pathlib import Path

import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import read

FILES = {
    "M5": "For M5|Adr     1|PI1 P1                   |SD          12.3456 m   |Hz   12.34567 gon |V1  99.87654 gon |\n",
    "JobXML": '<?xml version="1.0"?>\n<JOBFile jobName="hall"><FieldBook/></JOBFile>\n',
    "RW5": "JB,NMHALL,DT05-14-2026,TM09:00:00\nMO,AD0,UN1,SF1.0,EC1,EO0.0,AU0\n",
    "Topcon": "GTS-7 v3.0\nJOB    HALL,\nUNITS  M,D\nSTN    A,1.55,ST\n",
    "GEO": "{2 A}{3 1.55}\n{5 P1} {7 1.234} {8 1.51} {9 12.34}\n",
    "MATLAB": "MATLAB 5.0 MAT-file, Platform: GLNXA64\n",
    "JSON": '[{"target": "P1", "hz": 1.5}]\n',
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("suffix", ["dat", "csv"])
def test_what_is_not_read_is_named_with_what_to_export(tmp_path: Path, name: str, suffix: str) -> None:
    file = tmp_path / f"book.{suffix}"
    file.write_text(FILES[name])
    with pytest.raises(
        RecordError, match=rf"{name}.*which ltsim does not read; (export GSI, SDR or a|write its arrays)"
    ):
        read(file)
