"""The board answers its page on this machine and nobody else, whatever is sent to it: raw sockets to 127.0.0.1."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ltsim.reports.board import server
from ltsim.reports.board.board import MovableLayout
from ltsim.reports.board.server import (
    HTTP_RESPONSE_HEADERS,
    MAX_BODY_BYTES,
    MAX_CONNECTIONS,
    MAX_HEADER_BYTES,
    PlannerRequests,
)
from tests.planning.test_hall import HALL, points_csv
from tests.reports.browser import FLAGS, find_browser

START = (
    "import signal; signal.signal(2, signal.default_int_handler); from ltsim.reports.board import server; "
    "server.REQUEST_TIMEOUT_S = server._RequestHandler.timeout = 1.5; from ltsim.cli.main import main; main()"
)


@dataclass(frozen=True)
class Open:
    """A board that is being served."""

    port: int
    token: str
    folder: Path
    stations: list[dict[str, Any]]

    def sent(self, raw: bytes, *, half: bool = False) -> bytes:
        """The answer to some bytes; `half` leaves the connection open on this side."""
        parts = []
        with (
            contextlib.suppress(ConnectionError),
            socket.create_connection(("127.0.0.1", self.port), timeout=30) as connection,
        ):
            connection.sendall(raw)
            if not half:
                with contextlib.suppress(OSError):  # the server may have answered and closed already
                    connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(1 << 16):
                parts.append(part)
            return b"".join(parts)
        return b""

    def request(self, name: str, body: bytes = b"", method: str = "POST", **headers: str) -> tuple[int, bytes]:
        """Status and content of the answer to a well-formed request."""
        given = {"Host": f"127.0.0.1:{self.port}", "Content-Length": str(len(body))} | {
            k.replace("_", "-"): v for k, v in headers.items()
        }
        lines = [f"{method} /{self.token}/{name} HTTP/1.1", *(f"{k}: {v}" for k, v in given.items() if v)]
        head, _, content = self.sent("\r\n".join(lines).encode() + b"\r\n\r\n" + body).partition(b"\r\n\r\n")
        return int(head.split()[1]), content

    @property
    def layout_question(self) -> bytes:
        return json.dumps({"stations": self.stations}).encode()

    @property
    def lives(self) -> bool:
        status, content = self.request("judged", self.layout_question)
        return status == 200 and bool(json.loads(content)["points"])


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hall")
    (folder / "points.csv").write_text(points_csv(), encoding="utf-8")
    text = HALL.replace("[search]", "[stations]\ncount = 3\n[work]\nfaces = 1\n[search]")
    (folder / "hall.toml").write_text(text, encoding="utf-8")
    return folder / "hall.toml"


@pytest.fixture(scope="module")
def board(hall: Path) -> Iterator[Open]:
    folder = hall.parent / "moved"
    command = [sys.executable, "-c", START, "view", "--plan", str(hall), "--out", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    _, _, place, token, _ = process.stdout.readline().strip().split("/")
    stations = [
        {"name": s["name"], "position_mm": s["position_mm"], "yaw_deg": s["yaw_deg"]}
        for s in MovableLayout.from_plan(hall).hall_json()["stations"]
    ]
    yield Open(int(place.partition(":")[2]), token, folder, stations)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=60)
    assert (process.returncode, output) == (0, "")


def test_the_page_and_its_questions_are_answered(board: Open) -> None:
    status, page = board.request("", method="GET")
    assert status == 200 and b"<html" in page
    assert board.lives
    origin = f"http://127.0.0.1:{board.port}"
    assert board.request("judged", board.layout_question, Origin=origin)[0] == 200
    named = f"localhost:{board.port}"
    assert board.request("judged", board.layout_question, Host=named, Origin=f"http://{named}")[0] == 200


ATTACK = """<body><p id="seen"></p><script>
const tell = (way) => { document.getElementById("seen").textContent += way + " "; };
const got = (way, answer) => answer.then(() => tell(way), () => {});
got("fetch", fetch("ADDRESS"));
got("save", fetch("ADDRESSsave", {method: "POST", body: QUESTION}));
got("guess", fetch("http://127.0.0.1:PORT/guess/"));
for (const kind of ["img", "script"]) {
  const element = document.createElement(kind);
  element.onload = () => tell(kind);
  element.src = "ADDRESS";
  document.body.append(element);
}
const socket = new WebSocket("ws://127.0.0.1:PORT/TOKEN/");
socket.onopen = () => tell("socket");
fetch("ADDRESSsave", {method: "POST", mode: "no-cors", body: QUESTION}).finally(() => tell("done"));
</script></body>"""


def test_no_page_of_another_origin_frames_the_board(board: Open) -> None:
    raw = board.sent(f"GET /{board.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{board.port}\r\n\r\n".encode())
    assert b"\r\nContent-Security-Policy: frame-ancestors 'none'\r\n" in raw.partition(b"\r\n\r\n")[0] + b"\r\n"


@pytest.mark.long
def test_a_page_in_the_same_browser_that_knows_the_token_reads_and_saves_nothing(board: Open, tmp_path: Path) -> None:
    browser = find_browser()
    page = ATTACK.replace("ADDRESS", f"http://127.0.0.1:{board.port}/{board.token}/").replace("PORT", str(board.port))
    page = page.replace("TOKEN", board.token).replace("QUESTION", json.dumps(board.layout_question.decode()))
    (tmp_path / "evil.html").write_text(page)
    command = [
        browser,
        *FLAGS,
        f"--user-data-dir={tmp_path / 'profile'}",
        "--dump-dom",
        (tmp_path / "evil.html").as_uri(),
    ]
    process = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False).stdout
    assert '<p id="seen">done </p>' in process
    assert not board.folder.exists()
    assert board.lives


FOREIGN = (
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:1"},
    {"Origin": "https://127.0.0.1:PORT"},
    {"Origin": "127.0.0.1:PORT"},
    {"Origin": "http://127.0.0.1:PORT.evil.example"},
    {"Host": "evil.example"},
    {"Host": "evil.example:PORT"},
    {"Host": "127.0.0.1:1"},
    {"Host": "127.0.0.1"},
    {"Host": ""},
)


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
@pytest.mark.parametrize("name", ["", "judged", "save"])
def test_who_knows_the_token_is_refused_under_another_name(headers: dict[str, str], name: str, board: Open) -> None:
    given = {key: value.replace("PORT", str(board.port)) for key, value in headers.items()}
    status, content = board.request(name, board.layout_question if name else b"", "POST" if name else "GET", **given)
    assert status in (403, 421)
    assert content == b""
    assert not board.folder.exists()


@pytest.mark.parametrize(
    "path", ["/", "/judged", "//judged", "/wrong/", "/wrong/judged", "/{}/nothing", "/{}x/", "/%00"]
)
def test_other_paths_do_not_exist(path: str, board: Open) -> None:
    for method in ("GET", "POST"):
        lines = f"{method} {path.format(board.token)} HTTP/1.1\r\nHost: 127.0.0.1:{board.port}\r\nContent-Length: 2\r\n"
        assert board.sent(lines.encode() + b"\r\n{}").split()[1] == b"404"


def deep(count: int) -> bytes:
    return b'{"stations": ' + b"[" * count + b"]" * count + b"}"


BODIES = {
    "nothing": b"",
    "a list": b"[1]",
    "a number": b"7",
    "null": b"null",
    "no JSON": b"{",
    "no text": b"\xff\xfe\x00",
    "deep": deep(100_000),
    "no stations": b"{}",
    "stations of another kind": b'{"stations": [1, 2, 3]}',
    "stations by name": b'{"stations": {"position_mm": 1}}',
    "one station of three": b'{"stations": [{"name": "S1", "position_mm": [0, 0, 0], "yaw_deg": 0}]}',
    "no number": b'{"stations": [{"name": "S1", "position_mm": [NaN, 0, 0], "yaw_deg": 0}]}',
    "a number of 5000 digits": b'{"stations": [{"position_mm": [' + b"9" * 5000 + b', 0, 0], "yaw_deg": 0}]}',
    "a huge number": b'{"stations": [{"name": "a", "position_mm": [1e308, 0, 0], "yaw_deg": 1e308}, '
    b'{"name": "b", "position_mm": [1e308, 0, 0], "yaw_deg": 1e308}]}',
    "a camera of another kind": b'{"stations": [], "camera": 5}',
    "a camera at its focal point": b'{"stations": [], "camera": [[1, 2, 3], [1, 2, 3], [0, 0, 1]]}',
    "a camera without an up direction": b'{"stations": [], "camera": [[1, 2, 3], [0, 0, 0], [0, 0, 1e-300]]}',
    "a camera of words": b'{"stations": [], "camera": [["a"], 2, {}]}',
}


@pytest.mark.parametrize("name", ["judged", "verdict", "scene", "save"])
@pytest.mark.parametrize("kind", BODIES)
def test_a_body_that_makes_no_sense_is_a_problem_and_the_board_goes_on(kind: str, name: str, board: Open) -> None:
    status, content = board.request(name, BODIES[kind])
    assert status in (200, 400)
    assert json.loads(content)["problem"] and "internal error of ltsim" not in json.loads(content)["problem"]
    assert not board.folder.exists()
    assert board.lives


@pytest.mark.parametrize(
    "more",
    [
        "",
        "Content-Length: -1",
        "Content-Length: many",
        "Content-Length: 1_0",
        "Content-Length: \u0663",
        "Content-Length: 1e3",
        f"Content-Length: {MAX_BODY_BYTES + 1}",
        f"Content-Length: {'9' * 5000}",
        "Content-Length: 2\r\nContent-Length: 3",
        "Transfer-Encoding: chunked",
        "Transfer-Encoding: chunked\r\nContent-Length: 2",
        "Content-Length: 1000",
        "Expect: 100-continue\r\nContent-Length: 7",
        "no colon",
        "Content-Length: 2\r\n" + "X: y\r\n" * 200,
        "Long: " + "y" * 100_000,
        f"Two: {'y' * (MAX_HEADER_BYTES // 2)}\r\n" * 2,
    ],
    ids=lambda more: more[:40],
)
def test_a_malformed_request_ends_nothing(more: str, board: Open) -> None:
    head = f"POST /{board.token}/judged HTTP/1.1\r\nHost: 127.0.0.1:{board.port}\r\n{more}\r\n\r\n{{}}"
    answer = board.sent(head.encode("utf-8", "replace"))
    assert not answer or b" 4" in answer.split(b"\r\n")[0] or b"100 Continue" in answer
    assert board.lives


@pytest.mark.parametrize(
    "raw", [b"", b"\r\n", b"GET", b"GET /\r\n\r\n", b"\x16\x03\x01", b"A" * 70_000, b"PUT / HTTP/1.1\r\n\r\n"]
)
def test_what_is_no_request_ends_nothing(raw: bytes, board: Open) -> None:
    board.sent(raw)
    assert board.lives


@pytest.mark.parametrize("method", ["HEAD", "OPTIONS", "TRACE", "PUT", "CONNECT", "get", "<script>", "__init__"])
def test_another_method_is_refused_without_a_word_of_the_request(method: str, board: Open) -> None:
    for path in (f"/{board.token}/save", "/<script>"):
        raw = board.sent(f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{board.port}\r\nX: <script>\r\n\r\n".encode())
        head, _, content = raw.partition(b"\r\n\r\n")
        assert head.split()[1] == b"501" and content == b"" and b"script" not in head
        assert all(f"\r\n{name}: {value}".encode() in head for name, value in HTTP_RESPONSE_HEADERS.items())


def test_a_request_without_a_version_gets_no_page(board: Open) -> None:
    assert board.sent(f"GET /{board.token}/\r\nHost: 127.0.0.1:{board.port}\r\n\r\n".encode()) == b""


@pytest.mark.parametrize("beginning", [b"", b"POST / HTTP/1.1\r\nX: ", b"X: " + b"y" * 60_000])
def test_connections_of_another_program_keep_no_page_from_the_board(beginning: bytes, board: Open) -> None:
    """More than the board serves at once, all open: each new one replaces the oldest without the token."""
    waiting = []
    for _ in range(3 * MAX_CONNECTIONS):
        waiting.append(socket.create_connection(("127.0.0.1", board.port), timeout=30))
        waiting[-1].sendall(beginning)
    assert all(board.lives for _ in range(3))
    for connection in waiting:
        connection.close()


def test_slow_and_silent_connections_end_by_themselves(board: Open) -> None:
    head = f"POST /{board.token}/judged HTTP/1.1\r\nHost: 127.0.0.1:{board.port}\r\nContent-Length: 10\r\n\r\n{{"
    assert board.sent(head.encode(), half=True).split(b"\r\n")[0][-3:] != b"200"
    assert b" 200 " not in board.sent(b"POST", half=True)
    with socket.create_connection(("127.0.0.1", board.port)) as drip:  # a byte at a time, before the end of a header
        drip.settimeout(0.1)
        drip.sendall(b"POST / HTTP/1.1\r\nX: ")
        for _ in range(600):
            with contextlib.suppress(TimeoutError, ConnectionError):
                drip.sendall(b"y")
                assert b" 200 " not in drip.recv(1 << 16)
                break
        else:
            raise AssertionError("the board waits for a slow header for ever")
    silent = [socket.create_connection(("127.0.0.1", board.port)) for _ in range(2 * MAX_CONNECTIONS)]
    for connection in silent:  # closed by the board: at once beyond those that it serves, the others after a while
        connection.settimeout(30)
        with contextlib.suppress(ConnectionError):
            assert connection.recv(1) == b""
        connection.close()
    assert board.lives


def test_a_fault_is_reported_and_the_board_goes_on(hall: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    access = PlannerRequests(MovableLayout.from_plan(hall), tmp_path / "out")

    def broken(*_: object) -> None:
        raise IndexError("nobody expects this")

    monkeypatch.setattr(access, "respond", broken)
    answer = server._respond_or_report(access, "POST", f"/{access.token}/judged", b"")
    assert answer.status == 500
    assert json.loads(answer.content)["problem"].startswith("internal error of ltsim (IndexError: nobody expects this)")


def test_a_layout_is_not_saved_through_a_link(board: Open, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    board.folder.mkdir()
    (board.folder / "plan.toml").symlink_to(tmp_path / "mine")
    status, content = board.request("save", board.layout_question)
    assert status == 200 and "is a link out of the folder" in json.loads(content)["problem"]
    assert (tmp_path / "mine").read_text() == "mine"
    assert [p.name for p in board.folder.iterdir()] == ["plan.toml"]
    shutil.rmtree(board.folder)


def test_a_layout_is_saved(board: Open) -> None:
    status, content = board.request("save", board.layout_question)
    assert status == 200
    assert [Path(file).name for file in json.loads(content)] == ["scenario.toml", "plan.toml"]
    assert board.folder.exists()
    shutil.rmtree(board.folder)  # other tests look whether they have saved
