"""The guide that repeats the paper's analyses: its files, its commands and its table of numbers.

The whole of it takes minutes: ``tools/test-tutorials`` runs it, which sets HIPSTA_BIDS_TUTORIALS.
"""

import json
import os
import re
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from extension_marks import needs
from small_cohorts import (
    NODES,
    begin_dataset,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)
from tutorial_pages import commands, whole

from hipsta_bids.cli.commands import phantom_parser
from hipsta_bids.cli.group import group_parser
from hipsta_bids.cli.main import main
from hipsta_bids.cli.participant import build_parser
from hipsta_bids.extensions.agreement.columns import REPLICATE_COLUMNS
from hipsta_bids.extensions.agreement.commands import compare_parser, replicate_parser
from hipsta_bids.extensions.agreement.replicate import GROUPS, PUBLISHED
from hipsta_bids.geometry.catalog import MAPS, PER_SUBFIELD, SUMMARY
from hipsta_bids.group.output import write
from hipsta_bids.group.settings import GroupSettings
from hipsta_bids.io import files
from hipsta_bids.io.files import read_tsv
from hipsta_bids.protocols.protocol import Tissue
from hipsta_bids.settings import PUBLISHED as PUBLISHED_SETTINGS
from hipsta_bids.settings import Settings

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "replicate.md").read_text()
ROWS = read_tsv(PUBLISHED)
#: Items of the paper with numbers, and the rows of each.
ITEMS = Counter({"table 1": 6, "text 3.1": 2, "table 2": 8, "table 3": 4, "table 4": 6})
ITEMS |= {"table 5": 8, "table 6": 2, "table 7": 6, "table A1": 8}
NUMBERS = ("n", "t", "p", "p_corrected", "node_x", "node_y", "auc_base", "auc_base_ci")
NUMBERS = (*NUMBERS, "auc_full", "auc_full_ci", "age_mean", "age_sd", "female")
CONTRASTS = "CU-MCI = group[CU] - group[MCI]", "CU-DAT = group[CU] - group[DAT]"


@pytest.fixture(scope="module", autouse=True)
def without_pages():
    """Let runs make pages here, as the commands do."""


def code(language):
    """List the blocks of the page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def commands_of_page():
    """List command lines without the program's name."""
    plain = re.sub(r"^```\w+\n.*?^```\n", "", PAGE, flags=re.MULTILINE | re.DOTALL)
    return [line for line, _ in commands(plain)]


def test_the_settings_of_the_page_are_those_of_the_published_method():
    participant, group = (tomllib.loads(text) for text in code("toml"))
    Settings().changed(**participant)  # names and ranges are checked
    grid = {"x_extent": 0.9, "y_extent": 0.975, "z_extent": 0.9, "z_nodes": 11}
    preset = {name: dict(values) for name, values in PUBLISHED_SETTINGS.items()}
    assert participant == preset | {"sheet": preset["sheet"] | grid}
    checked = GroupSettings.model_validate(group)
    assert not checked.registration.standardize
    assert not checked.registration.center


def test_the_commands_of_the_page_are_understood():
    first, *_ = every = commands_of_page()
    named = {"phantom", "surrogate", "compare", "replicate"}
    kinds = [line[0] if line[0] in named else line[2] for line in every]
    assert kinds == [
        "phantom",
        "participant",
        "group",
        "surrogate",
        *kinds[:3],
        "compare",
        *["replicate"] * 2,
    ]
    assert phantom_parser().parse_args(first[1:]).groups == ["CU", "MCI", "DAT"]
    for line in every:
        if "participant" in line:
            options = build_parser().parse_args(line)
            assert options.method == "published"
        elif line[0] == "compare":
            names = [
                text.partition("=")[0] for text in compare_parser().parse_args(line[1:]).analyses
            ]
            assert names == ["published", "ashs"]
        elif line[0] == "replicate":
            assert replicate_parser().parse_args(line[1:]).groups is None
        elif "group" in line:
            assert len(group_parser().parse_args(line).contrast) == 5


