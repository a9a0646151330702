"""Probabilities of labels: found, read as shares of voxels, refused, and used by the command."""

import json
from dataclasses import replace

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from input_cases import describe, find, save
from measured_phantoms import measure, results, spiral

import hipsta_bids as hb
from hipsta_bids.cli import main
from hipsta_bids.errors import ArgumentError, ExitCode, InputError
from hipsta_bids.inputs.labels import read_label_volume
from hipsta_bids.inputs.search import InputRequest, find_inputs
from hipsta_bids.io import files
from hipsta_bids.phantom import Phantom, encode
from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.protocols.protocol import Part, Tissue
from hipsta_bids.settings import GridSettings, Settings

SETTINGS = Settings(grid=GridSettings(spacing=0.5))
PHANTOM = Phantom(spiral(length=8.0))


def draw(protocol, side="L"):
    return PHANTOM.label_volume(
        load_protocol(protocol), hemi=side, voxel_size=(0.5, 0.5, 0.5), supersample=3
    )


@pytest.fixture(scope="module")
def volume():
    return draw("freesurfer")


@pytest.fixture
def data(tmp_path, volume):
    """The labels of one hemisphere, as FreeSurfer writes them."""
    describe(tmp_path / "data", kind="raw")
    save(labels_of(tmp_path / "data"), encode(volume), volume.affine)
    return tmp_path / "data"


def labels_of(data):
    return data / "derivatives/fs/sub-1/mri/lh.hippoAmygLabels-T1.v22.mgz"


def beside(data, label, side="L"):
    suffix = f"_label-{label}" if label else ""
    return labels_of(data).with_name(f"sub-1_hemi-{side}{suffix}_probseg.nii.gz")


def names_of(volume):
    """Write each tissue as the file name of BIDS has it."""
    return {
        label.tissue: "".join(filter(str.isalnum, label.abbreviation))
        for label in volume.protocol.labels
        if label.tissue in volume.shares
    }


def write(data, volume, change=lambda share: share):
    for tissue, name in names_of(volume).items():
        save(beside(data, name), change(volume.shares[tissue]), volume.affine)


def read(data, **options):
    (item,) = find(data, **{"probabilities": "auto", **options})
    return item, read_label_volume(item)


def agrees(volume, drawn, atol=1e-6):
    """Compare shares with the drawn ones; the crop of the labels lies in the drawn lattice."""
    part = tuple(slice(a, a + n) for a, n in zip(volume.start, volume.tissue.shape, strict=True))
    tissues = {*drawn.protocol.sheet, *drawn.protocol.layer} & drawn.shares.keys()
    for tissue in tissues:
        np.testing.assert_allclose(volume.shares[tissue], drawn.shares[tissue][part], atol=atol)
    return bool(tissues)


def test_bids_files_give_the_maps_of_the_shares(data, volume):
    write(data, volume)
    item, found = read(data)
    assert item.origin["probabilities"] == "probseg"
    assert agrees(found, volume)
    soft = measure(found, settings=SETTINGS).thickness
    drawn = measure(volume, settings=SETTINGS).thickness
    np.testing.assert_allclose(soft, drawn, atol=1e-6)
    plain = measure(replace(found, shares={}), settings=SETTINGS).thickness
    assert np.abs(soft - plain).max() > 0.01
    assert not read(data, probabilities="never")[1].shares


def test_label_map_of_a_sidecar(data, volume):
    names = names_of(volume)
    stacked = np.stack(
        [1 - sum(volume.shares[t] for t in names), *map(volume.shares.get, names)], 3
    )
    save(beside(data, ""), stacked, volume.affine)
    item = find(data, probabilities="auto")[0]
    assert "neither LabelMap nor a table" in item.notes[-1]
    sidecar = beside(data, "").with_suffix("").with_suffix(".json")
    sidecar.write_text(json.dumps({"LabelMap": ["background", *names.values()]}))
    assert agrees(read(data)[1], volume)
    sidecar.write_text(json.dumps({"LabelMap": list(names.values())}))
    with pytest.raises(InputError, match=f"has {len(names) + 1} volumes, but {len(names)} labels"):
        read(data)
    sidecar.write_text("{")
    assert "not readable as JSON" in find(data, probabilities="auto")[0].notes[-1]


