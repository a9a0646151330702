"""Other programs' maps: whose they are, what they hold, and the surface that they lie on."""

import os
import re

import numpy as np
import pytest
from hippunfold_like import (
    PATTERNS,
    cifti_name,
    flat_surface,
    names,
    write_cifti,
    write_map,
    write_surface,
)
from nibabel.cifti2 import BrainModelAxis, Cifti2Image, ScalarAxis

from hipsta_bids.errors import InputError, NothingToDoError, UsageError
from hipsta_bids.extensions.maps.external import find_maps, map_patterns, read_maps
from hipsta_bids.inputs.maps import scan
from hipsta_bids.io import files
from hipsta_bids.io.gifti import read_map, read_mesh

POINTS, TRIANGLES = flat_surface(50)
GRID = (4, 3)


def anybody(*_):
    return True


@pytest.fixture(params=[1, 2])
def version(request):
    return request.param


def write_subject(root, subject, version, values, hemi="L", **which):
    path, surface = names(root / "hippunfold", subject, hemi, version=version, **which)
    write_map(path, values)
    write_surface(surface, POINTS, TRIANGLES)
    return path


def find_and_read(root, pattern, *, surfaces=(), known=(), wanted=anybody):
    (request,) = map_patterns([("hipp", pattern)], surfaces, ())
    found = find_maps(request, root, known, wanted, scan(request.pattern, root))
    visits = sorted(found.visits, key=lambda visit: (visit[0], visit[1] or ""))
    return *read_maps(found, visits, GRID, with_sheets=True)[:2], visits


def visits_of(side, visits):
    return [visits[row] for row in side.rows]


def test_maps_of_hippunfold_with_the_surface_beside(tmp_path, version):
    values = np.linspace(0.5, 2, 50)
    for subject in ("02", "01"):
        write_subject(tmp_path, subject, version, values * int(subject))
    write_subject(tmp_path, "01", version, values, measure="gyrification")  # another map
    write_subject(tmp_path, "02", version, np.where(values < 1, np.nan, values), hemi="R")
    sides, unit, visits = find_and_read(tmp_path, PATTERNS[version])
    assert visits_of(sides["L"], visits) == [("01", None), ("02", None)]
    # Single precision is what the files hold.
    left = sides["L"].maps["hipp"][..., 0]
    np.testing.assert_allclose(left, [values, 2 * values], rtol=1e-6)
    np.testing.assert_allclose(sides["L"].mesh.points, POINTS, rtol=1e-6)
    assert sides["L"].mesh.triangles.shape == TRIANGLES.shape
    assert unit == "mm"
    assert visits_of(sides["R"], visits) == [("02", None)]
    assert np.isnan(sides["R"].maps["hipp"]).sum() == (values < 1).sum()


def test_curvature_has_one_sign_on_both_sides(tmp_path, version):
    """HippUnfold 1 gives curvature of right hemispheres with the opposite sign."""
    values = np.linspace(-0.4, 0.6, 50)
    for hemi, sign in (("L", 1), ("R", -1 if version == 1 else 1)):
        write_subject(tmp_path, "01", version, sign * values, hemi, measure="curvature")
    pattern = PATTERNS[version].replace("thickness", "curvature")
    (request,) = map_patterns([("bend", pattern)], (), ())
    found = find_maps(request, tmp_path, (), anybody, scan(request.pattern, tmp_path))
    sides, _, notes = read_maps(found, [("01", None)], GRID, with_sheets=True)
    for side in sides.values():
        np.testing.assert_allclose(side.maps["bend"][0, :, 0], values, rtol=1e-6)
    assert [note for note in notes if "multiplied by -1" in note] == notes
    assert len(notes) == (version == 1)


@pytest.mark.parametrize(
    "name", ["{subject}.{hemi}.hipp_thickness", "{subject}.hippocampus_thickness"]
)
def test_maps_in_the_folders_of_the_hcp(tmp_path, name):
    """Names and structures are those of the HCP's pipelines."""
    folder = tmp_path / "100307" / "T1w" / "HippUnfold" / "2k"
    values = {"L": np.linspace(0.5, 2, 50), "R": np.linspace(1, 3, 50)}
    for hemi in "LR":
        write_surface(folder / f"100307.{hemi}.hipp_flat.2k.surf.gii", POINTS, TRIANGLES)
        write_map(folder / f"100307.{hemi}.hipp_thickness.2k.shape.gii", values[hemi])
    sides = {"HIPPOCAMPUS_LEFT": values["L"], "HIPPOCAMPUS_RIGHT": values["R"]}
    sides |= {"HIPPOCAMPUS_DENTATE_LEFT": np.ones(20), "HIPPOCAMPUS_DENTATE_RIGHT": np.ones(20)}
    axes = [BrainModelAxis.from_surface(np.arange(len(v)), len(v), s) for s, v in sides.items()]
    scalars = ScalarAxis(["thickness"]), sum(axes[1:], start=axes[0])
    image = Cifti2Image(np.concatenate(list(sides.values()))[None], scalars)
    image.to_filename(folder / "100307.hippocampus_thickness.2k.dscalar.nii")
    ending = "shape.gii" if "hemi" in name else "dscalar.nii"
    pattern = f"{{subject}}/T1w/HippUnfold/2k/{name}.2k.{ending}"
    sides, unit, visits = find_and_read(tmp_path, pattern)
    assert unit == "mm"
    assert visits == [("100307", None)]
    for hemi, side in sides.items():
        np.testing.assert_allclose(side.maps["hipp"][0, :, 0], values[hemi], rtol=1e-6)
        np.testing.assert_allclose(side.mesh.points, POINTS, rtol=1e-6)


