"""Local HTTP server of the interactive planner: loopback only, protected by a token in the URL.

Other web pages in the same browser can reach this machine too, but do not know the token. A request is rejected if its
Host is another name of this machine (DNS rebinding) or its Origin is another page.

Each connection has a thread, since browsers keep connections open; the work is done by the serving thread, since the 3D
view must stay in one thread. No request ends the server.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from http import HTTPStatus
from http.client import HTTP_PORT, LineTooLong
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from io import BufferedIOBase
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator

from ltsim.core.errors import InputError, LtsimError
from ltsim.reports.board.board import MovableLayout
from ltsim.reports.document_model import CONTENT_SECURITY_POLICY

LOOPBACK_ADDRESS = "127.0.0.1"
"""Address of this machine, which other machines cannot reach."""
MAX_BODY_BYTES = 1 << 20
"""Largest size of the body of a request [byte]."""
MAX_HEADER_BYTES = 1 << 16
"""Largest size of the request line and the headers of a request together [byte]; browsers send 1 to 10 kB."""
MAX_CONNECTIONS = 32
"""Largest number of simultaneous connections; a browser opens six. A further connection replaces the oldest connection
that has not yet sent headers with the secret token; if there is none, the further connection is closed."""
REPLACEMENT_TIMEOUT_S = 1.0
"""Longest time [s] that a new connection waits until the connection that it replaces has ended."""
REQUEST_TIMEOUT_S = 10.0
"""Time [s] within which a request must arrive completely; its connection is closed afterwards."""
INTERRUPT_CHECK_INTERVAL_S = 0.2
"""Longest time [s] that the server waits for a request before it reacts to Ctrl-C."""
MIN_CAMERA_VECTOR_LENGTH = 1e-6
"""Smallest distance [m] of the camera from its focal point, and smallest length of its up direction."""
HTTP_RESPONSE_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""HTTP headers of every response: no caching, no referrer, no display in frames of other pages."""
FiniteTriple = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class StationPosition(BaseModel):
    """Station at the position that the user chose on the page: coordinates [mm] and yaw [deg]."""

    model_config = ConfigDict(strict=True)
    """Configuration of pydantic: values are not converted."""

    name: str
    position_mm: FiniteTriple
    yaw_deg: FiniteFloat


class LayoutRequest(BaseModel):
    """Request of the page with a layout: all stations, and the camera of the 3D view."""

    model_config = ConfigDict(strict=True)
    """Configuration of pydantic: values are not converted."""

    stations: list[StationPosition] = Field(max_length=1000)
    camera: Annotated[list[FiniteTriple], Field(min_length=3, max_length=3)] | None = None
    """Position [m], focal point [m] and up direction of the camera of the 3D view; None for the default camera."""

    @field_validator("camera")
    @classmethod
    def check_camera(cls, camera: list[list[float]] | None) -> list[list[float]] | None:
        """Unchanged `camera`; raises ValueError if a direction has no length."""
        if camera is not None and min(math.dist(*camera[:2]), math.hypot(*camera[2])) < MIN_CAMERA_VECTOR_LENGTH:
            raise ValueError("the camera is at its focal point, or its up direction is zero")
        return camera


class HttpResponse(NamedTuple):
    """Response to an HTTP request."""

    status: HTTPStatus
    media_type: str = "text/plain"
    """Media type of the content."""
    content: bytes = b""


MISSING_PAGE_RESPONSE = HttpResponse(HTTPStatus.NOT_FOUND)
"""Response to a request whose path lacks the secret token of the page, or has an unknown name."""


class PlannerRequests:
    """Requests that the page of the interactive planner may send, and their responses.

    Every path begins with the secret token.
    """

    def __init__(self, layout: MovableLayout, folder: Path) -> None:
        self.layout, self.folder = layout, folder
        self.token = secrets.token_urlsafe(18)
        self._handlers: dict[str, Callable[[list[dict[str, Any]], LayoutRequest], Any]] = {
            "judged": lambda stations, _: layout.evaluation_json(stations),
            "verdict": lambda stations, _: layout.verdict_json(stations),
            "scene": lambda stations, question: layout.scene_page_with_stations(stations, question.camera),
            "save": lambda stations, _: [str(file) for file in layout.save(stations, folder)],
        }

    def page_html(self) -> str:
        """HTML of the page of the planner, with the hall."""
        hall = json.dumps(self.layout.hall_json() | {"folder": str(self.folder)}).replace("<", "\\u003c")
        text = (files("ltsim.reports.board") / "page.html").read_text(encoding="utf-8")
        policy = CONTENT_SECURITY_POLICY.replace("connect-src", "connect-src 'self'")
        palette = (files("ltsim.reports") / "templates" / "palette.css").read_text(encoding="utf-8")
        return text.replace("POLICY", policy, 1).replace("PALETTE", palette, 1).replace("HALL", hall, 1)

    def has_token(self, path: str) -> bool:
        """True if the path of a request begins with the secret token of the page."""
        return secrets.compare_digest(path.removeprefix("/").partition("/")[0].encode(), self.token.encode())

    def respond(self, method: str, path: str, request_body: bytes) -> HttpResponse:
        """Response to a request; its status is 404 if the path does not begin with the token."""
        name = path.removeprefix("/").partition("/")[2]
        if not self.has_token(path) or (name and name not in self._handlers):
            return MISSING_PAGE_RESPONSE
        if method != ("POST" if name else "GET"):
            return HttpResponse(HTTPStatus.METHOD_NOT_ALLOWED)
        if not name:
            return HttpResponse(HTTPStatus.OK, "text/html", self.page_html().encode())
        status = HTTPStatus.OK
        try:
            request = LayoutRequest.model_validate_json(request_body)
            content = self._handlers[name]([station.model_dump() for station in request.stations], request)
        except ValidationError as problem:
            first_error = problem.errors(include_url=False, include_input=False)[0]
            status = HTTPStatus.BAD_REQUEST
            content = {"problem": f"{'.'.join(map(str, first_error['loc'])) or 'the request'}: {first_error['msg']}"}
        except (LtsimError, OSError) as problem:
            content = {"problem": str(problem)}
        return HttpResponse(status, "application/json", json.dumps(content).encode())


