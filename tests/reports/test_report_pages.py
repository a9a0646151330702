"""What pages say, of a hemisphere of each kind; how they look is tested in a browser."""

import contextlib
import io
import json
import re
import shutil

import nibabel as nib
import numpy as np
import pytest
from extension_marks import needs
from page_outline import Outline

from hipsta_bids.cli import main
from hipsta_bids.derivatives.names import DATASET_FILES
from hipsta_bids.participant import pages as reporting
from hipsta_bids.reports import participant as participant_module
from hipsta_bids.reports.cells import FILTERS
from hipsta_bids.reports.cohort import cohort_page, read_cohort
from hipsta_bids.reports.page import Section
from hipsta_bids.reports.participant import participant_page
from hipsta_bids.settings import PUBLISHED

EVIL = "<script>document.title='owned'</script>\"'&"


@pytest.fixture(params=["sub-01.html", "sub-02.html", "report.html"])
def page(out, request):
    """Text of each page."""
    return (out / request.param).read_text(encoding="utf-8")


def test_a_page_is_whole_small_and_asks_for_nothing_outside(page):
    outline = Outline(page)
    assert outline.open == []
    assert len(page) < 5_000_000
    local = re.compile(r"data:|#|sub-\w+\.html|report\.html")
    assert [a for a in outline.addresses if not local.match(a)] == []
    assert "default-src 'none'" in page
    assert not re.search(r"url\((?!data:)|@import|fetch\(|XMLHttpRequest|import\(", page)


def test_a_page_is_made_for_all_readers(page):
    outline = Outline(page)
    assert outline.unlabeled == []
    assert outline.headings[0] == 1
    assert max(np.diff(outline.headings)) <= 1  # no level is left out
    assert len(outline.ids) == len(set(outline.ids))
    assert '<html lang="en">' in page


def test_decisions_are_said_with_what_to_do(out):
    first, second = ((out / f"sub-0{n}.html").read_text() for n in (1, 2))
    verdicts = [
        re.findall(
            r'<span class="verdict">\w+: (.*?)</span></h4>\n<p class="why"><b>(.*?)</b>', text
        )
        for text in (first, second)
    ]
    assert [title for page in verdicts for title, _ in page] == [
        *("Use", "Use", "Look before use", "Do not use")
    ]
    assert [reason for _, reason in verdicts[0]] == [
        "No check raised a flag, and no label was repaired.",
        "Labels were repaired: bridges cut (1).",
    ]
    assert verdicts[1][1][1].startswith("The body is interrupted at RAS")
    assert "the body is interrupted at RAS" in second
    assert "fill in missing slices" in second
    assert "sub-02_hemi-R_seg-freesurfer_desc-edited_mask.nii.gz" in second


def test_backticks_of_messages_become_code_and_tags_in_them_stay_text():
    marked = FILTERS["code"]("try `--scheme <A>`, or `--force`")
    assert marked == "try <code>--scheme &lt;A&gt;</code>, or <code>--force</code>"
    assert FILTERS["code"]("a & b") == "a &amp; b"


def test_a_finding_has_one_share(copy):
    """That of the headline, where the headline is about it."""
    heads = [f"a bump near RAS {x}.0 -20.0 -20.0 mm (CA1): look there" for x in (20, 25)]
    flags = [{"reason": "a", "message": h, "columns_share": 0.03} for h in heads]
    path = next((copy / "sub-02/anat").glob("*hemi-L*_metrics.json"))
    spoil(path, lambda record: record.update(flags=flags, repairs=[]))
    text = participant_page(copy, "02", None, read_cohort(copy))
    listed = re.findall(r'<span class="kind">flag</span> (.*?)</li>', text)
    consequence = "It concerns 3.0% of the map; the effect on the mean thickness is unknown."
    assert listed == [heads[0], f"{heads[1]}. {consequence}"]
    assert "It concerns 3.0% of the map" in text


def scenes(text):
    """What the three-dimensional view is given."""
    found = re.search(r'<div class="viewer".*?application/json">(.*?)</script>', text, re.DOTALL)
    return json.loads(found[1])["scenes"]


def test_a_failed_hemisphere_has_its_body_and_the_defect_in_three_dimensions(out):
    left, right = scenes((out / "sub-02.html").read_text())
    assert "surfaces" in left
    assert "surfaces" not in right
    vertices = np.array(right["body"]["vertices"]).reshape(-1, 3)
    assert max(right["body"]["triangles"]) == len(vertices) - 1
    defect = np.array(right["findings"][0]["point"])
    # The place of the gap is on the body's end, within a step of the thinned mask.
    assert np.linalg.norm(vertices - defect, axis=1).min() < 2


