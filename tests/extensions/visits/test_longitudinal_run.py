"""``participant --longitudinal`` from files to files: outputs, records, what is measured again."""

import html
import json
import shutil

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from scipy import ndimage
from scipy.spatial.transform import Rotation

from hipsta_bids.cli import main
from hipsta_bids.derivatives.names import HemisphereName
from hipsta_bids.derivatives.results import ResultPlace, list_results, read_record, read_sheet
from hipsta_bids.errors import ExitCode
from hipsta_bids.io import files
from hipsta_bids.phantom import Hemisphere, PhantomSpec, write_dataset
from hipsta_bids.reports.cohort import correction_of, read_cohort
from hipsta_bids.reports.participant import participant_page

SEG = "freesurfer"
THICKNESS = {"1": 2.0, "2": 1.9, "3": 1.8}


def pose(number):
    motion = np.eye(4)
    turn = Rotation.from_euler("xyz", [3 * number, -2 * number, number], degrees=True)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), [1.3 * number, -0.7 * number, 0.4]
    return motion


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    hemispheres = [
        Hemisphere(
            subject=f"01_ses-{session}",
            hemi="L",
            spec=PhantomSpec(kind="spiral", thickness=thickness, length=12.0),
            pose=pose(number),
        )
        for number, (session, thickness) in enumerate(THICKNESS.items())
    ]
    write_dataset(folder, hemispheres, layouts=(SEG,), voxel_size=(0.5, 0.5, 0.5))
    (folder / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    return folder


def run(data, out, *options):
    settings = ["--settings", data / "coarse.toml", "--no-reports", "--n-procs", "1"]
    arguments = [data, out, "participant", "--longitudinal", *settings, *options]
    return main.main(list(map(str, arguments)))


def place(out, session):
    name = HemisphereName(subject="01", session=session, hemi="L", seg=SEG)
    return ResultPlace(root=out, name=name)


def thickness(out, session):
    return read_sheet(place(out, session).path("sheet"), ["thickness"])["thickness"]


def values(path):
    return nib.load(path).agg_data()


@pytest.fixture(scope="module")
def out(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert run(data, out) == ExitCode.OK
    return out


def test_each_visit_has_the_files_of_a_visit_alone(data, out, tmp_path):
    options = ["--settings", data / "coarse.toml", "--no-reports", "--session-label", "1"]
    separate = tmp_path / "alone"
    assert main.main(list(map(str, [data, separate, "participant", *options]))) == ExitCode.OK
    folder = "sub-01/ses-1/anat"
    assert "Visits on one sheet" not in participant_page(separate, "01", "1", read_cohort(separate))
    single, shared = ({p.name for p in (root / folder).iterdir()} for root in (separate, out))
    assert single <= shared
    assert {name.split("_desc-")[1] for name in shared - single} == {
        "thicknessChange_morph.shape.gii",
        "thicknessChange_morph.json",
    }
    first, second = (
        files.read_tsv(place(root, "1").path("summary"))[0].keys() for root in (separate, out)
    )
    assert first == second


def test_the_change_is_the_planted_change(out):
    means = [thickness(out, session).mean() for session in THICKNESS]
    # Each visit alone is off by up to 0.02 mm in voxels of 0.5 mm, so a change by twice as much.
    assert means[2] - means[0] == pytest.approx(-0.2, abs=0.04)
    assert means[1] - means[0] == pytest.approx(-0.1, abs=0.04)


def test_the_template_has_mean_and_sd_of_the_visits(out):
    maps = np.stack([thickness(out, session) for session in THICKNESS])
    shared = place(out, None)
    rounding = 1e-3  # of tables and of single precision
    mean, sd = (values(shared.path(f"template_{key}")) for key in ("thickness", "sd"))
    assert mean == pytest.approx(maps.mean(axis=0).ravel(), abs=rounding)
    assert sd == pytest.approx(maps.std(axis=0, ddof=1).ravel(), abs=rounding)
    for number, session in enumerate(THICKNESS):
        change = values(place(out, session).path("change"))
        assert change == pytest.approx((maps[number] - maps.mean(axis=0)).ravel(), abs=rounding)
    points, _ = nib.load(shared.path("template_midthickness")).agg_data()
    assert len(points) == maps[0].size
    assert shared.path("template_mask").exists()


def test_records_name_all_visits_and_their_files(out):
    for session in THICKNESS:
        record = read_record(place(out, session))
        assert [visit["session"] for visit in record["visits"]] == list(THICKNESS)
        assert record["metrics"]["frame"] == "person"
        assert record["metrics"]["frame_overlap"] > 0.9
        sidecar = place(out, session).path("thickness").name.replace(".shape.gii", ".json")
        sources = json.loads((out / f"sub-01/ses-{session}/anat" / sidecar).read_text())["Sources"]
        assert {f"ses-{n}" for n in THICKNESS} == {
            text.split("sub-01_")[1].split("/")[0] for text in sources
        }
    record = files.read_json(place(out, None).path("template_qc"))
    assert len(record["motions"]) == len(THICKNESS)
    assert record["measured"] == list(THICKNESS)
    assert len({read_record(place(out, s))["input_hash"] for s in THICKNESS}) == len(THICKNESS)


def test_the_template_is_no_visit(out):
    assert {result.name.session for result in list_results(out)} == set(THICKNESS)
    rows = files.read_tsv(out / "status.tsv")
    assert [row["session"] for row in rows] == [f"ses-{session}" for session in THICKNESS]
    assert all(float(row["seconds_template"]) > 0 for row in rows)


def test_pages_show_all_visits_on_the_same_columns(out):
    page = participant_page(out, "01", "2", read_cohort(out))
    assert "Visits on one sheet" in page
    maps = [thickness(out, session) for session in THICKNESS]
    for number, session in enumerate(THICKNESS):
        change = maps[number].mean() - np.mean(maps)
        words = f"left, ses-{session} mean {change:.3f}"
        # Of maps in single precision, and of a table with four decimals.
        near = [f"left, ses-{session} mean {change + step:.3f}" for step in (-1e-4, 1e-4)]
        assert any(text in page for text in (words, *near))


def visits_of_page(out, bids_dir):
    call = [bids_dir, out, "participant", "--reports-only", "--no-anatomy"]
    assert main.main(list(map(str, call))) == ExitCode.OK
    page = (out / "sub-01_ses-2.html").read_text()
    section = page.split('data-visits="')[1]
    titles = [section.index(f"left, ses-{session} mean") for session in THICKNESS]
    visits = json.loads(html.unescape(section.split('"')[0]))
    return visits, [list(THICKNESS)[i] for i in np.argsort(titles)]


def test_pages_show_visits_by_time(out, tmp_path):
    table = tmp_path / "in/sub-01/sub-01_sessions.tsv"
    table.parent.mkdir(parents=True)
    shutil.copytree(out, tmp_path / "out")
    rows = "ses-1\t2021-02-01T11:00:00\nses-2\t2021-02-01T09:00:00Z\nses-3\t{}\n"
    for last, order in (("2020-01-05", "321"), ("n/a", "123"), ("5.1.2020", "123")):
        table.write_text("session_id\tacq_time\n" + rows.format(last))
        visits, maps = visits_of_page(tmp_path / "out", tmp_path / "in")
        assert [visit.split(",")[0] for visit in visits] == [f"ses-{one}" for one in order]
        assert maps == list(order)
    assert visits[0] == "ses-1, 2021-02-01"


@pytest.mark.parametrize("option", [(), ("--no-anatomy",)])
def test_pages_show_dates_of_sessions_with_and_without_anatomy(out, tmp_path, option):
    table = tmp_path / "in/sub-01/sub-01_sessions.tsv"
    table.parent.mkdir(parents=True)
    table.write_text(
        "session_id\tacq_time\nses-1\t2020-01-05T10:00:00\nses-2\t2021-02-01\nses-3\tn/a\n"
    )
    shutil.copytree(out, tmp_path / "out")
    call = [tmp_path / "in", tmp_path / "out", "participant", "--reports-only", *option]
    assert main.main(list(map(str, call))) == ExitCode.OK
    page = (tmp_path / "out/sub-01_ses-2.html").read_text()
    visits = json.loads(html.unescape(page.split('data-visits="')[1].split('"')[0]))
    assert visits == ["ses-1, 2020-01-05", "ses-2, 2021-02-01", "ses-3"]


def test_methods_describe_the_common_sheet(out):
    text = (out / "CITATION.md").read_text()
    assert "with no visit as target" in text


def test_one_visit_more_makes_all_be_measured_again(data, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(data, out, "--session-label", "1", "2") == ExitCode.OK
    before = thickness(out, "1")
    capsys.readouterr()
    assert run(data, out, "--session-label", "1", "2", "-v") == ExitCode.OK
    assert "2 unchanged, skipped" in capsys.readouterr().out
    assert run(data, out, "--session-label", "3") == ExitCode.OK
    assert main.main([str(data), str(out), "group"]) == ExitCode.BAD_DATA
    assert "sessions are on different sheets (1, 2; 3)" in capsys.readouterr().err
    assert run(data, out) == ExitCode.OK
    printed = capsys.readouterr().out
    assert "measured again on a sheet of the sessions 1, 2, 3 (before: 1, 2)" in printed
    notes = read_record(place(out, "1"))["notes"]
    assert any("before: 1, 2" in note for note in notes)
    assert not np.array_equal(before, thickness(out, "1"))


def test_a_visit_that_cannot_be_read_fails_alone(data, tmp_path):
    broken = tmp_path / "data"
    shutil.copytree(data, broken)
    (path,) = broken.glob("derivatives/freesurfer/sub-01_ses-3/mri/*.mgz")
    path.write_bytes(b"no image")
    out = tmp_path / "out"
    assert run(broken, out) == ExitCode.SOME_FAILED
    rows = {row["session"]: row for row in files.read_tsv(out / "status.tsv")}
    assert [rows[f"ses-{n}"]["decision"] for n in "123"] == ["use", "use", "failed"]


def test_an_edited_mask_enters_the_mean(data, out, tmp_path):
    mask = tmp_path / "edits" / "sub-01" / "ses-2" / "anat"
    mask = mask / f"sub-01_ses-2_hemi-L_seg-{SEG}_desc-edited_mask.nii.gz"
    mask.parent.mkdir(parents=True)
    body = nib.load(place(out, "2").path("body_mask"))
    inside = np.asarray(body.dataobj) > 0
    thin = ndimage.binary_erosion(inside)
    nib.save(nib.Nifti1Image(thin.astype(np.uint8), body.affine), mask)
    edited = tmp_path / "out"
    assert run(data, edited, "--edited-dir", mask.parents[3]) == ExitCode.OK
    sizes = [
        np.count_nonzero(nib.load(place(folder, None).path("template_mask")).dataobj)
        for folder in (out, edited)
    ]
    # A third of what one of three visits lost, in finer voxels.
    lost = 1 - np.count_nonzero(thin) / np.count_nonzero(inside)
    assert 1 - sizes[1] / sizes[0] == pytest.approx(lost / 3, rel=0.35)
    reasons = {flag["reason"] for flag in read_record(place(edited, "2"))["flags"]}
    assert "edited-mask-different" in reasons

    elsewhere = np.zeros_like(thin, dtype=np.uint8)
    elsewhere[0, 0, 0] = 1
    nib.save(nib.Nifti1Image(elsewhere, body.affine), mask)
    assert run(data, edited, "--edited-dir", mask.parents[3]) == ExitCode.SOME_FAILED
    rows = {row["session"]: row for row in files.read_tsv(edited / "status.tsv")}
    assert [rows[f"ses-{n}"]["decision"] for n in "123"] == ["use", "failed", "use"]
    assert "misses the sheet's labels" in rows["ses-2"]["message"]


def test_a_visit_of_another_shape_fails_alone(data, tmp_path):
    wrong = tmp_path / "data"
    shutil.copytree(data, wrong)
    (path,) = wrong.glob("derivatives/freesurfer/sub-01_ses-3/mri/*.mgz")
    spec = PhantomSpec(kind="s-shape", thickness=2.4, width=13.0, length=12.0)
    stranger = Hemisphere(subject="01_ses-3", hemi="L", spec=spec, pose=pose(2))
    path.unlink()
    write_dataset(wrong, [stranger], layouts=(SEG,), voxel_size=(0.5, 0.5, 0.5))
    out = tmp_path / "out"
    assert run(wrong, out) == ExitCode.SOME_FAILED
    rows = {row["session"]: row for row in files.read_tsv(out / "status.tsv")}
    assert [rows[f"ses-{n}"]["decision"] for n in "123"] == ["use", "use", "failed"]
    assert rows["ses-3"]["reason"] == "visit-unlike"
    (note,) = [n for n in read_record(place(out, "1"))["notes"] if "do not resemble" in n]
    assert note.endswith(": 3")
    pair = tmp_path / "pair"
    assert run(data, pair, "--session-label", "1", "2") == ExitCode.OK
    np.testing.assert_array_equal(thickness(out, "1"), thickness(pair, "1"))


@pytest.mark.parametrize("way", ["folders", "option"])
def test_visits_that_share_a_space_are_not_aligned(data, tmp_path, way):
    shutil.copytree(data, tmp_path / "data")
    folder = tmp_path / "data" / "derivatives" / SEG
    shutil.rmtree(folder / "sub-01_ses-3")
    if way == "folders":  # FreeSurfer's longitudinal stream
        for session in "12":
            path = folder / f"sub-01_ses-{session}"
            path.rename(path.with_name(f"{path.name}.long.sub-01"))
    # The second visit is moved back to the first one, but for half a millimeter.
    for path in folder.glob("sub-01_ses-2*/mri/*.mgz"):
        image = nib.load(path)
        shift = np.eye(4)
        shift[0, 3] = 0.5
        back = shift @ pose(0) @ np.linalg.inv(pose(1))
        nib.save(type(image)(np.asarray(image.dataobj), back @ image.affine), path)
    out = tmp_path / "out"
    options = ["--longitudinal", "shared"] if way == "option" else []
    assert run(tmp_path / "data", out, *options) == ExitCode.OK
    motions = files.read_json(place(out, None).path("template_qc"))["motions"]
    assert motions[0]["frame_to_visit"] == motions[1]["frame_to_visit"]


def test_a_dataset_without_sessions_is_refused(tmp_path, capsys):
    body = Hemisphere(subject="01", hemi="L", spec=PhantomSpec(length=12.0))
    write_dataset(tmp_path / "data", [body], layouts=(SEG,), voxel_size=(0.6, 0.6, 0.6))
    (tmp_path / "data" / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    assert run(tmp_path / "data", tmp_path / "out") == ExitCode.USAGE
    assert "no segmentation has a session" in capsys.readouterr().err


def test_visits_in_thick_slices_get_a_note(tmp_path):
    bodies = [
        Hemisphere(subject=f"01_ses-{n}", hemi="L", spec=PhantomSpec(length=16.0), pose=pose(0))
        for n in "12"
    ]
    voxels = (0.5, 2.0, 0.5)
    write_dataset(tmp_path / "data", bodies, layouts=(SEG,), voxel_size=voxels, axes="LAI")
    (tmp_path / "data" / "coarse.toml").write_text("[grid]\nspacing = 0.5\n")
    assert run(tmp_path / "data", tmp_path / "out") == ExitCode.OK
    notes = read_record(place(tmp_path / "out", "2"))["notes"]
    assert any(note.startswith("thick slices") and "sessions 1, 2" in note for note in notes)


def test_a_folder_holds_one_kind_of_maps(data, out, capsys):
    options = ["--settings", data / "coarse.toml", "--no-reports"]
    code = main.main(list(map(str, [data, out, "participant", *options])))
    assert code == ExitCode.USAGE
    assert "made with --longitudinal; add --longitudinal, or" in capsys.readouterr().err


def test_the_command_for_corrections_is_accepted_by_its_folder(data, out, tmp_path):
    cohort = read_cohort(out)
    command = correction_of(cohort.hemispheres, cohort.settings)["command"]
    words = {"BIDS_DIR": data, "OUT_DIR": out, "EDITS": tmp_path, "FILE": data / "coarse.toml"}
    arguments = [str(words.get(word, word)) for word in command.split()[1:]]
    assert main.main([*arguments, "--no-reports", "--n-procs", "1"]) == ExitCode.OK
    assert words.keys() <= set(command.split())


@pytest.mark.parametrize(
    "option",
    [("--region", "extended"), pytest.param(("--uncertainty", "2"), marks=needs("uncertainty"))],
)
def test_what_longitudinal_maps_do_not_have_is_refused(data, tmp_path, option, capsys):
    assert run(data, tmp_path / "out", *option) == ExitCode.USAGE
    assert "--longitudinal measures the body" in capsys.readouterr().err
