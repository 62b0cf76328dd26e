"""A headless browser, driven by the Chrome DevTools protocol."""

import base64
import json
import shutil
import subprocess
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import pytest

PATIENCE = 90.0
"""Time limit of an answer of the browser, [s]."""
SIZE = 1280, 800
"""Width and height of the window, [pixels]."""


def chromium():
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def wait_for(condition, seconds=PATIENCE, every=0.05):
    """Wait until a function returns something true, and return it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(every)
    pytest.fail(f"did not happen within {seconds} s: {condition}")
    return None


class Browser:
    def __init__(self):
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        words = ["--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--no-first-run"]
        words += ["--disable-background-networking", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        words += [f"--user-data-dir={self._folder.name}", f"--window-size={SIZE[0]},{SIZE[1]}", "about:blank"]
        self._process = subprocess.Popen([chromium(), *words], stderr=subprocess.PIPE, text=True)
        line = next(line for line in self._process.stderr if "DevTools listening on" in line)
        self._address = "http://" + line.split()[-1].split("/")[2]
        threading.Thread(target=lambda: list(self._process.stderr), daemon=True).start()

    def tab(self, url):
        request = urllib.request.Request(f"{self._address}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            return Tab(json.load(answer)["webSocketDebuggerUrl"], url)

    def close(self):
        self._process.terminate()
        self._process.wait(PATIENCE)
        self._folder.cleanup()


class Tab:
    """One tab; `requests` are the addresses that it asked for, `errors` what its console said."""

    def __init__(self, address, url):
        from websockets.sync.client import connect

        self._socket, self._number = connect(address, max_size=None, ping_interval=None), 0
        self.requests, self.errors, self.closed = [], [], False
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.downloads = Path(tempfile.mkdtemp())
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(self.downloads))
        self.call("Page.navigate", url=url)

    def call(self, method, **parameters):
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message):
        method, parameters = message.get("method"), message.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(str(parameters))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and parameters["type"] == "error":
            self.errors.append(str(parameters["args"]))

    def run(self, script):
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        return result["result"].get("value")

    def screenshot(self):
        """Return the picture of the tab as a PNG file."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def text(self, selector):
        return self.run(f"document.querySelector({selector!r})?.textContent ?? ''")

    def place(self, selector, text=""):
        """Return the middle of the innermost element with a text."""
        script = (
            f"(()=>{{const all=[...document.querySelectorAll({selector!r})];"
            f"const e=all.filter(e=>e.textContent.includes({text!r}))"
            ".sort((a,b)=>a.textContent.length-b.textContent.length)[0];"
            "if(!e)return null;e.scrollIntoViewIfNeeded();const r=e.getBoundingClientRect();"
            "return [r.x+r.width/2,r.y+r.height/2]})()"
        )

        def still():
            place = self.run(script)
            time.sleep(0.06)
            return place if place == self.run(script) else None

        return wait_for(still)

    def press(self, selector, text=""):
        place = self.place(selector, text)
        for kind, buttons in (("Moved", 0), ("Pressed", 1), ("Released", 0)):
            self.mouse(kind, place, buttons)

    def mouse(self, kind, point, buttons=0):
        button = "none" if kind == "Moved" and not buttons else "left"
        self.call(
            "Input.dispatchMouseEvent", type=f"mouse{kind}", x=point[0], y=point[1], button=button,
            buttons=buttons, clickCount=0 if kind == "Moved" else 1,
        )  # fmt: skip

    def drag(self, first, last, steps=6):
        self.mouse("Moved", first)
        time.sleep(0.2)
        self.mouse("Pressed", first, 1)
        for i in range(1, steps + 1):
            share = i / steps
            self.mouse("Moved", [a + share * (b - a) for a, b in zip(first, last, strict=True)], 1)
            time.sleep(0.06)
        self.mouse("Released", last)

    def press_right(self):
        pressed = {"key": "ArrowRight", "code": "ArrowRight", "windowsVirtualKeyCode": 39}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, **pressed)

    def canvas(self):
        """Return left, top, width and height of the picture of the scene."""
        return self.run(
            "(()=>{const a=[...document.querySelectorAll('canvas')].sort((a,b)=>b.clientWidth*b.clientHeight"
            "-a.clientWidth*a.clientHeight)[0].getBoundingClientRect();return [a.x,a.y,a.width,a.height]})()"
        )

    def close(self):
        if not self.closed:
            self.closed = True
            self.call("Page.close")
            self._socket.close()
            shutil.rmtree(self.downloads, ignore_errors=True)
