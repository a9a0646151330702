"""Segmentations of several kinds in one analysis: refused, or named with what they go with."""

import json
import re
from itertools import product
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from extension_marks import needs
from norm_cohorts import write_people
from scipy import stats
from small_cohorts import (
    NODES,
    begin_dataset,
    place_of,
    table,
    write_hemisphere,
    write_participants,
)

from hipsta_bids.cli.main import main
from hipsta_bids.derivatives.dataset import PROVENANCE
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.reports.group import group_page
from hipsta_bids.stats.settings import Provenance

PEOPLE = 12
USUAL = {
    "tool": "freesurfer",
    "version": "v22",
    "analysis": "T1",
    "atlas": "n/a",
    "hierarchy": "full",
    "space": "n/a",
    "design": "cross-sectional",
    "edited": "n/a",
    "probabilities": "n/a",
    "voxel_size": "0.333 x 0.333 x 0.333",
}
OTHER = {
    "tool": "nextbrain",
    "version": "v21",
    "analysis": "T1-T2",
    "atlas": "bigbrain",
    "hierarchy": "FS60+HBT",
    "space": "FSvoxelSpace",
    "design": "longitudinal",
    "edited": "labels",
    "probabilities": "ashs",
    "voxel_size": "0.333 x 0.333 x 1",
}
#: Ages, unlike the groups, which are odd and even.
AGES = [61, 64, 70, 72, 66, 63, 74, 69, 62, 71, 67, 65]


def is_patient(i):
    return i % 2 == 1


