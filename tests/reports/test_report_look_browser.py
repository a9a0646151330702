"""Slices, the view in three dimensions, themes and paper in a real browser; see :mod:`browsing`."""

import base64
import re
import shutil

import numpy as np
import pytest
from browsing import (
    colored,
    faint,
    fits,
    one,
    open_page,
    pixels,
    texts,
    until,
    use_theme,
    watched,
)
from selenium import webdriver
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.participant import participant_page


@pytest.fixture
def visit(browser, shown):
    """Open a page at a width; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        use_theme(browser, "light")
        yield lambda name, width=1280: open_page(browser, shown / name, width)


def center(browser, element):
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    return element


def enlarge(browser, selector):
    """Click a slice, and wait for the large one."""
    button = center(browser, one(browser, selector))
    button.click()
    until(lambda: texts(browser, "dialog[open] .facts"))
    return button


def level(browser):
    return int(re.match(r"Slice (\d+) of", texts(browser, "dialog .facts")[0])[1])


def press(browser, *keys):
    browser.switch_to.active_element.send_keys(*keys)


def test_a_slice_enlarges_moves_and_closes_by_keys(visit):
    browser = visit("sub-01.html")
    button = one(browser, "[id$=-input] .enlarge")
    browser.execute_script("arguments[0].focus()", button)
    press(browser, Keys.ENTER)
    until(lambda: texts(browser, "dialog[open] .facts"))
    first = level(browser)
    assert first == int(button.get_attribute("data-level")) + 1
    assert "norm.mgz" in texts(browser, "dialog .facts")[0]
    canvas = one(browser, "dialog canvas")
    assert canvas.size["width"] > 2.5 * button.size["width"]
    assert colored(pixels(canvas)) > 0.01
    before = pixels(canvas)
    press(browser, Keys.ARROW_UP, Keys.ARROW_UP, Keys.ARROW_LEFT)
    assert level(browser) == first + 1
    assert (pixels(canvas) != before).any(axis=-1).mean() > 0.05
    press(browser, Keys.PAGE_UP)
    assert level(browser) == first + 6
    # It ends with the first and last slice.
    last = int(texts(browser, "dialog .facts")[0].split(" of ")[1].split(",")[0])
    press(browser, Keys.END, Keys.ARROW_UP)
    assert level(browser) == last
    press(browser, Keys.HOME, Keys.ARROW_DOWN)
    assert level(browser) == 1
    press(browser, Keys.ESCAPE)
    assert browser.find_elements(By.CSS_SELECTOR, "dialog[open]") == []
    assert browser.switch_to.active_element == button


def test_a_slice_moves_by_wheel_and_buttons_and_hides_its_layers(visit):
    browser = visit("sub-01.html")
    enlarge(browser, "[id$=-input] .panel:nth-of-type(3) .enlarge")
    canvas, first = one(browser, "dialog canvas"), level(browser)
    origin = ScrollOrigin.from_element(canvas)
    webdriver.ActionChains(browser).scroll_from_origin(origin, 0, 120).perform()
    until(lambda: level(browser) == first - 3)
    one(browser, "dialog [aria-label='Next slice']").click()
    assert level(browser) == first - 2
    one(browser, "dialog [aria-label='Previous slice']").click()
    assert level(browser) == first - 3
    whole = pixels(canvas)
    one(browser, "dialog [value=labels]").click()
    plain = pixels(canvas)
    assert colored(whole) > 0.01 > colored(plain)
    one(browser, "dialog [value=anatomy]").click()
    # Letters, a ruler and the outline on white are left.
    white = (pixels(canvas) > 250).all(axis=-1).mean()
    assert white > 0.8 > (plain > 250).all(axis=-1).mean() + 0.5
    one(browser, "dialog [value=body]").click()
    assert (pixels(canvas) > 250).all(axis=-1).mean() > white + 0.005
    one(browser, "dialog [aria-label=Close]").click()
    assert browser.find_elements(By.CSS_SELECTOR, "dialog[open]") == []


def test_labels_in_the_large_slice_have_the_colors_of_the_small_one(visit):
    browser = visit("sub-02.html")  # without an image behind, on white
    button = center(browser, one(browser, "[id$=-input] .panel:nth-of-type(3) .enlarge"))
    for name in ("mask", "surfaces", "plane"):
        center(browser, one(browser, f".t-{name}")).click()
    center(browser, button)

    def common(picture):
        colors, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
        most = colors[counts > 0.004 * counts.sum()]
        return {tuple(color) for color in most.tolist() if max(color) - min(color) > 20}

    small = common(pixels(button))
    enlarge(browser, "[id$=-input] .panel:nth-of-type(3) .enlarge")
    one(browser, "dialog [value=body]").click()
    large = common(pixels(one(browser, "dialog canvas")))
    assert len(large) >= 3
    assert all(min(np.abs(np.subtract(a, b)).max() for b in small) <= 2 for a in large)


def test_the_slice_of_a_point_has_its_cross(visit):
    browser = visit("sub-02.html")
    enlarge(browser, "[id$=-points] details[open] .enlarge")
    canvas = one(browser, "dialog canvas")
    one(browser, "dialog [value=labels]").click()
    there = colored(pixels(canvas))
    press(browser, Keys.PAGE_UP)
    assert there > 0.002
    assert colored(pixels(canvas)) == 0


def touch(browser, kind, *points):
    places = [{"x": x, "y": y} for x, y in points]
    browser.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})


def drag(browser, element, dx, dy):
    box = browser.execute_script("return arguments[0].getBoundingClientRect()", element)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch(browser, "touchStart", (x, y))
    for n in range(1, 9 if dx or dy else 1):  # a slow tap would be a long press
        touch(browser, "touchMove", (x + dx * n / 8, y + dy * n / 8))
    touch(browser, "touchEnd")


@pytest.fixture
def phone(browser):
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    yield
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


@pytest.mark.usefixtures("phone")
def test_slices_and_the_view_work_by_touch_on_a_phone(visit):
    browser = visit("sub-01.html", 390)
    button = center(browser, one(browser, "[id$=-input] .panel:nth-of-type(3) .enlarge"))
    drag(browser, button, 0, 0)
    until(lambda: texts(browser, "dialog[open] .facts"))
    assert fits(browser, 390)
    canvas, first = one(browser, "dialog canvas"), level(browser)
    assert canvas.size["width"] <= 390
    drag(browser, canvas, 0, -60)
    until(lambda: level(browser) == first + 4)
    close = one(browser, "dialog [aria-label=Close]")

    def closed():
        if not browser.find_elements(By.CSS_SELECTOR, "dialog[open]"):
            return True
        drag(browser, close, 0, 0)  # the first tap after a swipe may only end its momentum
        return False

    until(closed)
    solid = center(browser, one(browser, ".solid"))
    until(lambda: colored(pixels(solid)) > 0.02)
    before = pixels(solid)
    assert solid.rect["x"] >= 0
    assert solid.rect["x"] + solid.size["width"] <= 370  # a strip beside it scrolls the page
    drag(browser, solid, 90, 10)
    until(lambda: (np.abs(pixels(solid) - before).max(axis=-1) > 40).mean() > 0.03)


def view(browser):
    solid = center(browser, one(browser, ".solid"))
    until(lambda: colored(pixels(solid)) > 0.02)
    return solid


def test_edges_planes_and_points_of_the_view_are_named(visit):
    browser = visit("sub-01.html")
    view(browser)
    assert texts(browser, ".pins span") == ["medial edge", "lateral edge"]
    one(browser, ".show [value=planes]").click()
    ends = ["posterior end plane", "anterior end plane"]
    assert texts(browser, ".pins span") == ["medial edge", "lateral edge", *ends]
    one(browser, ".show [value=boundaries]").click()
    assert texts(browser, ".pins span") == ends
    assert texts(browser, ".side .ends b") == ["A", "P"]
    one(browser, ".sides label:nth-of-type(2) input").click()
    numbers = texts(browser, ".pins button")
    assert numbers == [str(n + 1) for n in range(len(numbers))] != []


def test_a_click_on_a_point_opens_what_is_said_about_it(visit):
    browser = visit("sub-01.html")
    solid = view(browser)
    one(browser, ".sides label:nth-of-type(2) input").click()
    until(lambda: texts(browser, ".pins button"))
    entry = one(browser, "[id$=-points-right-1]")
    assert entry.get_attribute("open") is None
    one(browser, ".pins button").click()
    assert entry.get_attribute("open") is not None
    assert browser.switch_to.active_element == entry.find_element(By.TAG_NAME, "summary")
    # The ball itself does the same, and no point of the sheet is picked.
    browser.execute_script("arguments[0].open = false", entry)
    view(browser)
    pin = one(browser, ".pins button")
    left, top = (
        float(re.search(rf"{side}: ([\d.]+)%", pin.get_attribute("style"))[1]) / 100
        for side in ("left", "top")
    )
    size = solid.size
    webdriver.ActionChains(browser).move_to_element_with_offset(
        solid, round((left - 0.5) * size["width"]), round((top - 0.5) * size["height"])
    ).click().perform()
    until(lambda: entry.get_attribute("open") is not None)
    assert texts(browser, ".values dt") == []


#: Pixels of the sheet, and the colors that its legend has for the nodes there.
_NODES = """
const viewer = document.querySelector(".viewer").viewer, box = viewer.solid.getBoundingClientRect();
const colors = viewer.colors(), found = [], ny = viewer.scene.shape[1], pick = viewer.pick;
for (let x = 0.2; x < 0.8; x += 0.03) {
  for (let y = 0.2; y < 0.8; y += 0.03) {
    let node = null;
    viewer.pick = (i, j) => { node = [i, j]; };
    viewer.pickAt({ clientX: box.left + x * box.width, clientY: box.top + y * box.height });
    if (node) found.push([x, y, colors[node[0] * ny + node[1]]]);
  }
}
viewer.pick = pick;
return found;
"""


@pytest.mark.parametrize("kind", ["thickness", "subfield"])
def test_colors_of_the_sheet_are_those_of_the_legend_but_for_shade(visit, kind):
    browser = visit("sub-01.html")
    solid = view(browser)
    for name in ("boundaries", "findings"):
        one(browser, f".show [value={name}]").click()
    one(browser, f".colors option[value={kind}]").click()
    browser.execute_script("document.querySelector('.pins').hidden = true")
    browser.execute_script("document.querySelector('.compass').hidden = true")
    before = None
    while before is None or (before != pixels(solid)).any():
        before = pixels(solid)
    rows, columns = before.shape[:2]
    shades, rests = [], []
    for x, y, color in browser.execute_script(_NODES):
        seen = before[int(y * rows), int(x * columns)]
        legend = 255 * np.array(color)
        shade = seen @ legend / (legend @ legend)
        shades.append(shade)
        rests.append(np.abs(seen - shade * legend).max())
    assert len(shades) > 50
    # Light makes colors darker, up to 40 %, and leaves their hue; between nodes they are mixed.
    assert 0.55 < np.percentile(shades, 10) < np.percentile(shades, 98) < 1.05
    assert np.median(shades) > 0.65
    assert np.median(rests) < 8
    assert np.percentile(rests, 85) < 30
    # Shells and planes are lines: what is between them keeps its color.
    sheet = np.ptp(before, axis=-1) > 60
    for name in ("interior", "exterior", "planes"):
        one(browser, f".show [value={name}]").click()
    until(lambda: (pixels(solid) != before).any(axis=-1).mean() > 0.02)
    same = (np.abs(pixels(solid) - before).max(axis=-1) <= 2)[sheet]
    assert same.mean() > 0.5


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html", "report.html"])
def test_texts_can_be_read_in_both_themes(visit, name, theme):
    browser = visit(name)
    use_theme(browser, theme)
    back = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", back)[:3])) < 150) == (theme == "dark")
    for details in browser.find_elements(By.CSS_SELECTOR, "details"):
        browser.execute_script("arguments[0].open = true", details)
    if name != "report.html":
        enlarge(browser, "[id$=-input] .enlarge")
    seen, found = faint(browser)
    assert seen > 30
    assert found == []


def test_pictures_are_on_white_in_the_dark_theme(visit):
    browser = visit("sub-02.html")
    light = [pixels(e) for e in browser.find_elements(By.CSS_SELECTOR, ".picture img")]
    use_theme(browser, "dark")
    dark = [pixels(e) for e in browser.find_elements(By.CSS_SELECTOR, ".picture img")]
    for a, b in zip(light, dark, strict=True):
        # Their places differ by parts of a pixel.
        assert abs(a.mean() - b.mean()) < 2
        assert (b > 250).all(axis=-1).mean() > 0.2
    panel = one(browser, "[id$=-input] .panel svg")
    assert (pixels(center(browser, panel)) > 240).all(axis=-1).mean() > 0.2


def printed(browser):
    """Print a page: the number of sheets of A4."""
    answer = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    paper = base64.b64decode(answer["data"])
    sizes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", paper)
    assert {(round(float(w)), round(float(h))) for w, h in sizes} == {(595, 842)}
    return len(re.findall(rb"/Type /Page\b", paper))


@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html"])
def test_a_hemisphere_takes_two_sheets_of_paper(visit, name):
    assert printed(visit(name)) <= 4  # two hemispheres


def test_a_page_of_one_hemisphere_takes_two_sheets(browser, shown, tmp_path):
    root = shutil.copytree(shown, tmp_path / "out")
    for record in (root / "sub-01/anat").glob("*hemi-L*qc_metrics.json"):
        record.unlink()
    (tmp_path / "in").symlink_to(shown.with_name("in"))
    text = participant_page(root, "01", None, read_cohort(root), tmp_path / "in")
    (root / "one.html").write_text(text)
    with watched(browser):
        assert printed(open_page(browser, root / "one.html")) <= 2


def test_paper_has_pictures_and_legends_but_no_controls(visit):
    browser = visit("sub-01.html")
    printed(browser)  # as the view has not been looked at, it is drawn for this
    use_theme(browser, "light", "print")
    for selector in ("nav", ".controls", ".toggles", ".solid", ".pins"):
        elements = browser.find_elements(By.CSS_SELECTOR, selector)
        assert elements
        assert not any(element.is_displayed() for element in elements)
    still = center(browser, one(browser, ".still"))
    assert colored(pixels(still)) > 0.02
    for selector in ("[id$=-input] .legend", ".bar .gradient", "[id$=-input] svg", ".picture img"):
        assert one(browser, selector).is_displayed()
    exact = "return getComputedStyle(arguments[0]).printColorAdjust"
    assert browser.execute_script(exact, one(browser, ".swatch")) == "exact"
