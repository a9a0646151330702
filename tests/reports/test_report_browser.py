"""How pages behave in a real browser; see :mod:`browsing`."""

import numpy as np
import pytest
from browsing import colored, fits, one, open_browser, open_page, pixels, texts, until, watched
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp("browser")) as session:
        yield session


@pytest.fixture
def visit(browser, out):
    """Open a page at a width; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        yield lambda name, width=1280: open_page(browser, out / name, width)


def show_view(browser):
    canvas = one(browser, ".solid")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    until(lambda: colored(pixels(canvas)) > 0.02)
    return canvas


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html", "report.html"])
def test_a_page_fits_its_window(visit, name, width):
    browser = visit(name, width)
    assert fits(browser, width)


def test_the_view_draws_the_sheet_and_turns(visit):
    browser = visit("sub-01.html")
    canvas = show_view(browser)
    before = pixels(canvas)
    assert 0.05 < colored(before) < 0.8
    canvas.click()
    for _ in range(5):
        canvas.send_keys(Keys.ARROW_LEFT)
    until(lambda: (np.abs(pixels(canvas) - before).max(axis=-1) > 40).mean() > 0.05)
    one(browser, ".reset").click()
    # The click has picked a point, which is drawn: a ball of a few pixels.
    until(lambda: (np.abs(pixels(canvas) - before).max(axis=-1) > 40).mean() < 0.02)


def test_shells_and_colors_change_what_is_drawn(visit):
    browser = visit("sub-01.html")
    canvas = show_view(browser)
    for action in (
        ".show [value=exterior]",
        ".show [value=planes]",
        ".colors option[value=subfield]",
    ):
        before = pixels(canvas)
        one(browser, action).click()
        until(lambda before=before: (pixels(canvas) != before).any(axis=-1).mean() > 0.02)


def values(browser):
    return dict(zip(texts(browser, ".values dt"), texts(browser, ".values dd"), strict=True))


def test_picking_a_point_tells_its_values(visit, out):
    browser = visit("sub-01.html")
    canvas = show_view(browser)
    assert values(browser) == {}
    picture = pixels(canvas)
    rows, columns = np.nonzero(np.ptp(picture, axis=-1) > 60)
    n = len(rows) // 2
    middle = np.array(picture.shape[:2]) // 2
    webdriver.ActionChains(browser).move_to_element_with_offset(
        canvas, int(columns[n] - middle[1]), int(rows[n] - middle[0])
    ).click().perform()
    until(lambda: values(browser))
    told = values(browser)
    x, y = (int(word.split()[1]) for word in told["Node"].split(", "))
    table = next((out / "sub-01/anat").glob("*hemi-L*desc-sheet_morph.tsv"))
    header, *lines = (line.split("\t") for line in table.read_text().splitlines())
    row = next(
        dict(zip(header, line, strict=True)) for line in lines if line[:2] == [str(x), str(y)]
    )
    assert told["Thickness"] == f"{float(row['thickness']):.2f} mm"
    assert told["Subfield"] == row["subfield"]
    # The arrow keys on the map go on from there, one node at a time.
    flat = one(browser, ".flat")
    flat.send_keys(Keys.ARROW_DOWN if y > 1 else Keys.ARROW_UP)
    until(lambda: values(browser) != told)
    step = [int(word.split()[1]) for word in values(browser)["Node"].split(", ")]
    assert step == [x, y - 1 if y > 1 else y + 1]


def test_a_click_on_the_map_picks_that_corner(visit):
    browser = visit("sub-01.html")
    flat = one(browser, ".flat")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", flat)
    size = flat.size
    webdriver.ActionChains(browser).move_to_element_with_offset(
        flat, size["width"] // 2 - 3, -(size["height"] // 2 - 3)
    ).click().perform()
    # In the left hemisphere as in the right one, the lateral and anterior corner.
    assert values(browser)["Node"] == "x 41, y 21"


def test_a_failed_hemisphere_shows_its_body_and_the_defect(visit):
    browser = visit("sub-02.html")
    canvas = show_view(browser)
    one(browser, ".sides label:nth-of-type(2) input").click()
    assert not one(browser, ".side").is_displayed()
    red = np.array([1, -1, -1])

    def has_mark():
        picture = pixels(canvas)
        return ((picture @ red > -60) & (picture[..., 0] > picture[..., 1] + 60)).sum() > 30

    until(has_mark)


def test_layers_of_the_slices_can_be_hidden(visit):
    browser = visit("sub-01.html")
    lines = browser.find_elements(By.CSS_SELECTOR, ".layers .line.mask")
    shown = "return getComputedStyle(arguments[0]).display"
    assert browser.execute_script(shown, lines[0]) != "none"
    one(browser, ".t-mask").click()
    assert browser.execute_script(shown, lines[0]) == "none"


def rows(browser):
    return texts(browser, "#table tbody tr td:nth-child(2)")


def test_the_table_is_filtered_and_sorted_with_the_maps(visit):
    browser = visit("report.html")
    assert rows(browser) == ["sub-01", "sub-01", "sub-02", "sub-02"]
    assert len(texts(browser, "#tiles li")) == 4
    one(browser, "[name=status][value=failed]").click()
    assert texts(browser, "#table .badge") == ["ok", "repaired", "flagged"]
    one(browser, "#search").send_keys("large-repair")
    assert rows(browser) == ["sub-02"]
    assert texts(browser, "#tiles li") == ["02 L"]
    one(browser, "#search").clear()
    one(browser, "#search").send_keys(" ")
    one(browser, "[data-key=volume] button").click()
    head = one(browser, "[data-key=volume]")
    assert head.get_attribute("aria-sort") == "descending"
    heads = browser.find_elements(By.CSS_SELECTOR, "#table thead th")
    n = 1 + [head.get_attribute("data-key") for head in heads].index("volume")
    volumes = [float(text) for text in texts(browser, f"#table tbody td:nth-child({n})")]
    assert volumes == sorted(volumes, reverse=True)
    assert "3 of 4 shown" in one(browser, "#shown").text


def test_maps_are_drawn_and_lead_to_their_page(visit):
    browser = visit("report.html")
    tile = one(browser, "#tiles .tile")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", tile)
    assert colored(pixels(tile)) > 0.9
    before = pixels(tile)
    one(browser, "[name=map][value=curvature]").click()
    assert (pixels(tile) != before).any()
    one(browser, "#tiles a").click()
    assert texts(browser, "h1") == ["sub-01"]
    one(browser, ".crumbs a").click()
    assert texts(browser, "h1") == ["All hemispheres"]


def test_the_selection_is_a_list_that_the_group_level_takes(visit, out):
    from hipsta_bids.group.collect import GroupRequest, collect_sheets  # noqa: PLC0415

    browser = visit("report.html")
    assert not one(browser, "#save").is_enabled()
    one(browser, "#table tbody tr:nth-child(3) input").click()
    assert "1 selected" in one(browser, "#shown").text
    one(browser, "#save").click()
    path = browser.downloads / "exclude.tsv"
    until(path.exists)
    header, line = (row.split("\t") for row in path.read_text().splitlines())
    assert header == ["participant_id", "session_id", "hemi", "protocol", "region", "reason"]
    assert line[:5] == ["sub-02", "n/a", "L", "freesurfer", "body"]
    found = collect_sheets(GroupRequest(roots=(out,), exclude_table=path))
    left_out = {(e.participant, e.hemi): e.reason for e in found.exclusions}
    assert left_out["sub-02", "L"] == "listed"
    assert [r.place.name.subject for r in found.records] == ["01", "01"]
