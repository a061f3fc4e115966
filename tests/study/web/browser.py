"""Pages in a browser, and whether they could ask a network for anything."""

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = {  # names of vocabularies and in comments, which are never requested
    "http://www.w3.org/1999/xhtml",
    "http://www.w3.org/2000/svg",
    "https://threejs.org",
    "https://github.com/mrdoob/three.js/pull/23228",
}


def asks_nothing(text: str) -> None:
    """Checks that a page's policy forbids requests, that it names no other place, and that its scripts make none."""
    policy = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    first = min(text.find(each) % len(text) for each in ("<script", "<style", "<img"))
    assert policy and policy.start() < first
    rules = dict(rule.strip().split(" ", 1) for rule in policy[1].split(";"))
    assert {rules[name] for name in ("default-src", "form-action", "base-uri")} == {"'none'"}
    assert not any("http" in each or "*" in each or "connect" in each for each in policy[1].split())
    assert not re.search(r'(?:src|href|action)\s*=\s*["\']?\s*(?:https?:)?//', text)
    assert set(re.findall(r"https?://[\w./-]+", text)) <= NAMES
    scripts = re.findall(r"(?s)<script>(.*?)</script>", text)
    own = "".join(script for script in scripts if "@license" not in script)
    assert not re.search(r"\b(fetch|XMLHttpRequest|WebSocket|EventSource|sendBeacon|import)\b\s*\(", own)


class Browser:
    """Holds a page in headless Chromium, its console output and its requests."""

    def __init__(self, chromium: Any, path: Path, width: int, height: int, first: str = "") -> None:
        self.page = chromium.new_page(viewport={"width": width, "height": height})
        if first:  # a script that runs before the page's own
            self.page.add_init_script(first)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.set_default_timeout(120_000)  # ms; a busy machine draws slowly
        self.page.goto(path.as_uri())

    def until(self, holds: str) -> None:
        """Waits for what a script says; Playwright's own waiting evaluates text, which the pages do not allow."""
        end = time.monotonic() + 60.0
        while not self.page.evaluate(f"() => {holds}"):
            assert time.monotonic() < end, holds
            time.sleep(0.05)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Yields a browser, or skips the test if there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (requirements-optional.txt)"
    )
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium here")
    with playwright.sync_playwright() as started:
        # drawn in software: a machine without a display has no other WebGL
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = started.chromium.launch(executable_path=path, args=flags)
        yield browser
        browser.close()
