"""The page about an analysis: what it says, that it is whole and safe, and how it behaves."""

import base64
import json
import re
import shutil
import time

import numpy as np
import pandas as pd
import pytest
from browsing import (
    colored,
    faint,
    fits,
    one,
    open_page,
    pixels,
    texts,
    unnamed,
    unreached,
    until,
    use_theme,
    violations,
    watched,
)
from extension_marks import PRESENT
from page_outline import Outline
from selenium import webdriver
from selenium.webdriver.common.keys import Keys
from small_cohorts import NODES, table, write_dataset

from hipsta_bids.cli.main import main
from hipsta_bids.group.output import figures, write
from hipsta_bids.io import files
from hipsta_bids.reports import group as page_module
from hipsta_bids.reports.cells import display_name
from hipsta_bids.reports.display import ORIENTATION
from hipsta_bids.reports.group import group_page, write_group_report
from hipsta_bids.reports.maps import new_figure
from hipsta_bids.reports.page import Section

MODEL = "group-age-sex"
EVIL = "<script>document.title='owned'</script>&"


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Data, output and options of an analysis with everything that a page can show."""
    folder = tmp_path_factory.mktemp("page")
    data, out = write_dataset(folder)
    (folder / "group.toml").write_text("[classification]\nrepeats = 1\nfolds = 3\n")
    excluded = folder / "exclude.tsv"
    files.write_tsv(
        excluded, ["participant_id", "hemi", "reason"], [["sub-30", "L", "moved <b>much</b>"]]
    )
    given = ["--settings", str(folder / "group.toml"), "--exclude", str(excluded)]
    given += ["--asymmetry", "--name", MODEL]
    given += ["--normative", "group=CN"] * ("norms" in PRESENT)
    with pytest.MonkeyPatch.context() as patch:
        # Figures take longer than all else: those of maps alone.
        patch.setattr(write, "draw_figures", only_maps)
        assert main([str(data), str(out), "group", *given]) == 0
    return data, out, given


def only_maps(*given):
    return ((name, draw) for name, draw in figures.draw_figures(*given) if name.endswith("_maps"))


@pytest.fixture(scope="module")
def out(dataset):
    return dataset[1]


@pytest.fixture(scope="module")
def page(out):
    return (out / "group" / f"{MODEL}.html").read_text(encoding="utf-8")


@pytest.fixture
def copy(out, tmp_path):
    """A copy to do harm to."""
    return shutil.copytree(out, tmp_path / "copy")


def scenes(text):
    return json.loads(re.search(r'id="maps">(.*?)</script>', text, re.DOTALL)[1])


def test_the_page_is_whole_and_made_for_all_readers(page):
    outline = Outline(page)
    assert outline.open == []
    assert outline.unlabeled == []
    assert outline.headings[0] == 1
    assert max(np.diff(outline.headings)) <= 1  # no level is left out
    assert len(outline.ids) == len(set(outline.ids))
    local = re.compile(rf"data:|#|{MODEL}/")
    assert [a for a in outline.addresses if not local.match(a)] == []
    assert not re.search(r"url\((?!data:)|@import|fetch\(|XMLHttpRequest|import\(", page)
    assert "could not be made" not in page


@pytest.mark.parametrize("key", [section.key for section in page_module.SECTIONS])
def test_every_part_is_there(page, key):
    # Average cross-sections need surfaces, which these sheets lack; the others are optional.
    absent = {"sections", "harmonization", "power", "retest", "norms", "surrogate"}
    assert (f'id="group-{key}"' in page) == (key not in absent)


def test_findings_are_those_of_the_tables(out, page):
    maps = table(out / "group" / MODEL / "maps.tsv")
    for row in maps[maps.n_significant > 0].itertuples():
        assert f"{row.n_significant} of {row.n_tests} points survive" in page
    assert (maps.n_significant > 0).any()
    peaks = table(out / "group" / MODEL / "peaks.tsv")
    first = peaks[(peaks.measure == "thickness") & (peaks.hemi == "L")].iloc[0]
    assert f"d {first.effect_size:.3g}" in page
    assert "%), larger in CN; peak CA1, " in page


def found(page):
    """Titles of what was found, with the lines of the sides, and the folded rest."""
    part = re.search(r'<section id="group-found".*?</section>', page, re.DOTALL)[0]
    cards = re.findall(r'<div class="card yes">\n<h3>(.*?)</h3>(.*?)</div>', part, re.DOTALL)
    return part, [(title, re.findall(r"</b> (.*?)</li>", lines)) for title, lines in cards]


def test_a_map_with_few_points_is_no_finding_of_the_same_rank(copy):
    folder = copy / "group" / MODEL
    change_table(folder / "maps.tsv", "n_tests", lambda content: ["861"] * len(content))

    def counts(content):
        return [{"thickness": 225, "curvature": 1}[m.split("_")[0]] for m in content["measure"]]

    change_table(folder / "maps.tsv", "n_significant", counts)
    part, cards = found(group_page(folder))
    assert cards[0][0] == "Thickness, CN-AD"
    assert all(title.startswith("Thickness") for title, _ in cards)
    assert "225 of 861 points survive (26%)" in cards[0][1][0]
    folded = part.index("contrasts of maps survive in less than 1% of a map</summary>")
    assert part.index("1 of 861 points survive (less than 1%)") > folded
    n = len(pd.read_csv(folder / "maps.tsv", sep="\t"))
    assert f"{n} families of points, each map" in part


def test_the_largest_part_of_a_map_comes_first(copy):
    folder = copy / "group" / MODEL
    change_table(
        folder / "maps.tsv",
        "n_significant",
        lambda content: [30 if m == "curvature" else 15 for m in content["measure"]],
    )
    _, cards = found(group_page(folder))
    assert cards[0][0] == "Curvature, CN-AD"


def test_summaries_are_in_the_order_of_corrected_p_and_folded_above_the_level(copy):
    path = copy / "group" / MODEL / "measures.tsv"
    ps = []

    def values(content):
        ps.extend(
            f"{0.001 + 0.09 * (n * 7 % len(content)) / len(content):.4f}"
            for n in range(len(content))
        )
        return ps

    change_table(path, "p_fdr", values)
    text = group_page(copy / "group" / MODEL)
    rows = [rows_of(text, label)[1] for label in ("Summary measures", "Other summary measures")]
    shown = [[float(row["p, FDR"]) for row in part] for part in rows]
    assert shown[0] + shown[1] == sorted(round(float(p), 3) for p in ps)
    assert max(shown[0]) < 0.05 <= min(shown[1])
    assert text.index(
        "<details><summary>", text.index('aria-label="Summary measures"')
    ) < text.index('aria-label="Other summary measures"')
    assert f"{len(ps)} tests, by corrected p; {len(shown[0])} are below 0.05" in text


def test_maps_are_those_of_the_tables(out, page):
    side = scenes(page)[0]["sides"][0]
    assert side["shape"] == list(NODES)
    points = table(out / "group" / MODEL / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    (test,) = side["tests"]
    # Four digits are written.
    np.testing.assert_allclose(test["values"]["p"], points.p, rtol=1e-3)
    np.testing.assert_allclose(test["effect"], points.cohen_d, rtol=1e-3)
    assert test["significant"] == points.significant.astype(int).tolist()
    means = table(out / "group" / MODEL / "means.tsv")
    own = means[(means.measure == "thickness") & (means.hemi == "L") & (means.group == "AD")]
    (group,) = [one for one in side["means"] if one["group"] == "AD"]
    np.testing.assert_allclose(group["values"], own["mean"], rtol=1e-3)


def test_figures_are_embedded_with_text_alternatives(copy, page):
    folder = copy / "group" / MODEL
    shutil.rmtree(folder / "figures")
    names = {"roc", "calibration", "registration", "sections"}
    for name in names:
        svg = f'<svg xmlns="http://www.w3.org/2000/svg" width="90pt"><title>{name}</title></svg>'
        files.write_text(folder / "figures" / f"{name}.svg", svg)
    text = group_page(folder)
    embedded = re.findall(r'data:image/svg\+xml;base64,([^"]+)" alt="[^"]{20,}"', text)
    titles = {
        re.search("<title>(.*)</title>", base64.b64decode(one).decode())[1] for one in embedded
    }
    assert titles == names
    auc = table(folder / "classification.tsv").auc_full[0]
    assert re.search(rf'alt="Receiver [^"]*CN against AD, left: [^"]*{auc:.2f}', text)
    outline = Outline(text)
    assert outline.open == outline.unlabeled == []
    assert max(np.diff(outline.headings)) <= 1
    assert text.count("No figure of ") == 4  # they were taken away
    assert "No figure of " not in page


def test_who_is_left_out_is_said_with_the_reason(page):
    assert "sub-30" in page
    assert "&lt;b&gt;much&lt;/b&gt;" in page
    assert "<b>much" not in page


def test_the_page_can_be_made_anew_from_the_folder(dataset, page, capsys):
    data, out, _ = dataset
    path = out / "group" / f"{MODEL}.html"
    path.unlink()
    assert main([str(data), str(out), "group", "--reports-only"]) == 0
    assert path.read_text(encoding="utf-8") == page
    assert str(path) in capsys.readouterr().out
    assert main([str(data), str(out), "group", "--reports-only", "--name", "other"]) == 66
    assert "no analysis of the name other" in capsys.readouterr().err


def test_a_page_takes_less_than_ten_seconds(out):
    before = time.process_time()
    group_page(out / "group" / MODEL)
    assert time.process_time() - before < 10


def rename(path):
    """Give a group and a column names that a page must not take for its own."""
    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r"\b(AD|age)\b", rf"\1{EVIL}", text), encoding="utf-8")


def rows_of(page, label):
    """Titles of the columns of a table, and its rows by title."""
    part = re.search(rf'aria-label="{label}">(.*?)</table>', page, re.DOTALL)[1]
    titles = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", part)
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in part.split("<tr")[2:]]
    return titles, [dict(zip(titles, row, strict=True)) for row in rows]


@pytest.mark.parametrize("label", ["Other summary measures", "Classification"])
def test_what_decides_comes_before_what_may_be_cut_off(page, label):
    titles, rows = rows_of(page, label)
    assert titles.index("p") == 2
    assert "Contrast" not in titles[:6]
    assert rows


def test_classification_of_few_says_what_cannot_be_judged(page):
    titles, _ = rows_of(page, "Classification")
    assert "Slope" not in titles
    assert "needs 100 members in both groups; no comparison here has them" in page


def change_table(path, column, values):
    content = pd.read_csv(path, sep="\t", keep_default_na=False, dtype=str)
    content[column] = values(content)
    content.to_csv(path, sep="\t", index=False)


@pytest.mark.parametrize(("area", "said"), [("0.07", True), ("0.61", False)])
def test_areas_below_chance_are_explained(copy, area, said):
    path = copy / "group" / MODEL / "classification.tsv"
    for column in ("auc_base_cv", "auc_full_cv"):
        change_table(path, column, lambda content: [area] * len(content))
    text = group_page(copy / "group" / MODEL)
    assert ("means that nothing was learned" in text) == said


@pytest.mark.parametrize("tested", [True, False])
def test_only_summary_measures_that_were_tested_are_said_not_to_differ(copy, tested):
    path = copy / "group" / MODEL / "measures.tsv"
    change_table(path, "p_fdr", lambda content: ["0.5"] * len(content))
    if not tested:
        path.unlink()
    text = group_page(copy / "group" / MODEL)
    assert ("No summary measure has a corrected p below" in text) == tested


def test_effects_of_two_models_name_their_model(copy):
    path = copy / "group" / MODEL / "measures.tsv"
    models = ["a + b", "a + b + icv"]
    change_table(path, "model", lambda content: [models[n % 2] for n in range(len(content))])
    change_table(path, "p_fdr", lambda content: ["0.01"] * len(content))
    text = group_page(copy / "group" / MODEL)
    part, _ = found(text)
    lettered = dict(zip("AB", models, strict=True))
    for letter, model in lettered.items():
        assert f"{letter} <code>{model}</code>" in part
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', part)
    letters = [re.findall(r"<td>(.*?)</td>", row)[-1] for _, row in rows]
    counts = pd.read_csv(path, sep="\t")["model"].value_counts()
    assert {lettered[name]: letters.count(name) for name in "AB"} == counts.to_dict()
    _, rows = rows_of(text, "Summary measures")
    assert {row["Model"] for row in rows} == {"A", "B"}
    assert "A <code>a + b</code>; B <code>a + b + icv</code>" in text


def test_measures_of_subfields_are_spelled():
    assert display_name("area_CA2_3") == "area, CA2/3"
    assert display_name("thickness_mean_PRESUBICULUM") == "thickness mean, presubiculum"
    assert display_name("volume_CA1_asymmetry") == "volume, CA1 asymmetry"
    assert display_name("extent_x") == "extent x"


def test_values_are_read_where_the_maps_lie(page):
    """Places come from the drawings: each unfolded map has one, with what it shows."""
    assert ORIENTATION in page
    found = [
        dict(re.findall(r'([\w-]+)="([^"]*)"', tag))
        for tag in re.findall(r'<div class="map".*?>', page)
    ]
    own = [spot for spot in found if spot["data-block"] == "0"]
    assert len(own) == 8  # two means, effect and significance on both sides
    assert sum(spot["aria-label"].startswith("Effect of CN-AD") for spot in own) == 2
    boxes = [[float(n) for n in re.findall(r"[\d.]+", spot["style"])] for spot in own]
    for left, top, width, height in boxes:
        assert 0 < left < left + width < 100
        assert 0 < top < top + height < 100
    assert len({(box[0], box[1]) for box in boxes}) == 8


def test_users_text_is_escaped(copy):
    folder = copy / "group" / MODEL
    for path in (*folder.glob("*.tsv"), folder / "analysis.json", folder / "methods.md"):
        rename(path)
    text = group_page(folder)
    assert "<script>document" not in text
    assert "&lt;script&gt;document" in text
    assert "could not be made" not in text
    assert Outline(text).open == []


def test_a_section_that_fails_harms_no_other(copy, monkeypatch, page):
    def fail(_):
        raise ZeroDivisionError("nothing there")

    broken = Section(key="peaks", title="Peaks", template="group/peaks.html", build=fail)
    sections = [broken if s.key == "peaks" else s for s in page_module.SECTIONS]
    monkeypatch.setattr(page_module, "SECTIONS", sections)
    text = group_page(copy / "group" / MODEL)
    assert "ZeroDivisionError: nothing there" in text
    assert scenes(text) == scenes(page)


def test_a_page_that_fails_costs_a_line_and_no_results(copy):
    (copy / "group" / MODEL / "analysis.json").write_text("{")
    assert write_group_report(copy, MODEL).startswith(f"{MODEL}.html: not made (")
    # That of an earlier analysis would be taken for this one's.
    assert not (copy / "group" / f"{MODEL}.html").exists()
    assert (copy / "group" / MODEL / "peaks.tsv").exists()


def test_a_figure_that_fails_costs_a_line_and_no_results(dataset, copy, monkeypatch, capsys):
    data, _, given = dataset

    def fail():
        raise ZeroDivisionError("nothing there")

    def one_fails(*_):
        yield "broken", fail
        yield "boxes", lambda: [labeled("\N{CJK UNIFIED IDEOGRAPH-60A3}")]

    monkeypatch.setattr(write, "draw_figures", one_fails)
    assert main([str(data), str(copy), "group", *given, "--figures"]) == 0
    told = capsys.readouterr().out
    assert "note: figure broken: not drawn (ZeroDivisionError: nothing there)\n" in told
    assert "show boxes for \N{CJK UNIFIED IDEOGRAPH-60A3}; SVG has them as text" in told
    folder = copy / "group" / MODEL
    assert (folder / "peaks.tsv").exists()
    assert "\N{CJK UNIFIED IDEOGRAPH-60A3}" in (folder / "figures" / "boxes.svg").read_text()


def labeled(text):
    figure = new_figure((1.0, 1.0), None)
    figure.text(0.5, 0.5, text)
    return figure


def test_no_page_is_made_or_left_if_none_is_wanted(dataset, copy, monkeypatch, capsys):
    data, _, given = dataset
    monkeypatch.setattr(write, "draw_figures", lambda *_: iter(()))
    assert main([str(data), str(copy), "group", *given, "--no-reports"]) == 0
    assert not (copy / "group" / f"{MODEL}.html").exists()
    methods = copy / "group" / MODEL / "methods.md"
    assert f"report: {methods}\n" in capsys.readouterr().out


@pytest.fixture
def visit(browser, out):
    """Open the page at a width; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        yield lambda width=1280: open_page(browser, out / "group" / f"{MODEL}.html", width)