class _RequestStream(BufferedIOBase):
    """Bytes of one request, of which lines are read up to a total of `MAX_HEADER_BYTES`."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._n_free = stream, MAX_HEADER_BYTES

    def readline(self, size: int | None = -1) -> bytes:
        """Next line of the request; raises LineTooLong if more than `MAX_HEADER_BYTES` were read."""
        line: bytes = self._stream.readline(self._n_free + 1)
        self._n_free -= len(line)
        if self._n_free < 0:
            raise LineTooLong("header")
        return line

    def read(self, size: int | None = -1) -> bytes:
        """Next `size` bytes of the request, fewer at its end."""
        content: bytes = self._stream.read(size)
        return content

    def close(self) -> None:
        """Close the stream of the connection."""
        self._stream.close()
        super().close()


class _RequestHandler(BaseHTTPRequestHandler):
    """Handler of one connection: it checks a request, passes it to the serving thread, and sends the response."""

    work_queue: SimpleQueue[tuple[Future[HttpResponse], str, str, bytes]]
    """Queue of requests for the serving thread, each with the future of its response."""
    requests: PlannerRequests
    """Requests that are permitted, with their responses."""
    server: _ConnectionLimitedServer
    allowed_hosts: frozenset[str]
    """Allowed values of the HTTP header Host, and of the header Origin after `http://`."""
    timeout = REQUEST_TIMEOUT_S
    """Time [s] within which a request must arrive completely."""
    server_version, sys_version = "ltsim", ""

    def setup(self) -> None:
        """Prepare the connection, from which nothing is read after `REQUEST_TIMEOUT_S`."""
        super().setup()
        self.rfile = _RequestStream(self.rfile)
        self._deadline = threading.Timer(REQUEST_TIMEOUT_S, self._stop_reading)
        self._deadline.daemon = True
        self._deadline.start()

    def finish(self) -> None:
        """Close the connection."""
        self._deadline.cancel()
        super().finish()

    def _stop_reading(self) -> None:
        """Close the connection for reading after the timeout."""
        with suppress(OSError):  # it is closed already
            self.connection.shutdown(socket.SHUT_RD)

    def do_GET(self) -> None:
        """Send the page."""
        self._send_response(self._refusal_response() or self._response_of_serving_thread(b""))

    def do_POST(self) -> None:
        """Answer a request of the page."""
        refusal = self._refusal_response()
        body = b"" if refusal else self._read_body()
        self._send_response(
            refusal or (body if isinstance(body, HttpResponse) else self._response_of_serving_thread(body))
        )

    def _refusal_response(self) -> HttpResponse | None:
        """Response that refuses a request of another page or program; None for a request of the page."""
        if not self.request_version.startswith("HTTP/1."):
            return HttpResponse(HTTPStatus.HTTP_VERSION_NOT_SUPPORTED)
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        if len(hosts) != 1 or hosts[0].lower() not in self.allowed_hosts:
            return HttpResponse(HTTPStatus.MISDIRECTED_REQUEST)
        if not {origin.lower() for origin in origins} <= {f"http://{host}" for host in self.allowed_hosts}:
            return HttpResponse(HTTPStatus.FORBIDDEN)
        if not self.requests.has_token(self.path):
            return MISSING_PAGE_RESPONSE
        self.server.exclude_from_replacement(self.connection)
        return None

    def _read_body(self) -> bytes | HttpResponse:
        """Body of a request, or the response to an invalid length or a timeout."""
        lengths = self.headers.get_all("Content-Length", [])
        if "Transfer-Encoding" in self.headers or len(lengths) != 1:
            return HttpResponse(HTTPStatus.LENGTH_REQUIRED)
        if not (lengths[0].isascii() and lengths[0].isdigit()):
            return HttpResponse(HTTPStatus.BAD_REQUEST)
        if len(lengths[0]) > len(str(MAX_BODY_BYTES)) or int(lengths[0]) > MAX_BODY_BYTES:
            return HttpResponse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        body = self.rfile.read(int(lengths[0]))
        return body if len(body) == int(lengths[0]) else HttpResponse(HTTPStatus.REQUEST_TIMEOUT)

    def _response_of_serving_thread(self, request_body: bytes) -> HttpResponse:
        """Response of the serving thread to the request of this connection."""
        future: Future[HttpResponse] = Future()
        self.work_queue.put((future, self.command, self.path, request_body))
        return future.result()

    def _send_response(self, response: HttpResponse) -> None:
        """Send a response with the headers `HTTP_RESPONSE_HEADERS`."""
        self.send_response(response.status)
        self.send_header("Content-Type", f"{response.media_type}; charset=utf-8")
        self.send_header("Content-Length", str(len(response.content)))
        for name, value in HTTP_RESPONSE_HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(response.content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send the status of a malformed request or an unknown method, without any text of the request."""
        self.request_version = "HTTP/1.0"  # of a malformed request unknown, and then no status would be sent
        self._send_response(HttpResponse(HTTPStatus(code)))

    def log_message(self, *_: Any) -> None:
        """Suppress the log of requests."""


