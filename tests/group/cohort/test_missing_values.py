"""Spellings of missing values: one list, for all kinds of columns and all tables."""

import re

import numpy as np
import pandas as pd
import pytest
from small_cohorts import place_of

from hipsta_bids.api.models import group
from hipsta_bids.errors import InputError, ModelError
from hipsta_bids.group.cohort.covariates import read_covariates, spelled_note
from hipsta_bids.group.cohort.exclusions import Choices
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.inputs.edits import read_ends
from hipsta_bids.io import files, gifti
from hipsta_bids.stats.formula import check_numbers, typed, with_factors

SPELLINGS = (
    *("", " ", "n/a", "N/A", "NA", "na", "N.A.", "n.a.", "<NA>", "#N/A", "#NA", "NaN", "nan"),
    *("-nan", "1.#QNAN", "NULL", "null", "#NULL!", "nil", "None", "NONE", "none", "?", "??", "-"),
    *("--", "---", "\u2013", "\u2014", "\u2212", ".", "..", "\u2026", "_", "unknown", "Unknown"),
    *("UNKNOWN", "(unknown)", "unk", "Unk.", "missing", "[missing]", "not\u00a0available"),
    *("not_applicable", "Not-Known", "not recorded", "not reported", "undefined", "unspecified"),
    *("#DIV/0!", "#VALUE!", "#REF!", "unbekannt", "-9", "-99", "-999", "-9999", "-9999.0"),
)
#: Words that look alike, and are levels.
LEVELS = [
    "+",
    "+/-",
    "0",
    "no",
    "never",
    "nobody",
    "nano",
    "U",
    "X",
    "unknowns",
    "NAc",
    "none2",
    "♀",
]
N = 24
KINDS = {
    "age": [str(50 + i) for i in range(N)],
    "sex": ["F" if i % 2 else "M" for i in range(N)],
    "group": ["CN" if i % 3 else "AD" for i in range(N)],
    "site": [str(i % 3 + 1) for i in range(N)],
}


def read(tmp_path, columns, sidecar=None, visits=N):
    names = [f"sub-{i:02d}" for i in range(visits)]
    table = pd.DataFrame({"participant_id": names, "session_id": None}, index=names)
    rows = zip(names[: len(next(iter(columns.values())))], *columns.values(), strict=True)
    lines = ["\t".join(cells) for cells in [("participant_id", *columns), *rows]]
    (tmp_path / "participants.tsv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    if sidecar is not None:
        files.write_json(tmp_path / "participants.json", sidecar)
    settings = GroupSettings()
    joined, absent, spelled = read_covariates(table, tmp_path, [], settings)
    return with_factors(joined, settings.design, settings.model), absent, spelled


def test_there_are_spellings_enough():
    assert len(set(SPELLINGS)) >= 50


@pytest.mark.parametrize("kind", KINDS)
def test_no_spelling_is_a_level_or_a_number_and_each_is_counted(tmp_path, kind):
    # Among words, none is a level: no drug, no diagnosis.
    nones = {"None", "NONE", "none"} if kind in {"sex", "group"} else set()
    spellings = [cell for cell in SPELLINGS if cell not in nones]
    cells = [*KINDS[kind], *spellings, "-99"]
    table, absent, spelled = read(tmp_path, {kind: cells}, visits=len(cells))
    values = typed(table[kind])
    assert not absent
    assert [cell for cell, value in zip(cells, values, strict=True) if pd.notna(value)] == KINDS[
        kind
    ]
    expected = dict.fromkeys(spellings, 1) | {"-99": 2}
    assert dict(spelled) == {
        (kind, cell): n for cell, n in expected.items() if cell.strip() not in {"", "n/a"}
    }


def test_missing_values_of_the_sidecar_are_missing(tmp_path):
    columns = {
        "apoe": ["None" if i % 2 else "e4" for i in range(N)],
        "cdr": ["-1" if i % 4 == 0 else str(i) for i in range(N)],
    }
    table, _, spelled = read(tmp_path, columns)
    assert not spelled
    assert set(typed(table["apoe"])) == {"None", "e4"}
    sidecar = {"apoe": {"MissingValues": "None"}, "cdr": {"MissingValues": [-1, -4]}}
    table, _, spelled = read(tmp_path, columns, sidecar)
    assert dict(spelled) == {("apoe", "None"): N / 2, ("cdr", "-1"): N / 4}
    assert typed(table["apoe"]).dropna().unique().tolist() == ["e4"]
    assert typed(table["cdr"]).min() == 1


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ([*range(18, 31), -4, -4], "-4 (2)"),  # scores of a test
        ([*range(8, 21), -1], "-1 (1)"),  # years of education
        ([*range(55, 90), -4, -1], "-4 (1), -1 (1)"),
    ],
)
def test_codes_of_adni_are_refused_with_their_counts(values, code):
    with pytest.raises(ModelError, match=re.escape(f"'mmse' has {code}, other values are from")):
        check_numbers(pd.Series(values, dtype=float, name="mmse"), GroupSettings().design)


