"""One phantom in the files of every tool, through the command line."""

import numpy as np
import pytest
from input_cases import describe, save
from measured_phantoms import results

from hipsta_bids.cli import main
from hipsta_bids.errors import ExitCode
from hipsta_bids.phantom import Phantom, PhantomSpec, encode
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue

PHANTOM = Phantom(PhantomSpec(kind="spiral", thickness=1.8, length=9.0))
GRAY = "lfseg_corr_usegray.nii.gz"

#: Subject, hemisphere, protocol, and how the posterior and the anterior end are found.
EXPECTED = [
    ("full", "L", "freesurfer", "labels", "labels"),
    ("combined", "L", "freesurferCA", "labels", "labels"),
    ("old", "L", "freesurferFS60", "labels", "automatic"),
    ("abc", "L", "ashsABC3T", "labels", "labels"),
    ("pmc", "L", "ashsPMC", "automatic", "automatic"),
    ("utrecht", "L", "ashsUtrecht7T", "labels", "automatic"),
    ("magdeburg", "R", "ashsMagdeburg7T", "labels", "automatic"),
    ("both", "L", "ashsABC3T", "labels", "labels"),
    ("both", "R", "ashsABC3T", "labels", "labels"),
    ("v1", "R", "hippunfold", "automatic", "automatic"),
    ("v2", "L", "hippunfold", "automatic", "automatic"),
    ("lab", "L", "ourlab", "labels", "labels"),
    ("maget", "L", "cobralab", "automatic", "automatic"),
    ("maget", "R", "cobralab", "automatic", "automatic"),
    ("brain", "L", "nextbrain", "automatic", "automatic"),
]

#: The second automatic rule guards the first and may take off the last slice, which is tilted
#: against the end of the phantom by a few degrees.
RULES = {"labels": {"labels"}, "automatic": {"subfields", "cross-section"}}

SNAP = """################################################
    0     0    0    0        0  0  0    "Clear Label"
    1   255    0    0        1  1  1    "CA1"
    2     0  255    0        1  1  1    "CA2"
    3   128   64  255        1  1  1    "DG"
    4   255  255    0        1  1  1    "CA3"
    8   240   86  224        1  1  1    "SUB"
   10   210  180  140        1  1  1    "ERC"
   11    55  180  255        1  1  1    "BA35"
"""

TABLE = """index\tname\tabbreviation
1\tsubiculum\tSub
2\tCA1\tCA1
3\tCA2/3\tCA23
4\tdentate gyrus\tDG
5\thippocampal head\tHead
6\thippocampal tail\tTail
"""

SCHEME = """
name = "inhouse"
title = "A protocol of the tests"
citation = "none"
sheet = ["subiculum", "CA1", "CA2_3"]
layer = []
interior = ["dentate_gyrus"]
labels = [
  { code = 1, tissue = "subiculum", name = "a", abbreviation = "a", color = "#000000" },
  { code = 2, tissue = "CA1", name = "b", abbreviation = "b", color = "#000000" },
  { code = 3, tissue = "CA2_3", name = "c", abbreviation = "c", color = "#000000" },
  { code = 4, tissue = "dentate_gyrus", name = "d", abbreviation = "d", color = "#000000" },
  { code = 5, tissue = "hippocampus", part = "head", name = "e", abbreviation = "e", color = "#000000" },
  { code = 6, tissue = "hippocampus", part = "tail", name = "f", abbreviation = "f", color = "#000000" },
]
"""  # noqa: E501 (one label a line)

#: A laboratory's own codes for the tissues of the full hierarchy.
LAB_CODES = {
    Tissue.PRESUBICULUM: 1,
    Tissue.SUBICULUM: 1,
    Tissue.CA1: 2,
    Tissue.CA2_3: 3,
    Tissue.CA4: 4,
    Tissue.DENTATE_GYRUS: 4,
}
CA_CODES = {
    Tissue.PRESUBICULUM: 204,
    Tissue.SUBICULUM: 205,
    Tissue.CA1: 206,
    Tissue.CA2_3: 208,
    Tissue.CA4: 209,
    Tissue.DENTATE_GYRUS: 209,
    Tissue.HIPPOCAMPUS: 226,
}


def draw(protocol, hemi="L", axes="RAS"):
    return PHANTOM.label_volume(load_protocol(protocol), hemi=hemi, axes=axes)


def recode(volume, codes):
    table = np.zeros(max(Tissue) + 1, dtype=np.int16)
    table[list(codes)] = list(codes.values())
    return table[volume.tissue]