def test_sessions_of_the_sheets_decide(tmp_path):
    pattern = "hippunfold/sub-{subject}/ses-{session}/surf/*_hemi-{hemi}_*_thickness.shape.gii"
    for session in ("a", "b"):
        write_subject(tmp_path, "01", 1, POINTS[:, 0], session=session)
    write_subject(tmp_path, "02", 1, POINTS[:, 0])
    sides, _, visits = find_and_read(tmp_path, pattern)
    assert visits_of(sides["L"], visits) == [("01", "a"), ("01", "b"), ("02", None)]
    known = [("01", "b"), ("02", "x"), ("02", "y")]
    sides, _, visits = find_and_read(tmp_path, pattern, known=known)
    # The second participant's file has no session in its name: it holds for all.
    assert visits_of(sides["L"], visits) == [("01", "b"), ("02", "x"), ("02", "y")]
    sides, _, visits = find_and_read(tmp_path, pattern, wanted=lambda subject, *_: subject == "02")
    assert visits_of(sides["L"], visits) == [("02", None)]


def test_table_of_the_sheets_grid_needs_no_surface(tmp_path):
    x, y = np.divmod(np.arange(12), 3)
    rows = [
        [str(i + 1), str(j + 1), "n/a" if i == 0 else f"{i + j}"] for i, j in zip(x, y, strict=True)
    ]
    files.write_tsv(tmp_path / "sub-1_hemi-R_desc-T2_map.tsv", ["x", "y", "T2"], rows)
    sides, _, _ = find_and_read(tmp_path, "sub-{subject}_hemi-{hemi}_desc-T2_map.tsv")
    side = sides["R"]
    assert side.mesh is None
    assert side.shape == GRID
    expected = np.where(x == 0, np.nan, x + y).reshape(GRID)
    np.testing.assert_array_equal(side.maps["hipp"][0], expected)


def test_named_surface_and_its_refusals(tmp_path):
    write_map(tmp_path / "sub-1_lh.shape.gii", POINTS[:, 1])
    write_surface(tmp_path / "flat_hemi-L.surf.gii", POINTS, TRIANGLES)
    write_surface(tmp_path / "small.surf.gii", *flat_surface(20))
    pattern = "sub-{subject}_{side}.shape.gii"
    for surfaces in ([(None, "flat_hemi-{hemi}.surf.gii")], [("hipp", f"{tmp_path}/flat*")]):
        sides, _, _ = find_and_read(tmp_path, pattern, surfaces=surfaces)
        assert sides["L"].shape == (50, 1)
    with pytest.raises(InputError, match="has 20 vertices, the maps hipp of hemisphere L have 50"):
        find_and_read(tmp_path, pattern, surfaces=[(None, "small.surf.gii")])
    with pytest.raises(InputError, match=r"no file none\.surf\.gii"):
        find_and_read(tmp_path, pattern, surfaces=[(None, "none.surf.gii")])
    with pytest.raises(InputError, match=r"50 values fit neither sheets .* nor a surface beside"):
        find_and_read(tmp_path, pattern)
    with pytest.raises(InputError, match="is no surface"):
        read_mesh(tmp_path / "sub-1_lh.shape.gii")


def test_maps_of_different_densities_are_refused(tmp_path):
    for subject, count in (("1", 50), ("2", 50), ("3", 40)):
        write_map(tmp_path / f"sub-{subject}_hemi-L.shape.gii", np.zeros(count))
    with pytest.raises(InputError, match=r"2 with 50 .*; 1 with 40 \(.*sub-3_hemi-L"):
        find_and_read(tmp_path, "sub-{subject}_hemi-{hemi}.shape.gii")