def test_numbers_are_those_of_the_tables(out):
    summary = (out / "sub-01/anat").glob("*hemi-L*desc-summary_morph.tsv")
    names, values = next(summary).read_text().splitlines()
    row = dict(zip(names.split("\t"), values.split("\t"), strict=True))
    text = (out / "sub-01.html").read_text()
    assert f'<td class="n">{float(row["thickness_mean"]):.2f}</td>' in text
    assert f'<td class="n">{float(row["volume"]):.0f}</td>' in text


def test_the_command_and_the_settings_are_named(dataset):
    text = (dataset / "out" / "sub-01.html").read_text()
    assert "hipsta-bids" in text
    assert "participant --n-procs 1</code>" in text
    digest = json.loads((dataset / "out/desc-settings.json").read_text())["hash"]
    assert digest in text


def cohort_data(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_the_table_has_every_hemisphere(out):
    data = cohort_data((out / "report.html").read_text())
    assert [(r["participant"], r["hemi"], r["decision"]) for r in data["rows"]] == [
        ("sub-02", "R", "failed"),
        ("sub-02", "L", "look"),
        ("sub-01", "L", "use"),
        ("sub-01", "R", "use"),
    ]
    assert [r["tile"] for r in data["rows"]] == [None, 0, 1, 2]
    assert [r["change"] is None for r in data["rows"]] == [True, False, True, True]
    assert all((out / row["page"]).exists() for row in data["rows"])


def test_the_same_files_give_the_same_pages(out):
    cohort = read_cohort(out)
    assert participant_page(out, "01", None, cohort) == (out / "sub-01.html").read_text()
    assert cohort_page(cohort) == (out / "report.html").read_text()


@pytest.fixture
def copy(out, tmp_path):
    """A copy to do harm to, with its sources where they were: links to them are relative."""
    (tmp_path / "in").symlink_to(out.with_name("in"))
    return shutil.copytree(out, tmp_path / "copy")


def spoil(path, change):
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


PUBLISHED_METHOD = {group: dict(values) for group, values in PUBLISHED.items()}


@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ({}, ""),
        pytest.param({"sheet": {"frame": "person"}}, " --longitudinal", marks=needs("visits")),
        pytest.param(
            {"sheet": {"frame": "shared"}, "grid": {"spacing": 0.5}},
            " --longitudinal shared --settings FILE",
            marks=needs("visits"),
        ),
        ({"grid": {"spacing": 0.5}}, " --settings FILE"),
        (PUBLISHED_METHOD, " --method published"),
        ({"body": {"region": "whole"}}, ""),
        ({"checks": {"of_another_version": 1}}, ""),
    ],
)
def test_a_correction_has_the_options_of_its_folder(copy, changes, options):
    def change(record):
        for group, values in changes.items():
            record["settings"][group] |= values

    spoil(copy / DATASET_FILES["settings"], change)
    assert main.main(["-", str(copy), "participant", "--reports-only"]) == 0
    text = (copy / "sub-02.html").read_text()
    command = "hipsta-bids BIDS_DIR OUT_DIR participant --edited-dir EDITS --participant-label 02"
    assert f"<code>{command}{options}</code>" in text
    assert ("FILE is the settings file" in text) == ("FILE" in options)
    shared = "--longitudinal" in options
    assert ("All visits of the side are measured again" in text) == shared
    assert ("Only what changed is measured again" in text) != shared


def test_tags_in_any_text_of_the_results_stay_text(copy):
    evil = {
        "message": EVIL,
        "reason": EVIL,
        "scheme_title": EVIL,
        "chosen_because": EVIL,
        "notes": [EVIL],
        "flags": [{"reason": EVIL, "message": f"{EVIL} at RAS -20 -20 -20 mm"}],
        "inputs": [{"file": f"bids:x:{EVIL}"}],
        "passed_over": [{"file": EVIL, "reason": EVIL}],
        "decision": "look",
    }
    for path in (copy / "sub-01/anat").glob("*_metrics.json"):
        spoil(path, lambda record: record.update(evil))
    sheet = next((copy / "sub-01/anat").glob("*hemi-L*desc-sheet_morph.tsv"))
    sheet.write_text(sheet.read_text().replace("CA1", EVIL).replace("gaussian", EVIL))
    cohort = read_cohort(copy)
    for text in (participant_page(copy, "01", None, cohort), cohort_page(cohort)):
        assert text.count("owned") > 0
        assert "<script>document" not in text
        Outline(text)


