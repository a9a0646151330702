"""Valid inputs of the command line, and how to damage them at random.

Bytes, numbers, words, encodings, values and depths of JSON, headers of images, and formulas.
"""

import contextlib
import copy
import gzip
import io
import json
import re
import shutil
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np

from hipsta_bids.cli import main as command
from hipsta_bids.extensions.norms import file as saved
from hipsta_bids.io import gifti
from hipsta_bids.phantom import Hemisphere, PhantomSpec
from hipsta_bids.phantom import write_dataset as write_phantoms

MEM = 800
"""MB, of --mem."""

_NUMBERS = [
    *(b"0", b"-1", b"3", b"1e308", b"-1e-320", b"NaN", b"Infinity", b"-inf", b"1e5000", b"0x10"),
    *(b"99999999999", b"2147483648", b"1_0", b"-0.0", b"9" * 400, b"\xd9\xa3", b"1,5", b"null"),
]
_TEXTS = [
    *(b"", b" ", b"\0", b"\x1b[2J", b"\xc2\x85", b"\xe2\x80\xae", b"\xed\xa0\x80", b"\\ud800"),
    *(b"x" * 100_000, b"[" * 100_000, b'"', b"'", b"\t", b"\n", b"\r", b"\xff\xfe", b"n/a", b"`"),
    *(b"../../x", b"__class__", b"<b>&lt;", b"{subject}", b"%s", b"true", b"sub-01", b"$x^2$"),
]
_VALUES: list[Any] = [
    *(None, True, 0, -1, 3, 0.5, 1e308, -1e-320, 10**400, float("nan"), float("inf"), "", "NaN"),
    *("x" * 100_000, "\0", "\ud800", "sub-01", [], {}, [[]], ["a", "b"], [None], {"": 0}, "<b>"),
    *([0.0] * 100_000, [[0.0]] * 3, "@50", "@900", "@100000"),
]
_ATOMS = "group age sex thickness volume icv 0 1 2 1e9 'CN' `ab`".split()  # noqa: SIM905
_CALLS = ["C", "I", "abs", "bs", "center", "cr", "exp", "log", "poly", "scale", "sqrt", "open"]
_SIGNS = ["+", "-", "*", "/", ":", "**", "~", ",", "|", "==", "%in%", "+ +", " "]


def damage_bytes(content: bytes, random: Random) -> bytes:
    """Return bytes some of which are flipped, lost, repeated or inserted."""
    changed = bytearray(content)
    place = random.randrange(len(changed) + 1)
    size = random.choice([1, 2, 4, 16, 100, 4096])
    action = random.randrange(6)
    if action == 0:
        for _ in range(size if changed else 0):
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    elif action == 1:
        del changed[place:]
    elif action == 2:  # noqa: PLR2004  (one of six)
        del changed[place : place + size]
    else:
        piece = [bytes(size), random.randbytes(size), bytes(changed[place : place + size])]
        changed[place:place] = piece[action - 3]
    return bytes(changed)


def damage_text(content: bytes, random: Random) -> bytes:
    """Return a text with other numbers, words, lines or encoding."""
    for _ in range(random.choice([1, 1, 1, 2, 5])):
        action = random.randrange(8)
        pattern = rb"-?\d+(\.\d+)?(e[-+]?\d+)?" if action < 3 else rb"[\w.]+"  # noqa: PLR2004
        tokens = list(re.finditer(pattern, content))
        lines = content.split(b"\n")
        if action < 6 and tokens:  # noqa: PLR2004  (of eight)
            token, other = random.choice(tokens), random.choice(tokens)[0]
            pieces = [*(_NUMBERS if action < 3 else _TEXTS), other]  # noqa: PLR2004
            content = content[: token.start()] + random.choice(pieces) + content[token.end() :]
        elif action == 6:  # noqa: PLR2004  (of eight)
            lines.insert(random.randrange(len(lines)), random.choice([*lines, *_TEXTS]))
            del lines[random.randrange(len(lines))]
            content = b"\n".join(lines)
        elif random.randrange(2):
            code = random.choice(["utf-8-sig", "utf-16", "utf-32", "cp037"])
            content = content.decode(errors="replace").encode(code, errors="replace")
        else:
            content = damage_bytes(content, random)
    return content


