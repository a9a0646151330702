"""Tables of volumes as FreeSurfer, ASHS and HippUnfold write them."""

import numpy as np
import pandas as pd
import pytest

from hipsta_bids.errors import InputError
from hipsta_bids.extensions.maps.volumes import (
    VolumeTable,
    join_volumes,
    read_volumes,
    table_of,
)

FREESURFER = """\
Hippocampal_tail 563.290157
subiculum-body 251.843926
CA1-body 130.912
GC-ML-DG-head 161.5
Whole_hippocampus 3521.075811
"""
ASHS = """\
sub-01 left CA1 15 1356.24
sub-01 left SUB 17 402.5
sub-01 left Br35 10 533.01
"""
HIPPUNFOLD = "subject\themi\tSub\tCA1\nsub-01\tL\t500.5\t800.25\nsub-01\tR\t510\tn/a\n"


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("labels", "table"),
    [
        ("lh.hippoAmygLabels-T1.v22.mgz", "lh.hippoSfVolumes-T1.v22.txt"),
        ("rh.hippoAmygLabels-T1-T2.v21.FS60.mgz", "rh.hippoSfVolumes-T1-T2.v21.txt"),
        ("lh.hippoAmygLabels-T1.long.v22.FSvoxelSpace.mgz", "lh.hippoSfVolumes-T1.long.v22.txt"),
        ("lh.hippoSfLabels-T1.v10.mgz", "lh.hippoSfVolumes-T1.v10.txt"),
        ("lh.hippoAmygLabels.mgz", "lh.hippoSfVolumes.txt"),
    ],
)
def test_freesurfer_table_of_the_same_analysis_is_taken(tmp_path, labels, table):
    write(tmp_path / "mri" / "lh.hippoSfVolumes-T2.v22.txt", FREESURFER)
    assert table_of(tmp_path / "mri" / labels) is None
    path = write(tmp_path / "mri" / table, FREESURFER)
    assert table_of(tmp_path / "mri" / labels) == ("freesurfer", path)
    (hemi,) = volumes = read_volumes(path)
    assert hemi == ("L" if table.startswith("l") else "R")
    assert volumes[hemi]["GC_ML_DG_head"] == 161.5
    assert len(volumes[hemi]) == 5


@pytest.mark.parametrize("kind", ["heur", "corr_usegray", "corr_nogray"])
def test_ashs_table_of_the_same_step_is_taken(tmp_path, kind):
    image = tmp_path / "final" / f"sub-01_left_lfseg_{kind}.nii.gz"
    assert table_of(image) is None
    path = write(tmp_path / "final" / f"sub-01_left_{kind}_volumes.txt", ASHS)
    assert table_of(image) == ("ashs", path)
    assert read_volumes(path) == {"L": {"CA1": 1356.24, "SUB": 402.5, "Br35": 533.01}}


def test_hippunfold_table_of_the_same_atlas_is_taken(tmp_path):
    name = "sub-01_hemi-L_space-cropT1w_desc-subfields_atlas-multihist7_dseg.nii.gz"
    write(tmp_path / "sub-01_space-cropT1w_desc-subfields_atlas-bigbrain_volumes.tsv", HIPPUNFOLD)
    assert table_of(tmp_path / name) is None
    table = tmp_path / "sub-01_space-cropT1w_desc-subfields_atlas-multihist7_volumes.tsv"
    assert table_of(tmp_path / name) is None
    write(table, HIPPUNFOLD)
    assert table_of(tmp_path / name) == ("hippunfold", table)
    volumes = read_volumes(table)
    assert volumes["L"] == {"Sub": 500.5, "CA1": 800.25}
    assert np.isnan(volumes["R"]["CA1"])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("lh.hippoSfVolumes.txt", ""),
        ("lh.hippoSfVolumes.txt", "CA1 12 13\n"),
        ("lh.hippoSfVolumes.txt", "CA1 much\n"),
        ("lh.hippoSfVolumes.txt", "CA1 -3\n"),
        ("lh.hippoSfVolumes.txt", "CA1 1e9\n"),
        ("x_volumes.txt", "sub-01 middle CA1 15 1356.24\n"),
        ("x_volumes.tsv", "subject\tCA1\nsub-01\t3\n"),
        ("x_volumes.tsv", "subject\themi\tCA1\nsub-01\t3\n"),
    ],
)
def test_other_tables_are_refused(tmp_path, name, text):
    with pytest.raises(InputError, match="not readable as a table of volumes"):
        read_volumes(write(tmp_path / name, text))


def test_tables_become_one_measure_per_structure(tmp_path):
    tables = [
        VolumeTable(name="ashs", visit="sub-01", path=write(tmp_path / "a_volumes.txt", ASHS)),
        VolumeTable(
            name="hippunfold",
            visit="sub-02",
            path=write(tmp_path / "h_volumes.tsv", HIPPUNFOLD),
            hemi="L",
        ),
        VolumeTable(name="ashs", visit="sub-03", path=write(tmp_path / "b_volumes.txt", "")),
    ]
    visits = pd.Index(["sub-01", "sub-02", "sub-03"])
    volumes, (note,) = join_volumes(tables, visits)
    assert list(volumes) == ["L"]  # the right one of the bilateral table was not asked for
    assert volumes["L"].loc["sub-01", "volume_ashs_CA1"] == 1356.24
    assert volumes["L"].loc["sub-02", "volume_hippunfold_CA1"] == 800.25
    assert volumes["L"].isna().sum().to_dict()["volume_ashs_CA1"] == 2
    assert "sub-03" in note
    with pytest.raises(InputError, match="it is empty"):
        join_volumes(tables, visits, strict=["ashs"])


def test_same_structure_twice_is_refused(tmp_path):
    paths = [write(tmp_path / f"{kind}_volumes.txt", ASHS) for kind in "ab"]
    tables = [VolumeTable(name="x", visit="sub-01", path=path) for path in paths]
    with pytest.raises(InputError, match="make the pattern match one"):
        join_volumes(tables, pd.Index(["sub-01"]))


@pytest.mark.parametrize("word", ["NA", "unknown", "-", "", "n/a"])
def test_missing_values_are_those_of_other_tables(tmp_path, word):
    path = tmp_path / "sub-1_volumes.tsv"
    path.write_text(f"subject\themi\tCA1\tSub\n1\tL\t{word}\t7\n")
    assert np.isnan(read_volumes(path)["L"]["CA1"])