@pytest.mark.parametrize("width", [1280, 390])
def test_the_page_fits_its_window(visit, width):
    assert fits(visit(width), width)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_texts_can_be_read_in_both_themes(visit, theme):
    browser = visit()
    use_theme(browser, theme)
    seen, found = faint(browser)
    use_theme(browser, "light")
    assert seen > 100
    assert found == []


def test_the_page_works_by_keys_and_for_screen_readers(visit):
    browser = visit()
    for check in (unreached, unnamed):
        count, *wrong = check(browser)
        assert count > 10
        assert not any(wrong)


def test_axe_finds_nothing(visit):
    assert violations(visit()) == []


@pytest.mark.parametrize(
    "label", ["Clusters and peaks", "Other summary measures", "Classification"]
)
def test_no_column_is_cut_off(visit, label):
    browser = visit()
    table_of = one(browser, f"[aria-label='{label}']")
    browser.execute_script("arguments[0].closest('details, main').open = true", table_of)
    assert int(table_of.get_property("scrollWidth")) <= int(table_of.get_property("clientWidth"))


@pytest.mark.parametrize(
    ("label", "width"), [("Clusters and peaks", 1280), ("Other summary measures", 390)]
)
def test_boxes_of_tables_end_with_a_whole_row(visit, label, width):
    browser = visit(width)
    box = one(browser, f"[aria-label='{label}']")
    browser.execute_script("arguments[0].closest('details, main').open = true", box)
    until(lambda: box.get_property("clientHeight") > 0)
    edge = "const edge = arguments[0].getBoundingClientRect().top + arguments[0].clientHeight;"
    rows = (
        "[...arguments[0].querySelectorAll('tbody tr')].map((row) => row.getBoundingClientRect())"
    )
    cut = "((row) => row.top < edge - 1 && row.bottom > edge + 1)"
    until(lambda: not browser.execute_script(f"{edge} return {rows}.some{cut}", box))
    assert browser.execute_script(f"{edge} return {rows}.some((row) => row.bottom < edge)", box)
    assert box.get_property("scrollHeight") > box.get_property("clientHeight")