def test_rows_of_a_label_table(tmp_path, volume):
    names = {
        tissue: name for tissue, name in names_of(volume).items() if tissue != Tissue.HIPPOCAMPUS
    }
    codes = {tissue: code for code, tissue in enumerate(names, start=3)}
    folder = tmp_path / "derivatives/lab/sub-1/anat"
    labels = np.zeros(volume.tissue.shape, dtype=np.int16)
    for tissue, code in codes.items():
        labels[volume.tissue == tissue] = code
    save(folder / "sub-1_hemi-L_seg-lab_dseg.nii.gz", labels, volume.affine)
    save(
        folder / "sub-1_hemi-L_seg-lab_probseg.nii.gz",
        np.stack(list(map(volume.shares.get, codes)), 3),
        volume.affine,
    )
    rows = "".join(f"{code}\t{Tissue(t).name}\n" for t, code in codes.items())
    (folder / "sub-1_hemi-L_seg-lab_dseg.tsv").write_text(f"index\tname\n{rows}")
    item, found = read(tmp_path)
    assert item.protocol.name == "lab"
    assert agrees(found, replace(volume, protocol=item.protocol))


def test_fusion_posteriors_of_ashs(tmp_path):
    """They are weights, of a part of the image."""
    volume = draw("ashsABC3T")
    folder = tmp_path / "derivatives/ashs/sub-1"
    save(folder / "final/sub-1_left_lfseg_corr_usegray.nii.gz", encode(volume), volume.affine)
    part = volume.affine.copy()
    part[:3, 3] += part[:3, :3] @ [4, 5, 3]
    scale = np.random.default_rng(0).uniform(0.2, 7.0, volume.tissue.shape).astype(np.float32)
    codes = {label.code: label.tissue for label in reversed(volume.protocol.labels)}
    written = set()
    for code, tissue in {0: Tissue.BACKGROUND, **codes}.items():
        share = volume.shares.get(tissue, 0) if tissue not in written else 0
        written.add(tissue)
        values = (scale * share)[4:-4, 5:-5, 3:-3]
        path = f"bootstrap/fusion/posterior_corr_usegray_left_{code:03d}.nii.gz"
        save(folder / path, values, part)
    item, found = read(tmp_path)
    assert item.origin["probabilities"] == "ashs"
    assert agrees(found, volume)
    (folder / "bootstrap/fusion/posterior_corr_usegray_left_000.nii.gz").unlink()
    assert find(tmp_path, probabilities="auto")[0].notes == (
        "probabilities not used: no file of background (code 0)",
    )


@pytest.mark.parametrize(
    ("analysis", "run"), [("T1.v22", "T1_v22"), ("T1-T2.v21", "T1_v21_T2"), ("T2.v21", "T1_v21_T2")]
)
def test_posteriors_of_freesurfer(data, volume, analysis, run):
    labels, codes = labels_of(data), encode(volume)
    labels = labels.rename(labels.with_name(f"lh.hippoAmygLabels-{analysis}.mgz"))
    parts = {"-head": volume.part == Part.HEAD, "-body": volume.part != Part.HEAD}
    names = {
        Tissue.PRESUBICULUM: "presubiculum",
        Tissue.SUBICULUM: "subiculum",
        Tissue.CA1: "ca1",
        Tissue.CA2_3: "ca3",
        Tissue.MOLECULAR_LAYER: "molecular_layer_hp",
    }
    for tissue, name in names.items():
        for part, mask in parts.items():
            share = volume.shares.get(tissue, np.zeros(mask.shape)) * mask
            path = labels.with_name(f"posterior_left_{name}{part}_{run}.mgz")
            save(path, share.astype(np.float32), volume.affine)
            save(path.with_name(path.name.replace("_v", "_v9")), 0 * codes, volume.affine)
    item, found = read(data)
    assert item.origin["probabilities"] == "freesurfer"
    assert agrees(found, volume)
    # Labels with merged codes are not of these files.
    labels.rename(labels.with_name(f"lh.hippoAmygLabels-{analysis}.FS60.mgz"))
    assert find(data, probabilities="auto")[0].probabilities is None


