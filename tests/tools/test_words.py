"""The counts of banned words and long sentences, on texts with known counts."""

import tomllib
from pathlib import Path

import pytest
import words

LONG = "one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen"


def found(text: str, most_words: int = words.SENTENCE) -> list[str]:
    return [p.split("'")[1] for p in words.problems(words.Text(1, text, most_words)) if "'" in p]


@pytest.mark.parametrize(
    ("text", "banned"),
    [
        ("were they as those around them, the mean would be the same", ["those", "were they"]),
        ("The mean is 1.98 mm with these columns as those around them.", ["those"]),
        ("Slices have what its neighbors lack.", ["what its"]),
        ("Underscores do in place of hyphens.", ["in place of"]),
        ("The share of the variance went from 98 to 99 %.", ["went"]),
        ("Sidecars say of maps what they are.", ["say", "what they"]),
        ("Mean thickness tells nobody apart here.", ["nobody", "tells"]),
        ("Those of repairs open with a click.", ["Those"]),
        ("It is what one person's brain differs by.", ["person"]),
        ("controls who tell shifts that the norms do not have", ["tell"]),
        (
            "Give no map of anybody: leave these two points out.",
            ["anybody", "leave these two points out"],
        ),
        (
            "The area is that of the interior wall, the same along the next axis.",
            ["that of", "the same along"],
        ),
        ("A map has not the shape that it should.", ["has not"]),
        ("The mean goes down and comes back.", ["goes", "comes"]),
        ("Such a map has what is missing.", ["what is", "Such"]),
        ("The map was left out, as we found out.", ["left out", "found out"]),
    ],
)
def test_banned_words_are_found(text: str, banned: list[str]) -> None:
    assert sorted(found(text)) == sorted(banned)


@pytest.mark.parametrize(
    "text",
    [
        "A hole of 25 grid nodes was filled. Check the label there.",
        "Names such as FreeSurfer's have not been read; the map has not converged.",
        "What is a cross-section? A slice across the body.",
        "The outcome, the personal note and a cargo are words of their own.",
        "The same settings give the same maps, in that order of files.",
        "The rows were these, and the total was left.",
    ],
)
def test_other_words_are_not(text: str) -> None:
    assert found(text) == []


def test_words_are_counted_by_sentence_or_in_the_whole() -> None:
    text = f"{LONG} et al. 2023, p = 0.05. {LONG.capitalize()}"
    assert [len(words._WORD.findall(s)) for s in words.sentences(text)] == [20, 15]
    assert list(words.problems(words.Text(1, text, 20))) == []
    (problem,) = words.problems(words.Text(1, text, 20, whole=True))
    assert problem.startswith("long: 35 words, limit 20: one two three")


PYTHON = '''
"""What is this module? Its docstring is not read; those are."""

def measure(name, count):
    """Tell what was measured."""
    "a string as a note, which nobody reads"
    if count:
        raise UsageError(f"{name}: one {'two' if count else 'three words and those'} four")
    warn("five short words; two more")
    return "one two three: " + f"four {name} those"

def _hidden():
    """Tell nobody."""
'''


def test_strings_and_docstrings_of_a_module() -> None:
    texts = {(t.line, t.text): (t.most_words, t.whole) for t in words.python_texts(PYTHON)}
    assert texts == {
        (4, "Tell what was measured."): (texts[4, "Tell what was measured."][0], False),
        (8, "X1: one X1 four"): (20, True),
        (8, "three words and those"): (20, True),
        (9, "five short words; two more"): (20, True),
        (10, "one two three: four X1 those"): (20, False),
    }
    assert texts[4, "Tell what was measured."][0] > 1000


