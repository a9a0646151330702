"""How pages behave in a real browser; see :mod:`browsing`."""

import json
import re

import numpy as np
import pytest
from browsing import colored, fits, one, open_page, pixels, texts, until, watched
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from hipsta_bids.io import files


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


def rows(browser):
    return texts(browser, "#table tbody tr td:first-child")


def test_the_table_is_filtered_and_sorted_with_the_maps(visit):
    browser = visit("report.html")
    # At first failed ones, then those to look at, and equal ones by name.
    assert rows(browser) == ["sub-02", "sub-02", "sub-01", "sub-01"]
    assert not browser.find_elements(By.CSS_SELECTOR, "#table [aria-sort]")
    assert texts(browser, "#table .badge") == ["failed", "look", "use", "use"]
    assert len(texts(browser, "#tiles li")) == 4
    one(browser, "[name=decision][value=failed]").click()
    assert texts(browser, "#table .badge") == ["look", "use", "use"]
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
    tile = one(browser, "#tiles .tile:not(.none)")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", tile)
    assert colored(pixels(tile)) > 0.9
    before = pixels(tile)
    one(browser, "[name=map][value=curvature]").click()
    assert (pixels(tile) != before).any()
    one(browser, "#tiles li:last-child a").click()
    assert texts(browser, "h1") == ["sub-01"]
    one(browser, ".crumbs a").click()
    assert texts(browser, "h1") == ["All hemispheres"]


@pytest.fixture
def review(visit, browser):
    """Open a page where nothing is kept yet."""

    def opened(name, width=1280):
        visit("report.html", width)
        browser.execute_script("localStorage.clear()")
        browser.get("about:blank")
        return visit(name, width)

    return opened


def press(browser, *keys):
    webdriver.ActionChains(browser).send_keys(*keys).perform()


def card(browser):
    """Which hemisphere keys are about."""
    return one(browser, ".card.current").get_attribute("id")


def rate(browser, row, rating):
    one(browser, f"#table tbody tr:nth-child({row}) .rate").click()
    one(browser, f"#table option[value={rating}]").click()
    one(browser, "#search").click()


def ratings(browser):
    """Participant, side, rating and note of the rows that are shown."""
    return browser.execute_script(
        "return [...document.querySelectorAll('#table tbody tr')].map(row => [...row.cells])"
        ".map(([who, , side, rating]) => [who.textContent, side.textContent,"
        " rating.querySelector('.rate').textContent.replace('none', ''),"
        " rating.querySelector('.remark').textContent])"
    )


def test_keys_lead_by_decision_and_rate(review, visit):
    browser = review("sub-02.html")
    # The table was left in its first order, so links are the same with it and without.
    one(browser, "a.badge.failed").click()
    until(lambda: card(browser) == "sub-02_hemi-R_seg-freesurfer")
    assert not one(browser, ".card.current .previous").is_displayed()
    press(browser, "3", "n")
    until(lambda: card(browser) == "sub-02_hemi-L_seg-freesurfer")
    press(browser, "2", "n")
    until(lambda: texts(browser, "h1") == ["sub-01"])
    assert card(browser) == "sub-01_hemi-L_seg-freesurfer"
    press(browser, "1", "0", "n")
    until(lambda: card(browser) == "sub-01_hemi-R_seg-freesurfer")
    assert not one(browser, ".card.current .next").is_displayed()
    press(browser, "1", "p")
    until(lambda: card(browser) == "sub-01_hemi-L_seg-freesurfer")
    assert browser.find_elements(By.CSS_SELECTOR, ".card.current .rating :checked") == []
    # Digits in a note are words.
    remark = one(browser, ".card.current .remark")
    remark.send_keys("bridge 1 of 2", Keys.TAB)
    visit("report.html")
    assert ratings(browser) == [
        ["sub-02", "R", "exclude", ""],
        ["sub-02", "L", "unsure", ""],
        ["sub-01", "L", "", "bridge 1 of 2"],
        ["sub-01", "R", "use", ""],
    ]
    one(browser, "#rating option[value=unsure]").click()
    assert rows(browser) == ["sub-02"]
    one(browser, "#rating option[value=none]").click()
    assert texts(browser, "#tiles li") == ["01 L"]
    assert "1 of 4 shown, 3 rated" in one(browser, "#shown").text


