"""The comparison with Hipsta: its files, the truth beside its nodes, costs, failures, tables."""

import json
import sys
from dataclasses import replace

import hipsta
import nibabel as nib
import numpy as np
import pytest
import specimens
from hipsta import HIPSTA, Map, compare, read_hipsta, read_ours, run
from specimens import PHANTOMS, Drawing, Specimen

from hipsta_bids.io.files import read_tsv
from hipsta_bids.phantom import Hemisphere, Phantom, PhantomSpec, write_dataset

PLAIN = Drawing(spec=PhantomSpec(thickness=2.0), voxel=0.8, degrees=(3, -2, 1), shift=(1, 2, 3))
UNEVEN = replace(PLAIN, spec=PhantomSpec(thickness=2.0, variation=0.3))
#: Hipsta's image: axes as FreeSurfer's, away from the origin.
AFFINE = np.array([[-0.4, 0, 0, -5], [0, 0, 0.4, -40], [0, -0.4, 0, 10], [0, 0, 0, 1.0]])


def grid(drawing, nx=41, ny=21):
    """Return positions u and v (nx, ny), and the mid-surface there."""
    u, v = np.meshgrid(np.linspace(0.02, 0.98, nx), np.linspace(0.05, 0.95, ny), indexing="ij")
    body = Phantom(drawing.spec).body
    return u, v, body.place(u, v, 0.0, hemi=drawing.hemi, pose=drawing.pose)


def write_hipsta(folder, points, thickness, side="lh"):
    """Write what Hipsta does: a table of thickness, and nodes in FreeSurfer's surface space."""
    image = nib.MGHImage(np.zeros((60, 80, 50), dtype=np.int32), AFFINE)
    (folder / "thickness").mkdir(parents=True)
    nib.save(image, folder / f"{side}.image.mgz")
    surface = image.header.get_vox2ras_tkr() @ np.linalg.inv(image.header.get_vox2ras())
    nx, ny = thickness.shape
    lines = [",".join(["", *(f"y{j}" for j in range(ny))])]
    lines += [",".join([f"x{i}", *map(str, thickness[i])]) for i in range(nx)]
    (folder / "thickness" / f"{side}.grid-segments-z.csv").write_text("\n".join(lines) + "\n")
    rows = []
    for i in range(nx):
        for j in range(ny):
            for k in (4, 5, 6):  # other layers are not the mid-surface
                point = points[i, j] + [0, 0, (k - 5) * 0.3]
                if np.isfinite(point).all():
                    rows.append([i, j, k, *nib.affines.apply_affine(surface, point)])
    np.savetxt(folder / "thickness" / f"{side}.grid-lines.csv", rows, delimiter=",")


def test_nodes_of_hipsta_are_in_scanner_space(tmp_path):
    _, _, points = grid(PLAIN)
    thickness = np.linspace(1, 2, points[..., 0].size).reshape(points.shape[:2])
    points[3, 4], thickness[3, 4] = np.nan, np.nan
    write_hipsta(tmp_path, points, np.where(np.isnan(thickness), "", thickness.astype(str)))
    result = read_hipsta(tmp_path, "L")
    # Images hold single precision, of coordinates of some tens of mm.
    np.testing.assert_allclose(result.points, points, atol=1e-4)
    np.testing.assert_allclose(result.thickness, thickness)


def test_the_table_of_a_sheet_is_read_by_node(tmp_path):
    folder = tmp_path / "sub-a" / "anat"
    folder.mkdir(parents=True)
    table = "x\ty\tr\ta\ts\tthickness\n1\t2\t1\t2\t3\t1.5\n2\t1\t4\t5\t6\tn/a\n"
    (folder / "sub-a_hemi-L_seg-freesurfer_desc-sheet_morph.tsv").write_text(table)
    result = read_ours(tmp_path, Specimen(subject="a", hemi="L", dataset=tmp_path))
    assert result.thickness[0, 1] == 1.5
    assert np.isnan(result.thickness).sum() == 3
    np.testing.assert_array_equal(result.points[1, 0], [4, 5, 6])