def make(folder, origin, sessions=(None,)):
    """Controls and patients; ``origin(i, session, hemi)`` is a hemisphere's provenance, if any."""
    data, out = begin_dataset(folder)
    random = np.random.default_rng(0)
    bend = 0.1 + 0.2 * np.exp(-(np.linspace(-2, 2, NODES[0])[:, None] ** 2)) + np.zeros(NODES)
    for i, session, hemi in product(range(PEOPLE), sessions, "LR"):
        record = origin(i, session, hemi)
        place = place_of(out, f"{i + 1:02d}", hemi, session=session)
        write_hemisphere(
            place,
            1.8 + 0.2 * random.standard_normal(NODES),
            bend + 0.01 * random.standard_normal(NODES),
            volume=500 + 10 * random.standard_normal(),
            **({} if record is None else {"provenance": record}),
        )
    rows = [
        [f"sub-{i + 1:02d}", ("CN", "AD")[is_patient(i)], f"{AGES[i]}", "FM"[i // 2 % 2]]
        for i in range(PEOPLE)
    ]
    write_participants(data, rows)
    for i in range(PEOPLE) if sessions != (None,) else ():
        path = data / f"sub-{i + 1:02d}" / f"sub-{i + 1:02d}_sessions.tsv"
        rows = [[f"ses-{name}", f"{year}"] for year, name in enumerate(sessions)]
        files.write_tsv(path, ["session_id", "years"], rows)
    return data, out


def patients_differ(field, value=None):
    other = OTHER[field] if value is None else value
    return lambda i, *_: USUAL | ({field: other} if is_patient(i) else {})


@pytest.fixture
def call(capsys):
    """Run the group level on summary measures, and return what it printed and wrote."""

    def run(dataset, *options, code=ExitCode.OK):
        data, out = dataset
        if not any(one.startswith(("--formula", "--retest", "--power")) for one in options):
            options = ("--formula", "thickness_mean ~ group + age", *options)
        words = [str(data), str(out), "group", "--name", "results", "--no-classification"]
        if {"--retest", "--power", "--fit-norms", "--norms"} & set(options):
            words.remove("--no-classification")
        assert main([*words, "--align", "none", *options]) == code
        printed = capsys.readouterr()
        folder = out / "group" / "results"
        written = code == ExitCode.OK
        return SimpleNamespace(
            error=printed.err,
            lines=[one for one in printed.err.splitlines() if "differ in" in one],
            record=files.read_json(folder / "analysis.json") if written else None,
            methods=(folder / "methods.md").read_text() if written else "",
            page=group_page(folder) if written else "",
        )

    return run


def refused(call, dataset, *options):
    """Return the one line of a refusal, which has written nothing."""
    result = call(dataset, *options, code=ExitCode.BAD_DATA)
    assert not (dataset[1] / "group").exists()
    (line,) = result.error.splitlines()
    return line


def test_ends_that_were_estimated_in_one_group_are_named_and_not_refused(tmp_path, call):
    dataset = make(tmp_path, lambda *_: USUAL)
    for path in dataset[1].rglob("*_desc-qc_metrics.json"):
        record = files.read_json(path)
        patient = is_patient(int(path.name[4:6]) - 1)
        rules = {"posterior": "labels", "anterior": "core" if patient else "user"}
        record["metrics"] |= {f"{end}_end_rule": rule for end, rule in rules.items()}
        files.write_json(path, record)
    result = call(dataset)
    (line,) = result.lines
    counts = "ends of the body: anterior estimated (12), labeled (12)"
    assert f"hemispheres differ in {counts}; association with group p 0.002 (Fisher" in line
    assert line.endswith("effects of group may be effects of ends of the body")
    assert "Note that hemispheres differ in ends of the body" in result.methods
    assert "was fitted to each summary measure" in result.methods
    assert "point" not in result.methods.partition("## Statistics")[2].partition("##")[0]


@pytest.mark.parametrize("field", PROVENANCE)
def test_each_kind_of_mix_is_refused_or_named(tmp_path, call, field):
    dataset = make(tmp_path, patients_differ(field))
    counts = ", ".join(f"{value} (12)" for value in sorted([USUAL[field], OTHER[field]]))
    line = refused(call, dataset)
    assert f"hemispheres of one analysis differ in {field}: {counts};" in line
    assert line.endswith(f"allow it by --mixed {field}")

    result = call(dataset, "--mixed", field)
    (warning,) = result.lines
    said = f"hemispheres differ in {field}: {counts}; association with group p 0.002 (Fisher's"
    assert warning.startswith(f"warning: {said}")
    assert warning.endswith(f"effects of group may be effects of {field}")
    assert result.record["settings"]["design"]["mixed"] == [field]
    (text,) = result.record["mixes"]
    assert text == warning.removeprefix("warning: ")
    assert f"Note that {text}.\n\n# References" in result.methods
    assert f"<b>Mixed segmentations:</b> {text.replace(chr(39), '&#39;')}." in result.page


def test_options_and_settings_know_the_fields():
    assert get_args(Provenance) == PROVENANCE


def test_other_fields_are_refused_nevertheless(tmp_path, call):
    def origin(i, *_):
        both = {name: OTHER[name] for name in ("analysis", "version")}
        return USUAL | (both if is_patient(i) else {})

    dataset = make(tmp_path, origin)
    line = refused(call, dataset)
    assert "version: v21 (12), v22 (12); analysis: T1 (12), T1-T2 (12);" in line
    assert line.endswith("--mixed version analysis")
    assert refused(call, dataset, "--mixed", "version", "tool").endswith("--mixed analysis")
    assert len(call(dataset, "--mixed", "version", "--mixed", "analysis").lines) == 2

    settings = tmp_path / "group.toml"
    settings.write_text('[design]\nmixed = ["analysis", "version"]\n')
    assert len(call(dataset, "--settings", str(settings)).lines) == 2


def test_unknown_fields_are_refused_with_a_list(tmp_path, call):
    dataset = make(tmp_path, patients_differ("analysis"))
    (line,) = call(dataset, "--mixed", "analyses", code=ExitCode.USAGE).error.splitlines()
    assert "'analyses'" in line
    assert all(repr(field) in line for field in PROVENANCE)


@pytest.mark.parametrize(
    "origin",
    [
        pytest.param(lambda *_: USUAL, id="alike"),
        pytest.param(lambda *_: OTHER, id="alike in another way"),
        pytest.param(lambda *_: None, id="not recorded"),
        pytest.param(lambda *_: {"tool": "freesurfer"}, id="partly recorded"),
        pytest.param(patients_differ("voxel_size", "0.336 x 0.33 x 0.333"), id="zoom"),
    ],
)
def test_homogeneous_cohorts_raise_no_alarm(tmp_path, call, origin):
    result = call(make(tmp_path, origin))
    assert (result.lines, result.record["mixes"]) == ([], [])
    assert "Mixed segmentations" not in result.page
    assert "Note that" not in result.methods


def test_voxels_in_another_order_of_axes_are_the_same(tmp_path, call):
    sizes = ("0.4 x 0.4 x 2", "2 x 0.403 x 0.4", "0.398 x 1.97 x 0.4")
    dataset = make(tmp_path, lambda i, *_: USUAL | {"voxel_size": sizes[i % 3]})
    assert not call(dataset).lines


@pytest.mark.parametrize(
    ("size", "said"),
    [
        # A slice, and an edge of protocols that are near to each other.
        ("0.4 x 0.4 x 2.2", "0.4 x 0.4 x 2 (12), 0.4 x 0.4 x 2.2 (12)"),
        ("0.43 x 0.43 x 2", "0.4 x 0.4 x 2 (12), 0.43 x 0.43 x 2 (12)"),
        ("n/a", "0.4 x 0.4 x 2 (12), n/a (12)"),
        ("0.4", "0.4 (12), 0.4 x 0.4 x 2 (12)"),
    ],
)
def test_other_sizes_of_voxels_are_a_mix(tmp_path, call, size, said):
    def origin(i, *_):
        return USUAL | {"voxel_size": size if is_patient(i) else "0.4 x 0.4 x 2"}

    assert f"differ in voxel_size: {said};" in refused(call, make(tmp_path, origin))


def test_what_some_do_not_record_is_a_mix(tmp_path, call):
    dataset = make(tmp_path, lambda i, *_: None if i < 3 else USUAL)
    line = refused(call, dataset)
    assert "differ in tool: freesurfer (18), n/a (6); version: n/a (6), v22 (18);" in line
    assert line.endswith("--mixed tool version analysis hierarchy design voxel_size")


def test_hemispheres_that_are_not_analyzed_do_not_count(tmp_path, call):
    """Those excluded, without a covariate, of a later session, of another region or protocol."""

    def origin(i, session, hemi):
        is_other = session == "2" or i == 1 or (i, hemi) == (2, "R")
        return OTHER if is_other else USUAL

    data, out = make(tmp_path, origin, sessions=("1", "2"))
    refused(call, (data, out))
    rows = [list(row.values()) for row in files.read_tsv(data / "participants.tsv")]
    rows[1][2] = "n/a"
    write_participants(data, rows)
    excluded = tmp_path / "exclude.tsv"
    excluded.write_text("participant_id\themi\nsub-03\tR\n")
    flat = np.full(NODES, 1.5)
    for name in ({"seg": "other"}, {"region": "extended"}):
        place = place_of(out, "05", "L", session="1", **name)
        write_hemisphere(place, flat, flat / 10, provenance=OTHER)
    result = call((data, out), "--seg", "demo", "--exclude", str(excluded))
    assert result.record["participants"] == 11
    assert not result.lines


def test_sides_of_different_kinds(tmp_path, call):
    dataset = make(tmp_path, lambda *at: USUAL | ({"edited": "mask"} if at[-1] == "L" else {}))
    assert "differ in edited: mask (12), n/a (12)" in refused(call, dataset, "--asymmetry")
    (line,) = call(dataset, "--asymmetry", "--mixed", "edited").lines
    assert "with side p < 0.001 (Fisher's exact test)" in line
    assert line.endswith("effects of side may be effects of edited")
    # All participants are of the same kind: both.
    assert "with group" not in line


@pytest.mark.parametrize(
    ("options", "term"),
    [
        pytest.param(
            ["--paired", "1", "2", "--formula", "thickness_mean ~ 1"],
            "session",
            marks=needs("repeated"),
        ),
        pytest.param(
            [
                "--longitudinal",
                "--formula",
                "thickness_mean ~ group * years",
                "--contrast",
                "years",
            ],
            "years",
            marks=needs("repeated"),
        ),
        pytest.param(["--retest"], "session", marks=needs("trials")),
        pytest.param(
            ["--power", "thinning=5%", "--visits", "0,12,24"], "session", marks=needs("trials")
        ),
    ],
)
def test_visits_of_different_kinds(tmp_path, call, options, term):
    def origin(_, session, __):
        return USUAL | ({} if session == "1" else {"version": "v21"})

    dataset = make(tmp_path, origin, sessions=("1", "2", "3"))
    numbers = (24, 24) if "--paired" in options else (48, 24)
    text = "differ in version: v21 ({}), v22 ({})".format(*numbers)
    assert text in refused(call, dataset, *options)
    result = call(dataset, *options, "--mixed", "version")
    (line,) = result.lines
    assert f"{text}; association with" in line
    assert f"with {term} p < 0.001 (" in line
    assert "may be effects of version" in line
    assert line.removeprefix("warning: ") in result.methods


@needs("repeated")
def test_pairs_count_what_was_measured_in_both_sessions(tmp_path, call):
    data, out = make(
        tmp_path,
        lambda i, session, hemi: OTHER if (i, session, hemi) == (4, "1", "L") else USUAL,
        sessions=("1", "2"),
    )
    options = ("--paired", "1", "2")
    assert "analysis: T1 (47), T1-T2 (1);" in refused(call, (data, out), *options)
    gone = place_of(out, "05", "L", session="2").path("qc")
    gone.write_text(
        json.dumps(json.loads(gone.read_text()) | {"decision": "failed", "reason": "x"})
    )
    assert not call((data, out), *options).lines


def said(capsys):
    return capsys.readouterr().err


@needs("norms")
def test_norms_and_scores(tmp_path, capsys):
    data, out = write_people(tmp_path / "norms", {"A": 60, "B": 60}, 1)
    paths = sorted(out.rglob("*_desc-qc_metrics.json"))

    def settle(origin):
        for i, path in enumerate(paths):
            path.write_text(json.dumps(json.loads(path.read_text()) | {"provenance": origin(i)}))

    command = [str(data), str(out), "group", "--measures", "thickness_mean", "--no-reports"]
    settle(lambda i: USUAL | ({"atlas": "bigbrain"} if i < 40 else {}))
    assert main([*command, "--fit-norms"]) == ExitCode.BAD_DATA
    counts = re.search(r"differ in atlas: bigbrain \((\d+)\), n/a \((\d+)\);", said(capsys))
    assert main([*command, "--fit-norms", "--mixed", "atlas"]) == ExitCode.OK
    assert f"{counts[0]} association with age p" in said(capsys)
    folder = out / "group" / "norms"
    # Norms leave out who is older or younger than nearly all.
    assert sum(map(int, counts.groups())) == 2 * len(table(folder / "covariates.tsv"))
    assert "Note that hemispheres differ in atlas" in (folder / "methods.md").read_text()
    score = [*command, "--norms", str(folder / "norms.json")]
    assert main(score) == ExitCode.BAD_DATA
    assert "differ in atlas" in said(capsys)
    settle(lambda _: USUAL)  # one of the two kinds that the norms rest on
    assert main(score) == ExitCode.OK
    assert "differ in" not in said(capsys)
    settle(lambda _: USUAL | {"version": "v21", "voxel_size": "0.34 x 0.34 x 0.34"})
    assert main(score) == ExitCode.BAD_DATA
    line = said(capsys)
    assert f"differ in version: v21, but v22 in {folder / 'norms.json'};" in line
    assert "voxel_size" not in line, "edges within 5 % are alike"
    assert main([*score, "--mixed", "version"]) == ExitCode.OK
    assert "version: v21, but v22 in" in said(capsys)


@needs("sites")
def test_effects_of_sites_of_another_kind(tmp_path, capsys):
    """Effects of sites that were estimated from other segmentations are refused."""
    data, out = write_people(tmp_path / "sites", {"A": 12, "B": 12}, 1)
    paths = sorted(out.rglob("*_desc-qc_metrics.json"))

    def settle(origin):
        for path in paths:
            path.write_text(json.dumps(json.loads(path.read_text()) | {"provenance": origin}))

    settle(USUAL)
    command = [
        str(data),
        str(out),
        "group",
        "--formula",
        "thickness_mean ~ age + C(site)",
        "--no-reports",
    ]
    command += ["--align", "none"]
    assert main([*command, "--harmonize", "site", "--name", "first"]) == ExitCode.OK
    saved = out / "group" / "first" / "harmonization.json"
    assert files.read_json(saved)["Labels"]["analysis"] == ["T1"]
    settle(USUAL | {"analysis": "T1-T2"})
    again = [*command, "--harmonize-model", str(saved), "--name", "second"]
    assert main(again) == ExitCode.BAD_DATA
    assert f"differ in analysis: T1-T2, but T1 in {saved};" in said(capsys)
    assert main([*again, "--mixed", "analysis"]) == ExitCode.OK
    second = files.read_json(saved.parents[1] / "second" / "harmonization.json")
    assert second["Labels"]["analysis"] == ["T1", "T1-T2"]
    settle(USUAL)
    assert main(again) == ExitCode.OK


def test_tests_are_those_of_participants(tmp_path, call):
    """Fisher's test for factors and an F test for numbers, both over participants."""
    kinds = np.array([0, 0, 0, 1, 0, 0, 1, 1, 0, 1, 0, 0])

    def origin(i, _, hemi):
        is_other = kinds[i] and (i != 3 or hemi == "L")  # one of them on one side only
        return USUAL | ({"analysis": "T1-T2"} if is_other else {})

    dataset = make(tmp_path, origin)
    (line,) = call(dataset, "--formula", "thickness_mean ~ sex + age", "--mixed", "analysis").lines
    assert "analysis: T1 (17), T1-T2 (7)" in line
    # The participant with one of each is a third kind of participant.
    kinds[3] = 2
    values = np.array(AGES, dtype=float)
    f_test = stats.f_oneway(*(values[kinds == kind] for kind in range(3)))
    assert f"with age p {f_test.pvalue:.3f} (F test)" in line
    sexes = np.arange(PEOPLE) // 2 % 2
    counts = [[np.sum((kinds == kind) & (sexes == sex)) for kind in range(3)] for sex in (0, 1)]
    random = stats.MonteCarloMethod(rng=np.random.default_rng(0))
    exact = stats.fisher_exact(np.array(counts), method=random).pvalue
    assert f"with sex p {exact:.3f} (Fisher's exact test)" in line
    assert f_test.pvalue < 0.05 < exact
    assert line.endswith("; effects of age may be effects of analysis")