def test_figures_are_few_and_the_page_is_short(visit):
    """Of four measures here; two figures, of a column's width in print, have 2,200 pixels."""
    browser = visit()
    assert len(texts(browser, "figure")) <= 15
    assert browser.execute_script("return document.documentElement.scrollHeight") < 7000
    shown = [e for e in browser.find_elements("css selector", ".plate") if e.is_displayed()]
    assert len(shown) == 2  # more measures are folded
    for picture in shown:
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", picture)
        assert colored(pixels(picture)) > 0.1


@pytest.mark.parametrize(("width", "printed"), [(1280, 680), (1280, 320), (390, 680)])
def test_figures_fill_the_page(visit, width, printed):
    """Up to twice their size in print; on a phone they scroll, so that they can be read."""
    browser = visit(width)
    plate = one(browser, ".plate")
    browser.execute_script(f"arguments[0].style.setProperty('--width', '{printed}px')", plate)
    room = one(browser, "main").size["width"] - (32 if width > 800 else 28)
    assert plate.size["width"] == pytest.approx(min(max(room, 640), 2 * printed), abs=1)
    assert one(browser, ".plate img").size["width"] == plate.size["width"]


def test_what_was_found_is_a_line_for_each_side(visit):
    browser = visit()
    lines = browser.find_elements("css selector", "#group-found .card li")
    assert len(lines) >= 2
    assert max(line.size["height"] for line in lines) < 30


