"""The template of registration in a dataset of a template (`hipsta-bids export`)."""

from pathlib import Path

from hipsta_bids.errors import UsageError

#: End of the name of the file, after the label of the template.
TEMPLATE_ENDING = "desc-registration_template.json"


def template_file(path: Path) -> Path:
    """Find the template of registration in a dataset of a template; a file is itself."""
    if not path.is_dir():
        return path
    paths = sorted(path.glob(f"tpl-*/anat/tpl-*_{TEMPLATE_ENDING}"))
    if len(paths) != 1:
        raise UsageError(
            f"--template {path}: has {len(paths)} templates of registration; name the file"
        )
    return paths[0]