def change_value(whole: Any, random: Random) -> None:  # noqa: ANN401  (any JSON)
    """Change one value or one key somewhere in lists and objects."""
    value = whole
    while value:
        key = random.choice(list(value) if isinstance(value, dict) else range(len(value)))
        inner = value[key]
        if not isinstance(inner, (dict, list)) or not inner or not random.randrange(6):
            break
        value = inner
    else:
        return
    choices = [*_VALUES, [inner], {"a": inner}, str(inner)]
    if isinstance(inner, list):
        choices += [inner * 2, inner[:-1], inner[::-1]]
    if isinstance(value, dict) and random.randrange(4) == 0:
        value[random.choice(["", "x", "\0", "LR", f"{key} "])] = value.pop(key)
    else:
        value[key] = copy.deepcopy(random.choice(choices))  # else one might hold itself


def damage_json(content: bytes, random: Random, *, is_hashed: bool = False) -> bytes:
    """Return JSON with other values, keys and depths; or with a text that is damaged."""
    if random.randrange(5) == 0:
        return damage_text(content, random)
    whole = json.loads(content)
    for _ in range(random.choice([1, 1, 1, 2, 4])):
        change_value(whole, random)
    if is_hashed and random.randrange(3):
        with contextlib.suppress(ValueError, TypeError):
            whole["hash"] = saved._digest(whole)  # noqa: SLF001  (else it ends at the hash)
    text = json.dumps(whole)
    for depth in (50, 900, 100_000):
        text = text.replace(f'"@{depth}"', "[" * depth + "]" * depth)
    if random.randrange(10) == 0:
        text = text.replace('": ', '": 1, "a": ', 1)
    return text.encode()


def damage_norms(content: bytes, random: Random) -> bytes:
    """Return norms that are damaged and mostly hashed again."""
    return damage_json(content, random, is_hashed=True)


def damage_image(content: bytes, random: Random) -> bytes:
    """Return an image with other numbers in its header, or other voxels."""
    is_packed = content.startswith(b"\x1f\x8b")
    plain = bytearray(gzip.decompress(content) if is_packed else content)
    action = random.randrange(8)
    if action == 0:
        return damage_bytes(content, random)
    if action == 1:
        plain = bytearray(damage_bytes(bytes(plain), random))
    elif action == 2:  # noqa: PLR2004  (of eight)
        size = random.choice([10, 1000, 50_000])
        place = random.randrange(544, len(plain))
        plain[place : place + size] = random.randbytes(1) * len(plain[place : place + size])
    else:
        size = 284 if plain[:4] == b"\0\0\0\1" else 348 if plain[:4] != b"\x1c\x02\0\0" else 552
        for _ in range(random.choice([1, 1, 2, 4])):
            kind = random.choice("hhhiiqffd")
            numbers: list[float] = [0, 1, 2, -1, 7, 64, 2**15 - 1, -(2**15), 2**31 - 1, 2**62]
            if kind in "fd":
                numbers = [0.0, float("nan"), float("inf"), 1e38, -1.0, 1e-30, 0.5, 3e9]
            numbers = [
                n for n in numbers if kind in "qfd" or abs(n) < 2 ** (8 * struct.calcsize(kind) - 1)
            ]
            packed = struct.pack(random.choice("<>") + kind, random.choice(numbers))
            place = random.randrange(0, size - 8, 2)
            plain[place : place + len(packed)] = packed
    return gzip.compress(bytes(plain), 1) if is_packed else bytes(plain)


def damage_cifti(content: bytes, random: Random) -> bytes:
    """Return a CIFTI file with a damaged header, or with another text of the right length."""
    if random.randrange(2):
        return damage_image(content, random)
    (size,), (start,) = struct.unpack("<i", content[544:548]), struct.unpack("<q", content[168:176])
    text = damage_text(content[552 : 544 + size].rstrip(b"\0"), random)
    text += bytes(-(len(text) + 8) % 16)
    header = content[:168] + struct.pack("<q", 552 + len(text)) + content[176:544]
    return header + struct.pack("<ii", len(text) + 8, 32) + text + content[start:]


