"""A headless Chromium for tests that look at pages as a person would."""

from __future__ import annotations

import base64
import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

# Debian calls them chromium and chromium-driver.
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Without a graphics card, WebGL is computed by SwiftShader. Nothing but the page asked for is to
# be fetched, the browser's own housekeeping included.
OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--disable-component-update", "--disable-default-apps", "--disable-sync", "--no-first-run",
    "--hide-scrollbars", "--force-device-scale-factor=1",
)  # fmt: skip
LOCAL = {"127.0.0.1", "localhost", "::1"}


class Browser:
    """One page, and what it asked of the network and said to the console."""

    def __init__(self, driver: Chrome) -> None:
        self.driver = driver
        self._events: list[dict[str, Any]] = []

    def events(self) -> list[dict[str, Any]]:
        """The network's events since the start, in the words of Chrome's DevTools protocol."""
        for entry in self.driver.get_log("performance"):
            self._events.append(json.loads(entry["message"])["message"])
        return self._events

    def foreign_requests(self) -> list[str]:
        """Addresses asked for that are neither this machine's nor inside the page itself."""
        addresses = [
            event["params"]["request"]["url"]
            for event in self.events()
            if event["method"] == "Network.requestWillBeSent"
        ]
        addresses += [
            event["params"]["url"]
            for event in self.events()
            if event["method"] == "Network.webSocketCreated"
        ]
        return [url for url in addresses if not _is_local(url)]

    def console_errors(self) -> list[str]:
        """What the console holds at the level of errors."""
        return [e["message"] for e in self.driver.get_log("browser") if e["level"] == "SEVERE"]

    def picture(self, path: Path | None = None) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, the window as it looks; kept at ``path`` where one is given."""
        # Unlike get_screenshot_as_png, this waits for nothing but the next frame.
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
        data = base64.b64decode(shot["data"])
        if path is not None:
            path.write_bytes(data)
        with Image.open(io.BytesIO(data)) as image:
            return np.array(image.convert("RGB"))

    def text(self) -> str:
        """What can be read on the page."""
        return str(self.driver.execute_script("return document.body.innerText"))

    def resize(self, width: int, height: int) -> None:
        """Give the page ``width`` x ``height`` CSS pixels."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600},
        )


@contextmanager
def open_browser(*, width: int = 1280, height: int = 800) -> Iterator[Browser]:
    """A browser with an empty page; the test is skipped, with the reason, where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    driver_path = shutil.which("chromedriver")
    if binary is None or driver_path is None:
        pytest.skip("no chromium and chromedriver (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for option in (*OPTIONS, f"--window-size={width},{height}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    service = webdriver.ChromeService(driver_path)
    driver = webdriver.Chrome(options=options, service=service)
    try:
        browser = Browser(driver)
        browser.resize(width, height)
        yield browser
    finally:
        driver.quit()


def _is_local(url: str) -> bool:
    parts = urlsplit(url)
    if parts.scheme in ("data", "blob", "about", "file", "chrome", "devtools"):
        return True
    return parts.hostname in LOCAL
