"""The page of measures: complete, drawn, and what the code says now."""

import re
from pathlib import Path

import pytest
from make_measures import LARGEST, OTHERS, PAGE, SHOWN, TABLES, image, make_example, page
from matplotlib.figure import Figure
from matplotlib.text import Text
from measure_figures import DRAWINGS
from measure_topics import TOPICS
from PIL import Image

from hipsta_bids.geometry.catalog import Column

DOCS = Path(__file__).parents[2] / "docs"
NUMBER = re.compile(r"[-+]?\d+\.\d+")


def without_numbers(text):
    """Lines of the page, with what was measured taken out of the tables."""
    lines = text.splitlines()
    return [re.sub(rf"{NUMBER.pattern}( %)?", "#", x) if x[:1] == "|" else x for x in lines]


@pytest.fixture(scope="module")
def shown():
    return make_example(SHOWN)


def test_every_measure_has_a_figure():
    for table, rows in TABLES.items():
        explained = [name for topic in TOPICS for name in topic.measures.get(table, ())]
        assert sorted(explained) == sorted(row.name for row in rows), table
    assert [topic.figure for topic in TOPICS] == list(DRAWINGS)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.figure)
def test_every_measure_is_found_in_its_figure(topic, shown):
    figure = Figure(figsize=(7.2, 4.0))
    DRAWINGS[topic.figure](figure, shown)
    words = " ".join(text.get_text() for text in figure.findobj(Text))
    names = {name.removesuffix("_mean") for names in topic.measures.values() for name in names}
    assert [name for name in names if name not in words] == []


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.figure)
def test_figures_are_there_and_small(topic):
    path = DOCS / image(topic)
    assert path.stat().st_size < LARGEST
    with Image.open(path) as picture:
        assert picture.size == (720, 400)


def test_the_page_is_what_the_code_says(shown):
    written = (DOCS / PAGE).read_text(encoding="utf-8")
    fresh = page(shown, dict.fromkeys(OTHERS, shown))
    hint = "run tools/make_measures.py docs"
    assert without_numbers(written) == without_numbers(fresh), hint
    # The table of errors is of other phantoms; above it, a change of 1 % is news.
    above = [text.split("## Errors on phantoms")[0] for text in (written, fresh)]
    before, now = ([float(number) for number in NUMBER.findall(text)] for text in above)
    assert before == pytest.approx(now, rel=0.01, abs=0.001), hint


def test_a_new_measure_without_a_figure_is_noticed(monkeypatch):
    new = Column(name="stretch", unit="1", definition="how far", source="here")
    monkeypatch.setitem(TABLES, "sheet", (*TABLES["sheet"], new))
    with pytest.raises(AssertionError, match="sheet"):
        test_every_measure_has_a_figure()