def draw_formula(random: Random, depth: int = 0) -> str:
    """Return what may be a formula."""
    if depth > random.choice([0, 2, 4]):
        return random.choice(_ATOMS)
    first, second = (draw_formula(random, depth + 1) for _ in range(2))
    call, number = random.choice(_CALLS), random.choice([1, 2, 3, 9, 60, 10**9, -1, 0.5])
    shapes = [f"{first} {random.choice(_SIGNS)} {second}"] * 6
    shapes += [f"({first})", f"{call}({first})", f"{call}({first}, {number})", f"{first}**{number}"]
    shapes += [
        f"{call}({first}, df={number})",
        f"C({first}, contr.sum)",
        f"-{first}",
        f"{first}[AD]",
    ]
    return random.choice(shapes)


def damage_formula(content: bytes, random: Random) -> bytes:
    """Return a formula of the grammar or near it."""
    text = draw_formula(random).encode() if random.randrange(4) else content
    return damage_text(text, random) if random.randrange(4) == 0 else text


class Kind(NamedTuple):
    """One kind of input: the file, or the option, that is damaged, and how it is run."""

    source: str
    change: Callable[[bytes, Random], bytes]
    arguments: str
    content: str = ""
    """What the file holds, or the option, if nothing wrote it."""


_FAST = "group --no-reports --no-classification"
_FREE = f"study/bids OUT {_FAST} --align none -d study/out"
_STUDY = f"{_FREE} --measures thickness volume"
_MAPS = (
    f"study/bids OUT {_FAST} --align none --measures own --maps-surface maps/{{hemi}}.surf.gii"
    " --maps own=maps/sub-{subject}"
)
_LABELS = f"OUT participant --no-reports --mem {MEM} --n-procs 1 --settings coarse.toml"
_SHEET = "study/out/sub-01/anat/sub-01_hemi-L_seg-demo_desc-"
_MGZ = "mgz/derivatives/freesurfer/sub-01/mri/lh.hippoAmygLabels-T1.v22.mgz"
_NIFTI = "nii/derivatives/ashs/sub-01/final/sub-01_left_lfseg_corr_usegray.nii.gz"
KINDS = {
    "mgz": Kind(_MGZ, damage_image, f"mgz {_LABELS}"),
    "nifti": Kind(_NIFTI, damage_image, f"nii {_LABELS}"),
    "participants": Kind("study/bids/participants.tsv", damage_text, _STUDY),
    "sidecar": Kind(
        "study/bids/participants.json",
        damage_json,
        _STUDY,
        '{"group": {"Levels": {"CN": "healthy", "AD": {"Description": "ill"}}}, "age": {}}',
    ),
    "sheet": Kind(f"{_SHEET}sheet_morph.tsv", damage_text, _STUDY),
    "record": Kind(f"{_SHEET}qc_metrics.json", damage_json, _STUDY),
    "ratings": Kind(
        "ratings.tsv",
        damage_text,
        f"{_STUDY} --ratings ratings.tsv",
        "participant_id\tsession_id\themi\tprotocol\tregion\trating\tnote\tinput_hash\n"
        "sub-01\tn/a\tL\tdemo\tbody\texclude\tbad\tn/a\nsub-02\tn/a\tR\tdemo\tbody\tuse\tn/a\tn/a\n",
    ),
    "exclude": Kind(
        "exclude.tsv",
        damage_text,
        f"{_STUDY} --exclude exclude.tsv",
        "participant_id\themi\tprotocol\tregion\treason\nsub-01\tL\tdemo\tbody\tblur\n",
    ),
    "formula": Kind("--formula", damage_formula, _FREE, "thickness ~ group * age + sex"),
    "contrast": Kind("--contrast", damage_formula, _STUDY, "group[CN]-0.5*group[AD], age"),
    "model": Kind("model.json", damage_json, f"{_STUDY} --model model.json"),
    "norms": Kind(
        "norms.json", damage_norms, "new/bids OUT group --no-reports -d new/out --norms norms.json"
    ),
    "summary": Kind("b.json", damage_json, "meta a.json b.json OUT"),
    "template": Kind(
        "template.json",
        damage_json,
        f"study/bids OUT {_FAST} --measures thickness -d study/out --template template.json",
    ),
    "gifti": Kind("study/bids/maps/sub-01_L.shape.gii", damage_text, f"{_MAPS}_{{hemi}}.shape.gii"),
    "surface": Kind("study/bids/maps/L.surf.gii", damage_text, f"{_MAPS}_{{hemi}}.shape.gii"),
    "cifti": Kind("study/bids/maps/sub-01.dscalar.nii", damage_cifti, f"{_MAPS}.dscalar.nii"),
}


