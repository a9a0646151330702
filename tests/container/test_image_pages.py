"""Every page and figure of every command, made in the image: the list of tests/cli."""

import pytest
from container_runs import IMAGE, in_container, mount, run, shared_folder
from every_page import COMMANDS, check_pages, words, write_inputs

if not IMAGE:
    pytest.skip("needs a container image: run tools/test-container", allow_module_level=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = shared_folder(tmp_path_factory.mktemp("pages") / "every page")
    write_inputs(path)
    run("chmod", "-R", "a+rwX", path)  # the container's user is nobody here
    return path


@pytest.mark.parametrize(("command", "code", "made"), COMMANDS, ids=[c for c, *_ in COMMANDS])
def test_every_page_is_made(folder, command, code, made):
    """In this order: later commands read what earlier ones write."""
    options = (*mount(folder, "/work dir"), "--workdir", "/work dir")
    done = in_container(*words(command), options=options)
    assert done.returncode == code, done
    check_pages(folder, done.stdout + done.stderr, made)