def put(path, protocol, hemi="L", axes="RAS"):
    volume = draw(protocol, hemi, axes)
    save(path, encode(volume).astype(np.int16), volume.affine)


def write_freesurfer(root):
    put(root / "sub-full" / "mri" / "lh.hippoAmygLabels-T1.v22.mgz", "freesurfer", axes="LIA")
    put(root / "sub-old" / "mri" / "lh.hippoSfLabels-T1.v10.mgz", "freesurferFS60", axes="LIA")
    volume = draw("freesurfer", axes="LIA")
    parts = {Part.HEAD: 232, Part.BODY: 231, Part.TAIL: 226}
    table = np.zeros(max(Part) + 1, dtype=np.int16)
    table[list(parts)] = list(parts.values())
    stem = root / "sub-combined" / "mri" / "lh.hippoAmygLabels-T1-T2.v21"
    save(stem.with_name(f"{stem.name}.CA.mgz"), recode(volume, CA_CODES), volume.affine)
    save(stem.with_name(f"{stem.name}.HBT.mgz"), table[volume.part], volume.affine)


def write_ashs(root):
    put(root / "ashs" / "sub-abc" / "final" / f"id_left_{GRAY}", "ashsABC3T", axes="LSA")
    put(root / "ashs-pmc" / "sub-pmc" / "final" / f"id_left_{GRAY}", "ashsPMC")
    (root / "ashs-pmc" / "snaplabels.txt").write_text(SNAP, encoding="utf-8")
    put(root / "ashs-utrecht" / "sub-utrecht" / f"id_left_{GRAY}", "ashsUtrecht7T")
    rows = [f"{label.code}\t{label.name}" for label in load_protocol("ashsUtrecht7T").labels]
    table = "\n".join(["index\tname", *rows])
    (root / "ashs-utrecht" / "dseg.tsv").write_text(table, encoding="utf-8")
    save(root / "ashs-both" / "sub-both" / "final" / f"id_{GRAY}", *both_hemispheres("ashsABC3T"))
    put(root / "ashs-magdeburg" / "sub-magdeburg" / f"id_right_{GRAY}", "ashsMagdeburg7T", "R")
    rows = [f"{label.code}\t{label.name}" for label in load_protocol("ashsMagdeburg7T").labels]
    table = "\n".join(["index\tname", *rows])
    (root / "ashs-magdeburg" / "dseg.tsv").write_text(table, encoding="utf-8")


def both_hemispheres(protocol):
    """Both on one grid, the codes of one shifted by 100."""
    left, right = draw(protocol), draw(protocol, "R")
    step = left.affine[0, 0]
    # The lattice of phantoms is fixed in space, so one grid holds both.
    start = np.rint((right.affine - left.affine)[:3, 3] / step).astype(int)
    low = np.minimum(start, 0)
    high = np.maximum(np.array(left.tissue.shape), start + right.tissue.shape)
    codes = np.zeros(high - low, dtype=np.int16)
    for volume, corner, hemi in ((left, -low, "L"), (right, start - low, "R")):
        own, offset = encode(volume), volume.protocol.shift(hemi)
        box = tuple(slice(a, a + n) for a, n in zip(corner, own.shape, strict=True))
        codes[box] += np.where(own > 0, own + offset, 0).astype(np.int16)
    affine = left.affine.copy()
    affine[:3, 3] += step * low
    return codes, affine


def write_hippunfold(root):
    first = "sub-v1_hemi-R_space-cropT1w_desc-subfields_atlas-bigbrain_dseg.nii.gz"
    newer = "sub-v2_hemi-L_space-cropT2w_label-hipp_atlas-multihist7_desc-subfields_dseg.nii.gz"
    put(root / "sub-v1" / "anat" / first, "hippunfold", "R")
    put(root / "sub-v2" / "anat" / newer, "hippunfold", axes="PIR")


def write_tools(root):
    describe(root / "maget", "MAGeTbrain")
    name = "sub-maget_T1w_labels.nii.gz"
    save(root / "maget" / "sub-maget" / "anat" / name, *both_hemispheres("cobralab"))
    put(root / "nextbrain" / "sub-brain" / "seg.left.nii.gz", "nextbrain")
    (root / "nextbrain" / "sub-brain" / "lut.txt").touch()


