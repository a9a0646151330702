"""The anatomical image behind the labels: the right one, in its place, or none."""

import base64
import gzip
import json
import shutil
import zlib

import nibabel as nib
import numpy as np
import pytest

from hipsta_bids.cli import main
from hipsta_bids.inputs.search import Candidate
from hipsta_bids.io.volumes import read_scalars
from hipsta_bids.reports import results
from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.reports.results import anatomy_of, find_results, read_views
from hipsta_bids.reports.slices import stack_of

MRI = "derivatives/freesurfer/sub-01/mri"


@pytest.fixture
def copy(shown, tmp_path):
    """A copy of input and output, to do harm to."""
    return shutil.copytree(shown.parent, tmp_path / "data")


def views_of(folder, hemi="L"):
    found = find_results(folder / "out", "01")
    hemisphere = next(h for h in found if h.result.name.hemi == hemi)
    return hemisphere, read_views(hemisphere, folder / "in")


def test_the_page_shows_it_and_says_which_file(shown):
    text = (shown / "sub-01.html").read_text()
    assert text.count("Behind the labels: <code>norm.mgz</code>") == 2
    assert text.count('"anatomy": {') == 2
    assert len(text) < 1_200_000
    assert f"freeview -v ../in/{MRI}/norm.mgz ../in/{MRI}/lh." in text
    assert "Behind the labels" not in (shown / "sub-02.html").read_text()


def test_values_are_those_of_the_image_at_the_same_points(tmp_path):
    affine = np.array([[0, -1.2, 0.3, 5], [0.9, 0, 0, -8], [0, 0.2, 1.1, 3], [0, 0, 0, 1]])
    indices = np.indices((20, 24, 22))
    image = np.einsum("i,i...->...", [2.0, 3.0, 5.0], indices)
    nib.save(nib.Nifti1Image(image.astype(np.float32), affine), tmp_path / "a.nii.gz")
    index = np.random.default_rng(0).uniform(4, 15, (50, 3))
    points = nib.affines.apply_affine(affine, index)
    anatomy = anatomy_of(tmp_path / "a.nii.gz", read_scalars(tmp_path / "a.nii.gz", points))
    read = anatomy.grays(points).astype(float)
    assert 0 < read.min() < read.max() < 255
    # Gray is linear in the value between black and white, and the image linear in the index.
    slope, offset = np.polyfit(index @ [2, 3, 5], read, 1)
    assert slope > 0
    assert np.abs(slope * (index @ [2, 3, 5]) + offset - read).max() < 1
    assert anatomy.grays(points + 1000).tolist() == [255] * 50


def unpacked(stack):
    values = np.frombuffer(zlib.decompress(base64.b64decode(stack["stack"])), dtype=np.uint8)
    return values.reshape(stack["shape"])


def test_the_stack_of_slices_has_labels_body_and_image(shown):
    stack = json.loads(json.dumps(stack_of(*views_of(shown.parent))))
    _, views = views_of(shown.parent)
    values = unpacked(stack)
    np.testing.assert_array_equal(values >= 128, views.mask)
    codes = np.array([0, *views.names])
    known = np.where(np.isin(views.labels, list(views.names)), views.labels, 0)
    np.testing.assert_array_equal(codes[values % 128], known)
    grays = unpacked(stack["anatomy"])
    assert grays.max() < stack["levels"]
    # At 1 mm, not at the finer voxels of the labels.
    assert np.abs(np.array(grays.shape) - np.array(views.shape) * views.voxel).max() <= 1
    # Both volumes fill the same box: dark is where the labels are.
    index = [np.round((np.arange(n) + 0.5) * m / n - 0.5).astype(int) for n, m in
             zip(grays.shape, values.shape, strict=True)]  # fmt: skip
    labeled = (values % 128 > 0)[np.ix_(*index)]
    assert grays[labeled].mean() < grays[~labeled].mean() - 15


