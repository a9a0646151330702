"""What looks alike on all pages and figures: colors, scales, orientation, and names."""

import json
import re
import shutil
from types import SimpleNamespace

import nibabel as nib
import numpy as np
import pytest
from scipy import stats

from hipsta_bids.protocols.load import load_protocol
from hipsta_bids.reports import maps as maps_module
from hipsta_bids.reports import unfolded
from hipsta_bids.reports.cohort import read_cohort
from hipsta_bids.reports.display import (
    CURVATURE,
    ORIENTATION,
    THICKNESS,
    Effects,
    effect_reach,
    kind_of,
    palette,
    scale_of,
    subfield_title,
)
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.reports.results import find_results


@pytest.fixture
def copy(out, tmp_path):
    """A copy to do harm to, with its sources where they were: links to them are relative."""
    (tmp_path / "in").symlink_to(out.with_name("in"))
    return shutil.copytree(out, tmp_path / "copy")


def scenes(text):
    found = re.search(r'<div class="viewer".*?application/json">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])["scenes"]


def fail(root, subject, hemi):
    """Turn a measured hemisphere into a failed one."""
    (path,) = (root / f"sub-{subject}/anat").glob(f"*hemi-{hemi}*_metrics.json")
    record = json.loads(path.read_text())
    record |= {"decision": "failed", "message": "nothing to be done", "metrics": {}}
    path.write_text(json.dumps(record))


def test_a_page_without_any_map_has_bodies_and_says_where_slices_are_empty(copy):
    fail(copy, "02", "L")
    text = participant_page(copy, "02", None, read_cohort(copy))
    assert "could not be made" not in text
    assert all("body" in scene for scene in scenes(text))
    # The right body is interrupted in the middle, where the third of its slices is.
    captions = re.findall(r"<figcaption>(coronal, 50%.*?)</figcaption>", text)
    assert ["nothing of the body" in caption for caption in captions] == [False, True]


def test_labels_without_the_protocols_codes_cost_the_slices_only(copy):
    fail(copy, "02", "R")
    (mask,) = (copy / "sub-02").rglob("*hemi-R*body_mask.nii.gz")
    mask.unlink()
    labels = next((copy / "../in/derivatives/freesurfer/sub-02/mri").glob("rh.*.mgz"))
    image, before = nib.load(labels), labels.read_bytes()
    nib.save(nib.MGHImage(np.zeros(image.shape, np.int32), image.affine), labels)
    try:
        text = participant_page(copy, "02", None, read_cohort(copy))
    finally:
        labels.write_bytes(before)
    assert "could not be made" not in text
    assert "no voxel has a label of the protocol" in text


def test_slices_view_and_files_have_the_colors_of_the_protocol(out):
    text = (out / "sub-01.html").read_text()
    items = r'background:(#\w{6})"></span>([^<]+)</li>'
    legend = {name: color for color, name in re.findall(items, text)}
    solid = {entry["name"]: entry["color"] for entry in scenes(text)[0]["subfields"]}
    assert set(solid) == {"PrS", "Sub", "CA1", "CA2/3"}
    assert {name: legend[name] for name in solid} == solid
    file = nib.load(next((out / "sub-01/anat").glob("*hemi-L*_dseg.label.gii")))
    written = {
        "#" + "".join(f"{round(255 * part):02x}" for part in label.rgba[:3])
        for label in file.labeltable.labels
    }
    assert set(solid.values()) <= written


def test_colors_of_parts_are_those_of_the_body_and_unknown_names_differ():
    assert palette(load_protocol("freesurfer"), ["CA1"]) == {"CA1": "#ff0000"}
    made_up = palette(None, ["a", "b", "c", "d"])
    assert len(set(made_up.values())) == 4


def test_maps_of_both_hemispheres_lie_alike(out, monkeypatch):
    left, right = (
        next(h for h in find_results(out, "01") if h.result.name.hemi == side) for side in "LR"
    )
    values = np.arange(12.0).reshape(4, 3)
    pictures = []
    monkeypatch.setattr(maps_module, "palette_png", lambda p, _: pictures.append(p) or "")
    maps_module.make_sprites([dict.fromkeys(("thickness", "curvature"), values)] * 2)
    tile = pictures[0][:, :4]
    np.testing.assert_array_equal(tile, pictures[0][:, 4:])
    assert tile[-1].tolist() == sorted(tile[-1].tolist())  # posterior below, medial left
    content = unfolded.draw_map(THICKNESS, [left, right]).content.decode()
    assert content.count(">medial  ←  mm  →  lateral</text>") == 2
    for hemisphere, pixels in zip((left, right), pictures[-3:], strict=False):
        shades = maps_module.shades_of(hemisphere.sheet.columns["thickness"], (0.5, 3.0))
        np.testing.assert_array_equal(pixels[4::8, 4::8], shades)


@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html", "report.html"])
def test_pages_say_how_maps_lie(out, name):
    assert ORIENTATION in (out / name).read_text()


def test_the_word_on_missing_webgl_comes_before_the_empty_view(out):
    text = (out / "sub-01.html").read_text()
    assert text.index('class="fallback') < text.index('class="stage"')


def test_no_two_numbers_of_a_page_have_one_name(out):
    text = (out / "sub-01.html").read_text()
    titles = re.findall(r'<tr><th scope="row">([^<]+)</th>', text)
    assert {"Length of the sheet, posterior to anterior", "Distance of the end planes"} <= {*titles}
    assert len(titles) == len(set(titles))
    assert "Length of the body" not in titles


def test_thickness_and_mean_curvature_have_fixed_scales_and_others_those_of_their_values():
    assert kind_of("thickness") is THICKNESS
    assert kind_of("curvature") is kind_of("curvature_interior") is CURVATURE
    assert scale_of(THICKNESS, [np.array([9.0])]) == scale_of(THICKNESS, []) == (0.5, 3.0)
    assert scale_of(CURVATURE, [np.linspace(0.0, 0.2, 101)]) == (-0.5, 0.5)
    # Other units: per square millimeter, differences, and maps of other programs.
    low, high = scale_of(kind_of("gaussian_curvature_exterior"), [np.linspace(0.0, 0.02, 101)])
    assert -low == high == pytest.approx(0.0192)
    assert scale_of(kind_of("t1t2"), [np.linspace(1.0, 2.0, 101)]) == pytest.approx((1.01, 1.99))
    assert scale_of(kind_of("t1t2"), []) == (-1.0, 1.0)
    change = scale_of(kind_of("thickness", change=True), [np.linspace(0.0, 0.2, 101)])
    assert change == pytest.approx((-0.196, 0.196))


def test_a_color_means_the_same_on_every_page(out):
    first, second = (
        json.loads(
            re.search(
                r'<div class="viewer".*?application/json">(.*?)</script>',
                (out / f"sub-0{n}.html").read_text(),
                re.DOTALL,
            )[1]
        )["scales"]
        for n in (1, 2)
    )
    assert first == second
    ends = (first["thickness"]["low"], first["thickness"]["high"])
    bar = r'<p class="colorbar[^>]*><span>≤ ([-\d.]+)</span>.*?<span>≥ ([-\d.]+) mm</span>'
    drawn = r'alt="Thickness on the unfolded sheet, [^"]*, colors from ([\d.]+) to ([\d.]+) mm"'
    for name, said, maps in (
        ("sub-01.html", drawn, 2),
        ("sub-02.html", drawn, 1),
        ("report.html", bar, 1),
    ):
        found = re.findall(said, (out / name).read_text())
        assert [tuple(map(float, pair)) for pair in found] == [ends] * maps


def effects_of_noise(kind="t", n=24, points=861):
    """Effects of two equal groups without any difference."""
    df = n - 2.0
    t = stats.t.rvs(df, size=points, random_state=3)
    sizes = 2 * t / np.sqrt(n) if kind == "t" else t**2 / (t**2 + df)
    return Effects(kind, sizes, t if kind == "t" else t**2, np.full(points, df))


@pytest.mark.parametrize("kind", ["t", "F"])
def test_noise_does_not_reach_the_ends_of_the_colors(kind):
    """A single point would have to survive Bonferroni's correction there."""
    noise = effects_of_noise(kind)
    reach = effect_reach([noise])
    t = stats.t.isf(0.025 / 861, 22)
    assert reach == pytest.approx(2 * t / np.sqrt(24) if kind == "t" else t**2 / (t**2 + 22))
    assert np.abs(noise.sizes).max() < reach
    # Large effects of another measure spread the colors of all.
    large = Effects(kind, np.full(50, 3 * reach), noise.statistic[:50], noise.df[:50])
    assert effect_reach([noise, large]) > reach
    assert effect_reach([]) > 0


def test_subfields_are_spelled_as_in_a_text():
    names = ("CA2_3", "BA35", "PRESUBICULUM", "DENTATE_GYRUS")
    assert [subfield_title(n) for n in names] == ["CA2/3", "BA35", "presubiculum", "dentate gyrus"]


def test_a_protocol_of_the_users_own_is_not_taken_for_one_of_the_package(out):
    (hemisphere, *_) = find_results(out, "01")
    unknown = SimpleNamespace(record={"scheme": "own"})
    assert hemisphere.protocol.name == "freesurfer"
    assert type(hemisphere).protocol.fget(unknown) is None
