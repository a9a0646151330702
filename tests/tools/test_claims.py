"""Every number of docs/validation.md, and of claims of README and paper, comes from a table."""

import json
import re
from pathlib import Path

import pytest
from claims import FOLDER, NUMBER, fill, find_number, read_claims, refresh
from validation_pages import BLOCK

from hipsta_bids.io.files import read_tsv

ROOT = Path(__file__).parents[2]
PAGE = "docs/validation.md"
TEXTS = {
    PAGE: BLOCK.sub("", (ROOT / PAGE).read_text("utf-8")),
    # The claims of the README are its bullets in bold.
    "README.md": "\n".join(
        re.findall(r"^- \*\*.*(?:\n  .*)*", (ROOT / "README.md").read_text("utf-8"), re.MULTILINE)
    ),
    # The claims of the paper are its paragraph on the same files.
    "paper/paper.md": next(
        text
        for text in (ROOT / "paper" / "paper.md").read_text("utf-8").split("\n\n")
        if " measured the same files" in text
    ),
}
CLAIMS = [claim for page in TEXTS for claim in read_claims(page)]
#: What has digits and is no figure: names, versions, licenses, years and places of articles.
NAMES = re.compile(
    r"CA\d(/\d)?|T1w?|MNI152\w+|OASIS\w+|BY-NC-SA [\d.]+|(GPL|Apache|AGPL)-[\d.]+|Hipsta [\d.]+"
    r"|\b(19|20)\d\d(-\d\d-\d\d)?\b|doi:\S+|\d+:\d+-\d+"
)


def known_numbers(claim):
    """All numbers of the tables of a claim, and of what their suites say about them."""
    files = {source.split("|")[0].strip() for source in claim["numbers"]}
    texts = [(FOLDER / file).read_text("utf-8") for file in files]
    for path in FOLDER.glob("*.json"):
        text = path.read_text("utf-8")
        if files & {entry["file"] for entry in json.loads(text)["tables"]}:
            texts.append(text)
    return {float(found) for text in texts for found in NUMBER.findall(text)}


def prose(text):
    """Text without targets of links, code, anchors and comments, in one line."""
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"`[^`]*`|<[^>]*>", "", text)
    return " ".join(text.split())


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim["text"])
def test_a_claim_is_on_its_page_with_the_numbers_of_its_tables(claim):
    assert len(re.findall(r"\{\}", claim["text"])) == len(claim["numbers"])
    assert fill(claim) in prose(TEXTS[claim["page"]])
    literal = {float(found) for found in NUMBER.findall(NAMES.sub("", claim["text"]))}
    assert literal <= known_numbers(claim)


@pytest.mark.parametrize("page", TEXTS)
def test_no_number_is_without_a_source(page):
    text = prose(TEXTS[page])
    for claim in sorted(CLAIMS, key=lambda claim: -len(claim["text"])):
        if claim["page"] == page:
            text = text.replace(fill(claim), "")
    left = re.findall(r"\S*\d\S*", NAMES.sub("", text))
    assert not left


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim["text"])
def test_a_claim_of_the_page_has_a_link_to_its_tables_beside_it(claim):
    if claim["page"] == PAGE:
        paragraphs = re.split(r"\n\n|\n(?=[|-] ?)", TEXTS[PAGE])
        (place,) = [part for part in paragraphs if fill(claim) in prose(part)]
        for source in claim["numbers"]:
            assert f"(validation/{source.split('|')[0].strip()})" in place


def test_the_page_lists_each_table_with_missed_targets_and_no_other():
    section = TEXTS[PAGE].split("\n## Missed targets\n")[1].split("\n## ")[0]
    listed = re.findall(r"\(validation/([\w-]+\.tsv)\)", section)
    missed = [
        path.name
        for path in FOLDER.glob("*.tsv")
        if any("missed" in row.values() for row in read_tsv(path))
    ]
    assert sorted(listed) == sorted(missed)


def test_the_page_is_short():
    assert len((ROOT / PAGE).read_text("utf-8").split()) <= 2500


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("accuracy--thickness.tsv | phantom = arc 2.0 mm | target SD | only | .2f", "0.04"),
        ("limits--thin.tsv | outcome ~ refused; voxels, mm = 0.4 | | count | d", "1"),
        ("limits--thin.tsv | outcome != ok | thickness, mm | most | .1f", "3.0"),
        ("slices--half.tsv | bodies = labels | targets | only#2 | .0f", "5"),
    ],
)
def test_numbers_are_looked_up(source, text):
    assert find_number(source) == text


def test_a_source_without_a_row_is_an_error():
    with pytest.raises(ValueError, match="no row"):
        find_number("limits--thin.tsv | outcome = lost | | count | d")


def test_a_text_that_is_not_on_its_page_once_is_an_error():
    claim = {"text": "of {} mm", "numbers": ["limits--thin.tsv | | thickness, mm | least | .1f"]}
    for text in ("of 2 cm", "of 2 mm and of 3 mm"):
        with pytest.raises(ValueError, match="on its page"):
            refresh(text, [claim])


def test_old_numbers_are_replaced_and_lines_stay():
    claim = {
        "text": "of {} mm and {} mm",
        "numbers": ["limits--thin.tsv | | thickness, mm | least | .1f"] * 2,
    }
    assert refresh("It is of 7.5\nmm and 3 mm.", [claim]) == "It is of 0.8\nmm and 0.8 mm."