@pytest.mark.parametrize(
    "values",
    [
        [-1.0, 0.3, 1.2, -0.4, 0.0, 2.1],  # z-scores
        [0.5, 1.5, 2.0, 3.5, 6.0, -1.0],  # changes
        [*range(30), -1],  # zero is a value
        [-4, -1, -3, -2, -5],
    ],
)
def test_true_values_of_minus_one_are_numbers(values):
    check_numbers(pd.Series(values, dtype=float), GroupSettings().design)


def test_words_that_look_alike_are_levels(tmp_path):
    table, _, spelled = read(tmp_path, {"treatment": LEVELS})
    assert not spelled
    assert typed(table["treatment"]).dropna().tolist() == LEVELS


def test_a_level_that_the_sidecar_lists_is_one(tmp_path):
    columns = {
        "treatment": ["none" if i % 2 else "drug" for i in range(N)],
        "amyloid": ["-" if i % 2 else "+" for i in range(N)],
        "sex": [("1", "2", "9")[i % 3] for i in range(N)],
        "smoker": [("yes", "no", "NA")[i % 3] for i in range(N)],
    }
    table, _, spelled = read(tmp_path, columns)
    assert spelled["treatment", "none"] == 0
    assert spelled["amyloid", "-"] == N / 2
    levels = {
        "treatment": {"none": "no treatment", "drug": "10 mg"},
        "amyloid": {"-": "", "+": "", "n/a": "not measured"},
        "sex": {"1": "male", "2": {"Description": "female"}, "9": "unknown"},
        "smoker": {"yes": "n/a", "no": "n/a"},
    }
    sidecar = {name: {"Levels": one} for name, one in levels.items()}
    table, _, spelled = read(tmp_path, columns, sidecar)
    assert dict(spelled) == {("sex", "9"): N / 3, ("smoker", "NA"): N / 3}
    found = {name: set(typed(table[name]).dropna()) for name in columns}
    assert found == {
        "treatment": {"none", "drug"},
        "amyloid": {"-", "+"},
        "sex": {"male", "female"},
        "smoker": {"yes", "no"},
    }


@pytest.mark.parametrize(
    ("values", "missing"),
    [
        ([0, 5, 12, 20, -9], [-9]),  # years of education
        ([-3, -1, 0, 3, -9], []),  # a change: as far from the others as these are from each other
        ([-3, -1, 0, 3, -99], [-99]),
        ([-3, -1, 0, 3, -1], []),
        ([1, 2, 3, -1], []),  # no code of the setting
        ([-20, -9, -5, 10], []),
        ([-9, -99, 60, 70], [-9, -99]),
        ([-200, -150, -120, -99], []),
        ([50, 60, 70, 999], []),  # refused later, as a value may be large
        ([-9, -9], [-9, -9]),
    ],
)
def test_codes_are_missing_out_of_the_range_of_all_others(tmp_path, values, missing):
    table, _, spelled = read(tmp_path, {"score": [str(x) for x in values]})
    present = [x for x in values if x not in missing]
    assert typed(table["score"]).dropna().tolist() == present
    assert sorted(spelled.elements()) == sorted(("score", str(x)) for x in missing)


def test_endless_numbers_give_no_range(tmp_path):
    cells = ["inf", "-1e400", "1e308", "-1e308", "60", "70", "-9", "-99"]
    *_, spelled = read(tmp_path, {"score": cells})
    assert dict(spelled) == {("score", "-9"): 1, ("score", "-99"): 1}


