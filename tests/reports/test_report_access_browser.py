"""Pages without a mouse and with a screen reader, in a real browser; see :mod:`browsing`."""

import pytest
from browsing import open_page, unnamed, unreached, violations, watched

PAGES = ("sub-01.html", "report.html")


@pytest.fixture
def visit(browser, out):
    """Open a page; afterwards nothing may have gone wrong or outside."""
    with watched(browser):
        yield lambda name: open_page(browser, out / name)


@pytest.mark.parametrize("name", PAGES)
def test_tab_reaches_each_control_and_shows_where_it_is(visit, name):
    count, passed_over, faint = unreached(visit(name))
    assert count > 5
    assert passed_over == []
    assert faint == []


@pytest.mark.parametrize("name", PAGES)
def test_controls_and_pictures_have_names(visit, name):
    count, nameless = unnamed(visit(name))
    assert count > 5
    assert nameless == []


@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_nothing(visit, name):
    assert violations(visit(name)) == []


def test_the_checks_find_what_is_wrong(visit, browser):
    visit("sub-01.html")
    browser.execute_script(
        "document.body.insertAdjacentHTML('afterbegin', '<button></button>"
        '<a href="#" style="outline: none" >plain</a>\')'
    )
    _, nameless = unnamed(browser)
    assert nameless == ["button"]
    _, _, faint = unreached(browser)
    assert faint
    assert all("plain" in text for text in faint)