def test_labels_that_are_gone_cost_the_labels_only(copy):
    gone = dict.fromkeys(("bids", "freesurfer"), "file:///gone")
    spoil(copy / DATASET_FILES["description"], lambda d: d.update(DatasetLinks=gone))
    text = participant_page(copy, "01", None, read_cohort(copy))
    assert "is not there any more" in text
    assert text.count('"body": true') == 2


@pytest.mark.parametrize("name", ["sub-01.html", "sub-02.html"])
def test_labels_are_drawn(out, name):
    text = (out / name).read_text(encoding="utf-8")
    assert "No labels are drawn" not in text


def test_labels_on_another_grid_than_the_mask_are_not_drawn(copy):
    (mask,) = copy.rglob("sub-01*hemi-L*desc-body_mask.nii.gz")
    image = nib.load(mask)
    smaller = np.asarray(image.dataobj)[:-1]
    nib.save(nib.Nifti1Image(smaller, image.affine), mask)
    text = participant_page(copy, "01", None, read_cohort(copy))
    assert "the image of the labels has changed since" in text


def test_a_section_that_fails_costs_itself_only(out, monkeypatch, caplog):
    def fail(_series):
        raise ZeroDivisionError("by zero")

    broken = Section(key="x", title="Broken", template="sections/status.html", build=fail)
    monkeypatch.setattr(participant_module, "SECTIONS", (broken, *participant_module.SECTIONS))
    text = participant_page(out, "01", None, read_cohort(out))
    assert "ZeroDivisionError: by zero" in text
    assert "no label was repaired." in text
    assert "section x" in caplog.text


def test_reports_only_makes_the_pages_anew(copy, capsys):
    for path in copy.glob("*.html"):
        path.unlink()
    options = ["--reports-only", "--participant-label", "02", "--n-procs", "1"]
    assert main.main(["gone", str(copy), "participant", *options]) == 0
    assert sorted(path.name for path in copy.glob("*.html")) == ["report.html", "sub-02.html"]
    said = capsys.readouterr().out
    assert re.match(r"  pages +\d+\.\d s\nreports of 1 visits", said)


def test_reports_only_of_nothing_says_so(tmp_path, capsys):
    assert main.main(["in", str(tmp_path), "participant", "--reports-only"]) == 66
    assert "no results of these participants" in capsys.readouterr().err


def test_a_page_that_cannot_be_made_is_a_warning(copy, monkeypatch):
    monkeypatch.setattr("hipsta_bids.reports.participant.participant_page", lambda *_, **__: 1 / 0)
    problem = reporting.make_page((copy, ("01", None), None, True))
    assert str(problem) == "sub-01.html: not made (ZeroDivisionError: division by zero)"


def run_block(root, error=None, *, wanted=True):
    plan = reporting.PagePlan(root=root, n_workers=1, log=root / "log")
    with reporting.reports_after(plan, [("01", None)]) as pages:
        pages.enabled = wanted
        if error:
            raise error
    return pages.problems


def test_pages_are_made_after_an_error_but_not_when_the_user_stops_the_run(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(reporting, "write_reports", lambda _plan, visits: made.append(visits) or [])
    run_block(tmp_path)
    with pytest.raises(ValueError, match="x"):
        run_block(tmp_path, ValueError("x"))
    assert len(made) == 2
    with pytest.raises(KeyboardInterrupt):
        run_block(tmp_path, KeyboardInterrupt())
    assert len(made) == 2


def test_no_pages_are_made_where_nothing_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(reporting, "write_reports", lambda *_: 1 / 0)
    assert run_block(tmp_path, wanted=False) == []


def test_an_error_in_reporting_is_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(reporting, "write_reports", lambda *_: 1 / 0)
    (problem,) = run_block(tmp_path)
    assert str(problem) == "not made (ZeroDivisionError: division by zero)"


def test_pages_up_to_date_are_left_alone(out, monkeypatch):
    monkeypatch.setattr(reporting, "write_reports", lambda *_: 1 / 0)
    assert run_block(out) == []


def test_a_hemisphere_whose_image_cannot_be_read_has_its_page(tmp_path):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert main.main(["phantom", str(tmp_path / "in"), "--n-subjects", "1"]) == 0
        (image,) = (tmp_path / "in/derivatives/freesurfer/sub-01/mri").glob("rh.hippo*.mgz")
        image.write_bytes(image.read_bytes()[:3000])
        assert main.main([str(tmp_path / "in"), str(tmp_path / "out"), "participant"]) == 1
    text = (tmp_path / "out/sub-01.html").read_text()
    assert "cannot be read as an image" in text
    assert "neither labels nor mask are available" in text