def test_later_tables_replace_nothing_by_what_is_missing(tmp_path):
    (tmp_path / "phenotype").mkdir()
    (tmp_path / "phenotype" / "a.tsv").write_text("participant_id\tage\nsub-01\t?\nsub-02\t9\n")
    table, _, spelled = read(tmp_path, KINDS)
    assert table["age"].tolist()[:4] == ["50", "51", "9", "53"]
    assert dict(spelled) == {("age", "?"): 1}


def test_columns_of_the_model_are_named_first():
    spelled = {(f"a{i}", "NA"): 9 for i in range(9)} | {("sex", "?"): 1, ("z_score", "-"): 2}
    note = spelled_note(spelled, "group + z_score", GroupSettings())
    assert note.startswith("read as missing: sex '?' (1), z_score '-' (2), a0 'NA' (9), a1")
    assert "and 3 more" in note


def test_headers_with_blanks_and_columns_in_two_spellings(tmp_path):
    columns = {" age ": KINDS["age"], "\u00a0sex": KINDS["sex"]}
    table, *_ = read(tmp_path, columns)
    assert {"age", "sex"} <= set(table.columns)
    for pair in (("age", " age"), ("age", "age\u00a0")):
        with pytest.raises(InputError, match="column 'age' occurs more than once"):
            read(tmp_path, dict.fromkeys(pair, KINDS["age"]))
    with pytest.raises(InputError, match="columns age and Age differ in capitals only"):
        read(tmp_path, dict.fromkeys(("age", "Age"), KINDS["age"]))
    read(tmp_path, dict.fromkeys(("t", "T"), KINDS["age"]))


def test_blank_lines_are_no_rows_and_absent_participants_are_known(tmp_path):
    columns = {"age": [*KINDS["age"][: N - 2]]}
    table, absent, _ = read(tmp_path, columns)
    assert absent == {"sub-22", "sub-23"}
    path = tmp_path / "participants.tsv"
    path.write_bytes(
        b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n") + b"\t\r\n  \t\r\n"
    )
    again, *_ = read_covariates(table.iloc[:, :2], tmp_path, [], GroupSettings())
    assert again["age"].tolist()[:-2] == columns["age"]


@pytest.mark.parametrize("word", ["NA", "unknown", "-", "", "n/a"])
def test_all_tables_of_users_share_the_list(tmp_path, word):
    path = tmp_path / "t.tsv"
    path.write_text(f"participant_id\tsession_id\themi\trating\nsub-1\t{word}\t{word}\texclude\n")
    name = place_of(tmp_path, "1", "L", session="2").name
    visits = [("1", "2")]
    assert Choices(path, path, visits).reason_to_leave_out(name, "0" * 64)[0] == "listed"
    path.write_text(f"participant_id\trating\tnote\nsub-1\t{word}\tx\n")
    assert Choices(None, path, visits).counts([(name, None)])["unrated"] == 1
    path.write_text(
        "participant_id\tsession\themi\tend\tr\ta\ts\tnr\tna\tns\n"
        f"sub-1\t{word}\tL\tanterior\t1\t2\t3\t{word}\t{word}\t{word}\n"
    )
    (row,) = read_ends(path)
    assert (row.session, row.end.normal) == (None, None)
    path.write_text(f"thickness\n1.5\n{word or 'n/a'}\n")
    np.testing.assert_array_equal(gifti.read_map(path, "L", "thickness").values, [1.5, np.nan])


def test_tables_of_python_are_read_alike():
    random = np.random.default_rng(0)
    table = pd.DataFrame(KINDS).assign(age=random.normal(70, 5, N))
    table.loc[[2, 5, 7], "sex"] = "unknown"
    table[0] = "NA"  # columns may have any name
    fit = group(random.normal(2, 0.1, (N, 3, 3)), table, "group + sex + age")
    assert set(fit.design.levels["sex"]) == {"F", "M"}
    assert fit.design.dropped == {"sex": ("2", "5", "7")}
    assert "sex 'unknown' (3)" in fit.design.notes["missing"]
