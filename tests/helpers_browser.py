"""Headless Chromium through its own driver: the W3C WebDriver protocol over HTTP, nothing else."""

import contextlib
import importlib.resources
import json
import os
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions",
    "--disable-dev-shm-usage", "--force-prefers-reduced-motion",
]  # fmt: skip

SHELL = "chromium-headless-shell"

KEYS = {"tab": "\ue004", "enter": "\ue007", "space": " ", "down": "\ue015", "right": "\ue014",
        "shift": "\ue008"}  # fmt: skip

BROKEN = r"""
    const broken = [];
    for (const cell of document.querySelectorAll("th, td")) {
      if (!cell.checkVisibility()) continue;
      const walker = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT);
      for (let node = walker.nextNode(); node; node = walker.nextNode()) {
        for (const word of node.data.matchAll(/\p{N}+\.\p{N}+|[\p{L}\p{N}]+/gu)) {
          const range = document.createRange();
          range.setStart(node, word.index);
          range.setEnd(node, word.index + word[0].length);
          const boxes = [...range.getClientRects()].filter((box) => box.width);
          if (new Set(boxes.map((box) => Math.round(box.top))).size > 1) broken.push(word[0]);
        }
      }
    }
    return broken;
"""
"""A script: words and numbers in cells of tables that stand on more than one line."""

SERIOUS = """
    if (arguments[0]) for (const node of document.querySelectorAll(arguments[0])) node.remove();
    return axe.run(document, { resultTypes: ["violations"] }).then(({ violations }) => violations
      .filter(({ impact }) => ["serious", "critical"].includes(impact))
      .map(({ id, nodes }) => `${id}: ${nodes.slice(0, 3).map((n) => n.html.slice(0, 160))}`));
"""
"""A script: what axe-core finds that keeps somebody from reading or using the page."""

_ELEMENT = "element-6066-11e4-a52e-4f735466cecf"


def programs():
    """Paths of the browser and its driver; None where one is missing.

    The shell comes first: without windows and toolbars it takes a third less processor time.
    """
    names = SHELL, "chromium", "chromium-browser", "google-chrome"
    browser = next(filter(None, map(shutil.which, names)), None)
    return (browser, driver) if browser and (driver := shutil.which("chromedriver")) else None