def test_several_files_or_none(tmp_path):
    for name in ("sub-1_hemi-L_a.shape.gii", "sub-1_hemi-L_b.shape.gii"):
        write_map(tmp_path / name, np.zeros(12))
    with pytest.raises(InputError, match="are both for sub-1 hemi-L"):
        find_and_read(tmp_path, "sub-{subject}_hemi-{hemi}_*.gii")
    with pytest.raises(NothingToDoError, match="no file matches"):
        find_and_read(tmp_path, "sub-{subject}_hemi-{hemi}_c.gii")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not readable as GIFTI"),
        (b"<?xml version='1.0'?><GIFTI", "not readable as GIFTI"),
        (b"not xml at all", "not readable as GIFTI"),
    ],
)
def test_damaged_files_are_refused(tmp_path, content, words):
    path = tmp_path / "x.shape.gii"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_map(path, "x", "L")


def test_damaged_headers_are_refused(tmp_path):
    def spoil(path, old, new):
        content = path.read_bytes()
        assert old in content
        path.write_bytes(content.replace(old, new, 1))
        return path

    write_map(tmp_path / "x.shape.gii", np.zeros(12))
    with pytest.raises(InputError, match="not readable as GIFTI"):
        read_map(spoil(tmp_path / "x.shape.gii", b'Dim0="12"', b'Dim0="21"'), "x", "L")
    path = tmp_path / "x.dscalar.nii"
    write_cifti(path, {"L": np.ones(50)})
    with pytest.raises(InputError, match="not readable as CIFTI"):
        read_map(spoil(path, b"TYPE_SURFACE", b"TYPE_SURFACF"), "x", "L")
    far = BrainModelAxis.from_surface(np.arange(50), 10**12, "CORTEX_LEFT")
    Cifti2Image(np.ones((1, 50), np.float32), (ScalarAxis(["x"]), far)).to_filename(path)
    with pytest.raises(InputError, match="a surface of 1000000000000 vertices"):
        read_map(path, "x", "L")


@pytest.mark.parametrize("structure", ["CORTEX", "HIPPOCAMPUS"])
def test_cifti_files_of_hippunfold_are_both_sides(tmp_path, version, structure):
    values = np.linspace(0.5, 2, 50)
    for subject in ("01", "02"):
        sides = {"L": values * int(subject), "R": np.where(values < 1, np.nan, values)}
        if subject == "02":
            del sides["R"]
        write_cifti(
            cifti_name(tmp_path / "hippunfold", subject, version=version),
            sides,
            structure=structure,
        )
        for hemi in "LR":
            _, surface = names(tmp_path / "hippunfold", subject, hemi, version=version)
            write_surface(surface, POINTS + 100 * (hemi == "R"), TRIANGLES)
    pattern = "hippunfold/sub-{subject}/*/*_label-hipp_thickness.dscalar.nii"
    sides, unit, visits = find_and_read(tmp_path, pattern)
    assert unit == "mm"
    assert visits_of(sides["L"], visits) == [("01", None), ("02", None)]
    assert visits_of(sides["R"], visits) == [("01", None)]
    left = sides["L"].maps["hipp"][..., 0]
    np.testing.assert_allclose(left, [values, 2 * values], rtol=1e-6)
    right = sides["R"].maps["hipp"][0, :, 0]
    np.testing.assert_allclose(right, np.where(values < 1, np.nan, values), rtol=1e-6)
    assert sides["R"].mesh.points.min() >= 100  # each side has its own surface


def spoiled_cifti(path, kind):
    sides = {"L": np.arange(300.0), "R": np.arange(300.0)}
    if kind == "one side":
        del sides["R"]
    write_cifti(path, sides, names=("a", "b") if kind == "two maps" else ("a",))
    cut = {"cut in the header": 700, "cut in the data": -100, "empty": 0}
    if kind in cut:
        path.write_bytes(path.read_bytes()[: cut[kind]])


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("cut in the header", "not readable as CIFTI"),
        ("cut in the data", "not readable as CIFTI"),
        ("empty", "not readable as CIFTI"),
        ("two maps", "holds 2 maps"),
        ("one side", "no surface of hemisphere R"),
    ],
)
def test_cifti_files_that_are_refused(tmp_path, kind, words):
    path = tmp_path / "x_thickness.dscalar.nii"
    spoiled_cifti(path, kind)
    with pytest.raises(InputError, match=words):
        read_map(path, "x", "R")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b'MatrixDimension="1"', b'MatrixDimension="7"', "not readable as CIFTI"),
        (b'IndexCount="50"', b'IndexCount="90000000"', "more vertices than it holds"),
    ],
)
def test_texts_in_cifti_files_are_checked(tmp_path, old, new, words):
    path = tmp_path / "x.dscalar.nii"
    write_cifti(path, {"L": np.ones(50)})
    head, text, data = cifti_parts(path.read_bytes())
    assert old in text
    path.write_bytes(cifti_joined(head, text.replace(old, new), data))
    with pytest.raises(InputError, match=words):
        read_map(path, "x", "L")


