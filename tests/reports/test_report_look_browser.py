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
from hipsta_bids.reports.results import find_results, read_views


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
        "return [...document.querySelectorAll('.verdict, .badge:is(.use, .look, .refuse)')]"
        ".map((element) => element.getBoundingClientRect().right)"
    )
    assert len(ends) >= 4
    assert max(ends) <= 390


def show(browser, *layers):
    """Show these layers of slices only."""
    for box in browser.find_elements(By.CSS_SELECTOR, ".card:first-of-type .toggles input"):
        if box.is_selected() != (box.get_attribute("value") in layers):
            box.click()


def first(browser, n=3):
    return center(browser, one(browser, f".card:first-of-type .panel:nth-of-type({n}) canvas"))


def test_layers_of_all_slices_are_hidden_together(visit):
    browser = visit("sub-01.html")
    canvas = first(browser)
    show(browser, "labels", "anatomy", "surfaces", "columns", "planes", "body")
    until(lambda: colored(pixels(canvas)) > 0.01)
    for name in ("labels", "columns", "surfaces", "body", "anatomy"):
        before = pixels(canvas)
        one(browser, f".card:first-of-type .toggles [value={name}]").click()
        first(browser)
        assert (pixels(canvas) != before).any(axis=-1).mean() > 0.003
    show(browser)
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
    show(browser, "surfaces")
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
        show(browser, "labels")
        labeled = np.ptp(pixels(first(browser, n)), axis=-1) > 40
        show(browser, "anatomy")
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
    show(browser, "labels")
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
    size = solid.size
    webdriver.ActionChains(browser).move_to_element_with_offset(
        solid, round((left - 0.5) * size["width"]), round((top - 0.5) * size["height"])
    ).click().perform()
    until(entry.is_displayed)
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

    show(browser, "columns")
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