def test_the_table_has_every_published_row_and_its_numbers():
    assert Counter(row["item"] for row in ROWS) == ITEMS
    assert [name for name in ROWS[0] if name in NUMBERS] == list(NUMBERS)
    for row in ROWS:
        numbers = {
            name: float(row[name].removeprefix("<")) for name in NUMBERS if row[name] != "n/a"
        }
        assert numbers
        assert all(
            0 < v < 1 for name, v in numbers.items() if name.startswith(("p", "auc", "female"))
        )
    assert {row["p"] for row in ROWS if row["p"].startswith("<")} == {"<0.001"}
    published = {(row["quantity"], row["contrast"]): row["t"] for row in ROWS if row["t"] != "n/a"}
    assert published["volume CA1", "CU-DAT"] == "11.22"
    assert published["extent y", "CU-MCI"] == "-0.08"
    assert published["interior/exterior ratio", "CU-DAT"] == "-0.18"


def test_the_table_names_measures_groups_and_models_as_analyses_do():
    subfields = {f"{row.name}_{tissue.name}" for row in PER_SUBFIELD for tissue in Tissue}
    summaries = {row.name for row in SUMMARY} | subfields
    maps = {row.name for row in MAPS}
    for row in ROWS:
        of_groups = row["file"] == "demographics"
        known = {"peaks": maps, "demographics": {"n/a"}}.get(row["file"], summaries)
        assert row["measure"] in known
        assert row["hemi"] in ({"n/a"} if of_groups else {"L", "R"} if known is maps else {"LR"})
        assert row["contrast"] in (GROUPS if of_groups else {"CU-MCI", "CU-DAT"})
        assert row["model"] in {
            "demographics": {"n/a"},
            "classification": {f"volume | volume + {row['measure']}"},
        }.get(row["file"], {"group + age + sex", "group + age + sex + icv"})
    assert set(REPLICATE_COLUMNS) >= {*ROWS[0], "reason"}


def write_cohort(folder, names=GROUPS):
    """Walls and all published measures are smaller by 0, 1 and 3 SD in the three groups."""
    data, out = begin_dataset(folder)
    random, people = np.random.default_rng(0), []
    measures = sorted({row["measure"] for row in ROWS if row["hemi"] == "LR"})
    for i in range(42):
        loss, subject = (0, 1, 3)[i % 3], f"{i + 1:02d}"
        for hemi in "LR":
            place = place_of(out, subject, hemi)
            wall = 2 - 0.1 * loss + 0.1 * random.standard_normal(NODES)
            write_hemisphere(place, wall, random.standard_normal(NODES))
            values = [f"{7 - loss + random.standard_normal():.4f}" for _ in measures]
            files.write_tsv(place.path("summary"), measures, [values])
        age, icv = random.normal([70, 1500], [6, 100])
        people.append([f"sub-{subject}", names[i % 3], f"{age:.1f}", "FM"[i % 2], f"{icv:.0f}"])
    write_participants(data, people, ("participant_id", "group", "age", "sex", "icv"))
    return data, out


