"""Tables as laboratories keep them, through the command line: each doubt costs one line."""

import re
from html import unescape

import numpy as np
import pytest
from markdown_it import MarkdownIt
from small_cohorts import FAST, read_participants, write_participants

from hipsta_bids.cli.main import main
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page

pytestmark = pytest.mark.usefixtures("without_figures")
COLUMNS = ("participant_id", "group", "age", "sex", "site")


def with_cells(study, changes, columns=COLUMNS):
    """Change cells of participants.tsv by row and column; sites are a, b and c."""
    rows = [
        dict(zip(COLUMNS, [*row, "abc"[k % 3]], strict=True))
        for k, row in enumerate(read_participants(study.data))
    ]
    for (row, column), cell in changes.items():
        rows[row][column] = cell
    write_participants(study.data, [list(row.values()) for row in rows], columns)


def run(study, capsys, *options):
    code = main([str(study.data), str(study.out), "group", *FAST, "--name", "t", *options])
    said = capsys.readouterr()
    assert not said.err
    assert code == 0
    folder = study.out / "group" / "t"
    return said.out, files.read_tsv(folder / "design.tsv"), files.read_tsv(folder / "excluded.tsv")


def test_missing_values_of_all_kinds_are_left_out_and_told_in_one_line(study, capsys):
    spelled = {(k, "sex"): "unknown" for k in (3, 4, 5)} | {
        (0, "age"): "-9999",
        (1, "age"): "?",
        (2, "age"): "n.a.",
        (6, "sex"): "-9",
        (7, "group"): "NULL",
        (20, "group"): "NA",
        (21, "group"): "-",
        (22, "site"): "NaN",
        (23, "site"): ".",
        (24, "site"): "n/a",
    }
    with_cells(study, spelled)
    said, design, excluded = run(study, capsys)
    assert list(design[0])[2:] == ["Intercept", "group[T.AD]", "age", "sex[T.M]", *SITES]
    assert sorted((row["participant_id"], row["message"]) for row in excluded) == sorted(
        (f"sub-{row + 1:02d}", f"{column} is missing") for row, column in spelled
    )
    (line,) = [line for line in said.splitlines() if "read as missing" in line]
    assert line == (
        "note: read as missing: age '-9999' (1), age '?' (1), age 'n.a.' (1), group '-' (1), group"
        " 'NA' (1), group 'NULL' (1), sex '-9' (1), sex 'unknown' (3) and 2 more; if one is a"
        " level, list it in Levels of the table's sidecar"
    )
    notes = files.read_json(study.out / "group" / "t" / "analysis.json")["notes"]
    assert line.removeprefix("note: ") in notes


SITES = ["site[T.b]", "site[T.c]"]


def test_spreadsheets_are_read_with_blanks_marks_and_line_ends(study, capsys):
    with_cells(study, {}, ("participant_id ", " group", "age\u00a0", "sex", "site"))
    path = study.data / "participants.tsv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n") + b"\t\t\t\t\r\n")
    said, design, excluded = run(study, capsys)
    assert list(design[0])[2:] == ["Intercept", "group[T.AD]", "age", "sex[T.M]", *SITES]
    assert len(design) == 30
    assert not excluded
    assert "read as missing" not in said


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (("participant_id", "group", "age", "age ", "site"), "'age' occurs more than once"),
        (("participant_id", "group", "sex", "Sex", "site"), "sex and Sex differ in capitals only"),
    ],
)
def test_columns_that_are_there_twice_are_refused(study, capsys, columns, words):
    with_cells(study, {}, columns)
    assert main([str(study.data), str(study.out), "group", *FAST]) == 65
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_participants_who_are_not_in_the_table_are_named_so(study, capsys):
    rows = read_participants(study.data)
    rows[3][2] = "n/a"
    rows[5][0] = "sub-x6"
    write_participants(study.data, [*rows[:28], rows[29]])
    said, design, excluded = run(study, capsys)
    assert len(design) == 27
    assert (
        "note: participants.tsv: has no row of sub-06, sub-29; add it, or check its label\n" in said
    )
    assert {(row["participant_id"], row["reason"], row["message"]) for row in excluded} == {
        ("sub-04", "incomplete", "age is missing"),
        ("sub-06", "incomplete", "not in participants.tsv"),
        ("sub-29", "incomplete", "not in participants.tsv"),
    }


def with_own_table(study, lines):
    path = study.data.parent / "own.tsv"
    path.write_text("\n".join("\t".join(line) for line in lines) + "\n")
    return "--covariates", str(path)


def test_groups_are_those_of_the_formula(study, capsys):
    """A table of the user has diagnoses, participants.tsv another grouping; one is unknown."""
    people = [row[0] for row in read_participants(study.data)]
    lines = [(label, "CN" if k % 2 else "AD") for k, label in enumerate(people[:-1])]
    table = with_own_table(study, [("participant_id", "diagnosis"), *lines])
    run(study, capsys, *table, "--formula", "diagnosis + age")
    folder = study.out / "group" / "t"
    record = files.read_json(folder / "analysis.json")["groups"]
    assert (record["column"], record["levels"]) == ("diagnosis", ["CN", "AD"])
    assert {row["group"] for row in files.read_tsv(folder / "means.tsv")} == {"CN", "AD"}
    text = (folder / "methods.md").read_text()
    assert "known for 29 participants (14 CN, 15 AD)" in text
    assert "In addition" not in text  # who has no diagnosis is told of once