def cifti_parts(content):
    """Header, text and data of a CIFTI file."""
    size, start = (int.from_bytes(content[a:b], "little") for a, b in ((544, 548), (168, 176)))
    return content[:544], content[552 : 544 + size].rstrip(b"\0"), content[start:]


def cifti_joined(head, text, data, extra=0):
    """Join the parts again; the text takes a multiple of 16 bytes, and some more."""
    text += bytes(-(len(text) + 8) % 16 + extra)
    start = len(head) + 8 + len(text)
    head = head[:168] + start.to_bytes(8, "little") + head[176:]
    return head + (len(text) + 8).to_bytes(4, "little") + (32).to_bytes(4, "little") + text + data


@pytest.mark.parametrize("kind", ["map", "surface"])
def test_gifti_arrays_without_numbers_are_refused(tmp_path, kind):
    path = tmp_path / "x.shape.gii"
    if kind == "map":
        write_map(path, np.zeros(12))
    else:
        write_surface(path, POINTS, TRIANGLES)
    path.write_bytes(re.sub(rb"<Data>[^<]*</Data>", b"", path.read_bytes()))
    with pytest.raises(InputError, match=r"holds 0 maps|not three numbers"):
        read_map(path, "x", "L") if kind == "map" else read_mesh(path)


def test_gifti_files_read_no_pipe_that_they_name(tmp_path):
    path = tmp_path / "x.shape.gii"
    write_map(path, np.zeros(12))
    os.mkfifo(tmp_path / "pipe")
    content = path.read_bytes().replace(b"GZipBase64Binary", b"ExternalFileBinary")
    path.write_bytes(content.replace(b'ExternalFileName=""', b'ExternalFileName="pipe"'))
    with pytest.raises(InputError, match="no regular file"):
        read_map(path, "x", "L")


def test_warnings_of_nibabel_are_no_messages(tmp_path):
    path = tmp_path / "x.dscalar.nii"
    write_cifti(path, {"L": np.ones(50)})
    path.write_bytes(cifti_joined(*cifti_parts(path.read_bytes()), extra=8))  # not in 16s
    assert read_map(path, "x", "L").values.tolist() == [1] * 50


def test_half_a_file_is_refused(tmp_path):
    path = tmp_path / "x.shape.gii"
    write_map(path, np.arange(1000.0))
    path.write_bytes(path.read_bytes()[:1500])
    with pytest.raises(InputError, match="not readable as GIFTI"):
        read_map(path, "x", "L")


def test_files_of_several_maps_are_refused_unless_a_column_has_the_name(tmp_path):
    write_map(tmp_path / "x.func.gii", np.zeros(5), np.ones(5))
    with pytest.raises(InputError, match="holds 2 maps"):
        read_map(tmp_path / "x.func.gii", "a", "L")
    files.write_tsv(tmp_path / "x.tsv", ["a", "b"], [["1", "2"], ["3", "inf"]])
    assert read_map(tmp_path / "x.tsv", "a", "L").values.tolist() == [1, 3]
    np.testing.assert_array_equal(read_map(tmp_path / "x.tsv", "b", "L").values, [2, np.nan])
    with pytest.raises(InputError, match="has columns a, b"):
        read_map(tmp_path / "x.tsv", "c", "L")
    files.write_tsv(tmp_path / "y.tsv", ["a"], [["much"]])
    with pytest.raises(InputError, match="no numbers"):
        read_map(tmp_path / "y.tsv", "a", "L")


@pytest.mark.parametrize(
    ("patterns", "surfaces", "words"),
    [
        ([("a b", "{subject}{hemi}")], [], "letters and digits"),
        ([("a", "{subject}{hemi}"), ("a", "{subject}{hemi}")], [], "occurs twice"),
        ([("thickness", "{subject}{hemi}")], [], "belongs to the sheets"),
        ([("a", "{hemi}")], [], "needs {subject}"),
        ([("a", "{subject}")], [], "and {hemi} or {side}"),
        ([("a", "{subject}{hem}")], [], "placeholders are"),
        ([("a", "{subject}{hemi}")], [("b", "x")], "no --maps b"),
        ([("a", "{subject}{hemi}")], [(None, "{x}")], "placeholders are"),
    ],
)
def test_options_that_cannot_be_meant(patterns, surfaces, words):
    with pytest.raises(UsageError) as caught:
        map_patterns(patterns, surfaces, ("thickness",))
    assert words in str(caught.value)
