"""A headless browser, where the machine has one: console, requests and a picture of a page."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER_HOSTS = ("google", "gvt1", "gstatic", "chromium")
"""The browser itself calls its maker; nothing of that comes from the page."""

FLAGS = (
    "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--hide-scrollbars", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--enable-logging=stderr", "--virtual-time-budget=6000",
)  # fmt: skip


@dataclass(frozen=True)
class SetupModel:
    """What the browser saw: console lines, addresses asked for, the picture (h, w, 3)."""

    console: list[str]
    asked: list[str]
    picture: np.ndarray


def find_browser() -> str:
    """Path of a browser; skips the test where there is none."""
    for name in NAMES:
        path = shutil.which(name)
        if path:
            return path
    pytest.skip("there is no headless browser (Debian: apt-get install chromium): pages are not looked at")


def visit(page: Path, folder: Path, *, width: int = 1000, height: int = 1600) -> SetupModel:
    """Open a page offline and look at it."""
    shot, log = folder / f"{page.stem}-{width}.png", folder / f"{page.stem}-{width}.json"
    command = [
        find_browser(), *FLAGS, f"--user-data-dir={folder / 'profile'}", f"--window-size={width},{height}",
        "--host-resolver-rules=MAP * ~NOTFOUND", f"--log-net-log={log}", f"--screenshot={shot}", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert shot.exists(), done.stderr[-2000:]
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    return SetupModel(console, _asked(log), np.asarray(image.imread(shot))[:, :, :3])


def _asked(log: Path) -> list[str]:
    """Addresses in the browser's log that are no part of the page and not the browser's own."""
    text = log.read_text(errors="replace").rstrip()
    events = json.loads(text if text.endswith("}") else text.rstrip(",") + "]}")["events"]
    urls = {str((event.get("params") or {}).get("url", "")) for event in events}
    return sorted(
        url
        for url in urls
        if url.startswith(("http:", "https:", "ws:", "wss:")) and not any(host in url for host in BROWSER_HOSTS)
    )