def test_figures_have_no_white_boxes_in_the_dark_theme(visit):
    browser = visit()
    use_theme(browser, "dark")
    plates = [e for e in browser.find_elements("css selector", ".plate") if e.is_displayed()]
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plates[0])
    picture = pixels(plates[0])
    use_theme(browser, "light")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plates[0])
    light = pixels(plates[0])
    dark = (picture.max(axis=-1) < 60).mean()
    assert dark > 0.4
    assert (light > 240).all(axis=-1).mean() > 0.4
    # Values have the colors that they have on white.
    values = [shot[np.ptp(shot, axis=-1) > 80].mean(axis=0) for shot in (picture, light)]
    assert np.abs(np.subtract(*values)).max() < 8


def test_pointing_at_a_map_tells_its_values(visit, out):
    browser = visit()
    spot = one(browser, ".map[data-kind=effect]")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", spot)
    assert not one(browser, "#tip").is_displayed()
    size = spot.size
    corner = (size["width"] // 2 - 3, -(size["height"] // 2 - 3))
    webdriver.ActionChains(browser).move_to_element_with_offset(spot, *corner).perform()
    until(lambda: one(browser, "#tip").is_displayed())
    told = dict(zip(texts(browser, "#tip dt"), texts(browser, "#tip dd"), strict=True))
    points = table(out / "group" / MODEL / "hemi-L_contrast-CNAD_desc-thickness_statmap.tsv")
    point = points.iloc[-1]  # lateral and anterior
    assert texts(browser, "#tip b") == [f"Left, node {NODES[0]}, {NODES[1]}"]
    spelled = f"{point.cohen_d:.3g}".replace("-", "\N{MINUS SIGN}")
    assert told["Cohen's d"] == spelled
    assert told["Subfield"] == point.subfield
    assert told["CN-AD"].endswith(" mm")
    assert "corrected p" in told


def test_arrow_keys_move_from_point_to_point(visit):
    browser = visit()
    spot = one(browser, ".map[data-kind=significance]")
    browser.execute_script("arguments[0].focus()", spot)
    middle = [n // 2 + 1 for n in NODES]
    for key, step in ((Keys.ARROW_UP, (0, 0)), (Keys.ARROW_RIGHT, (1, 0)), (Keys.ARROW_UP, (1, 1))):
        spot.send_keys(key)
        node = ", ".join(str(n + move) for n, move in zip(middle, step, strict=True))
        assert texts(browser, "#tip b") == [f"Left, node {node}"]
    spot.send_keys(Keys.ESCAPE)
    assert not one(browser, "#tip").is_displayed()


def test_users_text_is_not_run(browser, copy):
    folder = copy / "group" / MODEL
    for path in (*folder.glob("*.tsv"), folder / "analysis.json"):
        rename(path)
    hostile = copy / "group" / "hostile.html"
    hostile.write_text(group_page(folder), encoding="utf-8")
    with watched(browser):
        open_page(browser, hostile)
        assert browser.title.startswith(MODEL)
        assert f"AD{EVIL}" in one(browser, "#group-people table").text
