"""What keeps container, workflows and project together; none of it needs Docker."""

import os
import re
import shutil
import subprocess
import tomllib

import pytest
import yaml
from container_runs import ROOT

from hipsta_bids import __version__
from hipsta_bids.derivatives.dataset import CODE_URL_VARIABLE, CONTAINER_VARIABLES

DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = {
    path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))
    for path in (ROOT / ".github" / "workflows").glob("*.yml")
}
#: The default base is an official image of this Python.
PINNED = re.findall(
    r"^pinned=(\S+)$", (ROOT / "tools" / "build-image").read_text(encoding="utf-8"), re.MULTILINE
)[0]
BASE_PYTHON = re.findall(r"^ARG BASE_IMAGE=python:(3\.\d+)-slim\b", DOCKERFILE, re.MULTILINE)[0]


def steps(workflow):
    return [step for job in WORKFLOWS[workflow]["jobs"].values() for step in job.get("steps", [])]


def test_labels_are_those_of_the_project():
    labels = dict(re.findall(r"org\.opencontainers\.image\.(\w+)=\"([^\"$]+)\"", DOCKERFILE))
    assert labels == {
        "title": PROJECT["name"],
        "description": PROJECT["description"],
        "version": __version__,
        "authors": PROJECT["authors"][0]["name"],
        "vendor": PROJECT["authors"][0]["name"],
        "licenses": PROJECT["license"],
    }


def test_datasets_name_the_image_and_its_code():
    last = DOCKERFILE.rpartition("FROM ")[2]
    given = dict(re.findall(r"\b(HIPSTA_BIDS_\w+)=(\S+)", last))
    assert given == {
        CONTAINER_VARIABLES["Type"]: "docker",
        CONTAINER_VARIABLES["Tag"]: "${IMAGE}",
        CODE_URL_VARIABLE: "${CODE_URL}",
    }
    assert f"\nARG IMAGE=hipsta_bids:{__version__}\n" in DOCKERFILE


def test_the_base_is_one_by_its_digest():
    [base] = re.findall(r"^ARG BASE_IMAGE=(\S+)$", DOCKERFILE, re.MULTILINE)
    assert re.fullmatch(re.escape(base) + "@sha256:[0-9a-f]{64}", PINNED)
    # The argument is the whole reference, so that any other can be given, also without a digest.
    bases = re.findall(r"^FROM (.+)$", DOCKERFILE, re.MULTILINE)
    own = {"packages"}
    assert {name.split(" AS ")[0] for name in bases} == {"${BASE_IMAGE}", *own}
    assert bases[-1] == "${BASE_IMAGE}"


def test_packages_do_not_depend_on_own_code():
    """What is installed from the lock comes before, and apart from, what is copied of the code."""
    packages, _, rest = DOCKERFILE.partition("\nFROM packages AS slim\n")
    slim, _, rest = rest.partition("\nFROM packages AS program\n")
    program, _, last = rest.partition("\nFROM ${BASE_IMAGE}\n")
    assert re.findall(r"^COPY (.+)$", packages, re.MULTILINE) == [
        "requirements.lock requirements-dev.lock ./"
    ]
    assert "COPY" not in slim
    assert re.findall(r"^COPY (.+)$", program, re.MULTILINE) == [". ."]
    assert re.findall(r"^COPY --from=(\w+)", last, re.MULTILINE) == ["slim", "program"]
    # Nor on what the image is called: neither is known before the layers that take long.
    assert "ARG IMAGE" not in slim
    assert last.index("COPY --from=slim") < last.index("ARG IMAGE")


def test_user_of_the_image_is_a_number_and_not_root():
    """Numbers, since an orchestrator that forbids root cannot tell who a name is."""
    assert re.findall(r"^USER (.+)$", DOCKERFILE, re.MULTILINE) == ["1000:1000"]
    assert DOCKERFILE.index("\nUSER ") > DOCKERFILE.rindex("\nRUN ")


def test_the_image_has_the_dask_engine():
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    for requirement in PROJECT["optional-dependencies"]["cluster"]:
        name = re.match(r"[\w-]+", requirement)[0]
        assert re.search(rf"^{name}==", lock, re.MULTILINE), name


