from dataclasses import replace
from fnmatch import fnmatch

import pytest

from hipsta_bids.cli.participant import REGIONS
from hipsta_bids.derivatives.names import (
    DATASET_FILES,
    EXTRA_OUTPUTS,
    IGNORED,
    OUTPUTS,
    SHARED,
    TEXTS,
    HemisphereName,
    ignore_file,
    natural_order,
    output_name,
    output_path,
    participant_report,
)

FULL = HemisphereName(subject="01", session="02", hemi="R", seg="freesurfer")


def test_numbers_in_labels_are_sorted_by_value():
    labels = ["ses-11", "ses-2", "m6", "02", "10", "post", "ses-10", "m24", "2", "1b", "1a3", ""]
    ordered = ["", "1a3", "1b", "02", "2", "10", "m6", "m24", "post", "ses-2", "ses-10", "ses-11"]
    assert sorted(labels, key=natural_order) == ordered


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("sheet", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-sheet_morph.tsv"),
        ("sheet_sidecar", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-sheet_morph.json"),
        ("summary", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-summary_morph.tsv"),
        ("qc", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-qc_metrics.json"),
        ("interior_surface", "sub-01_ses-02_hemi-R_seg-freesurfer_interior.surf.gii"),
        (
            "midthickness_unfold",
            "sub-01_ses-02_hemi-R_space-unfold_seg-freesurfer_midthickness.surf.gii",
        ),
        ("thickness", "sub-01_ses-02_hemi-R_seg-freesurfer_thickness.shape.gii"),
        ("curvature", "sub-01_ses-02_hemi-R_seg-freesurfer_curv.shape.gii"),
        (
            "gaussian_curvature_interior",
            "sub-01_ses-02_hemi-R_seg-freesurfer_desc-gaussianInterior_curv.shape.gii",
        ),
        ("sections", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-sections_morph.tsv"),
        ("subfields", "sub-01_ses-02_hemi-R_seg-freesurfer_dseg.label.gii"),
        ("mesh", "sub-01_ses-02_hemi-R_seg-freesurfer_desc-tet_mesh.vtu"),
    ],
)
def test_names_as_published(key, expected):
    assert output_name(FULL, key) == expected
    assert str(output_path(FULL, key)) == f"sub-01/ses-02/anat/{expected}"


def test_no_session_leaves_no_trace():
    name = HemisphereName(subject="01", session=None, hemi="L", seg="x")
    assert str(output_path(name, "sheet")) == (
        "sub-01/anat/sub-01_hemi-L_seg-x_desc-sheet_morph.tsv"
    )


def test_all_names_differ():
    names = [output_name(FULL, output.key) for output in OUTPUTS]
    assert len(set(names)) == len(names)
    assert len({output.key for output in OUTPUTS}) == len(OUTPUTS)


def test_texts_of_outputs_have_no_leftovers():
    described = {output.key for output in (*OUTPUTS, *EXTRA_OUTPUTS)}
    surfaces = {"surface", "unfold"}  # of three surfaces each
    assert TEXTS["outputs"].keys() - described == surfaces


def test_quality_record_is_last():
    assert OUTPUTS[-1].key == "qc"


def test_entities_follow_the_standard():
    schema = pytest.importorskip("bidsschematools.schema").load_schema()
    short = [schema.objects.entities[entity].name for entity in schema.rules.entities]
    for output in OUTPUTS:
        entities = [
            part.split("-")[0] for part in output_name(FULL, output.key).split("_") if "-" in part
        ]
        ranks = [short.index(entity) for entity in entities]
        assert ranks == sorted(ranks), output.key


def test_outputs_without_a_rule_are_ignored_by_validators():
    for region in ("body", "extended", "entorhinal"):
        for output in (*OUTPUTS, *EXTRA_OUTPUTS):
            name = output_name(replace(FULL, region=region), output.key, output.desc)
            named = output.in_standard and region == "body"
            assert any(fnmatch(name, pattern) for pattern in IGNORED) != named, name
    shared = [row.for_all for row in SHARED]
    own = (*DATASET_FILES.values(), participant_report("01", None), *shared)
    tops = {f"/{name}" for name in own}
    hidden = {name for name in tops if any(fnmatch(name, pattern) for pattern in IGNORED)}
    named = ("dataset_description.json", "README.md", "dseg.json", ".bidsignore", "logs")
    assert hidden == tops - {f"/{name}" for name in named}


def test_every_line_of_the_ignore_file_hides_something_and_says_why():
    regions = [replace(FULL, region=region) for region in REGIONS]
    rows = (*OUTPUTS, *EXTRA_OUTPUTS)
    names = [output_name(name, row.key, row.desc) for name in regions for row in rows]
    names += [f"/{name}" for name in DATASET_FILES.values()]
    for pattern in IGNORED:
        assert any(fnmatch(name, pattern) for name in names), pattern
        assert pattern.rstrip("*").count("*") <= 1, "the validator does not match it"
        assert not pattern.endswith("/"), "the validator would not pass over the folder itself"
    lines = ignore_file().splitlines()
    assert [line for line in lines if line and not line.startswith("#")] == list(IGNORED)
    blocks = [block.splitlines() for block in ignore_file().split("\n\n")[1:]]
    for (pattern, why), (reason, *hidden, last) in zip(IGNORED.items(), blocks, strict=True):
        assert (reason, last) == (f"# {why}", pattern)
        (listed,) = hidden or [""]
        for name in listed.removeprefix("# Hides ").split():
            assert fnmatch(name, pattern), name
            assert any(full.endswith(name) for full in names), name


def test_the_ignore_file_lists_what_a_pattern_stands_for():
    comments = {line for line in ignore_file().splitlines() if line.startswith("# Hides ")}
    sidecars = "_curv.json _exterior.json _interior.json _midthickness.json _thickness.json"
    assert f"# Hides {sidecars}" in comments
    assert len(comments) == len(IGNORED) - 1  # a region is in the middle of a name
    listed = set(" ".join(comments).split())
    endings = {f"_{row.suffix}{row.extension}" for row in (*OUTPUTS, *EXTRA_OUTPUTS)}
    named = {f"_{row.suffix}{row.extension}" for row in OUTPUTS if row.in_standard}
    assert endings - named <= listed
    assert not named & listed