def write_lab(root, name, table=None):
    volume = draw("freesurfer")
    codes = recode(volume, LAB_CODES)
    # Their protocol has no subfields in head and tail.
    codes[(volume.part == Part.HEAD) & (volume.tissue > 0)] = 5
    codes[(volume.part == Part.TAIL) & (volume.tissue > 0)] = 6
    save(root / "sub-lab" / "anat" / f"sub-lab_hemi-L_{name}dseg.nii.gz", codes, volume.affine)
    if table:
        (root / "desc-hipp_dseg.tsv").write_text(table, encoding="utf-8")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    bids = tmp_path_factory.mktemp("layouts")
    derivatives = bids / "derivatives"
    describe(bids, kind="raw")
    write_freesurfer(derivatives / "freesurfer")
    write_ashs(derivatives)
    write_hippunfold(derivatives / "hippunfold")
    write_tools(derivatives)
    write_lab(derivatives / "our-lab", "desc-hipp_", TABLE)
    code = main.main([str(bids), str(bids / "out"), "participant"])
    assert code == ExitCode.OK
    return bids / "out"


@pytest.mark.parametrize("expected", EXPECTED, ids=lambda row: "-".join(row[:3]))
def test_thickness_and_ends_in_every_layout(out, expected):
    subject, hemi, protocol, posterior, anterior = expected
    found = results(out, subject, hemi, protocol)
    assert found.row["decision"] == "use", found.row["message"]
    # An eighth of the 0.4 mm voxels, as promised for the demonstration.
    truth = PHANTOM.truth(0.5, 0.5).summary
    assert float(found.summary["thickness_mean"]) == pytest.approx(
        truth["thickness_mean"], abs=0.05
    )
    metrics = found.metrics["metrics"]
    for end, rule in (("posterior", posterior), ("anterior", anterior)):
        assert metrics[f"{end}_end_rule"] in RULES[rule], end
    # Without labels, whole slices are counted, so each such end may be off by one.
    slack = 0.4 * (posterior, anterior).count("automatic") + 0.2
    assert metrics["body_length_mm"] == pytest.approx(truth["extent_y"], abs=slack)


def test_nothing_else_was_found(out):
    assert len(list(out.rglob("*desc-summary_morph.tsv"))) == len(EXPECTED)


@pytest.mark.parametrize(("subject", "protocol"), [("both", "ashsABC3T"), ("maget", "cobralab")])
def test_both_hemispheres_of_one_file_mirror_each_other(out, subject, protocol):
    left, right = (results(out, subject, hemi, protocol).sheet for hemi in "LR")
    # Mirrored voxels are cut into other triangles, mm.
    assert (left.thickness - right.thickness).std() < 0.04
    assert (left.r + right.r).abs().max() < 0.5


@pytest.mark.parametrize("mode", ["hsf", "hsfCA23"])
def test_hsf_in_the_mode_that_is_named(tmp_path, mode):
    describe(tmp_path / "bids", kind="raw")
    data = tmp_path / "hsf"
    put(data / "sub-h" / "anat" / "sub-h_T2w_right_hippocampus_seg.nii.gz", mode, "R")
    arguments = [str(tmp_path / "bids"), str(tmp_path / "out"), "participant", "-d", f"hsf={data}"]
    assert main.main(arguments) == ExitCode.BAD_DATA
    refused = results(tmp_path / "out", "h", "R", "hsf").row
    assert (refused["decision"], refused["reason"]) == ("failed", "ambiguous-scheme")
    assert main.main([*arguments, "--protocol", mode]) == ExitCode.OK
    found = results(tmp_path / "out", "h", "R", mode)
    assert float(found.summary["thickness_mean"]) == pytest.approx(1.8, abs=0.05)  # as above
    other = {"hsf": "hsfCA23", "hsfCA23": "hsf"}[mode]
    assert main.main([*arguments, "--protocol", other]) == ExitCode.BAD_DATA
    wrong = results(tmp_path / "out", "h", "R", other).metrics
    assert wrong["reason"] in {"unknown-labels", "wrong-scheme"}
    assert f"the labels fit {mode}" in wrong["message"].replace("hippunfold and ", "")


def test_a_users_protocol(tmp_path):
    protocol = tmp_path / "inhouse.toml"
    protocol.write_text(SCHEME, encoding="utf-8")
    describe(tmp_path / "bids", kind="raw")
    write_lab(tmp_path / "labels", "")
    arguments = [str(tmp_path / "bids"), str(tmp_path / "out"), "participant"]
    options = ["-d", f"mine={tmp_path / 'labels'}", "--scheme", str(protocol)]
    assert main.main([*arguments, *options]) == ExitCode.OK
    found = results(tmp_path / "out", "lab", "L", "inhouse")
    assert found.row["decision"] == "use"
    assert float(found.summary["thickness_mean"]) == pytest.approx(1.8, abs=0.05)  # as above
    assert set(found.sheet.subfield) == {"a", "b", "c"}