FAKE_DOCKER = """\
#!/bin/sh
echo "$@" >> "$LOG"
case "$*" in
    "image inspect --format"*) echo sha256:{number} ;;
    "image inspect {known}") ;;
    "image inspect"*|pull*) exit 1 ;;
esac
"""


@pytest.fixture
def build(tmp_path):
    """Run tools/build-image with a stand-in for Docker that knows one base."""

    def run(known, *options, **variables):
        script = FAKE_DOCKER.format(known=known, number="7" * 64)
        (tmp_path / "docker").write_text(script)
        (tmp_path / "docker").chmod(0o755)
        log = tmp_path / "log"
        names = ("IMAGE", "CODE_URL")
        kept = {key: value for key, value in os.environ.items() if key not in names}
        path = os.pathsep.join([str(tmp_path), os.environ["PATH"]])
        done = subprocess.run(
            [ROOT / "tools" / "build-image", *options],
            env=kept | {"PATH": path, "LOG": str(log)} | variables,
            capture_output=True,
            text=True,
            check=False,
        )
        lines = log.read_text(encoding="utf-8").splitlines()
        return done, [line for line in lines if line.startswith("build ")]

    return run


LABEL = "--label org.opencontainers.image."


def test_local_builds_have_all_labels(build):
    done, [line] = build(PINNED, "--network", "host")
    assert done.returncode == 0, done.stderr
    assert f"--tag hipsta_bids:{__version__} " in line
    assert f"{LABEL}base.digest={PINNED.partition('@')[2]} " in line
    assert f"{LABEL}created=" in line
    assert f"--build-arg BASE_IMAGE={PINNED} " in line
    assert "image.source" not in line
    assert line.endswith("--network host .")
    published = {"IMAGE": "registry.example/lab/app:1", "CODE_URL": "https://example.org/code"}
    line = build(PINNED, **published)[1][-1]
    assert f"--build-arg IMAGE={published['IMAGE']} " in line
    assert f"--build-arg CODE_URL={published['CODE_URL']} " in line
    assert f"{LABEL}source={published['CODE_URL']} " in line


def test_a_base_without_digest_is_taken_if_it_is_here(build):
    """As one that was loaded from a file: it is said, and the label has its number."""
    name = PINNED.partition("@")[0]
    done, [line] = build(name)
    assert done.returncode == 0, done.stderr
    assert f"taking the {name} that is here" in done.stderr
    assert f"--build-arg BASE_IMAGE={name} " in line
    assert f"{LABEL}base.digest=sha256:{'7' * 64} " in line


def test_no_other_base_is_taken_than_the_one_that_was_asked_for(build):
    done, lines = build("something:else")
    assert (done.returncode, lines) == (1, [])
    name = PINNED.partition("@")[0]
    done, lines = build(name, "--build-arg", f"BASE_IMAGE={name}@sha256:{'0' * 64}")
    assert (done.returncode, lines) == (1, [])


def test_only_what_the_package_is_made_of_goes_to_the_build():
    rules = [
        line
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if not line.startswith("#")
    ]
    assert rules[0] == "*"  # nothing at all, but for
    allowed = {rule[1:] for rule in rules if rule.startswith("!")}
    copied = set(re.search(r"^COPY (.+) \./$", DOCKERFILE, re.MULTILINE)[1].split())
    made_of = {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], PROJECT["name"]}
    made_of |= {"tools/make-descriptors", "tools/descriptors.py"}  # which run in it
    assert allowed == made_of | copied
    assert all((ROOT / name).exists() for name in allowed)