def test_settings_toml_templates_and_scripts() -> None:
    source = (
        'class S:\n    """One."""\n\n    a: int\n    """First line of ``a`` that\n    is long."""\n'
    )
    assert [(t.line, t.text) for t in words.settings_texts(source)] == [
        (5, "First line of X1 that\nis long.")
    ]
    source = 'title = "Two words"\nb = """\nwhat was measured: body"""\nc = ["d", "a b `c d` e"]\n'
    assert [(t.line, t.text) for t in words.toml_texts(source)] == [
        (3, "what was measured: body"),
        (4, "a b X1 e"),
    ]
    source = """<p>{% if a %}The first{% endif %} <b>{{ n }}</b> maps
 are here.</p>{% for x in y %}<td>{{ x }}</td>{% else %}<p>No map is in here &amp; there.</p>
<script>const those = "nobody tells what it is";</script>"""
    assert [(t.line, " ".join(t.text.split())) for t in words.template_texts(source)] == [
        (1, "The first X1 maps are here."),
        (2, "No map is in here & there."),
    ]
    source = "const a = `${n} maps of those rows`;\nb('short');\nc(\"four words of text\");\n"
    assert [(t.line, t.text) for t in words.script_texts(source)] == [
        (1, "X1 maps of those rows"),
        (3, "four words of text"),
    ]


@pytest.mark.parametrize(
    ("text", "prose"),
    [
        ("with `a` (mm), `b` (1/mm), `c`, and `d` each", "with X1 each"),
        ("`a`, `b` or `c`", "X1 or X1"),
        ("`a` and `b` (millimeters), `c`", "X1 and X1 (millimeters), X1"),
    ],
)
def test_a_list_of_code_is_a_word(text: str, prose: str) -> None:
    assert words._prose(text) == prose


PAGE = """# What is used, and what is not

The first paragraph
has `two of those` lines, see
[the page](index.md#such).

- An item of the list
- Another, with <https://example.org/those>

```
nobody reads code
```

| what it is | `those` |
|---|---|
| a cell | two |
"""


def test_prose_of_a_page_without_code_headings_and_addresses() -> None:
    texts = [(t.line, t.text) for t in words.markdown_texts(PAGE)]
    assert texts == [
        (3, "The first paragraph\nhas X1 lines, see\nthe page."),
        (7, "- An item of the list"),
        (8, "- Another, with <X1"),
        (14, " what it is "),
        (14, " X1 "),
        (16, " a cell "),
        (16, " two "),
    ]


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text("Nobody says that.\n\nThose are.\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(words, "BUDGETS", tmp_path / "words.toml")
    return Path("docs/page.md")


def test_only_a_count_above_the_budget_fails(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for budget, exit_code in ((3, 0), (2, 1), (4, 0)):
        words.BUDGETS.write_text(f'"{page}" = {budget}\n')
        assert words.main([]) == exit_code
        printed = capsys.readouterr().out
        assert (f"{page}: 3 problems, the budget in {words.BUDGETS} is 2" in printed) == exit_code
    words.BUDGETS.write_text("")
    assert words.main([str(page)]) == 1
    assert f"--list {page}" in capsys.readouterr().out
    assert words.main(["--list", str(page)]) == 0
    assert capsys.readouterr().out.splitlines()[2] == f"{page}:3 banned: 'Those' (write: the noun)"


def test_folders_are_listed(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("README.md").write_text("Those maps.\n")
    assert words.main(["--list", "docs"]) == 0
    assert {line.split(":")[0] for line in capsys.readouterr().out.splitlines()} == {str(page)}
    assert words.main(["--list"]) == 0
    listed = {line.split(":")[0] for line in capsys.readouterr().out.splitlines()}
    assert listed == {str(page), "README.md"}


def test_budgets_are_lowered_and_never_raised(page: Path) -> None:
    (page.parent / "other.md").write_text("Those maps.\n")
    words.BUDGETS.write_text(f'"{page}" = 5\n"docs/gone.md" = 7\n')
    assert words.main(["--lower"]) == 1
    assert tomllib.loads(words.BUDGETS.read_text()) == {str(page): 3}
    page.write_text("Nobody says that. Those are. Such maps.\n")
    assert words.main(["--lower"]) == 1
    assert tomllib.loads(words.BUDGETS.read_text()) == {str(page): 3}
