"""The documentation site: a build without warnings or network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


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
    assert 'id="topology"' in (site / "settings.html").read_text(encoding="utf-8")
    assert 'id="body-split"' in (site / "reasons.html").read_text(encoding="utf-8")
