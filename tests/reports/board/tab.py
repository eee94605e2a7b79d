"""A page in a headless browser driven as by a hand: real mouse and keys, through the browser's own pipe."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.reports.browser import FLAGS, find_browser

UNTIL = """new Promise((done, lost) => {{ const look = n => {{ const found = ({0});
  found ? done(found) : n ? setTimeout(look, 50, n - 1) : lost("never: {1}"); }}; look(600); }})"""

START = "import os, sys; [os.dup2(int(sys.argv[k]), k + 2) for k in (1, 2)]; os.execv(sys.argv[3], sys.argv[3:])"
"""The browser reads from its file 3 and writes to its file 4."""


class Tab:
    """The page; `console_lines` are its errors and console lines."""

    def __init__(self, reads: int, writes: int) -> None:
        self._reads, self._writes = reads, writes
        self._rest, self._count, self._session, self._loaded = b"", 0, "", False
        self.console_lines: list[str] = []

    def call(self, method: str, **given: Any) -> dict[str, Any]:
        """One command of the DevTools protocol."""
        self._count += 1
        asked: dict[str, Any] = {"id": self._count, "method": method, "params": given}
        if self._session:
            asked["sessionId"] = self._session
        os.write(self._writes, json.dumps(asked).encode() + b"\0")
        while True:
            answer = self._heard()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def _heard(self) -> dict[str, Any]:
        """The browser's next word; events are noted."""
        message = self._next()
        if message.get("method") in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            self.console_lines.append(json.dumps(message["params"])[:500])
        self._loaded |= message.get("method") == "Page.loadEventFired"
        return message

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            more = os.read(self._reads, 1 << 16)
            assert more, "the browser is gone"
            self._rest += more
        part, self._rest = self._rest.split(b"\0", 1)
        return json.loads(part)

    def open(self, address: str, width: int, height: int) -> None:
        """Go to an address."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self._loaded = False
        self.call("Page.navigate", url=address)
        while not self._loaded:
            self._heard()

    def value(self, expression: str) -> Any:
        """What an expression is on the page; promises are waited for."""
        result = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, expression: str) -> Any:
        """Wait until an expression holds."""
        return self.value(UNTIL.format(expression, expression.replace('"', "'")))

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 6) -> None:
        """Press at one place of the window, move, and let go at another."""

        def mouse(kind: str, share: float, buttons: int) -> None:
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            button = "left" if kind != "mouseMoved" else "none"
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=1)

        mouse("mousePressed", 0.0, 1)
        for k in range(1, steps + 1):
            mouse("mouseMoved", k / steps, 1)
        mouse("mouseReleased", 1.0, 0)

    def middle(self, selector: str) -> tuple[float, float]:
        """Middle of an element in the window."""
        box = f"document.querySelector('{selector}').getBoundingClientRect()"
        x, y = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        return x, y

    def picture(self, file: Path) -> None:
        """Write what is to be seen as a PNG."""
        answer = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        file.write_bytes(base64.b64decode(answer["data"]))


@contextmanager
def opened(address: str, folder: Path, width: int = 1300, height: int = 1000) -> Iterator[Tab]:
    """A tab at an address, as long as it is looked at."""
    flags = [flag for flag in FLAGS if "virtual-time" not in flag]
    (here, to_it), (from_it, there) = os.pipe(), os.pipe()
    far = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (here, there)]
    command = [find_browser(), *flags, f"--user-data-dir={folder / 'tab'}", "--remote-debugging-pipe", "about:blank"]
    browser = subprocess.Popen(
        [sys.executable, "-c", START, *map(str, far), *command], pass_fds=far, stderr=subprocess.DEVNULL
    )
    for end in (here, there, *far):
        os.close(end)
    tab = Tab(from_it, to_it)
    try:
        tab.open(address, width, height)
        yield tab
    finally:
        browser.terminate()
        browser.wait()
        os.close(from_it)
        os.close(to_it)
