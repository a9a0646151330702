"""The first screen of a page, and its slices, in a real browser; see :mod:`browsing`."""

import numpy as np
import pytest
from browsing import (
    center,
    colored,
    enlarge,
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
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from hipsta_bids.reports.results import find_results, read_views


@pytest.fixture
def visit(browser, shown):
    """Open a page at a width; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        use_theme(browser, "light")
        yield lambda name, width=1280: open_page(browser, shown / name, width)


def press(browser, *keys):
    browser.switch_to.active_element.send_keys(*keys)


#: Words that a reader sees before the first picture.
_WORDS = """
const picture = document.querySelector(".panel"), seen = [];
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode, parent = node.parentElement;
  if (picture.compareDocumentPosition(node) & Node.DOCUMENT_POSITION_FOLLOWING) break;
  const folded = parent.closest("details:not([open])") && !parent.closest("summary");
  if (!folded && parent.checkVisibility() && !parent.closest("script, style, .skip, .hidden")) {
    seen.push(...node.textContent.split(/\\s+/).filter(Boolean));
  }
}
return seen;
"""


def in_window(browser, selector):
    """Elements that lie in the window as a whole, above the bar with the rating."""
    script = (
        "const bar = document.querySelector('.rating').getBoundingClientRect().top;"
        "return [...document.querySelectorAll(arguments[0])].filter((element) => {"
        " const box = element.getBoundingClientRect();"
        " return box.width && box.top >= 0 && box.bottom <= bar && box.left >= 0"
        " && box.right <= innerWidth; })"
    )
    return browser.execute_script(script, selector)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html"])
def test_the_first_screen_has_decision_slices_map_and_rating(visit, name, theme):
    browser = visit(name)
    use_theme(browser, theme)
    card = ".card:first-of-type "
    slices = in_window(browser, f"{card}.panel canvas")
    assert len(slices) >= 3
    assert min(canvas.size["width"] for canvas in slices) >= 380
    until(lambda: all(colored(pixels(canvas)) > 0.01 for canvas in slices))
    for selector in (".verdict", ".why", ".toggles", ".beside img"):
        assert len(in_window(browser, card + selector)) == 1
    assert 0 < len(browser.execute_script(_WORDS)) <= 120
    bar = one(browser, f"{card}.rating")
    bottom = browser.execute_script("return arguments[0].getBoundingClientRect().bottom", bar)
    assert bottom == 900
    # The other side has a bar of its own, which keys are about while it is looked at.
    second = one(browser, ".card:nth-of-type(2)")
    browser.execute_script("arguments[0].scrollIntoView()", second)
    until(lambda: "current" in second.get_attribute("class"))
    assert one(browser, ".card:nth-of-type(2) .rating b").rect["y"] > 850


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html", "report.html"])
def test_no_verdict_is_cut_off_on_a_phone(visit, name, theme):
    browser = visit(name, 390)
    use_theme(browser, theme)
    assert fits(browser, 390)
    ends = browser.execute_script(
        "return [...document.querySelectorAll('.verdict, .badge:is(.use, .look, .failed)')]"
        ".map((element) => element.getBoundingClientRect().right)"
    )
    assert len(ends) >= 4
    assert max(ends) <= 390


def first(browser, n=3):
    return center(browser, one(browser, f".card:first-of-type .panel:nth-of-type({n}) canvas"))


def test_layers_of_all_slices_are_hidden_together(visit):
    browser = visit("sub-01.html")
    canvas = first(browser)
    show_layers(browser, "labels", "anatomy", "surfaces", "columns", "planes", "body")
    until(lambda: colored(pixels(canvas)) > 0.01)
    for name in ("labels", "columns", "surfaces", "body", "anatomy"):
        before = pixels(canvas)
        one(browser, f".card:first-of-type .toggles [value={name}]").click()
        first(browser)
        assert (pixels(canvas) != before).any(axis=-1).mean() > 0.003
    show_layers(browser)
    # Letters and a ruler are left, on the other side, too.
    for number in (1, 2):
        other = one(browser, f".card:nth-of-type({number}) .panel:nth-of-type(3) canvas")
        assert (pixels(center(browser, other)) > 250).all(axis=-1).mean() > 0.97
    boxes = browser.find_elements(By.CSS_SELECTOR, ".toggles input:not([value=findings])")
    assert len(boxes) > 10
    assert not any(box.is_selected() for box in boxes)


def test_lines_of_the_slices_lie_where_the_surfaces_are(visit, shown):
    browser = visit("sub-01.html")
    hemisphere = next(h for h in find_results(shown, "01") if h.result.name.hemi == "L")
    views = read_views(hemisphere)
    script = "return JSON.parse(document.querySelector('script.stack').textContent).panels[2]"
    panel = browser.execute_script(script)
    show_layers(browser, "surfaces")
    picture = pixels(first(browser))
    (left, low), (beyond, high) = panel["box"]
    for name, color in (("interior", (0, 121, 90)), ("exterior", (176, 68, 138))):
        drawn = np.argwhere(np.abs(picture - color).max(axis=-1) < 25)
        assert len(drawn) > 150
        shares = (drawn + 0.5) / picture.shape[:2]
        seen = np.column_stack(
            [left + shares[:, 1] * (beyond - left), high - shares[:, 0] * (high - low)]
        )
        # Points of the surface near the slice, on fine lines from posterior to anterior.
        points = hemisphere.sheet.points[name]
        rows = np.arange(points.shape[1])
        fine = np.linspace(0, rows[-1], 2000)
        lines = [[np.interp(fine, rows, line[:, k]) for k in range(3)] for line in points]
        index = views.to_index(np.moveaxis(lines, 1, -1).reshape(-1, 3))
        index = index[np.abs(index[:, 1] - round(panel["center"][1])) < 0.1]
        expected = (index[:, [0, 2]] + 0.5) * views.voxel[[0, 2]]
        gaps = np.linalg.norm(seen[:, None] - expected[None], axis=-1)
        # A line is two pixels wide, and lines of the grid are half a millimeter apart.
        assert gaps.min(axis=1).max() < 0.45
        assert np.percentile(gaps.min(axis=0), 95) < 0.2


def test_the_anatomical_image_lies_where_the_labels_are(visit):
    browser = visit("sub-01.html")
    for n in range(1, 7):
        canvas = first(browser, n)
        show_layers(browser, "labels")
        labeled = np.ptp(pixels(first(browser, n)), axis=-1) > 40
        show_layers(browser, "anatomy")
        first(browser, n)
        gray = pixels(canvas)[..., 0].astype(float)
        assert gray[labeled].mean() < gray[~labeled & (gray < 250)].mean() - 50


def test_a_slice_enlarges_moves_and_closes_by_keys(visit):
    browser = visit("sub-01.html")
    button = one(browser, ".enlarge")
    browser.execute_script("arguments[0].focus()", button)
    press(browser, Keys.ENTER)
    until(lambda: texts(browser, "dialog[open] .facts"))
    start = level(browser)
    assert "norm.mgz" in texts(browser, "dialog .facts")[0]
    canvas = one(browser, "dialog canvas")
    assert canvas.size["width"] > 1.8 * button.size["width"]
    assert colored(pixels(canvas)) > 0.01
    before = pixels(canvas)
    press(browser, Keys.ARROW_UP, Keys.ARROW_UP, Keys.ARROW_LEFT)
    assert level(browser) == start + 1
    assert (pixels(canvas) != before).any(axis=-1).mean() > 0.05
    press(browser, Keys.PAGE_UP)
    assert level(browser) == start + 6
    # It ends with the first and last slice.
    last = int(texts(browser, "dialog .facts")[0].split(" of ")[1].split(",")[0])
    press(browser, Keys.END, Keys.ARROW_UP)
    assert level(browser) == last
    press(browser, Keys.HOME, Keys.ARROW_DOWN)
    assert level(browser) == 1
    for direction in ("sagittal", "axial"):
        one(browser, f"dialog option:nth-of-type({1 if direction == 'sagittal' else 3})").click()
        assert texts(browser, "dialog h2") == [f"Left hemisphere, {direction}"]
        assert colored(pixels(canvas)) > 0.01
    browser.execute_script("arguments[0].focus()", canvas)
    press(browser, Keys.ESCAPE)
    assert browser.find_elements(By.CSS_SELECTOR, "dialog[open]") == []
    assert browser.switch_to.active_element == button


def test_a_slice_moves_by_wheel_and_buttons_and_has_the_layers_of_the_page(visit):
    browser = visit("sub-01.html")
    enlarge(browser, ".panel:nth-of-type(3) .enlarge")
    canvas, start = one(browser, "dialog canvas"), level(browser)
    origin = ScrollOrigin.from_element(canvas)
    webdriver.ActionChains(browser).scroll_from_origin(origin, 0, 120).perform()
    until(lambda: level(browser) == start - 3)
    one(browser, "dialog [aria-label='Next slice']").click()
    assert level(browser) == start - 2
    one(browser, "dialog [aria-label='Previous slice']").click()
    assert level(browser) == start - 3
    layers = ["anatomy", "labels", "body", "surfaces", "columns", "planes"]
    boxes = browser.find_elements(By.CSS_SELECTOR, "dialog .toggles input")
    assert [box.get_attribute("value") for box in boxes] == layers
    for name in ("columns", "surfaces", "labels", "anatomy"):
        before = pixels(canvas)
        one(browser, f"dialog [value={name}]").click()
        assert (pixels(canvas) != before).any(axis=-1).mean() > 0.004
    assert (pixels(canvas) > 250).all(axis=-1).mean() > 0.97
    one(browser, "dialog [aria-label=Close]").click()
    assert browser.find_elements(By.CSS_SELECTOR, "dialog[open]") == []
    # What was hidden there is hidden on the page.
    assert not one(browser, ".card .toggles [value=labels]").is_selected()
    assert (pixels(first(browser)) > 250).all(axis=-1).mean() > 0.97


def test_labels_in_the_large_slice_have_the_colors_of_the_small_one(visit):
    browser = visit("sub-02.html")  # without an image behind, on white
    show_layers(browser, "labels")
    canvas = first(browser, 2)

    def common(picture):
        colors, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
        most = colors[counts > 0.004 * counts.sum()]
        return {tuple(color) for color in most.tolist() if max(color) - min(color) > 20}

    small = common(pixels(canvas))
    enlarge(browser, ".panel:nth-of-type(2) .enlarge")
    large = common(pixels(one(browser, "dialog canvas")))
    assert len(large) >= 3
    assert all(min(np.abs(np.subtract(a, b)).max() for b in small) <= 2 for a in large)


def test_findings_are_numbers_in_the_pictures_and_open_their_slice(visit):
    browser = visit("sub-02.html")
    assert browser.find_elements(By.CSS_SELECTOR, "details.all[open]") == []
    card = ".card:first-of-type"
    numbers = [str(n + 1) for n in range(len(texts(browser, f"{card} .spot")))]
    assert len(numbers) > 4
    assert texts(browser, f"{card} .spot") == numbers
    assert sorted(texts(browser, f"{card} .panel .pin"), key=int) == numbers
    # On the map they lie on the sheet, and none hides another in the slices.
    places = browser.execute_script(
        "return [...document.querySelectorAll('.card:first-of-type .panels .pin')].map((pin) => {"
        " const box = pin.getBoundingClientRect(); return [box.x, box.y]; })"
    )
    places = np.array(places) @ [1, 1j]
    assert (np.abs(places[:, None] - places) + 99 * np.eye(len(places))).min() > 20
    pin = center(browser, one(browser, f"{card} .panel .pin"))
    pin.click()
    until(lambda: texts(browser, "dialog[open] .facts"))
    number = pin.text
    (message,) = (text for text in texts(browser, "dialog[open] > p") if text.startswith(number))
    canvas = one(browser, "dialog canvas")
    layers = "dialog .toggles input:checked:not([value=findings])"
    for box in browser.find_elements(By.CSS_SELECTOR, layers):
        box.click()
    there = colored(pixels(canvas))
    press(browser, Keys.PAGE_UP)
    assert there > 0.002
    assert colored(pixels(canvas)) == 0
    press(browser, Keys.ESCAPE)
    assert browser.switch_to.active_element == pin
    one(browser, f"{card} .toggles [value=findings]").click()
    assert not one(browser, f"{card} .spot").is_displayed()
    browser.execute_script("document.querySelector('.all').open = true")
    listed = texts(browser, f"{card} .findings li")[int(number) - 1]
    assert message.split(": ", 1)[1].split(";")[0] in listed