class _ConnectionLimitedServer(ThreadingHTTPServer):
    """Server with a limited number of connections, which ignores broken connections.

    Silent or slow connections of another program do not keep the page from its server: a new connection replaces the
    oldest connection without the token.
    """

    daemon_threads = True
    allow_reuse_address = os.name != "nt"
    """False on Windows, where another program could take over the port."""
    request_queue_size = 2 * MAX_CONNECTIONS
    """Length of the queue of waiting connections."""

    def __init__(self, address: tuple[str, int], handler: type[_RequestHandler]) -> None:
        self._free_connections = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._replaceable: dict[Any, None] = {}
        """Connections that have not yet sent headers with the secret token, the oldest first; a new connection may
        replace them."""
        super().__init__(address, handler)

    def process_request(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Start the thread of a connection."""
        if self._free_connections.acquire(blocking=False) or self._end_oldest_connection():
            self._replaceable[request] = None
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def _end_oldest_connection(self) -> bool:
        """True if the oldest connection without the secret token was ended, so that a new one can take its place."""
        oldest = next(iter([*self._replaceable]), None)
        if oldest is None:
            return False
        self.exclude_from_replacement(oldest)
        with suppress(OSError):  # it has just ended by itself
            oldest.shutdown(socket.SHUT_RDWR)
        return self._free_connections.acquire(timeout=REPLACEMENT_TIMEOUT_S)

    def exclude_from_replacement(self, request: Any) -> None:
        """Exclude a connection from replacement by new ones, since it has sent the secret token or has ended."""
        self._replaceable.pop(request, None)

    def process_request_thread(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Answer the requests of a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.exclude_from_replacement(request)
            self._free_connections.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a closed or silent connection."""


def serve_planner(requests: PlannerRequests, announce_address: Callable[[str], None], port: int = 0) -> None:
    """Serve the page until Ctrl-C, after a call of `announce_address`; raises InputError if the port is in use."""
    work_queue: SimpleQueue[tuple[Future[HttpResponse], str, str, bytes]] = SimpleQueue()
    handler: type[_RequestHandler] = type(
        "Handler", (_RequestHandler,), {"work_queue": work_queue, "requests": requests}
    )
    try:
        server = _ConnectionLimitedServer((LOOPBACK_ADDRESS, port), handler)
    except OSError as problem:
        raise InputError(f"--port {port} cannot be used ({problem.strerror}); omit it to use any free port") from None
    ports = (f":{server.server_port}", *([""] if server.server_port == HTTP_PORT else []))
    handler.allowed_hosts = frozenset(name + behind for name in (LOOPBACK_ADDRESS, "localhost") for behind in ports)
    with server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            announce_address(f"http://{LOOPBACK_ADDRESS}:{server.server_port}/{requests.token}/")
            while True:
                try:
                    future, method, path, body = work_queue.get(timeout=INTERRUPT_CHECK_INTERVAL_S)
                except Empty:
                    continue
                future.set_result(_respond_or_report(requests, method, path, body))
        except KeyboardInterrupt:
            pass
        finally:
            server.shutdown()


def _respond_or_report(requests: PlannerRequests, method: str, path: str, request_body: bytes) -> HttpResponse:
    """Response to a request; after an internal error a response with the error, which the page shows."""
    try:
        return requests.respond(method, path, request_body)
    except Exception as problem:  # internal error: shown by the page, the server continues
        message = f"internal error of ltsim ({type(problem).__name__}: {problem}); please report it"
        content = json.dumps({"problem": message}).encode()
        return HttpResponse(HTTPStatus.INTERNAL_SERVER_ERROR, "application/json", content)
