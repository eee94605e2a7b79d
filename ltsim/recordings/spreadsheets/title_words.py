"""Known titles of columns by role (content of the column), in English, German and other languages.

Titles are written in lower case, without blanks, accents and punctuation. Letters such as `ł` and `ø`, which are not
letters with an accent, are omitted. East Asian titles are unchanged.
"""

from collections.abc import Sequence
from itertools import product

EAST_ASIAN_LETTERS = "\u3040-\u30ff\u3400-\u9fff\uac00-\ud7a3"
"""Ranges of Japanese (hiragana, katakana), Chinese (ideographs) and Korean (syllables) letters, for a regular
expression."""

COMMON_SIGMA_ROLE = "sigma_mm"
"""Role of a column with one standard deviation for all three coordinates."""
TITLES_BY_ROLE = {
    "station": "station stn st setup occupy standpunkt stp stand standort stationname stationid stationnr stationno "
    "stationnumber stationpoint stationpointid setuppoint setuppointid standpunktnr standpunktnummer "
    "standpunktname atstation occupied occupiedpoint occupiedstation occpt occpoint "
    "from fromstn fromstation frompoint frompointid von instrument instrumentname "
    "tracker trackername device deviceid devicename stationsname setupname setupid setupno setupnr "
    "setupnumber occupation occupationid aufstellung aufstellungnr aufstellungsnr besetzung stationierung standpkt",
    "target": "target point pt name punkt pkt punktnummer punktnr punktid punktno pktnummer pktnr punktname pnr "
    "pointname pointid pointnumber pointno "
    "pointnr ptid ptno ptnr ptname targetname targetid feature featurename id to tostn tostation "
    "topoint topointid observed observedpoint sight sighted sightedpoint nach reflector smr "
    "zielpunkt zielpunktnr zielpunktnummer ziel nest nr nummer no",
    "face": "face f lage kreislage circlelage visierlage",
    "repeat": "repeat repetition rep wiederholung",
    "round": "round runde obsset satz set setnumber setno setnr satznummer satznr vollsatz serie series "
    "measurementround obsround messrunde durchgang epoch epoche messepoche",
    "horizontal": "hz ha horizontal horizontalangle hzangle horizontalrichtung hzrichtung richtung direction "
    "horizontalwinkel hzwinkel hcircle hzcircle horizontalcircle bearing",
    "azimuth": "azimuth az azimut azi azimuthangle azimutwinkel",
    "vertical": "v va vz vertical verticalangle vertikalwinkel vwinkel vangle vzangle vcircle verticalcircle",
    "zenith": "zenith za zd zen zenithangle zenit zenitwinkel zenitdistanz zenithdistance",
    "elevation": "elevation el elev elevationangle hohenwinkel hoehenwinkel altitudeangle elevationswinkel",
    "distance": "distance d sd slopedist slopedistance slope range r schragdistanz schraegdistanz "
    "schragstrecke schraegstrecke strecke distanz raumstrecke distance3d sdist "
    "schragentfernung schraegentfernung raumdistanz",
    "flat": "hd horizontaldistance horizontaldist horizontalstrecke horizontaldistanz hdist",
    "x": "x xactual actualx xmeas measx xist istx e east easting rechtswert rw ost ostwert xcoordinate xkoordinate",
    "y": "y yactual actualy ymeas measy yist isty n north northing hochwert hw nord nordwert ycoordinate ykoordinate",
    "z": "z zactual actualz zmeas measz zist istz h height hohe hoehe zcoordinate zkoordinate",
    COMMON_SIGMA_ROLE: "sigma stddev std sigmaxyz",
    "time": "time zeit timestamp zeitstempel zeitpunkt datetime utc uhrzeit clock clocktime times measuredat",
    "date": "date datum day tag",
    "instrument_height_mm": "ih hi fromhgt insthgtm stationheight stationshojd standpunkthohe hauteurstation "
    "altezzastazione",
    "target_height_mm": "tohgt th ht hr zh hv hp",
    "instrument_setup": "isetupid instrumentsetup instrumentsetupid",
    "target_setup": "tsetupid targetsetup targetsetupid",
    "air_temperature_c": "airtemperature airtemp lufttemperatur",
    "air_pressure_hpa": "airpressure pressure luftdruck",
    "relative_humidity_pct": "relativehumidity humidity luftfeuchte luftfeuchtigkeit",
}
"""English and German titles of columns by role (content, such as `azimuth`), separated by blanks."""
SUMMARY_ROW_FIRST_WORDS = (
    "sum total count mean average avg median min max minimum maximum std stddev rms summe gesamt anzahl mittel "
    "mittelwert somme moyenne nombre suma media promedio somma totale numero"
)
"""Words, separated by blanks, with which a row of sums or means begins."""
FOREIGN_TITLES_BY_LANGUAGE = {
    "French": {
        "station": "stationne pointstation pointstationne numerodestation stationinstrument stationdelinstrument "
        "positioninstrument positiondelinstrument miseenstation",
        "round": "tour epoque",
        "target": "pointvise visee vise cible nom nompoint nomdupoint",
        "horizontal": "anglehorizontal anglehz lecturehz lecturehorizontale directionhorizontale gisement",
        "vertical": "anglevertical lectureverticale",
        "zenith": "anglezenithal distancezenithale zenithal",
        "elevation": "angledesite anglesite site angledelevation angledehauteur hauteurangulaire",
        "distance": "distanceinclinee distanceoblique distancesuivantpente distancepente distancespatiale "
        "distanceselonlapente distincl",
        "flat": "distancehorizontale distancereduite",
        "time": "heure horodatage",
        "air_temperature_c": "temperatureair temperaturedelair",
        "air_pressure_hpa": "pression pressionatmospherique",
        "relative_humidity_pct": "humidite humiditerelative",
    },
    "Spanish and Portuguese": {
        "station": "estacion puntoestacion puntodeestacion estacao estacionamiento estacioninstrumento "
        "estaciondelinstrumento posicioninstrumento posiciondelinstrumento pontoestacao pontodeestacao",
        "round": "ronda vuelta epoca",
        "target": "punto puntovisado puntoobservado objetivo ponto pontovisado pontoobservado alvo nombre nome",
        "horizontal": "anghoriz angulohor angulohorizontal angulohz "
        "lecturahorizontal lecturahz direccionhorizontal leiturahorizontal "
        "direcaohorizontal",
        "azimuth": "acimut azimute",
        "vertical": "angulovert angulovertical lecturavertical leituravertical",
        "zenith": "angulocenital distanciacenital cenital angulozenital distanciazenital",
        "elevation": "angulodeelevacion anguloelevacion angulodealtura elevacion angulodeelevacao elevacao",
        "distance": "distanciageometrica distanciainclinada distancia distanciaespacial distgeom distgeometrica",
        "flat": "distanciahorizontal distanciareducida distanciareduzida",
        "date": "fecha",
        "time": "hora horario",
        "air_temperature_c": "temperaturadelaire temperaturaaire temperaturadoar",
        "air_pressure_hpa": "presion presionatmosferica pressao pressaoatmosferica",
        "relative_humidity_pct": "humedad humedadrelativa umidade umidaderelativa humidaderelativa",
    },
    "Italian": {
        "station": "stazione puntostazione puntodistazione stazionestrumento stazionedellostrumento "
        "posizionestrumento posizionedellostrumento",
        "round": "giro turno",
        "target": "puntocollimato puntobattuto bersaglio nomepunto",
        "horizontal": "angoloorizzontale angolohz angoloazimutale letturaorizzontale direzioneorizzontale orizzontale",
        "vertical": "angoloverticale letturaverticale",
        "zenith": "angolozenitale distanzazenitale zenitale",
        "elevation": "angolodielevazione angolodialtezza angolodisito elevazione",
        "distance": "distanzainclinata distanza distanzageometrica distanzaobliqua distinclinata",
        "flat": "distanzaorizzontale distanzaridotta",
        "time": "ora orario",
        "air_temperature_c": "temperaturadellaria temperaturaaria",
        "air_pressure_hpa": "pressione pressioneatmosferica",
        "relative_humidity_pct": "umidita umiditarelativa",
    },
    "Dutch": {
        "station": "standplaats opstelpunt opstelling",
        "target": "richtpunt doelpunt",
        "horizontal": "horizontalehoek hzhoek horizontalerichting",
        "vertical": "verticalehoek",
        "zenith": "zenithoek zenitafstand",
        "distance": "schuineafstand afstand",
        "flat": "horizontaleafstand",
    },
    "Swedish and Danish": {
        "station": "uppstallning stationspunkt opstilling",
        "target": "siktpunkt sigtepunkt",
        "horizontal": "horisontalvinkel horisontalriktning horisontalretning riktning retning",
        "vertical": "vertikalvinkel",
        "zenith": "zenitvinkel zenitdistans",
        "distance": "lutandelangd lutandeavstand skraafstand avstand afstand",
        "flat": "horisontellangd horisontalavstand horisontalafstand",
    },
    "Polish": {
        "station": "stanowisko",
        "target": "celowana punktcelowany",
        "horizontal": "kathoryzontalny katpoziomy kierunek",
        "vertical": "katpionowy katwertykalny",
        "zenith": "katzenitalny odlegosczenitalna",
        "distance": "odlegloscskosna odlegoscskosna",
        "flat": "odlegloscpozioma odlegoscpozioma",
    },
    "Czech and Slovak": {
        "station": "stanovisko stanoviste",
        "target": "bod cil ciel",
        "horizontal": "smer vodorovnysmer vodorovnyuhel vodorovnyuhol",
        "vertical": "svislyuhel zvislyuhol",
        "zenith": "zenitovyuhel zenituhel zenitovyuhol zenitovavzdalenost",
        "distance": "sikmadelka sikmavzdalenost sikmadlzka",
        "flat": "vodorovnadelka vodorovnavzdalenost vodorovnadlzka",
    },
    "Hungarian": {
        "station": "allaspont",
        "target": "pont pontszam iranyzottpont",
        "horizontal": "vizszintesirany vizszintesszog iranyertek",
        "zenith": "zenitszog",
        "elevation": "magassagiszog",
        "distance": "ferdetavolsag",
        "flat": "vizszintestavolsag",
        "time": "ido",
    },
    "Japanese": {
        "station": "器械点 器械点名 機械点 機械点名 測站",
        "target": "測点 測点名 点名 点番 点番号 視準点 視準点名 目標点",
        "round": "対回 対回数",
        "horizontal": "水平角 水平方向",
        "azimuth": "方位角",
        "vertical": "鉛直角",
        "zenith": "天頂角 天頂距離",
        "elevation": "高度角 高低角",
        "distance": "斜距離 斜距離測定値",
        "flat": "水平距離",
        "date": "日付 観測日 測定日",
        "time": "時刻 観測時刻 測定時刻",
        "instrument_height_mm": "器械高 機械高",
        "target_height_mm": "視準高 目標高 ミラー高 プリズム高 反射鏡高",
        "air_temperature_c": "気温",
        "air_pressure_hpa": "気圧",
        "relative_humidity_pct": "湿度 相対湿度",
    },
    "Chinese": {
        "station": "测站 测站名 测站点 测站点名 测站点号 測站名 測站點 測站點名 測站點號",
        "target": "点号 目标 目标点 照准点 镜点 點號 點名 目標 目標點 照準點 棱镜点",
        "round": "测回 测回数 測回 測回數",
        "horizontal": "水平度盘 水平度盘读数 水平度盤 水平度盤讀數 方向值",
        "vertical": "竖直角 垂直角 竖盘读数 豎直角 豎盤讀數",
        "zenith": "天顶距 天顶角 天頂距",
        "distance": "斜距 倾斜距离 傾斜距離",
        "flat": "平距 水平距离",
        "date": "日期 观测日期 觀測日期",
        "time": "时间 观测时间 時間 觀測時間",
        "instrument_height_mm": "仪器高 仪高 儀器高 儀高",
        "target_height_mm": "棱镜高 镜高 觇标高 目标高 稜鏡高 鏡高 覘標高",
        "air_temperature_c": "气温 氣溫",
        "air_pressure_hpa": "气压 氣壓",
        "relative_humidity_pct": "湿度值 相对湿度 相對濕度 濕度",
    },
    "Korean": {
        "station": "기계점 기계점명",
        "target": "측점 측점명 점명 점번호 시준점 시준점명",
        "round": "대회 대회수",
        "horizontal": "수평각",
        "azimuth": "방위각",
        "vertical": "연직각 수직각",
        "zenith": "천정각 천정거리",
        "elevation": "고도각 고저각",
        "distance": "사거리 경사거리",
        "flat": "수평거리",
        "date": "날짜 일자 관측일",
        "time": "시간 시각 관측시간 관측시각",
        "instrument_height_mm": "기계고",
        "target_height_mm": "시준고 목표고 프리즘고 타겟고",
        "air_temperature_c": "기온",
        "air_pressure_hpa": "기압",
        "relative_humidity_pct": "습도 상대습도",
    },
}
"""Titles of columns in other languages, by language and role (content, such as `azimuth`)."""
STATION_TITLE_FIRST_WORDS = (
    "instrument",
    "instruments",
    "instrumenten",
    "instr",
    "inst",
    "tracker",
    "gerat",
    "gerate",
    "geraete",
)
"""First words of titles of columns of stations, such as "instrument" in "instrument position"."""
STATION_TITLE_LAST_WORDS = (
    "station",
    "stn",
    "stand",
    "standort",
    "standpunkt",
    "standpkt",
    "position",
    "pos",
    "point",
    "location",
)
"""Last words of titles of columns of stations, such as "position" in "instrument position"."""
NUMBER_TITLE_ENDINGS = ("no", "nr", "num", "number", "nummer", "id", "name")
"""Words that may end the title of a column of stations or rounds, such as "no" in "station no"."""
_SETUP_TITLES = ("setup", "setupname", "setupid", "setupno", "setupnr", "setupnumber")
"""Titles of columns of names or numbers of set-ups."""
_OCCUPATION_TITLES = ("occupation", "occupationid", "aufstellung", "aufstellungnr", "aufstellungsnr", "besetzung")
"""Titles of columns that number the times at which the instrument occupied a survey mark."""
FALLBACK_TITLES = {
    "target": ("nr", "nummer", "no", "id"),
    "station": (*_SETUP_TITLES, *_OCCUPATION_TITLES),
    "elevation": ("site",),
}
"""Titles that denote a role (content of a column) only if no other title of the header denotes it, by role. For
vertical angles of any kind the header must also contain another kind of readings: "site" is French for an elevation,
and English for a place."""
AXIS_LETTERS = "xyz"
"""Letters of the axes, with which titles of coordinates begin or end."""
MIN_COMMON_WORD_LENGTH = 3
"""Smallest number of letters of the common word. One or two letters denote other quantities, such as rotations
and quaternions."""
WORDS_OF_OTHER_VECTORS = (
    "rot rotation angle ang euler quat quaternion vel velocity speed acc accel acceleration gyro force torque moment "
    "sigma std stddev sdev err error dev deviation diff difference delta unc uncertainty normal norm dir direction "
    "nom nominal soll cad design ref reference scale mag temp offset drehung winkel abweichung"
)
"""Words, separated by blanks, that denote rotations, deviations, nominal values and other vectors."""


