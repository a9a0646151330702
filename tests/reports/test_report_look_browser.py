"""Touch, the view in three dimensions, themes and paper in a real browser; see :mod:`browsing`."""

import base64
import re
import shutil

import numpy as np
import pytest
from browsing import (
    center,
    colored,
    enlarge,
    faint,
    fits,
    level,
    one,
    open_page,
    pixels,
    show_layers,
    texts,
    until,
    use_theme,
    watched,
)
from selenium import webdriver
from selenium.webdriver.common.by import By

from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.participant import participant_page


@pytest.fixture
def visit(browser, shown):
    """Open a page at a width; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        use_theme(browser, "light")
        yield lambda name, width=1280: open_page(browser, shown / name, width)


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
    button = center(browser, one(browser, ".panel:nth-of-type(3) .enlarge"))
    drag(browser, button, 0, 0)
    until(lambda: texts(browser, "dialog[open] .facts"))
    assert fits(browser, 390)
    canvas, start = one(browser, "dialog canvas"), level(browser)
    assert canvas.size["width"] <= 390
    drag(browser, canvas, 0, -60)
    until(lambda: level(browser) == start + 4)
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
    entry = one(browser, "[id$=-status-right-1]")
    assert not entry.is_displayed()
    one(browser, ".pins button").click()
    assert entry.is_displayed()
    assert browser.switch_to.active_element == entry
    # The ball itself does the same, and no point of the sheet is picked.
    browser.execute_script("arguments[0].closest('details').open = false", entry)
    view(browser)
    pin = one(browser, ".pins button")
    left, top = (
        float(re.search(rf"{side}: ([\d.]+)%", pin.get_attribute("style"))[1]) / 100
        for side in ("left", "top")
    )
    x, y = (left - 0.5) * solid.size["width"], (top - 0.5) * solid.size["height"]
    for above in range(16, 0, -2):  # of the ball, the sheet covers all but the upper rim
        click = webdriver.ActionChains(browser)
        click.move_to_element_with_offset(solid, round(x), round(y) - above).click().perform()
        if entry.is_displayed():
            break
    assert entry.is_displayed()
    assert texts(browser, ".values dt") == []


@pytest.mark.parametrize("width", [1280, 390])
def test_the_sheet_in_three_dimensions_is_clear_of_its_frame(visit, width):
    browser = visit("sub-01.html", width)
    browser.execute_script("document.querySelector('.pins').hidden = true")
    picture = pixels(view(browser))
    for edge in (picture[:6], picture[-6:], picture[:, :6], picture[:, -6:]):
        assert colored(edge) == 0


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
        enlarge(browser, ".enlarge")
    seen, found = faint(browser)
    assert seen > 30
    assert found == []


def test_the_dark_theme_has_no_white_boxes_and_the_same_colors_of_values(visit):
    browser = visit("sub-02.html")
    selectors = (".beside img", ".pictures img", ".panel canvas", ".solid")

    def shots(theme):
        use_theme(browser, theme)
        view(browser)
        until(lambda: one(browser, ".compass").is_displayed())
        elements = [e for s in selectors for e in browser.find_elements(By.CSS_SELECTOR, s)]
        return [pixels(center(browser, element)) for element in elements]

    show_layers(browser, "columns")
    light, dark = shots("light"), shots("dark")
    assert len(light) > 10
    for a, b in zip(light, dark, strict=True):
        # White at zero is left on maps of curvature.
        assert (a > 240).all(axis=-1).mean() - (b > 200).all(axis=-1).mean() > 0.2
        assert (b[:4] > 200).all(axis=-1).mean() == (b[-4:] > 200).all(axis=-1).mean() == 0
    maps = len(texts(browser, ".beside img, [id$=-sheet] img"))
    for a, b in zip(light[:maps], dark[:maps], strict=True):
        values = [picture[np.ptp(picture, axis=-1) > 80].mean(axis=0) for picture in (a, b)]
        assert np.abs(np.subtract(*values)).max() < 8  # places differ by parts of a pixel


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
    for selector in ("nav", ".controls", ".toggles", ".rating", ".solid", ".pins"):
        elements = browser.find_elements(By.CSS_SELECTOR, selector)
        assert elements
        assert not any(element.is_displayed() for element in elements)
    still = center(browser, one(browser, ".still"))
    assert colored(pixels(still)) > 0.02
    for selector in (".beside .legend", ".bar .gradient", ".panel canvas", ".picture img"):
        assert one(browser, selector).is_displayed()
    exact = "return getComputedStyle(arguments[0]).printColorAdjust"
    assert browser.execute_script(exact, one(browser, ".swatch")) == "exact"