class Browser:
    """One browser window. Every method waits for what it asks for."""

    def __init__(self, address):
        self._address = address
        self._session = ""

    def open_session(self, browser, profile, size):
        capabilities = {
            "browserName": "chrome-headless-shell" if Path(browser).name == SHELL else "chrome",
            "goog:chromeOptions": {
                "binary": browser,
                "args": [*FLAGS, f"--user-data-dir={profile}", f"--window-size={size}"],
            },
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
            # Milliseconds in which an element may appear, and in which a script has to end.
            "timeouts": {"implicit": 10_000, "script": 55_000},
        }
        found = self._call("POST", "/session", {"capabilities": {"alwaysMatch": capabilities}})
        self._session = f"/session/{found['sessionId']}"

    def close(self):
        self._call("DELETE", self._session)

    def open(self, url):
        self._call("POST", f"{self._session}/url", {"url": url})

    def run(self, script, *arguments):
        """Run the body of a function in the page and return what it returns."""
        body = {"script": script, "args": list(arguments)}
        return self._call("POST", f"{self._session}/execute/sync", body)

    def wait_for(self, condition, seconds=10):
        """Wait until an expression is true in the page."""
        until = time.monotonic() + seconds
        while not self.run(f"return Boolean({condition})"):
            if time.monotonic() > until:
                raise TimeoutError(f"never became true: {condition}")
            time.sleep(0.02)

    def texts(self, selector):
        """Visible texts of all elements that match."""
        return self.run(
            "const found = [...document.querySelectorAll(arguments[0])];"
            "return found.map((e) => (e.innerText ?? e.textContent).trim())",
            selector,
        )

    def text(self, selector):
        (found,) = self.texts(selector)
        return found

    def click(self, selector):
        element = self._find(selector)
        self._call("POST", f"{self._session}/element/{element}/click", {})

    def choose(self, name, text):
        """Choose an option of a select element, as a person does who types its first letters."""
        script = """
            const select = document.querySelector(`select[name="${arguments[0]}"]`);
            const option = [...select.options].find((o) => o.text === arguments[1]);
            if (!option) throw new Error(`no option ${arguments[1]}`);
            select.value = option.value;
            select.dispatchEvent(new Event("change", { bubbles: true }));
        """
        self.run(script, name, text)
        self.wait_for("!document.querySelector('[aria-busy]')")

    def press(self, *names):
        """Press keys, or chords such as ``shift+tab``, on whatever has the focus."""
        actions = []
        for chord in names:
            keys = [KEYS[name] for name in chord.split("+")]
            actions += [{"type": "keyDown", "value": key} for key in keys]
            actions += [{"type": "keyUp", "value": key} for key in reversed(keys)]
        body = {"actions": [{"type": "key", "id": "keyboard", "actions": actions}]}
        self._call("POST", f"{self._session}/actions", body)

    @contextlib.contextmanager
    def narrow(self, width, height=900):
        """Let pages have a width, also one below the least of a window, as telephones have."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        self._command("Emulation.setDeviceMetricsOverride", size)
        try:
            yield
        finally:
            self._command("Emulation.clearDeviceMetricsOverride")

    @contextlib.contextmanager
    def colours(self, theme):
        """Let the system ask pages for light or dark colours."""
        features = [{"name": "prefers-color-scheme", "value": theme}]
        self._command("Emulation.setEmulatedMedia", {"features": features})
        try:
            yield
        finally:
            self._command("Emulation.setEmulatedMedia", {"features": []})

    def defects(self, width, alike=""):
        """Sideways scrolling of a page in a window, broken words in cells, findings of axe.

        Elements that `alike` selects are removed before axe looks, which takes long over many.
        """
        assert self.run("return matchMedia(`(width: ${arguments[0]}px)`).matches", width)
        needed, available = self.run(
            "const e = document.documentElement; return [e.scrollWidth, e.clientWidth]"
        )
        defects = [f"scrolls sideways: {needed}"] if needed > available else []
        defects += [f"broken: {word}" for word in self.run(BROKEN)]
        axe = importlib.resources.files("axe_core_python") / "axe.min.js"
        self.run(axe.read_text(encoding="utf-8") + ";window.axe ??= axe;")
        return defects + self.run(SERIOUS, alike)

    def console(self):
        """Messages of the console since the last call."""
        return [m["message"] for m in self._log("browser")]

    def requests(self):
        """Addresses that the page asked for since the last call."""
        events = [json.loads(entry["message"])["message"] for entry in self._log("performance")]
        return [
            e["params"]["request"]["url"]
            for e in events
            if e["method"] == "Network.requestWillBeSent"
        ]

    def processor_seconds(self):
        """Seconds that the page's process has run on a processor, whatever else runs."""
        self._command("Performance.enable")
        found = self._command("Performance.getMetrics")["metrics"]
        (seconds,) = [metric["value"] for metric in found if metric["name"] == "ProcessTime"]
        return seconds

    def _command(self, name, parameters=None):
        body = {"cmd": name, "params": parameters or {}}
        return self._call("POST", f"{self._session}/goog/cdp/execute", body)

    def _log(self, kind):
        return self._call("POST", f"{self._session}/se/log", {"type": kind})

    def _find(self, selector):
        body = {"using": "css selector", "value": selector}
        return self._call("POST", f"{self._session}/element", body)[_ELEMENT]

    def _call(self, method, path, body=None):
        data = json.dumps(body).encode() if body is not None else None
        request = urllib.request.Request(  # noqa: S310  the driver's own address
            self._address + path, data, {"Content-Type": "application/json"}, method=method
        )
        # The driver is on this machine, whatever proxy the environment names.
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(request, timeout=60) as answer:
                return json.loads(answer.read())["value"]
        except urllib.error.HTTPError as error:
            with error:
                raise RuntimeError(json.loads(error.read())["value"]["message"]) from None


@contextlib.contextmanager
def launch(directory, size="1280,1000"):
    """Start driver and browser with a profile in `directory`, and end both afterwards."""
    browser, program = programs()
    directory = Path(directory)
    log = directory / "driver.log"
    driver = subprocess.Popen(
        [program, "--port=0", f"--log-path={log}"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "HOME": str(directory)},
    )
    try:
        port = _port(driver)
        window = Browser(f"http://127.0.0.1:{port}")
        window.open_session(browser, directory / "profile", size)
        try:
            yield window
        finally:
            window.close()
    finally:
        driver.terminate()
        driver.wait(timeout=20)
        driver.stdout.close()


def _port(driver):
    """The port that the driver says it has chosen."""
    until = time.monotonic() + 30
    while time.monotonic() < until and (line := driver.stdout.readline()):
        if "started successfully on port" in line:
            return int(line.rstrip().rstrip(".").rpartition(" ")[2])
    raise RuntimeError("the driver did not start")