def analyze(cohort, name, *contrasts, options=()):
    """Run the group level as the page does, but on few maps, without figures and pages."""
    settings = cohort[1].parent / "published-group.toml"
    quick = "repeats = 1\nfolds = 3\n"
    settings.write_text(code("toml")[1] + quick)
    model = "--formula", "~ group + age + sex", "--contrast", *contrasts
    few = "--align", "none", "--measures", "thickness", "--no-reports", "--quiet", *options
    command = *map(str, cohort), "group", "--name", name, "--settings", str(settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(write, "draw_figures", lambda *_: iter(()))
        assert main([*command, *model, *few]) == 0
    return cohort[1] / "group" / name


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    return write_cohort(tmp_path_factory.mktemp("paper"))


@pytest.fixture(scope="module")
def published(cohort):
    """An analysis by the model of the page."""
    folder = analyze(cohort, "published", *CONTRASTS)
    rows = [("participants", "n/a", 14, "n/a", "n/a", "n/a"), ("age", "n/a", 14, 70.5, 6, "n/a")]
    rows += [("sex", "F", 14, "n/a", "n/a", 50), ("sex", "M", 14, "n/a", "n/a", 50)]
    columns = ["group", "variable", "level", "n", "mean", "sd", "percent"]
    lines = [[group, *map(str, row)] for group in GROUPS for row in rows]
    files.write_tsv(folder / "demographics.tsv", columns, lines)
    return folder


def beside(folder, out, *options):
    """The table that the command writes."""
    assert main(["replicate", str(folder), str(out), *options]) == 0
    content = table(out / "replicate.tsv")
    sidecar = json.loads((out / "replicate.json").read_text())
    assert list(sidecar) == list(content.columns)
    return content


def test_every_published_row_has_a_counterpart_of_the_same_sign(published, tmp_path, capsys):
    rows = beside(published, tmp_path)
    printed = capsys.readouterr().out.splitlines()
    assert len(rows) == len(ROWS)
    assert rows.reason.isna().all()
    tested = rows[rows.file.isin(["measures", "peaks"])]
    dementia = tested[tested.contrast == "CU-DAT"]
    assert (dementia.own_t > 0).all()  # that of the published loss
    assert (dementia.own_t[dementia.t > 5] > 3).all()
    own = table(published / "measures.tsv")
    for model, adjusted in (("group + age + sex", False), ("group + age + sex + icv", True)):
        part = own[(own.measure == "volume") & (own.hemi == "LR") & (own.model == model)]
        assert len(part) == 2
        here = rows[(rows.measure == "volume") & (rows.contrast == "CU-DAT")]
        expected = part[part.contrast == "CU-DAT"].statistic.iloc[0]
        assert (here.own_t.iloc[0] == expected) == adjusted
    pairs = rows[rows.file == "classification"]
    assert pairs.own_auc_full.between(0.5, 1).all()
    assert (pairs.own_auc_full >= pairs.own_auc_base - 0.02).all()
    assert (pairs.own_n == 28).all()
    peaks = rows[rows.file == "peaks"]
    assert peaks.own_node_x.between(1, NODES[0]).all()
    assert (peaks.own_n == 42).all()
    groups = rows[rows.file == "demographics"]
    assert groups[["own_n", "own_age_mean", "own_female"]].eq([14, 70.5, 0.5]).all(axis=None)
    line = next(line for line in printed if line.startswith("table 2") and "CA1" in line)
    assert re.search(r"volume CA1 +CU-DAT +t 11\.22, p <0\.001 +t \d+\.\d+, p <0\.001, n 42$", line)
    assert printed[-1] == f"results: {tmp_path / 'replicate.tsv'}"


def test_contrasts_of_the_other_direction_give_the_same_numbers(published, cohort, tmp_path):
    turned = "MCI-CU = group[MCI] - group[CU]", "group[DAT]-group[CU]"
    other = beside(analyze(cohort, "turned", *turned), tmp_path / "turned")
    rows = beside(published, tmp_path / "rows")
    tests = rows.file.isin(["measures", "classification"])
    names = ["own_t", "own_p", "own_n", "own_auc_base", "own_auc_full"]
    np.testing.assert_allclose(other.loc[tests, names], rows.loc[tests, names], rtol=1e-6)
    np.testing.assert_allclose(other.own_t[rows.file == "peaks"], rows.own_t[rows.file == "peaks"])


def test_rows_without_a_counterpart_have_the_reason(cohort, tmp_path):
    contrasts = "CU-MCI = group[CU] - group[MCI] > 0", CONTRASTS[1]
    folder = analyze(cohort, "few", *contrasts, options=["--no-classification"])
    own = table(folder / "measures.tsv")
    few = own[(own.measure != "volume_CA2") & ~own.model.str.contains("icv") & (own.hemi == "LR")]
    few.to_csv(folder / "measures.tsv", sep="\t", index=False, na_rep="n/a")
    (folder / "demographics.tsv").unlink(missing_ok=True)
    rows = beside(folder, tmp_path)
    for item, quantity, contrast, text in (
        ("table 1", "demographics", "CU", "no demographics.tsv: run"),
        ("table 2", "volume CA2", "CU-DAT", "measures.tsv has no volume_CA2: add it to --measures"),
        ("table 2", "volume CA1", "CU-DAT", "measures.tsv has no model with ICV: check icv"),
        (
            "table 3",
            "thickness, peak of map",
            "CU-MCI",
            "peaks.tsv has no CU-MCI: check --contrast",
        ),
        ("table 4", "extent x", "CU-MCI", "measures.tsv has no CU-MCI: check --contrast"),
        ("table 6", "mean thickness", "CU-DAT", "no classification.tsv: run"),
    ):
        is_row = (rows["item"] == item) & (rows.quantity == quantity) & (rows.contrast == contrast)
        assert rows[is_row].reason.str.startswith(text).all()
        assert is_row.any()
    rest = rows[rows["item"].isin(["table 4", "table 5"]) & (rows.contrast == "CU-DAT")]
    assert rest.reason.isna().all()


def test_groups_of_other_names_are_compared_if_they_are_named(tmp_path, capsys):
    names = ("CN", "LMCI", "AD")
    cohort = write_cohort(tmp_path, names)
    folder = analyze(
        cohort, "names", *(f"CN-{name} = group[CN]-group[{name}]" for name in names[1:])
    )
    capsys.readouterr()
    assert main(["replicate", str(folder), str(tmp_path / "none")]) == 65
    assert capsys.readouterr().err == (
        f"hipsta-bids: {folder}: no contrast CU-MCI or CU-DAT; there is CN-LMCI and CN-AD; "
        "check --contrast and --groups\n"
    )
    assert not (tmp_path / "none").exists()
    rows = beside(folder, tmp_path, "--groups", *names)
    assert rows.reason[rows.file != "demographics"].isna().all()
    assert (rows.own_t[(rows.t > 5) & (rows.contrast == "CU-DAT")] > 3).all()


def test_what_is_no_analysis_is_refused_in_one_line(tmp_path, capsys):
    assert main(["replicate", str(tmp_path), str(tmp_path / "x")]) == 65
    said = capsys.readouterr().err
    assert said.startswith(f"hipsta-bids: {tmp_path}: no analysis of the group level")
    assert said.count("\n") == 1


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The folder in which every command of the page was run."""
    folder = tmp_path_factory.mktemp("replicate")
    before = Path.cwd()
    os.chdir(folder)
    for name, text in zip(("published", "published-group"), code("toml"), strict=True):
        Path(f"{name}.toml").write_text(text)
    for line in commands_of_page():
        assert main(line) == 0, line
    yield folder
    os.chdir(before)


@needs("surrogate")
@whole
def test_every_file_and_column_of_the_page_is_there(study):
    rows = re.findall(r"^\| .*? \| (`.*?) \| (.*?) \|$", PAGE, re.MULTILINE)
    assert len(rows) == 7
    columns = ""
    for out in ("out", "out-ashs"):
        folder = study / out / "group" / "published"
        for patterns, names in rows:
            columns = columns if names == "the same" else names
            wanted = set(re.findall(r"`(\w+)`", columns))
            for pattern in re.findall(r"`([^`]+)`", patterns):
                found = list(folder.glob(pattern))
                assert found, pattern
                tables = [table(path) for path in found if path.suffix == ".tsv"]
                wanted -= {name for one in tables for name in one.columns}
            assert not wanted
    assert list((study / "out").rglob("*_desc-surrogate_morph.tsv"))


@needs("surrogate")
@whole
def test_the_planted_loss_is_found_with_both_segmentations(study):
    for out in ("out", "out-ashs"):
        rows = table(study / out / "group" / "published" / "measures.tsv")
        thin = rows[(rows.measure == "thickness_mean_CA1") & (rows.contrast == "CU-DAT")]
        assert len(thin) == 3
        assert ((thin.estimate > 0) & (thin.p_fdr < 0.05)).all()


@needs("surrogate")
@whole
def test_both_segmentations_are_in_one_table(study):
    """The planted loss is in both, so that effect maps of the dementia group go together."""
    rows = table(study / "segmentations" / "agreement.tsv")
    thickness = rows[(rows.measure == "thickness") & (rows.contrast == "CU-DAT")]
    assert len(thickness) == 2
    assert (thickness.r > 0).all()


@needs("surrogate")
@whole
def test_the_published_numbers_stand_beside_those_of_the_cohort(study):
    """The protocol of the first cohort has one label for CA2 and CA3; ASHS has all subfields."""
    rows = table(study / "published-numbers" / "replicate.tsv")
    missing = rows[rows.reason.notna() & (rows.file != "demographics")]
    assert set(missing.measure) == {"volume_CA2", "volume_CA3"}
    rows = table(study / "published-ashs" / "replicate.tsv")
    assert rows.reason[rows.file != "demographics"].isna().all()
    thin = rows[(rows.measure == "thickness_nodes") & (rows.file == "measures")]
    assert (thin.own_t > 0).all()
