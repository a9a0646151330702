"""The documentation site: a build without warnings or network, read from its folder."""

import html
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from browsing import fits, one, open_page, texts, until, watched
from validation_pages import anchor, records

ROOT = Path(__file__).parents[2]
RECORDS = records()

#: What users ask, and the page that answers it.
QUESTIONS = {
    "exclude a participant": "quality",
    "csv of thickness": "python",
    "two sites": "consortia",
    "what does look mean": "quality",
    "use eTIV": "group",
    "which FreeSurfer file": "inputs",
    "ASHS atlas": "inputs",
    "HippUnfold labels": "inputs",
    "correct labels by hand": "quality",
    "rate hemispheres": "quality",
    "SLURM array job": "clusters",
    "docker permission denied": "containers",
    "resume an interrupted run": "running",
    "how long does it take": "running",
    "head and tail": "regions",
    "T1w/T2w ratio": "maps",
    "compare two groups": "group",
    "labels-end": "reasons",
    "change a setting": "settings",
    "what is mean curvature": "measures",
}
FIRST = 18  # questions whose page has to be the first result


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """All pages, built by MkDocs with warnings as errors and every connection refused."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", out]
    nowhere = {f"{name}_proxy": "http://127.0.0.1:9" for name in ("http", "https", "all")}
    environment = os.environ | nowhere | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_every_page_is_built(site):
    pages = {path.with_suffix(".html").name for path in (ROOT / "docs").glob("*.md")}
    assert {path.name for path in site.glob("*.html")} == pages | {
        "404.html",
        "CHANGELOG.html",
        "CONTRIBUTING.html",
    }


def test_bars_in_code_of_tables_are_not_escaped(site):
    assert "<code>group | sex=M" in (site / "statistics.html").read_text()
    questions = (site / "questions.html").read_text()
    assert "(1|site)" in questions
    assert questions.count("<tr>") == 25 + 4  # questions, and headings of tables


def test_nothing_is_loaded_from_elsewhere(site):
    loaded = re.compile(
        r"<(?:script|img|iframe|link|source)\b[^>]*?(?:src|href)=\"?((?:https?:)?//[^\" >]+)"
    )
    for path in site.rglob("*.html"):
        assert loaded.findall(path.read_text(encoding="utf-8")) == [], path.name
    for path in site.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"url\([\"']?(https?:)?//|@import", text), path.name


def test_docstrings_are_on_the_python_page(site):
    text = (site / "api.html").read_text(encoding="utf-8")
    assert 'id="hipsta_bids.participant.measure.measure_hemisphere"' in text
    assert 'id="hipsta_bids.api.maps.measure"' in text
    assert "With the reason why this hemisphere cannot be measured." in text


def test_pages_show_every_reason_and_setting(site):
    changed, others = (
        (site / f"{name}.html").read_text(encoding="utf-8") for name in ("settings", "settings-all")
    )
    assert "<code>body.layer_rule</code>" in changed
    assert "<code>topology.flag_part</code>" in others
    assert 'id="body-split"' in (site / "reasons.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(RECORDS))
def test_each_table_of_the_validation_is_on_the_page_of_its_suite(site, name):
    page = (site / "validation" / f"{name}.html").read_text(encoding="utf-8")
    for file in (entry["file"] for entry in RECORDS[name]["tables"]):
        heading = page.index(f'<h2 id="{anchor(file)}">')
        end = page.index(f'href="{file}"', heading)
        shown = html.unescape(re.sub(r"<[^>]+>", "", page[heading:end]))
        text = (ROOT / "docs" / "validation" / file).read_text(encoding="utf-8")
        cells = [cell for line in text.splitlines() for cell in line.split("\t")]
        assert not [cell for cell in cells if cell.replace("`", "") not in shown]
        link = f'href="validation/{name}.html#{anchor(file)}"'
        assert link in (site / "validation.html").read_text(encoding="utf-8")


def test_notebooks_are_pages(site):
    stems = {path.stem for path in (ROOT / "docs").glob("notebooks/*.ipynb")}
    assert {path.stem for path in site.glob("notebooks/*.html")} == stems


def test_notebooks_have_their_outputs(site):
    texts_of = {
        path.stem: path.read_text(encoding="utf-8") for path in site.glob("notebooks/*.html")
    }
    assert "voxel size, mm: 0.5 0.5 0.5" in texts_of["measure"]
    assert "t differs by less than 1e-4 at 861 vertices: True" in texts_of["group"]
    for name, text in texts_of.items():
        assert f'href="{name}.ipynb"' in text
        assert (site / "notebooks" / f"{name}.ipynb").exists()
        assert f'src="{name}-1.png"' in text


def test_questions_find_their_page_first(site, tmp_path):
    """The theme's own search runs in Deno, with our script, as in a browser."""
    program = shutil.which(
        "deno", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    )
    assert program, "deno is not there: make env, or install requirements-dev.lock"
    (worker,) = site.glob("assets/javascripts/workers/search.*.min.js")
    script = Path(__file__).with_name("search.js")
    files = (script, site, site / "iframe-worker.js", worker)
    done = subprocess.run(
        [program, "run", "--no-remote", "--allow-read", *files, *QUESTIONS],
        env=os.environ | {"DENO_DIR": str(tmp_path), "DENO_NO_UPDATE_CHECK": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout)
    first = {question: [*places, "-"][0].split(".html")[0] for question, places in answers.items()}
    assert len(first) == 20
    wrong = {question: page for question, page in first.items() if page != QUESTIONS[question]}
    assert len(first) - len(wrong) >= FIRST, wrong


def test_a_word_is_found_without_a_server(site, browser):
    with watched(browser):
        open_page(browser, site / "index.html")
        field = one(browser, ".md-search__input")
        field.click()
        field.send_keys("wide-cavity")
        until(lambda: "matching document" in one(browser, ".md-search-result__meta").text)
        until(lambda: "Flags and refusals" in texts(browser, ".md-search-result h1"))
        field.clear()
        field.send_keys("exclude a participant")
        title = "Check, rate, correct and exclude"
        until(lambda: texts(browser, ".md-search-result h1")[:1] == [title])
        field.clear()
        field.send_keys("wide-cavity")
        until(lambda: texts(browser, ".md-search-result h1")[:1] == ["Flags and refusals"])
        one(browser, ".md-search-result__link").click()
        until(lambda: browser.current_url.partition("#")[0].endswith("/reasons.html"))


@pytest.mark.parametrize(("name", "figures"), [("measure", 3), ("group", 3)])
def test_notebooks_show_their_figures(site, browser, name, figures):
    with watched(browser):
        open_page(browser, site / "notebooks" / f"{name}.html")
        assert fits(browser, 1280)
    assert len(texts(browser, "article img")) == figures