def test_links_follow_the_table_as_it_was_left_or_decisions_without_it(review, visit, browser):
    review("report.html")
    one(browser, "[data-key=volume] button").click()
    order = browser.execute_script(
        "return JSON.parse(Object.entries(localStorage).find(([k]) => k.endsWith(' order'))[1])"
    )
    page, key = order[1]["page"], order[1]["key"]
    visit(page)
    own = f"[data-key={key}]"
    for name, n in (("previous", 0), ("next", 2)):
        link = one(browser, f"{own} .{name}")
        assert link.get_attribute("href").endswith(f"{order[n]['page']}#{order[n]['key']}")
        assert order[n]["words"] in link.text
    # Without an order, or with one that leads elsewhere, links go by decision.
    browser.execute_script(
        "const [key] = Object.keys(localStorage).filter((key) => key.endsWith(' order'));"
        "const order = JSON.parse(localStorage[key]);"
        "order.forEach((row) => { row.page = 'javascript:alert(1)//'; });"
        "localStorage[key] = JSON.stringify(order)"
    )
    visit("sub-02.html")
    next_one = one(browser, "[data-key=sub-02_hemi-L_seg-freesurfer] .next")
    assert next_one.get_attribute("href").endswith("sub-01.html#sub-01_hemi-L_seg-freesurfer")
    browser.execute_script("localStorage.clear()")
    visit("sub-02.html")
    link = one(browser, "[data-key=sub-02_hemi-L_seg-freesurfer] .next")
    assert link.text == "sub-01 left: use →"
    assert link.get_attribute("href").endswith("sub-01.html#sub-01_hemi-L_seg-freesurfer")


def test_ratings_are_saved_loaded_and_taken_by_the_group_level(review, browser, out):
    from hipsta_bids.group.cohort.collect import GroupRequest, collect_sheets  # noqa: PLC0415

    review("report.html")
    assert not one(browser, "#save").is_enabled()
    rate(browser, 2, "exclude")
    assert "1 rated" in one(browser, "#shown").text
    one(browser, "#hemi option[value=L]").click()
    one(browser, "#rate-shown option[value=use]").click()
    before = ratings(browser)
    assert [row[2] for row in before] == ["exclude", "use"]
    one(browser, "#save").click()
    path = browser.downloads / "ratings.tsv"
    until(path.exists)
    header, *lines = (row.split("\t") for row in path.read_text().splitlines())
    assert header == [
        *("participant_id", "session_id", "hemi", "protocol", "region", "rating", "note"),
        "input_hash",
    ]
    assert [line[:7] for line in lines] == [
        ["sub-02", "n/a", "L", "freesurfer", "body", "exclude", "n/a"],
        ["sub-01", "n/a", "L", "freesurfer", "body", "use", "n/a"],
    ]
    found = collect_sheets(GroupRequest(roots=(out,), ratings=path))
    assert found.ratings == {"use": 1, "unsure": 0, "exclude": 1, "unrated": 2}
    assert {(e.participant, e.hemi): e.reason for e in found.exclusions}["sub-02", "L"] == "rated"
    assert [r.result.name.subject for r in found.records] == ["01", "01"]
    # Loaded where they are not known; one line is of nobody here.
    with path.open("a") as file:
        file.write("sub-99\tn/a\tL\tfreesurfer\tbody\tuse\tn/a\tn/a\n")
    review("report.html")
    one(browser, "#load").send_keys(str(path))
    until(lambda: "2 ratings loaded; 1 lines" in one(browser, "#told").text)
    one(browser, "#hemi option[value=L]").click()
    assert ratings(browser) == before


