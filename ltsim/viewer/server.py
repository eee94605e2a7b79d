"""The door between the page and the board: this machine alone, and only who was told the address.

Requests come in threads of their own, as browsers keep connections open; the work is done by the thread that serves,
since the 3D view must not change threads.
"""

import json
import secrets
import threading
from collections.abc import Callable
from concurrent.futures import Future
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from ltsim.errors import LtsimError, SetupError
from ltsim.pages.document import POLICY
from ltsim.viewer.board import Board

HERE = "127.0.0.1"
MOST_BYTES = 1 << 20
"""Of a request."""
WAIT = 0.2
"""[s] between two looks whether somebody wants to stop."""
Answer = tuple[str, bytes]
"""Kind of content, and the content."""


class BoardAccess:
    """What the page may ask of a board; every path begins with a word that nobody can guess.

    A page of the web that is open in the same browser reaches this machine too: it does not know the word.
    """

    def __init__(self, board: Board, folder: Path) -> None:
        self.board, self.folder = board, folder
        self.word = secrets.token_urlsafe(18)
        self._asked: dict[str, Callable[[Any], Any]] = {
            "judged": lambda asked: board.judged(asked["stations"]),
            "verdict": lambda asked: board.verdict(asked["stations"]),
            "scene": lambda asked: board.scene(asked["stations"], asked.get("camera")),
            "save": lambda asked: [str(file) for file in board.save(asked["stations"], folder)],
        }

    def page(self) -> str:
        """The page, with the hall in it."""
        hall = json.dumps(self.board.hall() | {"folder": str(self.folder)}).replace("<", "\\u003c")
        text = (files("ltsim.viewer") / "page.html").read_text(encoding="utf-8")
        policy = POLICY.replace("connect-src", "connect-src 'self'")
        palette = (files("ltsim.pages") / "templates" / "palette.css").read_text(encoding="utf-8")
        return text.replace("POLICY", policy, 1).replace("PALETTE", palette, 1).replace("HALL", hall, 1)

    def answer(self, path: str, body: bytes) -> Answer | None:
        """What a path gives; None where there is nothing, or the word is missing."""
        _, word, name = [*path.split("/", 2), "", ""][:3]
        if not secrets.compare_digest(word.encode(), self.word.encode()):
            return None
        if not name:
            return "text/html", self.page().encode()
        if name not in self._asked:
            return None
        try:
            asked = json.loads(body)
            found = self._asked[name](asked if isinstance(asked, dict) and "stations" in asked else {"stations": []})
        except (LtsimError, OSError, json.JSONDecodeError) as problem:
            found = {"problem": str(problem)}
        return "application/json", json.dumps(found).encode()


class _Handler(BaseHTTPRequestHandler):
    """Hands a request to the thread that works, and its answer back."""

    work: SimpleQueue[tuple[Future[Answer | None], str, bytes]]

    def do_GET(self) -> None:
        """The page."""
        self._hand_over(b"")

    def do_POST(self) -> None:
        """Whatever the page asks."""
        length = self.headers.get("Content-Length", "")
        self._hand_over(self.rfile.read(min(int(length) if length.isdigit() else 0, MOST_BYTES)))

    def _hand_over(self, body: bytes) -> None:
        future: Future[Answer | None] = Future()
        self.work.put((future, self.path, body))
        found = future.result()
        if found is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", f"{found[0]}; charset=utf-8")
        self.send_header("Content-Length", str(len(found[1])))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(found[1])

    def log_message(self, *_: Any) -> None:
        """Say nothing of each request."""


def serve(door: BoardAccess, tell: Callable[[str], None], port: int = 0) -> None:
    """Answer the page until Ctrl-C; `tell` is given the address; raises SetupError for a port that is taken."""
    work: SimpleQueue[tuple[Future[Answer | None], str, bytes]] = SimpleQueue()
    try:
        server = ThreadingHTTPServer((HERE, port), type("Handler", (_Handler,), {"work": work}))
    except OSError as problem:
        raise SetupError(f"--port {port}: {problem.strerror}; leave it out for any that is free") from None
    with server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            tell(f"http://{HERE}:{server.server_port}/{door.word}/")
            while True:
                try:
                    future, path, body = work.get(timeout=WAIT)
                except Empty:
                    continue
                try:
                    future.set_result(door.answer(path, body))
                except Exception as problem:
                    future.set_exception(problem)
                    raise
        except KeyboardInterrupt:
            pass
        finally:
            server.shutdown()