def test_errors_are_those_of_the_whole_wall_and_as_written():
    u, v, points = grid(UNEVEN)
    truth = Phantom(UNEVEN.spec).body.thickness(u, v)
    wall = truth + 0.1
    wall[[0, 1, -2, -1]] = 0.5  # the two columns beside each edge are not counted as inside
    row = compare(HIPSTA, UNEVEN, {HIPSTA: Map(thickness=0.9 * wall, points=points)})
    # Places are found to 1e-3 mm on the mid-surface, where thickness varies by 0.1 mm per mm.
    assert row["bias inside, mm"] == pytest.approx(0.1, abs=1e-3)
    assert row["SD inside, mm"] == pytest.approx(0, abs=1e-3)
    assert row["outermost columns, mm"] == pytest.approx(0.5)
    assert row["true there, mm"] == pytest.approx(truth[[0, -1]].mean(), abs=1e-3)
    assert row["bias, mm"] == pytest.approx((wall - truth).mean(), abs=1e-3)
    assert row["bias as written, mm"] == pytest.approx((0.9 * wall - truth).mean(), abs=1e-3)
    assert "r with Hipsta" not in row


def test_maps_on_different_grids_are_compared_where_they_are():
    u, _, points = grid(PLAIN)
    coarser, _, elsewhere = grid(PLAIN, 31, 16)
    maps = {
        HIPSTA: Map(thickness=0.9 * (1 + u), points=points),
        "default": Map(thickness=1.05 + coarser, points=elsewhere),
    }
    row = compare("default", None, maps)
    assert row["r with Hipsta"] == pytest.approx(1, abs=1e-3)
    assert row["minus Hipsta, mm"] == pytest.approx(0.05, abs=0.005)  # 0.02 per step of the grid
    assert "bias, mm" not in row
    assert "r with Hipsta" not in compare("default", PLAIN, maps)  # nothing varies in it
    assert compare("default", UNEVEN, maps)["r with Hipsta"] == pytest.approx(1, abs=1e-3)
    flipped = maps | {HIPSTA: Map(thickness=0.9 * (1 + u), points=points[::-1])}
    assert compare("default", None, flipped)["r with Hipsta"] < -0.9


def test_nodes_without_a_surface_nearby_are_not_compared():
    _, _, points = grid(PLAIN)
    ones = np.ones(points.shape[:2])
    here = hipsta.nearest_thickness(Map(thickness=ones, points=points), points + 1e-3)
    assert (here == 1).all()
    points[0, 0] = np.nan
    far = hipsta.nearest_thickness(Map(thickness=ones, points=points), points + 40)
    assert np.isnan(far).all()


@pytest.mark.parametrize(
    ("code", "failure"),
    [
        ("print('a map')", None),
        ("raise ValueError('no body')", "no body"),
        ("raise SystemExit(3)", "exit code 3"),
        ("while True: pass", "no result after 1 CPU s"),
    ],
)
def test_a_run_has_its_cost_and_its_end(tmp_path, code, failure):
    result = run([sys.executable, "-c", code], tmp_path / "out", limit=1)
    assert result.failure == failure
    assert result.memory > 1  # MB; Python alone takes some
    assert 0 < result.cpu < 2
    assert (tmp_path / "out" / "log.txt").exists()


def test_a_run_is_not_repeated(tmp_path):
    file = tmp_path / "out" / "run.json"
    first = hipsta.cached(file, [sys.executable, "-c", "raise ValueError('once')"], 10)
    again = hipsta.cached(file, [sys.executable, "-c", ""], 10)
    assert first == again
    assert again.failure == "once"


def test_the_error_that_is_named_is_the_last():
    log = "ValueError: first\n  File x\nhipsta.errors.SurfaceError: a hole\nAssertionError\n"
    assert hipsta.last_error(log, 1) == "a hole"
    assert hipsta.last_error("killed\n", 137) == "exit code 137"