def test_the_table_is_saved_as_it_is_shown(review, browser):
    review("report.html")
    rate(browser, 3, "use")
    one(browser, "#hemi option[value=L]").click()
    one(browser, "#save-table").click()
    path = browser.downloads / "hemispheres.tsv"
    until(path.exists)
    rows_of_table = files.read_tsv(path)
    assert [(row["participant_id"], row["decision"]) for row in rows_of_table] == [
        ("sub-02", "look"),
        ("sub-01", "use"),
    ]
    assert [row["rating"] for row in rows_of_table] == ["n/a", "use"]
    assert all(float(row["thickness_mean"]) > 1 for row in rows_of_table)


def test_ratings_of_other_labels_are_marked(review, visit, browser):
    review("report.html")
    rate(browser, 3, "use")
    browser.execute_script(
        "const [k, v] = Object.entries(localStorage).find(([k]) => k.includes('hemi-L'));"
        "localStorage.setItem(k, JSON.stringify({...JSON.parse(v), input_hash: 'other'}))"
    )
    visit("sub-01.html")
    assert "its labels were others" in one(browser, ".card.current .earlier").text
    assert browser.find_elements(By.CSS_SELECTOR, ".rating :checked") == []
    visit("report.html")
    one(browser, "#rating option[value=earlier]").click()
    assert ratings(browser) == [["sub-01", "L", "", "(use, of earlier labels)"]]
    visit("sub-01.html")
    press(browser, "1")
    assert one(browser, ".card.current .rating :checked").get_attribute("value") == "use"
    assert one(browser, ".card.current .earlier").text == ""


def test_the_command_that_opens_the_files_is_copied(visit):
    browser = visit("sub-01.html")
    one(browser, ".open summary").click()
    one(browser, ".open .copy").click()
    assert one(browser, ".open .copy").text == "Copied"
    remark = one(browser, ".remark")
    remark.send_keys(Keys.CONTROL, "v")
    assert remark.get_attribute("value").startswith("freeview -v ")
    remark.clear()


def change_table(out, folder, change):
    """Write the page of all hemispheres with other rows."""
    text = (out / "report.html").read_text()
    found = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)
    data = json.loads(found[1])
    change(data)
    page = folder / "report.html"
    page.write_text(text.replace(found[1], json.dumps(data)))
    return page


def test_maps_of_several_protocols_are_named_by_them(visit, out, tmp_path):
    def change(data):
        data["columns"].insert(3, {"key": "seg", "title": "Protocol"})
        data["rows"] += [{**row, "seg": "ashsPMC", "key": f"{row['key']}2"} for row in data["rows"]]

    browser = visit(change_table(out, tmp_path, change), 390)
    names = texts(browser, "#tiles .name")
    assert {"01 R freesurfer", "01 R ashsPMC"} <= {*names}
    assert len(names) == len({*names}) == 8
    badges = browser.find_elements(By.CSS_SELECTOR, "#table .badge:is(.use, .look, .failed)")
    assert len(badges) == 8
    assert max(badge.rect["x"] + badge.size["width"] for badge in badges) <= 390


def test_all_of_hundreds_of_rows_are_shown_and_sorted(visit, out, tmp_path):
    def change(data):
        data["rows"] = [
            {**data["rows"][n % 4], "key": f"k{n}", "participant": f"sub-{n:03d}", "volume": n}
            for n in range(200)
        ]

    browser = visit(change_table(out, tmp_path, change))
    until(lambda: len(rows(browser)) == 200)
    one(browser, "[data-key=volume] button").click()
    assert rows(browser)[0] == "sub-199"
    one(browser, "[data-key=volume] button").click()
    until(lambda: rows(browser) == [f"sub-{n:03d}" for n in range(200)])
    one(browser, "#search").send_keys("sub-19")
    until(lambda: len(texts(browser, "#tiles li")) == 10)
