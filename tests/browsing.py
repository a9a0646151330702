"""A real browser for tests of pages: Chromium without a network."""

import contextlib
import io
import os
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

selenium = pytest.importorskip("selenium", reason="selenium is not installed")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

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


def use_theme(browser, theme, media=""):
    """Let a page believe that its reader prefers ``light`` or ``dark``, on ``screen`` or paper."""
    feature = {"name": "prefers-color-scheme", "value": theme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": [feature]})


#: Contrast as in WCAG 2.1 of the visible texts with what is behind them.
_FAINT = """
const number = (text) => {
  const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
  return [r, g, b, a];
};
const over = ([r, g, b, a], back) => [r, g, b].map((v, k) => a * v + (1 - a) * back[k]);
const behind = (element) => {
  const layers = [];
  for (let up = element; up; up = up.parentElement) {
    layers.push(number(getComputedStyle(up).backgroundColor));
  }
  return layers.reverse().reduce((back, layer) => over(layer, back), [255, 255, 255]);
};
const light = (color) => {
  const [r, g, b] = color.map((v) => v / 255).map(
    (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const found = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
let seen = 0;
while (walker.nextNode()) {
  const element = walker.currentNode.parentElement, text = walker.currentNode.textContent.trim();
  if (!text || !element.checkVisibility() || element.closest("script, style, :disabled")) continue;
  seen += 1;
  const style = getComputedStyle(element), back = behind(element);
  const front = over(number(element instanceof SVGElement ? style.fill : style.color), back);
  const [low, high] = [light(front), light(back)].sort((a, b) => a - b);
  const ratio = (high + 0.05) / (low + 0.05);
  if (ratio < 4.5) found.push([text.slice(0, 40), ratio.toFixed(2), front.join(), back.join()]);
}
return [seen, found];
"""


def faint(browser):
    """Count the visible texts of a page, and list those that are hard to read."""
    return browser.execute_script(_FAINT)


#: Visible elements that react to keys, in the order of the page; of radio buttons one of a group.
_CONTROLS = """
const kinds = "a[href], button, input, select, textarea, summary, [tabindex]";
const groups = new Set();
return [...document.querySelectorAll(kinds)].filter((one) => {
  if (one.tabIndex < 0 || one.disabled || one.type === "hidden") return false;
  if (!one.checkVisibility({visibilityProperty: true}) || one.closest("[inert]")) return false;
  if (one.type !== "radio") return true;
  const known = groups.has(one.name);
  groups.add(one.name);
  return !known;
});
"""

#: What has the focus: its group if it is a radio button, and whether a mark shows the focus.
_FOCUS = """
const one = document.activeElement, style = getComputedStyle(one);
const mark = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 1;
return [one, one.type === "radio" ? one.name : "", mark || style.boxShadow !== "none"];
"""

#: Roles that people operate; each needs a name.
_OPERATED = {
    *("button", "link", "checkbox", "radio", "combobox", "textbox", "searchbox", "slider"),
    *("spinbutton", "listbox", "menuitem", "switch", "tab", "image", "region"),
}


def unreached(browser):
    """Press Tab through a page: list controls that are passed over, or have no visible focus."""
    controls = browser.execute_script(_CONTROLS)
    browser.execute_script("document.activeElement.blur(); window.scrollTo(0, 0)")
    groups, reached, faint_ones = set(), set(), []
    for _ in range(len(controls) + 3):
        webdriver.ActionChains(browser).send_keys(Keys.TAB).perform()
        element, group, is_marked = browser.execute_script(_FOCUS)
        if element.tag_name == "body":
            continue
        reached.add(element.id)
        groups.add(group)
        if not is_marked:
            faint_ones.append(element.get_attribute("outerHTML")[:120])
    passed_over = [
        element.get_attribute("outerHTML")[:120]
        for element in controls
        if element.id not in reached
        and not (
            element.get_attribute("type") == "radio" and element.get_attribute("name") in groups
        )
    ]
    return len(controls), passed_over, faint_ones


def unnamed(browser):
    """Count the controls and pictures in the tree for screen readers; list those without a name."""
    nodes = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    roles = [
        (node["role"]["value"], node.get("name", {}).get("value", "").strip())
        for node in nodes
        if not node["ignored"] and node["role"]["value"] in _OPERATED
    ]
    return len(roles), [role for role, name in roles if not name]


def violations(browser):
    """List what axe-core finds, if ``HIPSTA_BIDS_AXE`` names its file (``npm pack axe-core``)."""
    file = os.environ.get("HIPSTA_BIDS_AXE")
    if not file:
        pytest.skip("HIPSTA_BIDS_AXE does not name axe.min.js")
    browser.execute_script(Path(file).read_text("utf-8"))
    script = "axe.run().then(arguments[0], (error) => arguments[0]({error: String(error)}))"
    report = browser.execute_async_script(script)
    assert len(report["passes"]) > 10, report.get("error")
    return [
        (one["id"], node["html"][:160]) for one in report["violations"] for node in one["nodes"]
    ]


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


def center(browser, element):
    """Scroll an element to the middle of the window."""
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    return element


def enlarge(browser, selector):
    """Click a slice, and wait for the large one."""
    button = center(browser, one(browser, selector))
    button.click()
    until(lambda: texts(browser, "dialog[open] .facts"))
    return button


def show_layers(browser, *layers):
    """Show these layers of slices only."""
    for box in browser.find_elements(By.CSS_SELECTOR, ".card:first-of-type .toggles input"):
        if box.is_selected() != (box.get_attribute("value") in layers):
            box.click()


def level(browser):
    """Number of the slice that is shown enlarged."""
    return int(re.match(r"Slice (\d+) of", texts(browser, "dialog .facts")[0])[1])