def test_other_lattices(data, volume):
    def turned(share, affine):
        """Reverse the first axis, exchange the others, and cut off the border."""
        index = np.array([[-1, 0, 0, share.shape[0] - 3], [0, 0, 1, 2], [0, 1, 0, 2], [0, 0, 0, 1]])
        return share[2:-2, 2:-2, 2:-2][::-1].transpose(0, 2, 1), affine @ index

    for tissue, name in names_of(volume).items():
        save(beside(data, name), *turned(volume.shares[tissue], volume.affine))
    assert agrees(read(data)[1], volume)
    half = volume.affine.copy()
    half[:3, 3] += half[:3, :3] @ [0.5, 0, 0]
    for tissue, name in names_of(volume).items():
        save(beside(data, name), volume.shares[tissue], half)
    moved = {t: (s + np.roll(s, 1, 0)) / 2 for t, s in volume.shares.items()}
    assert agrees(read(data)[1], replace(volume, shares=moved))


def test_scaled_integers(data, volume):
    for tissue, name in names_of(volume).items():
        image = nib.Nifti1Image(np.rint(255 * volume.shares[tissue]), volume.affine)
        image.header.set_data_dtype(np.uint8)
        image.header.set_slope_inter(1 / 255, 0)
        image.to_filename(beside(data, name))
    assert agrees(read(data)[1], volume, atol=0.5 / 255 + 1e-6)


def _with_nan(share):
    return np.where(share > 0.5, np.nan, share)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda share: 255 * share,
            "has values up to 255, probabilities are 0 to 1; divide by 255",
        ),
        (
            lambda share: 100 * share,
            "has values up to 100, probabilities are 0 to 1; divide by 100",
        ),
        (lambda share: 1.2 * share, r"has values up to 1\.2, probabilities are 0 to 1; correct"),
        (lambda share: share - 0.1, "has values down to -0.1"),
        (_with_nan, "has values that are NaN or infinite"),
        (lambda share: np.maximum(share, 0.3), "the probabilities of a voxel add up to 2"),
        (
            lambda share: np.roll(share, 4, 0),
            r"in \d+% of the sheet's voxels other tissue is likelier",
        ),
        (lambda share: share[: len(share) // 2], "does not cover the labels"),
    ],
)
def test_refused(data, volume, change, message):
    write(data, volume, change)
    with pytest.raises(InputError, match=message) as error:
        read(data)
    assert error.value.reason == "bad-probabilities"
    assert "(--probabilities never)" in str(error.value)
    assert not read(data, probabilities="never")[1].shares


def test_the_other_side_is_refused(data):
    write(data, draw("freesurfer", "R"))
    with pytest.raises(InputError, match="does not cover the labels"):
        read(data)


def test_names_of_others_are_not_taken(data, volume):
    write(data, volume)
    for path in labels_of(data).parent.glob("*_probseg.nii.gz"):
        path.rename(path.with_name(path.name.replace("hemi-L", "hemi-R")))
    assert read(data)[0].probabilities is None
    for path in labels_of(data).parent.glob("*_probseg.nii.gz"):
        path.rename(path.with_name(path.name.replace("sub-1_hemi-R", "sub-2_hemi-L")))
    item, _ = read(data)
    assert item.probabilities is None
    assert item.notes == ()