def call(arguments: str, *more: str) -> list[str]:
    """Return the arguments of a command whose output goes to a new folder."""
    shutil.rmtree("out", ignore_errors=True)
    return [("out" if word == "OUT" else word) for word in (*arguments.split(), *more)]


def run_here(*arguments: str) -> None:
    """Run the command line in this process, which loads libraries; it has to succeed."""
    with contextlib.redirect_stdout(io.StringIO()):
        code = command.main(arguments)
    if code:
        sys.exit(f"FAILED: {arguments} returned {code}")


def leave_out_figures() -> None:
    """Draw no figures and start no workers, which take longer than all else."""
    for module, name, function in (
        ("group.output.write", "draw_figures", lambda *_: iter(())),
        ("group.output.write", "write_figures", lambda *_, **__: []),
        ("extensions.norms.norming", "_figures", lambda *_: iter(())),
        ("participant.run", "run_jobs", lambda plan, jobs: ((j, plan.work(j)) for j in jobs)),
    ):
        setattr(import_module(f"hipsta_bids.{module}"), name, function)


def write_maps() -> None:
    """Write maps of sixteen participants and the surfaces that they lie on."""
    Path("study/bids/maps").mkdir()
    random = np.random.default_rng(0)
    plane = np.column_stack([*np.divmod(np.arange(147), 7), np.zeros(147)]) * [2.0, 3.0, 1.0]
    for hemi in "LR":
        triangles = gifti.sheet_triangles(21, 7)
        content = gifti.surface_bytes(plane, triangles, hemi=hemi, secondary=None, unfolded=True)
        Path(f"study/bids/maps/{hemi}.surf.gii").write_bytes(content)
    for number in range(1, 17):
        values = {hemi: 2 + 0.1 * random.standard_normal(147) for hemi in "LR"}
        stem = f"study/bids/maps/sub-{number:02d}"
        for hemi, wall in values.items():
            content = gifti.shape_bytes(wall, hemi=hemi, name="own", unit="mm")
            Path(f"{stem}_{hemi}.shape.gii").write_bytes(content)
        rows = {hemi: wall[None] for hemi, wall in values.items()}
        Path(f"{stem}.dscalar.nii").write_bytes(gifti.cifti_bytes(rows, ["own"]))


def write_inputs() -> None:
    """Write valid inputs of all kinds into the working folder."""
    leave_out_figures()
    cohorts, norm_cohorts = import_module("small_cohorts"), import_module("norm_cohorts")
    spec = PhantomSpec(kind="arc", thickness=2.0, length=8.0)
    left = [Hemisphere(subject="01", hemi="L", spec=spec)]
    for folder, layout in (("mgz", "freesurfer"), ("nii", "ashs")):
        write_phantoms(Path(folder), left, layouts=(layout,), voxel_size=(0.5, 0.5, 0.5))
    Path("coarse.toml").write_text("[grid]\nspacing = 0.5\n", encoding="utf-8")
    Path("norms.toml").write_text("[norms]\nleast_participants = 50\n", encoding="utf-8")
    for study, size in (("study", 8), ("other", 9)):
        cohorts.write_dataset(Path(study), plan=replace(cohorts.PLAN, sizes=(size, size)))
    norm_cohorts.write_people(Path("old"), {"A": 70}, 1)
    norm_cohorts.write_people(Path("new"), {"A": 8}, 2)
    write_maps()
    norms = "--fit-norms --measures thickness volume --settings norms.toml --no-reports"
    run_here(*call(f"old/bids old/out group {norms}"))
    shutil.copy("old/out/group/norms/norms.json", "norms.json")
    model = "--measures thickness --formula group+age --name x --export-summary"
    for site, study, more in (("a", "study", ""), ("b", "other", "--template template.json")):
        run_here(*call(f"{study}/bids OUT {_FAST} -d {study}/out {model} {site} {more}"))
        shutil.copy("out/group/x/summary.json", f"{site}.json")
        for name in ("template.json", "model.json"):
            shutil.copy(f"out/group/x/{name}", name)
    for kind in KINDS.values():
        if kind.content and not kind.source.startswith("--"):
            Path(kind.source).write_text(kind.content, encoding="utf-8")
