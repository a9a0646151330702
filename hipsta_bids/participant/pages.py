"""Makes the pages of an output dataset, side by side, after the hemispheres are measured.

A page that cannot be made costs a line and the exit code, never a result.
"""

import contextlib
import logging
import traceback
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from hipsta_bids.derivatives.names import DATASET_FILES, participant_report
from hipsta_bids.derivatives.results import list_results
from hipsta_bids.errors import HipstaError, OutputError
from hipsta_bids.io import files
from hipsta_bids.participant.pool import RunJobs, WorkerLost, WorkerPlan, run_jobs
from hipsta_bids.progress import tell
from hipsta_bids.reports.cohort import Cohort, read_cohort
from hipsta_bids.types import VisitKey

_TIMEOUT = 600.0  # s for one page
_COHORT = DATASET_FILES["report"]
_RECORD = "_desc-qc_metrics.json"
_RECORDS = tuple(f"{folder}/*{_RECORD}" for folder in ("sub-*/anat", "sub-*/ses-*/anat"))
_START = 2000  # characters
#: In the head of pages with anatomical images.
ANATOMY = '<meta name="anatomy"'
_LOGGER = logging.getLogger(__name__)


@dataclass
class Pages:
    """The pages of a run."""

    problems: list[HipstaError] = field(default_factory=list)
    """Why pages could not be made."""
    enabled: bool = True
    """False where nothing can be written."""


#: Output dataset, visit (``None`` for the page of the cohort), input dataset, and whether its
#: anatomical images are shown.
PageJob = tuple[Path, VisitKey | None, Path | None, bool]


@dataclass(frozen=True, kw_only=True)
class PagePlan:
    """Where and how pages are made."""

    root: Path
    """The output dataset."""
    n_workers: int
    """Pages at the same time."""
    log: Path
    """Receives tracebacks and what libraries print."""
    bids_dir: Path | None = None
    """The dataset with anatomical images and dates of sessions; ``None`` shows neither."""
    anatomy: bool = True
    """Whether anatomical images are shown behind labels."""
    cohort: bool = True
    """Whether the page of the cohort is made, too."""
    engine: RunJobs | None = None
    """Workers elsewhere; ``None`` is this machine."""


def visits_of(root: Path) -> list[VisitKey]:
    """List the visits of which there is a record."""
    names = (result.name for result in list_results(root))
    return list(dict.fromkeys((name.subject, name.session) for name in names))


def write_reports(plan: PagePlan, visits: Iterable[VisitKey]) -> Iterator[HipstaError]:
    """Make the pages of some visits and of the cohort; yields why pages are missing or old.

    An error of output ends it: the others would fail likewise.
    """
    jobs: list[PageJob] = [(plan.root, None, None, False)] if plan.cohort else []
    source = plan.bids_dir, plan.anatomy
    jobs += [(plan.root, visit, *source) for visit in dict.fromkeys(visits)]
    workers = WorkerPlan(
        work=make_page,
        n_workers=max(1, min(plan.n_workers, len(jobs))),
        timeout=_TIMEOUT,
        log=plan.log,
        warm_up=warm_up,
    )
    answers = (plan.engine if plan.engine and jobs else run_jobs)(workers, jobs)
    tell("pages", 0, len(jobs))
    with contextlib.closing(answers) as pages:
        for count, (job, answer) in enumerate(pages, start=1):
            tell("pages", count, len(jobs))
            problem = answer
            if isinstance(answer, WorkerLost):
                cause = "took too long" if answer.timed_out else f"process died: {answer.cause}"
                problem = HipstaError(f"{_page_name(job[1])}: not made ({cause})")
            if problem is not None:
                _LOGGER.warning("report: %s", problem)
                yield problem
                if isinstance(problem, OutputError):
                    return


@contextlib.contextmanager
def reports_after(plan: PagePlan | None, visits: Sequence[VisitKey]) -> Generator[Pages]:
    """Make pages when the block ends, also by an error; not when the user stops the run.

    None are made without a plan.
    """
    pages = Pages()
    if plan is None:
        yield pages
        return
    try:
        yield pages
    except Exception:
        _try_all(plan, visits, pages.problems)
        raise
    if pages.enabled:
        _try_all(plan, visits, pages.problems)


def _try_all(plan: PagePlan, visits: Sequence[VisitKey], problems: list[HipstaError]) -> None:
    """Make the pages that are older than their records, or show images that they must not."""
    root = plan.root
    stale = []
    for subject, session in dict.fromkeys(visits):
        folder = f"sub-{subject}/{f'ses-{session}/' if session else ''}anat"
        page = root / participant_report(subject, session)
        shows = not (plan.bids_dir and plan.anatomy) and ANATOMY in _start(page)
        if shows or not _is_newer(page, root, f"{folder}/*{_RECORD}"):
            stale.append((subject, session))
    if not stale and (not plan.cohort or _is_newer(root / _COHORT, root, *_RECORDS)):
        return
    try:
        problems += write_reports(plan, stale)
    except Exception as error:  # results are worth more than pages
        _LOGGER.exception("report")
        problems.append(HipstaError(f"not made ({type(error).__name__}: {error})"))


def _is_newer(page: Path, root: Path, *patterns: str) -> bool:
    """Return whether a page is newer than all records of some patterns."""
    try:
        page_time = page.stat().st_mtime_ns
        records = [path for pattern in patterns for path in root.glob(pattern)]
        return all(page_time >= path.stat().st_mtime_ns for path in records)
    except OSError:
        return False


def _start(page: Path) -> str:
    """Read the first lines of a page, which say whether it shows anatomical images."""
    try:
        with page.open(encoding="utf-8") as stream:
            return stream.read(_START)
    except OSError:
        return ""


def warm_up() -> None:
    """Load the libraries, so that no page's time includes it."""
    import hipsta_bids.reports.participant  # noqa: F401, PLC0415  (loaded in workers only)
    from hipsta_bids.reports.display import THICKNESS, colors_of  # noqa: PLC0415

    colors_of(THICKNESS.colors)


def _page_name(visit: VisitKey | None) -> str:
    return participant_report(*visit) if visit else _COHORT


def make_page(job: PageJob) -> HipstaError | None:
    """Make one page; returns an error and never raises one."""
    from hipsta_bids.reports.cohort import cohort_page  # noqa: PLC0415  (workers only)
    from hipsta_bids.reports.participant import participant_page  # noqa: PLC0415

    root, visit, bids_dir, anatomy = job
    name = _page_name(visit)
    try:
        cohort = _cohort(root)
        page = (
            participant_page(root, *visit, cohort, bids_dir, anatomy=anatomy)
            if visit
            else cohort_page(cohort)
        )
        if page is not None:
            files.write_text(root / name, page)
    except OutputError as error:
        return error
    except HipstaError as error:
        return HipstaError(f"{name}: {error}")
    except Exception as error:  # noqa: BLE001  (a bug in one page must not end the others)
        traceback.print_exc()  # to the log, as everything that a worker prints
        return HipstaError(f"{name}: not made ({type(error).__name__}: {error})")
    return None


@cache
def _cohort(root: Path) -> Cohort:
    """Read the numbers of all participants once per worker."""
    return read_cohort(root)