def axes_of_titles_with_common_word(titles: Sequence[str]) -> dict[int, str]:
    """Axis (`x`, `y` or `z`), by position, of three titles with a common word before or after the letter of the axis.

    `titles` are in the form of `normalised_title`. The result is empty if no word, or more than one, has three axes.
    """
    positions_by_word: dict[tuple[str, bool], dict[str, int]] = {}
    for position, title in enumerate(titles):
        for word, letter, is_prefix in ((title[:-1], title[-1:], True), (title[1:], title[:1], False)):
            is_usable = len(word) >= MIN_COMMON_WORD_LENGTH and word not in WORDS_OF_OTHER_VECTORS.split()
            if is_usable and letter and letter in AXIS_LETTERS:
                positions_by_word.setdefault((word, is_prefix), {}).setdefault(letter, position)
    complete = [axes for axes in positions_by_word.values() if len(axes) == len(AXIS_LETTERS)]
    return {position: axis for axis, position in complete[0].items()} if len(complete) == 1 else {}


HEIGHT_WORDS = (
    "h height hgt hght ht hohe hoehe hauteur haut altura alt altezza hoogte hojd hojde hjde wysokosc vyska magassag"
)
"""Words for heights in titles of columns, separated by blanks."""
HEIGHT_OWNER_WORDS_BY_ROLE = {
    "instrument_height_mm": "instrument instr inst instrumenten gerate geraete kippachs appareil instrumento aparato "
    "strumento instrumentu pristroje stroje pristroja muszer",
    "target_height_mm": "target tgt prism prismen reflector refl reflektor rod pole signal ziel zielpunkt tafel prisme "
    "cible voyant reflecteur prisma objetivo alvo bersaglio mira segnale pryzmatu lustra ustra celu sygnau cile ciela "
    "hranolu jel prizma",
}
"""Words for the instrument and the target in titles of their heights, separated by blanks, by role of the column."""
HEIGHT_TITLE_LINKS = ("", "of", "de", "del", "do", "du", "della", "dello", "dell")
"""Words between a word for a height and the instrument or target."""
ROLE_BY_HEIGHT_TITLE = {
    title: role
    for role, owners in HEIGHT_OWNER_WORDS_BY_ROLE.items()
    for owner, height in product(owners.split(), HEIGHT_WORDS.split())
    for title in (owner + height, *(height + link + owner for link in HEIGHT_TITLE_LINKS))
}
"""Role (content) of a column of heights, by its title."""
FULL_WORDS_BY_ABBREVIATION = {
    "dist": ("distance", "distancia", "distanza"),
    "ang": ("angle", "angulo", "angolo"),
    "horiz": ("horizontal",),
    "hor": ("horizontal",),
    "vert": ("vertical",),
}
"""Words with which titles begin, by their abbreviation."""
LETTERS_OF_HEIGHTS = {"i": "instrument_height_mm", "t": "target_height_mm"}
"""Role (content) of a column of lengths whose title is a single letter."""
