"""A page as a real browser shows it: Chromium without a window, driven over its DevTools protocol by two pipes."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from deconfounded.envs.support.errors import InputError

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_S = 120.0  # for any answer


def program() -> str | None:
    """Where Chromium is, if there is one."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page of a given size, px; a context. `errors` are what its console complained of, since the last `open`."""

    def __init__(self, width: int, height: int, dark: bool = False) -> None:
        found = program()
        if found is None:
            raise InputError(f"no browser was found; install one of {', '.join(NAMES)}")
        self.size, self.dark, self.errors, self._asked, self._rest = (width, height), dark, list[str](), 0, b""
        self._home = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        import fcntl  # which Windows lacks: pages are written there, and not opened

        hears, self._to = os.pipe()
        self._from, says = os.pipe()
        # Chromium reads from 3 and writes to 4, whatever numbers these pipes have here.
        theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (hears, says)]
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--hide-scrollbars")
        self._process = subprocess.Popen(
            [found, *options, f"--user-data-dir={self._home.name}", "about:blank"],
            stderr=subprocess.DEVNULL,
            close_fds=False,
            start_new_session=True,
            preexec_fn=lambda: [os.dup2(end, i) for i, end in enumerate(theirs, start=3)],
        )
        for end in (*theirs, hears, says):
            os.close(end)
        self._session = ""

    def __enter__(self) -> Browser:
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")
        width, height = self.size
        self.ask(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if self.dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)  # its helpers too, which write to its folder
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
        self._home.cleanup()

    def ask(self, method: str, **params: Any) -> Any:
        """The answer to a command. Raises InputError where the browser has none, or dies."""
        self._asked += 1
        asked = {"id": self._asked, "method": method, "params": params}
        os.write(
            self._to, json.dumps({**asked, **({"sessionId": self._session} if self._session else {})}).encode() + b"\0"
        )
        while (said := self._next()).get("id") != asked["id"]:
            pass
        if "error" in said:
            raise InputError(f"the browser refused {method}: {said['error']['message']}")
        return said["result"]

    def _next(self) -> dict[str, Any]:
        """What it says next: an answer or an event, of which complaints are kept."""
        until = time.monotonic() + PATIENCE_S
        while b"\0" not in self._rest:
            if not select.select([self._from], [], [], max(until - time.monotonic(), 0))[0]:
                raise InputError(f"the browser did not answer in {PATIENCE_S:.0f} s")
            if not (part := os.read(self._from, 1 << 20)):
                raise InputError("the browser ended by itself")
            self._rest += part
        one, self._rest = self._rest.split(b"\0", 1)
        said, params = json.loads(one), json.loads(one).get("params", {})
        if said.get("method") == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(params["exceptionDetails"])[:500])
        if said.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
        if said.get("method") == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.errors.append(json.dumps(params["args"])[:500])
        return said

    def open(self, file: Path) -> None:
        """Show a file; returns when it is loaded, with its pictures."""
        self.errors.clear()
        self.ask("Page.navigate", url=file.resolve().as_uri())
        self.run(
            "new Promise(done => document.readyState === 'complete' ? done() : addEventListener('load', () => done()))"
        )

    def run(self, code: str) -> Any:
        """The value of some JavaScript, or of its promise. Raises InputError if it throws."""
        said = self.ask("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in said:
            raise InputError(f"the page threw {json.dumps(said['exceptionDetails'])[:300]}")
        return said["result"].get("value")

    def point(self, selector: str) -> None:
        """Move the mouse to the middle of an element."""
        found = f"document.querySelector({json.dumps(selector)})"
        self.run(f"{found}.scrollIntoView({{block: 'center'}})")
        x, y = self.run(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({found}.getBoundingClientRect())")
        self.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def picture(self, whole: bool = False) -> bytes:
        """A .png of what is seen, or of the whole page."""
        return base64.b64decode(
            self.ask("Page.captureScreenshot", captureBeyondViewport=whole, **self._clip(whole))["data"]
        )

    def _clip(self, whole: bool) -> dict[str, Any]:
        if not whole:
            return {}
        size = self.ask("Page.getLayoutMetrics")["cssContentSize"]
        return {"clip": {"x": 0, "y": 0, "width": self.size[0], "height": size["height"], "scale": 1}}
