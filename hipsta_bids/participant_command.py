"""The participant level's command line: from options to a run."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hipsta_bids.console import Progress, say, say_result, say_start, say_table
from hipsta_bids.errors import ExitCode, NothingToDoError, UsageError
from hipsta_bids.parser import COLLECT
from hipsta_bids.report_command import rebuild_reports
from hipsta_bids.threads import pin_threads

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Sequence

    from hipsta_bids.bids.dataset import Findings
    from hipsta_bids.bids.inputs import HemisphereInput, InputRequest
    from hipsta_bids.cluster import Cluster
    from hipsta_bids.runner import RunOptions
    from hipsta_bids.settings import Settings
    from hipsta_bids.shard import Shard


def run_participant_level(options: "Namespace", command: str | None = None) -> ExitCode:
    """Measure, collect or list hemispheres, as a parsed command line says.

    Parameters
    ----------
    options : Namespace
        Of :func:`~hipsta_bids.parser.build_parser`.
    command : str, optional
        The command line, for the record.

    Returns
    -------
    ExitCode

    Raises
    ------
    HipstaError
        With its own exit code, if nothing can be begun.
    """
    pin_threads()
    from hipsta_bids.settings_file import load_settings  # noqa: PLC0415  (start-up time)

    check_folders(options)
    if options.analysis_level == COLLECT and options.shard is not None:
        raise UsageError("collect is about all parts; leave --shard out", reason="usage")
    if options.reports_only:
        return rebuild_reports(options)
    settings = _with_region(load_settings(options.settings), options.region)
    request = input_request(options)
    say_start(options.analysis_level, options.bids_dir)
    from hipsta_bids.bids.dataset import dataset_notes, selection_table  # noqa: PLC0415  (heavy)
    from hipsta_bids.bids.maps import attach, map_requests  # noqa: PLC0415  (heavy)

    wishes = map_requests(options.map, options.map_sampling, options.map_interpolation)
    found = _find(request, options.shard)
    if found is None:
        say(f"part {options.shard.name} of the dataset has nothing to process")
        return ExitCode.OK
    items, map_notes = attach(found.items, wishes, options.roi, options.bids_dir)
    for note in (*dataset_notes(request, items), *found.notes, *map_notes):
        say(f"note: {note}")
    if options.dry_run:
        say_table(selection_table(items))
        return ExitCode.OK
    check_output_is_no_input(options.output_dir, items)
    if options.analysis_level == COLLECT:
        from hipsta_bids.collect import collect  # noqa: PLC0415  (heavy)

        result = collect(items, options.output_dir, settings, _run_options(options, command))
        say_result(result, options.output_dir)
        return result.exit_code
    from hipsta_bids.runner import run_participants  # noqa: PLC0415  (heavy)

    progress = Progress(len(items), options.verbose)
    try:
        result = run_participants(
            items, options.output_dir, settings, _run_options(options, command), progress.report
        )
    finally:
        progress.close()
    say_result(result, options.output_dir)
    return result.exit_code


def _find(request: "InputRequest", shard: "Shard | None") -> "Findings | None":
    """Find inputs, of one part of the subjects if asked for; ``None`` if that has none."""
    from hipsta_bids.bids.dataset import find_inputs, list_subjects  # noqa: PLC0415  (heavy)

    if shard is None:
        return find_inputs(request)
    subjects = shard.take(list_subjects(request))
    if not subjects:
        return None
    try:
        return find_inputs(replace(request, participant_labels=subjects))
    except NothingToDoError:
        return None  # others may have something, and collecting says if none has


def _with_region(settings: "Settings", region: str | None) -> "Settings":
    if region is None:
        return settings
    return replace(settings, body=replace(settings.body, region=region))


def check_folders(options: "Namespace") -> None:
    """Refuse a dataset as its own output folder."""
    if options.output_dir.resolve() == options.bids_dir.resolve():
        raise UsageError(
            f"{options.output_dir}: the output folder is the BIDS dataset itself; use for example"
            f" {options.bids_dir / 'derivatives' / 'hipsta_bids'}",
            reason="output-is-input",
        )


def check_output_is_no_input(out_dir: Path, items: "Sequence[HemisphereInput]") -> None:
    """Refuse a folder with segmentations as output folder."""
    if out_dir.resolve() in {item.source_path.resolve() for item in items}:
        raise UsageError(
            f"{out_dir}: the output folder holds the segmentations; choose another one",
            reason="output-is-input",
        )


def input_request(options: "Namespace") -> "InputRequest":
    """Say which inputs are asked for."""
    from hipsta_bids.bids.inputs import InputRequest  # noqa: PLC0415  (heavy)

    derivatives = dict(options.derivatives)
    if len(derivatives) != len(options.derivatives):
        raise UsageError("--derivatives: a name occurs twice; give each its own", reason="usage")
    return InputRequest(
        bids_dir=options.bids_dir,
        derivatives=derivatives,
        freesurfer_dir=options.freesurfer_dir,
        ashs_dir=options.ashs_dir,
        hippunfold_dir=options.hippunfold_dir,
        participant_labels=tuple(options.participant_label),
        session_labels=tuple(options.session_label),
        hemis=tuple(dict.fromkeys(options.hemi)),
        fs_analysis=options.fs_analysis,
        ashs_atlas=options.ashs_atlas,
        scheme=options.scheme,
        edited_dir=options.edited_dir,
        output_dir=options.output_dir,
        bids_filter_file=options.bids_filter_file,
        bids_database_dir=options.bids_database_dir,
    )


def _run_options(options: "Namespace", command: str | None) -> "RunOptions":
    from hipsta_bids.bids.files import check_scratch  # noqa: PLC0415  (start-up time)
    from hipsta_bids.runner import WORKER_GB, RunOptions  # noqa: PLC0415  (heavy)

    if options.mem is not None and options.mem < WORKER_GB:
        raise UsageError(
            f"--mem: {options.mem * 1000:g} MB is less than one hemisphere may need"
            f" ({WORKER_GB * 1000:g} MB); for gigabytes write 8G",
            reason="too-little-memory",
        )
    check_scratch(options.work_dir)
    return RunOptions(
        n_procs=options.n_procs,
        mem_gb=options.mem,
        work_dir=options.work_dir,
        stop_on_first_crash=options.stop_on_first_crash,
        verbosity=options.verbose,
        force=options.force,
        write_meshes=options.write_meshes,
        timeout=options.timeout,
        shard=options.shard,
        cluster=_cluster(options),
        reports=not options.no_reports,
        command=command,
    )


def _cluster(options: "Namespace") -> "Cluster | None":
    from hipsta_bids.cluster import Cluster, check_cluster  # noqa: PLC0415  (start-up time)

    if options.dask_scheduler is None and options.slurm is None:
        return None
    cluster = Cluster(scheduler=options.dask_scheduler, slurm=options.slurm)
    check_cluster(cluster)
    return cluster
