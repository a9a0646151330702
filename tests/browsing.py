"""A real browser for tests of pages: Chromium without a network.

Skipped unless HIPSTA_BIDS_BROWSER=required, which ``tools/test-reports`` sets.
"""

import contextlib
import io
import os
import re
import shutil
import time

import numpy as np
import pytest
from PIL import Image

selenium = pytest.importorskip("selenium", reason="selenium is not installed")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402

FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--hide-scrollbars",
)
#: What Chromium says of its own speed when pixels are read.
NOISE = "GL Driver Message"


@contextlib.contextmanager
def open_browser(folder):
    """Start a browser that keeps its profile and what it downloads in a folder."""
    if os.environ.get("HIPSTA_BIDS_BROWSER") != "required":
        pytest.skip("takes a browser: run tools/test-reports")
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.fail("no chromium or chromedriver on the PATH")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    profile, downloads = (folder / name for name in ("profile", "downloads"))
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    session = webdriver.Chrome(options=options, service=Service(driver))
    session.downloads = downloads
    downloads.mkdir()
    session.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(downloads)}
    )
    try:
        yield session
    finally:
        session.quit()


@contextlib.contextmanager
def watched(browser):
    """Afterwards nothing may have gone wrong or outside."""
    browser.get_log("browser")
    browser.get_log("performance")
    yield
    said = [entry["message"] for entry in browser.get_log("browser")]
    assert [message for message in said if NOISE not in message] == []
    sent = [entry["message"] for entry in browser.get_log("performance")]
    asked = [message for message in sent if '"Network.requestWillBeSent"' in message]
    own = re.compile('"url":"(file|data|blob):')
    assert asked
    assert [message for message in asked if not own.search(message)] == []


def open_page(browser, path, width=1280):
    """Open a file in a window of some width."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(path.as_uri())
    return browser


def fits(browser, width):
    """Tell whether a page is no wider than its window, and all its pictures are there."""
    broken = "return [...document.images].filter(i => !i.complete || !i.naturalWidth).length"
    wide = browser.execute_script("return document.documentElement.scrollWidth")
    return wide <= width and browser.execute_script(broken) == 0


def one(browser, selector):
    return browser.find_element(By.CSS_SELECTOR, selector)


def texts(browser, selector):
    return [element.text for element in browser.find_elements(By.CSS_SELECTOR, selector)]


def until(condition, seconds=10.0):
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def pixels(element):
    return np.asarray(Image.open(io.BytesIO(element.screenshot_as_png)).convert("RGB")).astype(int)


def colored(picture):
    """Share of the pixels that have a color, which neither the background nor letters have."""
    return float((np.ptp(picture, axis=-1) > 40).mean())