def test_slices_across_have_one_scale_and_the_whole_body(shown):
    hemisphere, views = views_of(shown.parent)
    *across, along = stack_of(hemisphere, views)["panels"]
    assert [panel["across"] for panel in (*across, along)] == [1, 1, 1, 1, 1, 0]
    boxes = np.array([panel["box"] for panel in across])
    sizes = boxes[:, 1] - boxes[:, 0]
    np.testing.assert_allclose(sizes, np.broadcast_to(sizes[0], sizes.shape), atol=0.02)  # rounded
    assert 1.5 - 0.01 <= sizes[0, 0] / sizes[0, 1] <= 2.0 + 0.01
    levels = [round(panel["center"][1]) for panel in across]
    assert levels == sorted({*levels})  # from posterior to anterior
    for level, (low, high) in zip(levels, boxes, strict=True):
        body = np.argwhere(views.mask[:, level]) * views.voxel[[0, 2]]
        assert (body.min(axis=0) > low + 2).all()
        assert (body.max(axis=0) < high - 2).all()


def shift(path):
    image = nib.load(path)
    affine = image.affine.copy()
    affine[:3, 3] += 200
    nib.save(nib.MGHImage(np.asarray(image.dataobj), affine), path)


def flatten(path):
    image = nib.load(path)
    nib.save(nib.MGHImage(np.full(image.shape, 7, np.uint8), image.affine), path)


def stretch(path):
    image = nib.load(path)
    data = np.stack([np.asarray(image.dataobj)] * 2, axis=-1)
    nib.save(nib.MGHImage(data, image.affine), path)


def cut_off(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def bomb(path):
    """A header that declares more than there is."""
    header = nib.load(path).header.copy()
    header.set_data_shape((2000, 2000, 2000))
    path.write_bytes(gzip.compress(header.binaryblock))


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (shift, "does not cover the body"),
        (flatten, "has one value everywhere round the body"),
        (stretch, "is unusable: has shape 91 x 61 x 52 x 2, but "),
        (cut_off, "is unusable: cannot be read as an image (Compressed file ended"),
        (lambda path: path.write_text("x"), "is unusable: cannot be read as an image (Not a gzip"),
        (bomb, "is unusable: cannot be read as an image ("),
    ],
    ids=["elsewhere", "uniform", "two volumes", "cut off", "text", "declared"],
)
def test_an_image_that_does_not_fit_costs_the_image_only(copy, harm, said):
    harm(copy / "in" / MRI / "norm.mgz")
    _, views = views_of(copy)
    assert views.anatomy is None
    assert views.unused.startswith(f"norm.mgz {said}")
    assert views.labels is not None


def test_the_page_says_that_an_image_is_not_shown(copy):
    shift(copy / "in" / MRI / "norm.mgz")
    text = participant_page(copy / "out", "01", None, read_cohort(copy / "out"), copy / "in")
    assert text.count("No anatomical image is shown: norm.mgz does not cover the body.") == 2
    assert 'class="stack"' in text
    assert '"anatomy": {' not in text


def test_an_image_of_unknown_space_has_to_have_the_grid_of_the_labels(copy, monkeypatch):
    (labels,) = (copy / "in" / MRI).glob("lh.hippo*.mgz")
    image = nib.load(labels)
    noise = np.random.default_rng(0).uniform(0, 99, image.shape).astype(np.float32)
    same, other = copy / "same_T1w.nii.gz", copy / "other_T1w.nii.gz"
    nib.save(nib.Nifti1Image(noise, image.affine), same)
    moved = image.affine.copy()
    moved[0, 3] += 0.3
    nib.save(nib.Nifti1Image(noise, moved), other)

    def shown_of(*candidates):
        monkeypatch.setattr(results, "find_anatomy", lambda *_: iter(candidates))
        views = views_of(copy)[1]
        return views.anatomy and views.anatomy.path.name, views.unused

    unknown = [Candidate(path=path, proven=False) for path in (other, same)]
    assert shown_of(*unknown) == ("same_T1w.nii.gz", None)
    why = "has another grid than the labels, so its space may be another"
    assert shown_of(unknown[0]) == (None, f"other_T1w.nii.gz {why}")
    assert shown_of(Candidate(path=other, proven=True)) == ("other_T1w.nii.gz", None)


def test_without_anatomy_no_trace_of_it_is_in_the_page(copy, out, capsys):
    page = copy / "out/sub-01.html"
    assert "norm.mgz" in page.read_text()
    command = [str(copy / "in"), str(copy / "out"), "participant", "--participant-label", "01"]
    # Nothing is measured, but the page is made again, as if there were no such image.
    assert main.main([*command, "--no-anatomy", "--n-procs", "1"]) == 0
    assert "2 unchanged" in capsys.readouterr().out
    assert page.read_text() == (out / "sub-01.html").read_text()
    assert "norm.mgz" not in page.read_text()
