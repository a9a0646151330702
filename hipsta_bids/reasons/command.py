"""Reasons that lie in the run, in its folders or in the command line."""

from hipsta_bids.reasons.reason import Reason

RUN: dict[str, Reason] = {
    "not-finished": Reason(
        "The run ended before this hemisphere.",
        "Run the same command again.",
    ),
    "timeout": Reason(
        "It was not done within `--timeout`.",
        "Look at the segmentation; noise makes it slow. Or raise `--timeout`.",
    ),
    "out-of-memory": Reason(
        "Memory ran out.",
        "Use fewer processes (`--n-procs`), or a machine with more memory.",
    ),
    "worker-died": Reason(
        "The worker process was killed, or crashed.",
        "If memory ran out, use fewer `--n-procs`. Else report it with the log.",
    ),
    "internal-error": Reason(
        "A bug of this software.",
        "Please report it with the traceback in `logs/`.",
    ),
}

COMMAND: dict[str, Reason] = {
    "usage": Reason(
        "The command line is wrong.",
        "The message says where; `hipsta-bids --help` lists the options.",
    ),
    "missing-folder": Reason("A folder does not exist.", "Check the path."),
    "not-a-folder": Reason("A file was given for a folder.", "Give the folder."),
    "no-file": Reason("A file that was named does not exist.", "Check the path."),
    "unreadable-folder": Reason("A folder cannot be listed.", "Check its permissions."),
    "no-segmentation": Reason(
        "No hippocampal segmentation was found.",
        "Name the dataset: `-d NAME=PATH`, `--freesurfer-dir`, `--ashs-dir`, `--hippunfold-dir`.",
    ),
    "no-match": Reason(
        "There are segmentations, but none matches the selection.",
        "Check `--participant-label`, `--session-label`, `--hemi` and the filter file.",
    ),
    "unknown-analysis": Reason(
        "No hemisphere has the FreeSurfer analysis of `--fs-analysis`.",
        "`--dry-run` lists what there is.",
    ),
    "unknown-scheme": Reason(
        "No protocol has this name.",
        "`hipsta-bids schemes` lists them. A file's name has to end in `.toml`.",
    ),
    "unreadable-scheme": Reason(
        "The protocol file cannot be read, or is no TOML.",
        "Start from a bundled one.",
    ),
    "invalid-scheme": Reason(
        "The protocol file is inconsistent.",
        "The message names the entry.",
    ),
    "output-is-input": Reason(
        "The output folder is, or holds, the input.",
        "Use a folder of its own, such as `BIDS_DIR/derivatives/hipsta_bids`.",
    ),
    "foreign-output": Reason(
        "The output folder is the dataset of another program.",
        "Choose a folder of its own.",
    ),
    "other-settings": Reason(
        "The results there were made with other settings.",
        "Use a new folder, or delete the old one to redo all of it. At the group level: measure all"
        " with the same settings.",
    ),
    "not-writable": Reason("A file cannot be written.", "Choose another output folder."),
    "read-only": Reason(
        "Writing is not allowed there.",
        "Choose another output folder, or change its permissions.",
    ),
    "disk-full": Reason(
        "The disk, or the quota, is full.",
        "Free some space and run the same command again.",
    ),
    "no-scratch": Reason(
        "No folder for temporary files can be written.",
        "Set `TMPDIR`; in a container, mount one at `/tmp`.",
    ),
    "too-little-memory": Reason(
        "`--mem` is less than one hemisphere may need.",
        "Give more; for gigabytes write `8G`.",
    ),
    "bad-hemisphere": Reason("`--hemi` is neither L nor R.", "Choose L, R or both."),
    "bad-label": Reason(
        "A label of a participant or session has other characters than letters and digits.",
        "Write it as in the dataset, with or without `sub-`, `ses-`.",
    ),
    "unreadable-filter": Reason(
        "The filter file cannot be read, or is no JSON.",
        "Check path and content.",
    ),
    "bad-filter": Reason(
        "The filter file has no entry for segmentations, or an unknown entity.",
        "The message names it.",
    ),
    "unreadable-database": Reason(
        "The pybids database is of another dataset, or damaged.",
        "Give an empty folder, and it will be made.",
    ),
    "edit-ambiguous": Reason(
        "An edited file fits several hemispheres, or two files the same one.",
        "Keep one, and say in its name which labels it corrects (`_seg-NAME_desc-edited_`).",
    ),
    "settings-unreadable": Reason("The settings file cannot be read.", "Check the path."),
    "settings-not-toml": Reason(
        "The settings file is no TOML.",
        "Start from what `hipsta-bids settings` prints.",
    ),
    "unknown-setting": Reason(
        "There is no setting of this name.",
        "See [Settings](settings.md); the message names similar ones.",
    ),
    "bad-setting": Reason("A setting has the wrong type.", "The message says what it has to be."),
    "setting-out-of-range": Reason(
        "A setting has a value that no stage could work with.",
        "The message gives the range.",
    ),
    "roi-columns": Reason(
        "The table of `--roi` lacks `x`, `y` or `region`.",
        "See [Other images on the sheet](maps.md).",
    ),
    "roi-empty": Reason("No point belongs to a region.", "Draw one."),
    "roi-duplicate": Reason("A point occurs twice in a region.", "Keep one."),
    "roi-point": Reason("A point is not on the sheet.", "Nodes are numbered from 1."),
    "nothing-to-report": Reason(
        "`--reports-only` found no results.",
        "Run without it first.",
    ),
    "bad-shard": Reason("`--shard` is not I/N with I from 1 to N.", "Write `3/100`, or `slurm`."),
    "no-array": Reason(
        "`--shard slurm` outside of an array job.",
        "Use `sbatch --array=1-N`, or write I/N.",
    ),
    "array-with-gaps": Reason(
        "The numbers of the array job leave gaps.",
        "To run some parts of N again write `--shard $SLURM_ARRAY_TASK_ID/N`.",
    ),
    "no-dask": Reason("Dask is not installed.", "Install the extra `cluster`."),
    "no-scheduler": Reason(
        "Dask's scheduler does not answer.",
        "Give its address as `tcp://HOST:PORT`, or the file that it writes.",
    ),
    "no-slurm": Reason(
        "There is no `sbatch`, or it refuses.",
        "Run it where jobs can be submitted; the message has its answer.",
    ),
    "workers-differ": Reason(
        "Dask's workers have another version, or cannot do the job.",
        "Install the same version there, and mount the same folders.",
    ),
}
