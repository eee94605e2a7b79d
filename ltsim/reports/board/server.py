"""Local HTTP server of the interactive planner: loopback only, protected by a token in the URL.

Other web pages in the same browser can reach this machine too, but do not know the token. A request is refused if its
Host is another name of this machine (DNS rebinding) or its Origin is another page.

Each connection has a thread, since browsers keep connections open; the work is done by the serving thread, since the 3D
view must stay in one thread. No request ends the server.
"""

from __future__ import annotations

import json
import secrets
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from http import HTTPStatus
from http.client import HTTP_PORT
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from ltsim.core.errors import LtsimError, SetupError
from ltsim.reports.board.board import Board
from ltsim.reports.document import CONTENT_SECURITY_POLICY

HERE = "127.0.0.1"
MAX_BYTES = 1 << 20
"""Largest size of the body of a request [byte]."""
MAX_CONNECTIONS = 32
"""Largest number of simultaneous connections; a browser opens six."""
REQUEST_TIMEOUT_S = 10.0
"""Largest time [s] for the complete arrival of a request."""
POLL_INTERVAL = 0.2
"""Time [s] between two checks for Ctrl-C."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""HTTP headers of every answer: no caching, no referrer, no display in frames of other pages."""
Triple = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class StationPlace(BaseModel):
    """Station as moved on the page."""

    model_config = ConfigDict(strict=True)

    name: str
    mm: Triple
    yaw: FiniteFloat


class Question(BaseModel):
    """Body of a request."""

    model_config = ConfigDict(strict=True)

    stations: list[StationPlace] = Field(max_length=1000)
    camera: Annotated[list[Triple], Field(min_length=3, max_length=3)] | None = None


class Answer(NamedTuple):
    """Response to a request."""

    status: HTTPStatus
    kind: str = "text/plain"
    """Media type of the content."""
    content: bytes = b""


MISSING = Answer(HTTPStatus.NOT_FOUND)


class BoardAccess:
    """Requests that the page may send; every path begins with the token."""

    def __init__(self, board: Board, folder: Path) -> None:
        self.board, self.folder = board, folder
        self.token = secrets.token_urlsafe(18)
        self._asked: dict[str, Callable[[list[dict[str, Any]], Question], Any]] = {
            "judged": lambda stations, _: board.judged(stations),
            "verdict": lambda stations, _: board.verdict(stations),
            "scene": lambda stations, question: board.scene(stations, question.camera),
            "save": lambda stations, _: [str(file) for file in board.save(stations, folder)],
        }

    def page(self) -> str:
        """HTML of the page, with the hall."""
        hall = json.dumps(self.board.hall() | {"folder": str(self.folder)}).replace("<", "\\u003c")
        text = (files("ltsim.reports.board") / "page.html").read_text(encoding="utf-8")
        policy = CONTENT_SECURITY_POLICY.replace("connect-src", "connect-src 'self'")
        palette = (files("ltsim.reports") / "templates" / "palette.css").read_text(encoding="utf-8")
        return text.replace("POLICY", policy, 1).replace("PALETTE", palette, 1).replace("HALL", hall, 1)

    def knows(self, path: str) -> bool:
        """True if a path begins with the token."""
        return secrets.compare_digest(path.removeprefix("/").partition("/")[0].encode(), self.token.encode())

    def answer(self, method: str, path: str, body: bytes) -> Answer:
        """Answer to a request; status 404 without the token."""
        name = path.removeprefix("/").partition("/")[2]
        if not self.knows(path) or (name and name not in self._asked):
            return MISSING
        if method != ("POST" if name else "GET"):
            return Answer(HTTPStatus.METHOD_NOT_ALLOWED)
        if not name:
            return Answer(HTTPStatus.OK, "text/html", self.page().encode())
        status = HTTPStatus.OK
        try:
            question = Question.model_validate_json(body)
            content = self._asked[name]([station.model_dump() for station in question.stations], question)
        except ValidationError as problem:
            first = problem.errors(include_url=False, include_input=False)[0]
            status = HTTPStatus.BAD_REQUEST
            content = {"problem": f"{'.'.join(map(str, first['loc'])) or 'the request'}: {first['msg']}"}
        except (LtsimError, OSError) as problem:
            content = {"problem": str(problem)}
        return Answer(status, "application/json", json.dumps(content).encode())