def test_incomplete(data, volume):
    write(data, volume)
    beside(data, "CA1").unlink()
    found = find_inputs(InputRequest(bids_dir=data, probabilities="auto"))
    note = "probabilities not used: no file of CA1-head (code 237)"
    assert found.items[0].notes == (note,)
    assert f"labels alone: 1 of 1 hemispheres; sub-1 L: {note}" in found.notes
    # What does not occur needs no file; two files of one label are one too many.
    write(data, volume)
    assert found.items[0].protocol.layer == (Tissue.MOLECULAR_LAYER,)
    assert not (volume.tissue == Tissue.MOLECULAR_LAYER).any()
    assert agrees(read(data)[1], volume)
    save(beside(data, "238"), volume.shares[Tissue.CA1], volume.affine)
    assert "both have code 238" in read(data)[0].notes[-1]


def test_a_folder(data, volume, tmp_path):
    write(data, volume)
    other = tmp_path / "other"
    (other / "sub-1").mkdir(parents=True)
    (item,) = find(data, probabilities=other)
    assert item.problem.reason == "bad-probabilities"
    assert "sub-1 L: no probabilities of its labels" in str(item.problem)
    for folder in ("sub-1/anat", "sub-1/mri"):
        labels_of(data).parent.glob("*")
        (other / folder).mkdir()
        for path in labels_of(data).parent.glob("*_probseg.nii.gz"):
            (other / folder / path.name).write_bytes(path.read_bytes())
        item, found = read(data, probabilities=other)
        assert item.probabilities.source_path == other
        assert {path.parent for path, _ in item.probabilities.files} == {other / folder}
        assert agrees(found, volume)
    with pytest.raises(InputError, match="folder not found"):
        find(data, probabilities=tmp_path / "none")


