"""A headless Chromium or Firefox for tests, driven through its own socket."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

KNOWN = {
    "Chromium": ("chromium", "chromium-browser", "google-chrome"),
    "Firefox": ("firefox-esr", "firefox"),
}
KEYS = {"Tab": ("\t", 9, "\ue004"), "Enter": ("\r", 13, "\ue007")}  # text, code, WebDriver's
PATIENCE_S = 120.0  # a busy machine takes a minute to start a browser


class Browser:
    """One open page; calling it evaluates an expression of JavaScript there."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._sent = socket, 0

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, **parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE_S))
            if answer.get("id") == self._sent:
                assert "error" not in answer, answer
                return dict(answer["result"])

    def __call__(self, expression: str) -> Any:
        raise NotImplementedError

    def until(self, condition: str) -> bool:
        """Whether it comes true while one waits."""
        end = time.monotonic() + PATIENCE_S
        while not (found := bool(self(condition))) and time.monotonic() < end:
            time.sleep(0.1)
        return found

    def reload(self) -> None:
        self("location.reload()")
        time.sleep(0.5)
        assert self.until("document.readyState === 'complete'")


class Chromium(Browser):
    """The DevTools protocol."""

    def __init__(self, socket: Any, url: str) -> None:
        super().__init__(socket)
        target = self._call("Target.createTarget", params={"url": "about:blank"})["targetId"]
        attach = {"targetId": target, "flatten": True}
        self._session = self._call("Target.attachToTarget", params=attach)["sessionId"]
        self._page("Page.navigate", url=url)

    def _page(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._call(method, params=parameters, sessionId=self._session)

    def __call__(self, expression: str) -> Any:
        answer = self._page("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def resize(self, width: int) -> None:
        size = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
        self._page("Emulation.setDeviceMetricsOverride", **size)

    def press(self, key: str) -> None:
        text, code, _ = KEYS[key]
        about = {"key": key, "code": key, "windowsVirtualKeyCode": code}
        self._page("Input.dispatchKeyEvent", type="keyDown", text=text, **about)
        self._page("Input.dispatchKeyEvent", type="keyUp", **about)


class Firefox(Browser):
    """WebDriver BiDi."""

    def __init__(self, socket: Any, url: str) -> None:
        super().__init__(socket)
        self._call("session.new", params={"capabilities": {}})
        # The first tab never has the focus.
        tab = self._call("browsingContext.create", params={"type": "tab"})
        self._context = tab["context"]
        self._page("browsingContext.navigate", url=url, wait="complete")

    def _page(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._call(method, params={"context": self._context, **parameters})

    def __call__(self, expression: str) -> Any:
        target = {"context": self._context}
        parameters = {"expression": expression, "target": target, "awaitPromise": False}
        answer = self._call("script.evaluate", params=parameters)
        assert answer["type"] == "success", answer
        return answer["result"].get("value")

    def resize(self, width: int) -> None:
        self._page("browsingContext.setViewport", viewport={"width": width, "height": 800})

    def press(self, key: str) -> None:
        strokes = [{"type": kind, "value": KEYS[key][2]} for kind in ("keyDown", "keyUp")]
        source = {"type": "key", "id": "keyboard", "actions": strokes}
        self._page("input.performActions", actions=[source])


@contextlib.contextmanager
def opened(name: str, page: Path) -> Iterator[Any]:
    """A page in a browser that is closed afterwards; the test is skipped where there is none."""
    client = pytest.importorskip("websockets.sync.client")
    program = next(filter(None, map(shutil.which, KNOWN[name])), None)
    if program is None:
        pytest.skip(f"no {name} is installed ({', '.join(KNOWN[name])})")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        log = Path(profile, "log")
        command = [program, "--remote-debugging-port=0"]
        command += (
            ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"]
            if name == "Chromium"
            else ["--headless", "--no-remote", "--profile", profile]
        )
        with open(log, "w") as stream:
            process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT)
        try:
            address = _address(log, process)
            path = "" if name == "Chromium" else "/session"
            with client.connect(address + path, max_size=None, open_timeout=PATIENCE_S) as socket:
                browser = {"Chromium": Chromium, "Firefox": Firefox}[name](socket, page.as_uri())
                ready = "location.protocol === 'file:' && document.readyState === 'complete'"
                assert browser.until(ready)
                yield browser
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE_S)


def _address(log: Path, process: subprocess.Popen[bytes]) -> str:
    """Where a browser listens, which both write among their messages."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end and process.poll() is None:
        if found := re.search(r"listening on (ws://\S+)", log.read_text(errors="replace")):
            return found[1]
        time.sleep(0.2)
    raise AssertionError(log.read_text(errors="replace"))