class _Handler(BaseHTTPRequestHandler):
    """Handler that checks a request, passes it to the serving thread, and sends its answer."""

    work: SimpleQueue[tuple[Future[Answer], str, str, bytes]]
    access: BoardAccess
    hosts: frozenset[str]
    """Allowed values of Host, and of Origin after http://."""
    timeout = REQUEST_TIMEOUT_S
    server_version, sys_version = "ltsim", ""

    def setup(self) -> None:
        """Prepare the connection, from which nothing is read after `REQUEST_TIMEOUT_S`."""
        super().setup()
        self._deadline = threading.Timer(REQUEST_TIMEOUT_S, self._stop_reading)
        self._deadline.daemon = True
        self._deadline.start()

    def finish(self) -> None:
        """Close the connection."""
        self._deadline.cancel()
        super().finish()

    def _stop_reading(self) -> None:
        with suppress(OSError):  # it is closed already
            self.connection.shutdown(socket.SHUT_RD)

    def do_GET(self) -> None:
        """Send the page."""
        self._send(self._refused() or self._worked(b""))

    def do_POST(self) -> None:
        """Answer a request of the page."""
        refused = self._refused()
        body = b"" if refused else self._body()
        self._send(refused or (body if isinstance(body, Answer) else self._worked(body)))

    def _refused(self) -> Answer | None:
        """Refusal of a request that does not come from the page; None for one that does."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            return Answer(HTTPStatus.MISDIRECTED_REQUEST)
        if any(origin.lower().removeprefix("http://") not in self.hosts for origin in origins):
            return Answer(HTTPStatus.FORBIDDEN)
        return None if self.access.knows(self.path) else MISSING

    def _body(self) -> bytes | Answer:
        """Body of a request, or the answer to an invalid length or a timeout."""
        lengths = self.headers.get_all("Content-Length", [])
        if "Transfer-Encoding" in self.headers or len(lengths) != 1:
            return Answer(HTTPStatus.LENGTH_REQUIRED)
        if not (lengths[0].isascii() and lengths[0].isdigit()):
            return Answer(HTTPStatus.BAD_REQUEST)
        if len(lengths[0]) > len(str(MAX_BYTES)) or int(lengths[0]) > MAX_BYTES:
            return Answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        body = self.rfile.read(int(lengths[0]))
        return body if len(body) == int(lengths[0]) else Answer(HTTPStatus.REQUEST_TIMEOUT)

    def _worked(self, body: bytes) -> Answer:
        future: Future[Answer] = Future()
        self.work.put((future, self.command, self.path, body))
        return future.result()

    def _send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        self.send_header("Content-Type", f"{answer.kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(answer.content)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.content)

    def log_message(self, *_: Any) -> None:
        """Suppress the log of requests."""


class _Server(ThreadingHTTPServer):
    """Server with a limited number of connections, which ignores broken ones."""

    daemon_threads = True
    request_queue_size = 2 * MAX_CONNECTIONS
    """Length of the queue of waiting connections."""

    def __init__(self, address: tuple[str, int], handler: type[_Handler]) -> None:
        self._free = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(address, handler)

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Start the thread of a connection."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Serve a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a closed or silent connection."""


def serve(access: BoardAccess, announce: Callable[[str], None], port: int = 0) -> None:
    """Serve the page until Ctrl-C; `announce` is called with the address; raises SetupError if the port is in use."""
    work: SimpleQueue[tuple[Future[Answer], str, str, bytes]] = SimpleQueue()
    handler: type[_Handler] = type("Handler", (_Handler,), {"work": work, "access": access})
    try:
        server = _Server((HERE, port), handler)
    except OSError as problem:
        raise SetupError(f"--port {port} cannot be used ({problem.strerror}); omit it to use any free port") from None
    ports = (f":{server.server_port}", *([""] if server.server_port == HTTP_PORT else []))
    handler.hosts = frozenset(name + behind for name in (HERE, "localhost") for behind in ports)
    with server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            announce(f"http://{HERE}:{server.server_port}/{access.token}/")
            while True:
                try:
                    future, method, path, body = work.get(timeout=POLL_INTERVAL)
                except Empty:
                    continue
                future.set_result(_answered(access, method, path, body))
        except KeyboardInterrupt:
            pass
        finally:
            server.shutdown()


def _answered(access: BoardAccess, method: str, path: str, body: bytes) -> Answer:
    try:
        return access.answer(method, path, body)
    except Exception as problem:  # internal error: shown by the page, the server continues
        words = f"internal error of ltsim ({type(problem).__name__}: {problem}); please report it"
        content = json.dumps({"problem": words}).encode()
        return Answer(HTTPStatus.INTERNAL_SERVER_ERROR, "application/json", content)