def test_edited_labels_are_certain_where_they_disagree(data, volume):
    write(data, volume)
    tissue, part = volume.tissue.copy(), volume.part.copy()
    spots = np.argwhere((tissue == Tissue.BACKGROUND) & (volume.shares[0] == 1))
    spot = tuple(spots[len(spots) // 2])
    tissue[spot], part[spot] = Tissue.CA1, Part.BODY
    edited = replace(volume, tissue=tissue, part=part)
    path = labels_of(data).with_name("sub-1_hemi-L_desc-edited_dseg.nii.gz")
    save(path, encode(edited), volume.affine)
    _, found = read(data)
    place = tuple(np.subtract(spot, found.start))
    assert found.tissue[place] == Tissue.CA1
    assert found.shares[Tissue.CA1][place] == 1
    near = (place[0] + 1, *place[1:])
    assert found.shares[Tissue.CA1][near] == volume.shares[Tissue.CA1][(spot[0] + 1, *spot[1:])]


def run(data, out, *options):
    settings = data.parent / "settings.toml"
    settings.write_text("[grid]\nspacing = 0.5\n")
    arguments = [data, out, "participant", "--settings", settings, *options]
    return main.main(list(map(str, arguments)))


def test_command(data, volume, tmp_path, capsys):
    never, out = tmp_path / "never", tmp_path / "out"
    assert run(data, never) == ExitCode.OK
    write(data, volume)
    capsys.readouterr()
    assert run(data, out) == ExitCode.OK
    said = capsys.readouterr().out
    assert "note: probabilities: probseg (1) of 1 hemispheres; --probabilities never" in said
    rows = [row for row in files.read_tsv(out / "inputs.tsv") if row["status"] == "used"]
    assert [row["probabilities"] for row in rows] == ["probseg", "probseg"]
    assert rows[1]["reason"] == f"probabilities of the same labels, files: {len(names_of(volume))}"
    record = results(out, "1", "L", "freesurfer").metrics
    assert record["provenance"]["probabilities"] == "probseg"
    first = record["probabilities"][0]
    path = data / "derivatives" / "fs" / first["file"].removeprefix("bids:fs:")
    assert first["sha256"] == files.sha256_of(path)
    assert "probability of the sheet is one half" in " ".join(
        (out / "CITATION.md").read_text().split()
    )
    run(data, out)
    assert "1 unchanged, skipped" in capsys.readouterr().out
    save(beside(data, "CA1"), volume.shares[Tissue.CA1] * 0.99, volume.affine)
    run(data, out)
    assert "skipped" not in capsys.readouterr().out
    run(data, out, "--probabilities", "never")
    assert "skipped" not in capsys.readouterr().out
    assert "probability" not in (out / "CITATION.md").read_text()
    same = [path for path in never.rglob("*_hemi-L_*") if path.suffix != ".json"]
    assert len(same) > 10
    for path in same:
        assert path.read_bytes() == (out / path.relative_to(never)).read_bytes(), path.name
    # Labels alone are no answer to a folder that was named.
    assert run(data, out, "--probabilities", tmp_path) == ExitCode.BAD_DATA
    write(data, volume, lambda share: 255 * share)
    assert run(data, out) == ExitCode.BAD_DATA
    (row,) = files.read_tsv(out / "status.tsv")
    assert row["reason"] == "bad-probabilities"


@needs("surrogate")
def test_surrogate_takes_labels_alone(data, volume, tmp_path):
    write(data, volume, lambda share: 255 * share)
    assert main.main(["surrogate", str(data), str(tmp_path / "out")]) == ExitCode.OK


def test_phantoms(tmp_path):
    folder = tmp_path / "phantoms"
    options = ["--n-subjects", "1", "--voxel-size", "1", "1", "1", "--layout", "hippunfold"]
    assert main.main(["phantom", str(folder), "--probabilities", *options]) == ExitCode.OK
    items = find(folder, probabilities="auto")
    assert [item.probabilities.kind for item in items] == ["probseg", "probseg"]
    assert all(read_label_volume(item).shares for item in items)
    options = ["phantom", str(folder), "--head", "1", "--probabilities"]
    assert main.main(options) == ExitCode.USAGE


def test_python(data, volume, tmp_path):
    codes = encode(volume)
    common = {"protocol": "freesurfer", "affine": volume.affine, "settings": SETTINGS}
    drawn = measure(volume, settings=SETTINGS).thickness
    sheet = sum(volume.shares[tissue] for tissue in volume.protocol.sheet)
    whole = hb.measure(codes, probabilities=sheet, **common)
    by_code = {
        label.code: volume.shares.get(label.tissue, np.zeros(codes.shape))
        for label in volume.protocol.labels
        if label.part in {Part.BODY, Part.TAIL}
    }
    measured = hb.measure(codes, probabilities=by_code, **common)
    np.testing.assert_allclose(measured.maps["thickness"], drawn, atol=1e-6)
    # Beyond the body, labels without subfields have shares of their own.
    body = {t: share for t, share in volume.shares.items() if t != Tissue.HIPPOCAMPUS}
    drawn = measure(replace(volume, shares=body), settings=SETTINGS).thickness
    np.testing.assert_allclose(whole.maps["thickness"], drawn, atol=1e-6)
    write(data, volume)
    path = save(tmp_path / "sheet.nii.gz", sheet, volume.affine)
    for given in (path, nib.load(path)):
        measured = hb.measure(
            labels_of(data), protocol="freesurfer", settings=SETTINGS, probabilities=given
        )
        np.testing.assert_allclose(measured.maps["thickness"], drawn, atol=1e-6)
    measured.save(tmp_path / "out", "sub-1")
    record = results(tmp_path / "out", "1", "L", "freesurfer").metrics
    assert record["provenance"] == {"probabilities": "memory"}
    with pytest.raises(ArgumentError, match="have shape"):
        hb.measure(codes, probabilities=sheet[1:], **common)
    with pytest.raises(InputError, match="no probabilities of CA1, "):
        hb.measure(codes, probabilities={234: by_code[234]}, **common)
    with pytest.raises(ArgumentError, match="code is 5"):
        hb.measure(codes, probabilities={5: sheet}, **common)
    with pytest.raises(InputError, match="probabilities: has values up to 100"):
        hb.measure(codes, probabilities=100 * sheet, **common)