def test_phantoms_differ_and_lie_on_their_side():
    assert len(PHANTOMS) == 8
    for attribute in ("spec.thickness", "spec.kind", "voxel", "rough", "hemi"):
        first, *rest = attribute.split(".")
        values = {
            getattr(d, first) if not rest else getattr(d.spec, *rest) for d in PHANTOMS.values()
        }
        assert len(values) > 1, attribute
    for drawing in PHANTOMS.values():
        right = grid(drawing)[2][..., 0]
        assert (right < 0).all() if drawing.hemi == "L" else (right > 0).all()


def test_rough_labels_differ_at_borders_alone():
    smooth = specimens.draw(PLAIN)
    rough = specimens.draw(replace(PLAIN, rough=0.2))
    changed = rough.tissue != smooth.tissue
    assert 0.005 < changed.sum() / (smooth.tissue > 0).sum() < 0.3
    steps = [np.roll(smooth.tissue, shift, axis) for axis in range(3) for shift in (-1, 1)]
    at_border = np.any([step != smooth.tissue for step in steps], axis=0)
    # 0.2 mm of noise hardly takes a label from beyond the next voxel of 0.8 mm.
    assert at_border[changed].mean() > 0.95


def test_labels_of_a_dataset_are_rewritten_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(specimens, "PHANTOMS", {"plain": PLAIN})
    data = tmp_path / "data"
    shape = PhantomSpec(layer_thickness=0.5)
    write_dataset(data, [Hemisphere(subject="a", hemi="R", spec=shape)], voxel_size=(0.8,) * 3)
    items = list(specimens.specimens(data, tmp_path / "work"))
    assert [item.name for item in items] == ["phantom-plain_hemi-L", "sub-a_hemi-R"]
    written = nib.load(items[1].labels)
    (file,) = data.glob("derivatives/freesurfer/sub-a/mri/*.mgz")
    original = nib.load(file)
    np.testing.assert_array_equal(written.get_fdata(), original.get_fdata())
    np.testing.assert_allclose(written.affine, original.affine)
    assert {226, 238, 240, 246} <= set(np.unique(written.get_fdata()).astype(int))


def test_tables_and_their_record_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(specimens, "PHANTOMS", {"plain": PLAIN, "uneven": UNEVEN})
    monkeypatch.setattr(hipsta, "PROGRAMS", (HIPSTA,))
    _, _, points = grid(PLAIN)
    write_hipsta(tmp_path / "made", points, np.full(points.shape[:2], 1.8))
    script = tmp_path / "run_hipsta"  # like Hipsta: the hemisphere and the folder are options
    lines = [
        "#!/bin/sh",
        '[ "$1" = --version ] && echo run_hipsta 9.8.7 && exit',
        'case "$2" in *uneven*) echo "AssertionError: Check surface failed"; exit 1;; esac',
        f'cp -r {tmp_path / "made"}/. "$8"',
    ]
    script.write_text("\n".join(lines) + "\n")
    script.chmod(0o755)
    out = tmp_path / "docs"
    options = ["--hipsta", str(script), "--work", str(tmp_path / "work"), "--tables", str(out)]
    hipsta.main(options)
    record = json.loads((out / "beside-hipsta.json").read_text())
    assert record["libraries"]["Hipsta"] == "9.8.7"
    names = [entry["file"] for entry in record["tables"]]
    assert sorted(names) == sorted(file.name for file in out.glob("*.tsv"))
    plain, uneven = read_tsv(out / "beside-hipsta--hemispheres.tsv")
    assert (plain["result"], plain["reason"]) == ("map", "n/a")
    assert plain["bias, mm"] in ("0.000", "-0.000")
    assert plain["bias as written, mm"] == "-0.200"
    assert (uneven["result"], uneven["reason"]) == ("failed", "Check surface failed")
    assert uneven["bias, mm"] == "n/a"
    (summary,) = read_tsv(out / "beside-hipsta--summary.tsv")
    assert (summary["hemispheres"], summary["failed"]) == ("2", "1")
    assert summary["median CPU s"] == plain["CPU s"]  # failed runs end early