def test_build_tools_come_from_the_lock():
    """The image's only package without a wheel is built by a setuptools with hashes."""
    script = re.search(r"sed -n '([^']+)' (\S+) > build\.lock", DOCKERFILE)
    sed = shutil.which("sed")
    done = subprocess.run(
        [sed, "-n", script[1], ROOT / script[2]], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert re.fullmatch(r"setuptools==[\d.]+ \\", lines[0])
    assert sum(line.strip().startswith("--hash=sha256:") for line in lines) >= 1
    assert not any("==" in line for line in lines[1:])


def test_workflows_test_the_pythons_that_the_package_names():
    prefix = "Programming Language :: Python :: 3."
    named = [name.removeprefix(prefix) for name in PROJECT["classifiers"] if prefix in name]
    tested = WORKFLOWS["test"]["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tested == [f"3.{minor}" for minor in named]
    assert PROJECT["requires-python"] == f">={tested[0]}"
    assert BASE_PYTHON in tested


@pytest.mark.parametrize("workflow", ["container", "release"])
def test_images_are_compared_with_their_own_python(workflow):
    """Results are promised to be equal to the last byte for one version of Python only."""
    pythons = {step["with"]["python-version"] for step in steps(workflow) if "with" in step
               if "python-version" in step["with"]}  # fmt: skip
    assert pythons == {BASE_PYTHON}


def test_workflows_call_what_there_is():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    commands = [step["run"] for name in WORKFLOWS for step in steps(name) if "run" in step]
    targets = {match for text in commands for match in re.findall(r"^make (\w+)", text)}
    tools = {match for text in commands for match in re.findall(r"^tools/\S+", text)}
    assert targets == {"test", "env"}
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    assert tools == {"tools/test-container", "tools/test-install"}
    assert all((ROOT / tool).stat().st_mode & 0o100 for tool in tools)


def test_what_is_released_is_what_was_tested_with_its_contents_and_origin():
    job = WORKFLOWS["release"]["jobs"]["container"]
    uses = [step.get("uses", step.get("run", "")) for step in job["steps"]]
    places = [
        next(i for i, text in enumerate(uses) if word in text)
        for word in (
            "IMAGE=$name:",
            "tools/test-container",
            'docker push "$IMAGE"',
            "anchore/sbom-action@",
            "actions/attest-sbom@",
            "actions/attest-build-provenance@",
            'make-descriptors --image "$IMAGE" --url "$CODE_URL"',
        )
    ]
    assert places == sorted(places)
    assert not any("docker build" in text for text in uses)  # nothing is built anew
    assert job["env"]["CODE_URL"] == "${{ github.server_url }}/${{ github.repository }}"
    needed = {"packages", "id-token", "attestations"}
    assert {key for key, value in job["permissions"].items() if value == "write"} == needed
    attested = [step["with"] for step in job["steps"] if "actions/attest" in step.get("uses", "")]
    for given in attested:
        assert given["subject-name"] == "${{ env.NAME }}"  # without a tag
        assert given["subject-digest"] == "${{ steps.published.outputs.digest }}"
        assert given["push-to-registry"] is True
    listed = next(s["with"] for s in job["steps"] if "sbom-action" in s.get("uses", ""))
    assert listed["image"] == "${{ env.IMAGE }}"
    assert listed["output-file"] == attested[0]["sbom-path"]


def test_the_release_page_has_the_descriptors_of_the_published_image():
    jobs = WORKFLOWS["release"]["jobs"]
    kept = [s["with"] for s in jobs["container"]["steps"] if "upload-artifact" in s.get("uses", "")]
    assert [(one["name"], one["path"]) for one in kept] == [("descriptors", "descriptors/")]
    page = jobs["page"]["steps"]
    taken = [s["with"] for s in page if "download-artifact" in s.get("uses", "")]
    assert {"name": "descriptors", "path": "descriptors"} in taken
    assert page[-1]["run"].endswith("dist/* descriptors/*.*")  # its folders are no files


def test_a_release_waits_for_the_tests():
    jobs = WORKFLOWS["release"]["jobs"]
    waits = {name: job.get("needs", []) for name, job in jobs.items()}
    needs = {name: [need] if isinstance(need, str) else need for name, need in waits.items()}
    assert jobs["test"]["uses"] == "./.github/workflows/test.yml"
    assert "workflow_call" in WORKFLOWS["test"][True]  # YAML 1.1 takes the key "on" for a boolean
    assert {"test", "package"} <= set(needs["container"])
    assert needs["publish"] == ["container"]
    assert needs["page"] == ["publish"]
