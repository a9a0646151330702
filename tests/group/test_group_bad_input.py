"""What the group level refuses: one line, the right code, and nothing half-written."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from small_cohorts import FAST, place_of, read_participants, write_hemisphere, write_participants

from hipsta_bids import __version__
from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.dataset import identity, update_status
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.group.cohort.exclusions import is_listed
from hipsta_bids.io import files


def edit_record(place, **changes):
    path = place.path("qc")
    files.write_json(path, json.loads(path.read_text()) | changes)


def no_groups(study):
    rows = [row[:1] + row[2:] for row in read_participants(study.data)]
    write_participants(study.data, rows, ("participant_id", "age", "sex"))


def one_group(study):
    write_participants(study.data, [[r[0], "CN", *r[2:]] for r in read_participants(study.data)])


def no_table(study):
    (study.data / "participants.tsv").unlink()


def twice(study):
    rows = read_participants(study.data)
    write_participants(study.data, [*rows, rows[0]])


def huge_age(study):
    rows = read_participants(study.data)
    rows[3][2] = "1e300"
    write_participants(study.data, rows)


def no_age(study):
    rows = read_participants(study.data)
    write_participants(study.data, [[*row[:2], "n/a", row[3]] for row in rows])


def other_people(study):
    rows = read_participants(study.data)
    write_participants(study.data, [[f"{row[0]}x", *row[1:]] for row in rows])


def header_only(study):
    write_participants(study.data, [])


def other_encoding(study):
    path = study.data / "participants.tsv"
    path.write_bytes(path.read_text().replace("CN", "Contrôle").encode("latin-1"))


def with_commas(study):
    path = study.data / "participants.tsv"
    path.write_text(path.read_text().replace("\t", ","))


def column_twice(study):
    rows = read_participants(study.data)
    columns = ("participant_id", "group", "age", "age")
    write_participants(study.data, rows, columns)


def no_dataset(study):
    shutil.rmtree(study.data)


def ages(study, function):
    rows = [[*row[:2], function(row[2]), row[3]] for row in read_participants(study.data)]
    write_participants(study.data, rows)


def impossible_age(study):
    rows = read_participants(study.data)
    rows[3][2] = "1e50"
    write_participants(study.data, rows)


def negative_age(study):
    rows = read_participants(study.data)
    rows[3][2] = "-3"
    write_participants(study.data, rows)


def age_in_months(study):
    rows = read_participants(study.data)
    rows[3][2] = "150"
    write_participants(study.data, rows)


def coded_age(study):
    rows = read_participants(study.data)
    rows[3][2] = rows[7][2] = "999"
    write_participants(study.data, rows)


def coded_sex(study):
    rows = read_participants(study.data)
    rows[3][3] = rows[7][3] = rows[9][3] = "999"
    write_participants(study.data, rows)


def comma_age(study):
    ages(study, lambda age: age.replace(".", ","))


def date_age(study):
    ages(study, lambda age: f"19{age[:2]}-01-01")


def two_spellings(study):
    rows = read_participants(study.data)
    rows[3][1] = rows[3][1].lower()
    write_participants(study.data, rows)


def text_age(study):
    rows = read_participants(study.data)
    rows[3][2] = "old"
    write_participants(study.data, rows)


def one_patient(study):
    rows = read_participants(study.data)
    write_participants(
        study.data, [[row[0], "CN" if k else "AD", *row[2:]] for k, row in enumerate(rows)]
    )


def mixed_settings(study):
    edit_record(place_of(study.out, "07", "R"), settings_hash="0" * 64)


def other_grid(study):
    path = place_of(study.out, "05", "L").path("sheet")
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-7]) + "\n")


def no_list_of_files(study):
    edit_record(place_of(study.out, "07", "R"), inputs=["rh.mgz"])


def no_metrics(study):
    edit_record(place_of(study.out, "07", "R"), metrics="none")


def no_grid(study):
    files.write_json(study.out / "desc-settings.json", {"settings": {"sheet": {"x_nodes": "41"}}})


def no_sheet(study):
    place_of(study.out, "05", "L").path("sheet").unlink()


def unfinished(study):
    row = identity(place_of(study.out, "99", "L").name)
    update_status(study.out, [row | {"decision": "failed", "reason": "not-finished"}])


def second_protocol(study):
    place = place_of(study.out, "01", "L", seg="other")
    write_hemisphere(place, np.ones((21, 7)), np.ones((21, 7)))


def all_failed(study):
    for path in study.out.glob("sub-*/anat/*_metrics.json"):
        files.write_json(path, {"decision": "failed", "reason": "too-thin"})


def no_values(study):
    for path in study.out.glob("sub-*/anat/*hemi-L*_desc-sheet_morph.tsv"):
        rows = [line.split("\t") for line in path.read_text().splitlines()]
        rows[1:] = [[*row[:2], "n/a", *row[3:]] for row in rows[1:]]
        path.write_text("\n".join("\t".join(row) for row in rows) + "\n")


@pytest.mark.parametrize(
    ("spoil", "options", "code", "words"),
    [
        (no_groups, [], 65, "no column has two groups"),
        (no_table, [], 65, "BIDS_DIR/participants.tsv is missing or has no further"),
        (one_group, [], 65, "group is CN for all in the analysis; see --seg"),
        (impossible_age, [], 65, "has sub-04 (1e+50), half of the others"),
        (negative_age, [], 65, "sub-04 (-3), which is impossible"),
        (age_in_months, [], 65, "sub-04 (150), which is impossible"),
        (coded_age, [], 65, "has sub-04 (999), sub-08 (999), other values are 5"),
        (coded_sex, [], 65, "'sex' has 999 (3) among words: a code for missing values?"),
        (comma_age, [], 65, "'age' holds decimal commas, as sub-01 ('74,1')"),
        (date_age, [], 65, "'age' holds dates, as sub-01 ('1974-01-01')"),
        (two_spellings, [], 65, "capitals or blanks only: 'CN' (15), 'cn' (1)"),
        (twice, [], 65, "sub-01 occur more than once"),
        (text_age, [], 65, "sub-04"),
        (huge_age, [], 65, "too large for rows sub-04"),
        (no_age, ["--formula", "group + age"], 65, "missing are age (30)"),
        (other_people, [], 65, "names none of the participants here"),
        (header_only, [], 65, "has no rows"),
        (other_encoding, [], 65, "no UTF-8 text"),
        (with_commas, [], 65, "columns are separated by ','; save it with tabs"),
        (column_twice, [], 65, "'age' occurs more than once"),
        (no_dataset, [], 65, "folder not found"),
        (None, ["--formula", " "], 64, "--formula is empty"),
        (None, ["--formula", "group + my age"], 64, "backticks"),
        (None, ["--formula", "thickness ~ I(age.map(open))"], 64, "'age.map(open)' is not allowed"),
        (None, ["--formula", "group + {age.to_csv('x')}"], 64, "is not allowed; allowed are"),
        (None, ["--formula", "(group + age + sex + age + sex)**9"], 64, "more than 1000 products"),
        (None, ["--formula", "log(group)"], 65, "'log(group)': functions take numbers, but group"),
        (None, ["--formula", "thickness ~ group | sex"], 64, "'|' is not allowed"),
        (None, ["--exclude", "nowhere.tsv"], 65, "file not found"),
        (one_patient, [], 65, "AD (1)"),
        (mixed_settings, [], 65, "sub-07_hemi-R"),
        (other_grid, [], 65, "21 x 7 nodes"),
        (no_list_of_files, [], 65, "hemi-R_seg-demo_desc-qc_metrics.json: bad inputs"),
        (no_metrics, [], 65, "hemi-R_seg-demo_desc-qc_metrics.json: bad metrics"),
        (no_grid, [], 65, "x_nodes is '41', but has to be a whole number"),
        (no_sheet, [], 65, "sub-05_hemi-L"),
        (unfinished, [], 65, "sub-99_hemi-L"),
        (second_protocol, [], 65, "choose one by --seg"),
        (all_failed, [], 66, "60 failed: too-thin"),
        (no_values, [], 65, "sub-01: no point of the thickness map has a value"),
        (None, ["--seg", "nope"], 66, "there is demo"),
        (None, ["--participant-label", "77"], 66, "no hemisphere as asked for"),
        (None, ["--participant-label", "01", "02", "20", "21"], 65, "too few"),
        (None, ["--formula", "group + aeg", "--contrast", "age"], 65, "did you mean age?"),
        (None, ["--contrast", "group[XX]-group[CN]"], 65, "group[XX]"),
        (None, ["--contrast", "age-sex[M]", "age:sex[M]"], 65, "whose files would have one name"),
        (None, ["--reference", "group=XX"], 65, "XX"),
        (None, ["--formula", "group + age + I(2*age)"], 65, "combination"),
        (None, ["--formula", "group + log(age - 80)"], 65, "no value for rows sub-01"),
        (None, ["--base", "volum"], 65, "did you mean volume?"),
        (None, ["--base", "group"], 64, "this column has the groups to classify"),
        (None, ["--exclude-qc", "filled_fraction"], 64, "is not of the form"),
        (None, ["--exclude-qc", "filled_fracton > 1"], 64, "did you mean filled_fraction?"),
        (None, ["--exclude-qc", "rule > 1"], 64, "no number"),
        (None, ["--model", "nowhere.json"], 65, "nowhere.json: file not found"),
        (None, ["--template", "nowhere.json"], 65, "nowhere.json"),
        (None, ["-d", "hipsta=/nowhere"], 65, "/nowhere"),
        (None, ["--align", "fancy"], 64, "fancy"),
        (None, ["--name", "../x"], 64, "../x"),
        (None, ["--name", "é"], 64, "'é' is not a name of letters, digits"),
    ],
)
def test_refused_in_one_line(study, capsys, spoil, options, code, words):  # noqa: PLR0917 -- cases
    data, out = study
    if spoil is not None:
        spoil(study)
    assert main([str(data), str(out), "group", *options]) == code
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert not list(out.glob("group/*"))
    assert not list(out.glob("group/.*"))


def test_who_alone_determines_a_coefficient_leaves_no_variance(study, capsys):
    """Rounding must not let a residual of zero pass for one that is known."""
    rows = [
        [*row[:3], "MF"[row[0] == "sub-30" or (row[1] == "CN" and i % 2)]]
        for i, row in enumerate(read_participants(study.data))
    ]
    write_participants(study.data, rows)
    settings = study.data / "hc3.toml"
    settings.write_text('[glm]\ncovariance = "hc3"\n')
    model = ["--formula", "group * sex", "--contrast", "group[T.AD]:sex[T.M]"]
    call = [str(study.data), str(study.out), "group", *FAST, *model, "--settings", str(settings)]
    assert main(call) == 65
    error = capsys.readouterr().err
    assert "a coefficient depends on one participant at all points" in error
    assert error.count("\n") == 1


def test_ages_less_their_mean_may_be_negative(study):
    ages(study, lambda age: f"{float(age) - 70:.1f}")
    assert main([str(study.data), str(study.out), "group", *FAST]) == 0


def test_failing_run_leaves_earlier_results(study):
    data, out = study
    kept = out / "group" / "group-age-sex" / "peaks.tsv"
    files.write_text(kept, "earlier")
    mixed_settings(study)
    assert main([str(data), str(out), "group"]) == 65
    assert kept.read_text() == "earlier"


def test_same_subject_in_two_datasets_is_refused(written, study, tmp_path, capsys):
    roots = [f"a={study.out}", f"b={written / 'out'}"]
    arguments = [str(study.data), str(tmp_path / "o"), "group", "-d", *roots]
    assert main(arguments) == 65
    assert "different sites need different labels" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.usefixtures("without_figures")
def test_table_of_a_spreadsheet_is_read(study, quick):
    """With a byte order mark, line ends of Windows, and blanks round the labels."""
    path = study.data / "participants.tsv"
    text = path.read_text().replace("\n", "\r\n").replace("sub-02", "sub-02 ")
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    options = [*quick, "--align", "none", "--measures", "thickness"]
    assert main([str(study.data), str(study.out), "group", *options]) == 0
    (table,) = (study.out / "group").glob("*/excluded.tsv")
    left_out = table.read_text()
    assert left_out.count("\n") == 1


def test_contrasts_name_columns_with_blanks_in_backticks(study):
    columns = ("participant_id", "Dx group", "Alter-1", "sex")
    write_participants(study.data, read_participants(study.data), columns)
    model = ["--formula", "`Dx group` + `Alter-1`", "--name", "blanks", "--contrast"]
    contrasts = ["`Dx group`[CN]-`Dx group`[AD]", "`Alter-1`"]
    call = [str(study.data), str(study.out), "group", *FAST, *model, *contrasts]
    assert main(call) == 0
    maps = files.read_tsv(study.out / "group" / "blanks" / "maps.tsv")
    assert [row["contrast"] for row in maps[:2]] == contrasts
    assert int(maps[0]["n_significant"]) > 0  # the walls of patients are thinner


@pytest.mark.usefixtures("without_figures")
def test_names_of_groups_may_have_any_signs(study):
    path = study.data / "participants.tsv"
    text = path.read_text()
    path.write_text(text.replace("\tCN", "\tâgé 女>=24").replace("\tAD", "\t=low()"))
    call = [str(study.data), str(study.out), "group", *FAST, "--name", "signs"]
    assert main(call) == 0
    maps = files.read_tsv(study.out / "group" / "signs" / "maps.tsv")
    assert {row["contrast"] for row in maps} == {"=low()-âgé 女>=24"}
    files_of = (study.out / "group" / "signs").glob("*contrast-LowAgeU597324_*.shape.gii")
    assert len(list(files_of)) > 0


def test_exclusions_name_one_protocol_and_region():
    name = HemisphereName(subject="01", session=None, hemi="L", seg="fs", region="extended")
    row = {"participant_id": "sub-01", "session_id": "n/a", "hemi": "L"}
    assert is_listed(name, row)
    assert is_listed(name, row | {"protocol": "fs", "region": "extended"})
    assert not is_listed(name, row | {"protocol": "fs", "region": "body"})
    assert not is_listed(name, row | {"protocol": "other", "region": "n/a"})
    # Maps of other programs have no protocol.
    assert is_listed(replace(name, seg=""), row | {"protocol": "other", "region": "body"})


@pytest.mark.usefixtures("without_figures")
def test_exclusions_of_nobody_are_told(study, quick, tmp_path, capsys):
    listed = tmp_path / "listed.tsv"
    listed.write_text("participant_id\themi\nsub-77\tn/a\nsub-01\tL\n")
    options = [*quick, "--align", "none", "--measures", "thickness", "--exclude", str(listed)]
    assert main([str(study.data), str(study.out), "group", *options]) == 0
    assert "matches no hemisphere here: sub-77" in capsys.readouterr().out


@pytest.mark.usefixtures("without_figures")
def test_sheets_that_no_hippocampus_has_are_left_out_by_participant_and_measure(study, capsys):
    wrong = {
        "01": ("thickness", "-1", "thickness reaches -1 mm"),
        "02": ("thickness", "0", "thickness reaches 0 mm"),
        "03": ("thickness", "10", "thickness reaches 10 mm"),
        "04": ("thickness", "1.8", "thickness is 1.8 mm at all points"),
        "05": ("curvature", "1e6", "curvature reaches 1e+06 1/mm"),
        "06": ("curvature", "0", "curvature is 0 1/mm at all points"),
        "07": ("thickness_mean", "-2", "thickness_mean reaches -2 mm"),
        "08": ("volume", "0", "volume reaches 0 mm^3"),
        "09": ("volume", "1e9", "volume reaches 1e+09 mm^3"),
        "10": ("volume", "inf", "volume reaches inf mm^3"),
    }
    for subject, (column, value, _) in wrong.items():
        kind = "sheet" if column in {"thickness", "curvature"} else "summary"
        path = place_of(study.out, subject, "L").path(kind)
        rows = files.read_tsv(path)
        files.write_tsv(path, list(rows[0]), [(row | {column: value}).values() for row in rows])
    assert main([str(study.data), str(study.out), "group", *FAST, "--name", "few"]) == 0
    excluded = files.read_tsv(study.out / "group" / "few" / "excluded.tsv")
    assert [(row["participant_id"], row["hemi"]) for row in excluded] == [
        (f"sub-{subject}", "L") for subject in wrong
    ]
    said = capsys.readouterr().out
    for (*_, text), row in zip(wrong.values(), excluded, strict=True):
        assert row["reason"] == "damaged-map"
        assert row["message"].startswith(text)
    assert f"sub-01, hemisphere L, is excluded: {wrong['01'][-1]}" in said


@pytest.mark.usefixtures("without_figures")
def test_damaged_hemispheres_are_left_out_by_name_and_other_versions_told(study, capsys):
    path = place_of(study.out, "05", "L").path("sheet")
    lines = [line.split("\t") for line in path.read_text().splitlines()]
    lines[9][2] = "1e30"
    path.write_text("\n".join("\t".join(line) for line in lines) + "\n")
    for hemi in "LR":  # a participant without any hemisphere is not in the model at all
        path = place_of(study.out, "06", hemi).path("sheet")
        rows = [line.split("\t") for line in path.read_text().splitlines()]
        rows[1:] = [[*row[:2], "n/a", "n/a", row[4]] for row in rows[1:]]
        path.write_text("\n".join("\t".join(row) for row in rows) + "\n")
    edit_record(place_of(study.out, "07", "R"), version="0.0.9")
    assert main([str(study.data), str(study.out), "group", *FAST]) == 0
    said = capsys.readouterr()
    assert (
        "29 participants in the model, 3 exclusions of participants, visits or hemispheres"
        in said.out
    )
    assert "sub-05, hemisphere L, is excluded: thickness reaches 1e+30 mm" in said.out
    assert "sub-06, hemisphere R, is excluded: 100% of the curvature profile" in said.out
    assert said.err.startswith("warning: hemispheres were measured by several versions, 0.0.9 (1),")
    assert f"measure sub-07_hemi-R with {__version__}" in said.err
    (path,) = study.out.glob("group/*/excluded.tsv")
    excluded = files.read_tsv(path)
    assert [(row["participant_id"], row["hemi"], row["reason"]) for row in excluded] == [
        ("sub-05", "L", "damaged-map"),
        ("sub-06", "L", "damaged-map"),
        ("sub-06", "R", "damaged-map"),
    ]


def with_column(study, name, values):
    rows = [
        [*row, str(value)] for row, value in zip(read_participants(study.data), values, strict=True)
    ]
    write_participants(study.data, rows, ("participant_id", "group", "age", "sex", name))


@pytest.mark.usefixtures("without_figures")
def test_sites_are_factors_however_they_are_coded_and_empty_covariates_told(study, capsys):
    no_age(study)
    with_column(study, "site", [k % 3 + 1 for k in range(30)])
    assert main([str(study.data), str(study.out), "group", *FAST]) == 0
    (design,) = study.out.glob("group/*/design.tsv")
    columns = ["Intercept", "group[T.AD]", "sex[T.M]", "site[T.2]", "site[T.3]"]
    assert list(files.read_tsv(design)[0])[2:] == columns
    assert "note: age is n/a for all, and not in the model" in capsys.readouterr().out


@pytest.mark.usefixtures("without_figures")
def test_sidecar_makes_factors_and_names_their_levels(study, capsys):
    with_column(study, "stage", [k % 3 for k in range(30)])
    options = [*FAST, "--formula", "group + stage"]
    assert main([str(study.data), str(study.out), "group", *options]) == 0
    assert "stage has 3 values (0, 1, 2), fitted as a line" in capsys.readouterr().out
    levels = {"0": "none", "1": {"Description": "some"}, "2": "much"}
    files.write_json(study.data / "participants.json", {"stage": {"Levels": levels}})
    options += ["--contrast", "stage[none]-stage[much]"]
    assert main([str(study.data), str(study.out), "group", *options]) == 0
    assert "as a line" not in capsys.readouterr().out
    (design,) = study.out.glob("group/*/design.tsv")
    assert list(files.read_tsv(design)[0])[-2:] == ["stage[T.much]", "stage[T.some]"]


@pytest.mark.usefixtures("without_figures")
def test_smaller_groups_that_vary_more_are_told_unless_the_model_allows_for_it(study, capsys):
    said = []
    write_participants(study.data, read_participants(study.data)[:24])
    for factor, settings in ((1, ""), (3, ""), (1, '[glm]\ncovariance = "hc3"\n')):
        for i in range(17, 25):
            path = place_of(study.out, f"{i:02d}", "L").path("sheet")
            rows = files.read_tsv(path)
            for row in rows:
                wall = 1.6 + factor * (float(row["thickness"]) - 1.6)
                row["thickness"] = f"{max(0.1, wall):.4f}"
            files.write_tsv(path, list(rows[0]), [row.values() for row in rows])
        (study.out / "own.toml").write_text(settings)
        options = [*FAST, "--settings", str(study.out / "own.toml"), "--name", "spread"]
        options.append("--allow-missing")
        assert main([str(study.data), str(study.out), "group", *options]) == 0
        said.append(capsys.readouterr().out)
    assert ["the smaller group varies more" in one for one in said] == [False, True, False]
    assert "CN (16) and AD (8), thickness, L: the smaller group" in said[1]
    methods = (study.out / "group" / "spread" / "methods.md").read_text()
    assert "tested with the same model. " in methods  # no intracranial volume is known
