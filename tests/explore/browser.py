"""A headless Chromium controlled through two pipes (--remote-debugging-pipe): pages keep their
policy; requests to other hosts and console messages are recorded."""

import base64
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Browser:
    """One page of a browser; a context."""

    def __init__(self, folder: Path, wait: float = 60.0):
        self.wait, self.number, self.rest = wait, itertools.count(1), b""
        self.requests: list[str] = []
        self.console: list[str] = []
        read, self.write = os.pipe()
        self.read, write = os.pipe()
        # The program reads from 3 and writes to 4; first out of the way of either.
        read, write = (os.dup2(fd, fd + 40) for fd in (read, write))
        self.program = subprocess.Popen(
            ["bash", "-c", f'exec "$@" 3<&{read} 4>&{write}', "", CHROMIUM, "--headless=new",
             "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--window-size=1200,1000",
             f"--user-data-dir={folder / 'profile'}", "about:blank"],
            pass_fds=(read, write), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(read)
        os.close(write)
        self.session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        found = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = found["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.program.terminate()
        self.program.wait(10)
        os.close(self.read)
        os.close(self.write)

    def call(self, method: str, **values):
        """The result of a command of the protocol."""
        number = next(self.number)
        told = {"id": number, "method": method, "params": values}
        if self.session is not None:
            told["sessionId"] = self.session
        os.write(self.write, json.dumps(told).encode() + b"\0")
        end = time.monotonic() + self.wait
        while time.monotonic() < end:
            message = self._next(end)
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
        raise TimeoutError(method)

    def _next(self, end: float) -> dict:
        while b"\0" not in self.rest:
            ready, _, _ = select.select([self.read], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                raise TimeoutError("the browser says nothing")
            self.rest += os.read(self.read, 1 << 20)
        first, _, self.rest = self.rest.partition(b"\0")
        message = json.loads(first)
        given = message.get("params", {})
        if message.get("method") == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif message.get("method") == "Runtime.exceptionThrown":
            self.console.append(str(given["exceptionDetails"]))
        elif message.get("method") == "Log.entryAdded":
            self.console.append(given["entry"]["text"])
        elif message.get("method") == "Runtime.consoleAPICalled":
            self.console.append(str(given["args"]))
        return message

    def open(self, address: str) -> None:
        """Go to a page, and wait until it is loaded."""
        self.call("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def value(self, script: str):
        """The value of an expression in the page."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait for a condition."""
        end = time.monotonic() + self.wait
        while not self.value(condition):
            if time.monotonic() > end:
                raise TimeoutError(condition)
            time.sleep(0.05)

    def take_picture(self, path: Path) -> None:
        """The whole page, as a PNG file."""
        found = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(found["data"]))