def test_values_that_a_table_of_the_user_replaces_are_named(study, capsys):
    rows = read_participants(study.data)
    older = [(rows[2][0], "99"), (rows[3][0], rows[3][2]), (rows[4][0], "n/a")]
    table = with_own_table(study, [("participant_id", "age"), *older])
    said, design, _ = run(study, capsys, *table)
    label = rows[2][0]
    assert f"note: age of {label} differs between tables; own.tsv counts\n" in said
    assert design[2]["age"] == "99"


def with_numbers(study, name, function):
    """Add a column of numbers, given the row and the age."""
    rows = read_participants(study.data)
    numbers = [f"{function(k, float(row[2])):.6g}" for k, row in enumerate(rows)]
    rows = [[*row, number] for row, number in zip(rows, numbers, strict=True)]
    write_participants(study.data, rows, ("participant_id", "group", "age", "sex", name))


@pytest.mark.parametrize(
    ("column", "n_small", "factor"), [("eTIV", 12, 1e-3), ("icv", 20, 1e-3), ("icv", 1, 1e-6)]
)
def test_head_volumes_in_two_units_are_refused(study, capsys, column, n_small, factor):
    with_numbers(study, column, lambda k, age: (1.2e6 + 1e4 * age) * (factor if k < n_small else 1))
    options = [*FAST, "--formula", f"group + {column}"]
    assert main([str(study.data), str(study.out), "group", *options]) == 65
    error = capsys.readouterr().err
    assert f"{column!r} has {n_small} values to" in error
    assert f", {30 - n_small} from" in error
    assert "(cm^3 and mm^3?); use one unit" in error
    assert error.count("\n") == 1


def test_head_volumes_of_the_default_model_are_checked_too(study, capsys):
    with_numbers(study, "TIV", lambda k, age: (1.2e6 + 1e4 * age) * (1e-3 if k < 9 else 1))
    call = [str(study.data), str(study.out), "group", "--align", "none", "--no-reports"]
    assert main([*call, "--no-classification"]) == 0
    said = capsys.readouterr().out
    assert (
        "volumes, areas and extents are not adjusted for TIV: model: 'TIV' has 9 values to" in said
    )


def test_head_volumes_that_differ_as_heads_do_pass(study, capsys):
    with_numbers(study, "icv", lambda k, age: (0.5 + 0.1 * k + 0 * age) * 1e6)
    run(study, capsys, "--formula", "group + icv")


@pytest.mark.parametrize(
    ("noise", "is_noted"), [(0.0, None), (0.6, True), (8.0, False), (-0.6, True)]
)
def test_covariates_that_are_nearly_the_same_are_noted(study, capsys, noise, is_noted):
    years = []

    def shifted(k, age):
        years.append((age, (-1 if noise < 0 else 1) * (age + noise * (-1) ** k)))
        return years[-1][1]

    with_numbers(study, "years", shifted)
    r = np.corrcoef(np.transpose(years))[0, 1]
    assert (abs(r) > 0.99) == (is_noted is not False)
    options = ["--formula", "group + age + years", "--contrast", "group[CN]-group[AD]"]
    if is_noted is None:
        assert main([str(study.data), str(study.out), "group", *FAST, *options]) == 65
        assert "combination of" in capsys.readouterr().err
        return
    said, *_ = run(study, capsys, *options)
    assert said.count(f"age and years are nearly the same (r = {r:.4f})") == is_noted
    assert said.count("nearly the same") == is_noted


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("group + age + sex", None),
        ("group * sex + age", "the model has 4 columns for 30 participants; use one per 10"),
        ("group + poly(age, 12)", "the model has 13 columns for 30 participants; use one per 10"),
        ("0 + group + age", None),
    ],
)
def test_more_columns_than_a_tenth_of_the_participants_are_noted(study, capsys, formula, words):
    said, *_ = run(study, capsys, "--formula", formula, "--contrast", "group[CN]-group[AD]")
    assert said.count("columns for") == (words is not None)
    assert (words or "") in said


def test_methods_show_names_of_tables_as_they_are(study, capsys):
    """In GitHub's Markdown and on the page, whatever their signs mean there."""
    groups = {"CN": "*a* <b>b</b> &lt;", "AD": "[x](http://y) _z_ $1$ `c`"}
    sites = ("![i](j)", "~~k~~", "C:\\*")
    rows = [
        [*row[:1], groups[row[1]], *row[2:], sites[k % 3]]
        for k, row in enumerate(read_participants(study.data))
    ]
    write_participants(study.data, rows, ("participant_id", "group", "my age_", "sex", "site"))
    call = [str(study.data), str(study.out), "group", "--align", "none", "--measures", "thickness"]
    call += ["--name", "t", "--formula", "group + `my age_` + site"]
    assert main([*call, "--contrast", "`my age_`", "age_diff_ = 2*`my age_`"]) == 0
    assert not capsys.readouterr().err
    folder = study.out / "group"
    source = (folder / "t" / "methods.md").read_text(encoding="utf-8")
    page = group_page(folder / "t")
    rendered = MarkdownIt("commonmark").enable(["strikethrough", "table"]).render(source)
    for html in (rendered, page[page.index('<div class="methods">') :]):
        method = html[: html.index("References")]
        assert not re.search(r"<(?!/?(p|h\d|code|div|ul|li)\b)", method)
        assert method.count("<code>group + `my age_` + site</code>") == 1
        words = unescape(re.sub(r"<[^>]+>", "", method))
        assert f"(16 {groups['CN']}, 14 {groups['AD']})" in words
        assert f"(reference levels: group {groups['CN']}, site ![i](j))" in words
        assert "Contrasts were `my age_` and age_diff_." in words
        assert "thickness, `my age_`, L: " in words.partition("Significant points")[2]
    assert "$1$" not in source  # GitHub's formulas, which the parser above does not know
