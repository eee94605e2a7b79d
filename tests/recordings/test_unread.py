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
    "M5 or Rec": "For_M5|Adr 00001|TO   HALL                       |                      |                      |\n",
    "format RW5": "--Carlson SurvCE\nMO,AD0,UN1,SF1.0,EC1,EO0.0,AU0\nOC,OP1,N 10.0,E 10.0,EL1.0,--CP\n",
    "Nikon": "CO,Nikon RAW data format V2.00\nCO,HALL\nCO,Dist Units: Metres\nST,1,,2,,1.55,0.0,0.0\n",
    "a raw file of Topcon": "GTS-700 v3.0\nJOB\tHALL\nSTN\tA,1.55,\n",
    "Geodimeter": "50=HALL\n2=A\n3=1.55\n5=P1\n7=12.3456\n8=98.7654\n9=12.345\n",
    "STAR": "# hall\n.UNITS METERS\nC A 10 20 1 ! ! !\nDB A\nDM B 0-00-00.0 12.345 89-12-13.2 1.5/1.6\nDE\n",
    "LandXML": '<?xml version="1.0"?>\n<LandXML version="1.2"><Survey/></LandXML>\n',
    "HeXML": '<?xml version="1.0"?>\n<HexagonXML/>\n',
    "JSON object": '{"stations": [{"name": "A"}]}\n',
    "database": "SQLite format 3\0\n",
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("suffix", ["dat", "csv"])
def test_what_is_not_read_is_named_with_what_to_export(tmp_path: Path, name: str, suffix: str) -> None:
    file = tmp_path / f"book.{suffix}"
    file.write_text(FILES[name])
    with pytest.raises(
        RecordError, match=rf"{name}.*which ltsim does not read; (export GSI, SDR or a|write its arrays|export the obs)"
    ):
        read(file)
