"""The documentation site, built as ``make docs`` does, and opened from its folder in a browser."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from browsing import fits, one, open_browser, open_page, texts, until, watched

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if os.environ.get("HIPSTA_BIDS_BROWSER") != "required":
        pytest.skip("takes a browser: run tools/test-reports")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp("browser")) as session:
        yield session


def test_a_word_is_found_without_a_server_or_a_network(site, browser):
    with watched(browser):
        open_page(browser, site / "index.html")
        field = one(browser, ".md-search__input")
        field.click()
        field.send_keys("wide-cavity")
        until(lambda: "matching document" in one(browser, ".md-search-result__meta").text)
        until(lambda: "Flags and refusals" in texts(browser, ".md-search-result h1"))
        one(browser, ".md-search-result__link").click()
        until(lambda: browser.current_url.partition("#")[0].endswith("/reasons.html"))


@pytest.mark.parametrize(("name", "figures"), [("measure", 1), ("group", 3)])
def test_notebooks_show_what_their_cells_give(site, browser, name, figures):
    with watched(browser):
        open_page(browser, site / "notebooks" / f"{name}.html")
        assert fits(browser, 1280)
    assert len(texts(browser, "article img")) == figures
    assert len(texts(browser, ".output")) >= 3
    assert (site / "notebooks" / f"{name}.ipynb").exists()
    link = one(browser, f'a[href="{name}.ipynb"]')
    assert link.text == "This notebook as a file"
