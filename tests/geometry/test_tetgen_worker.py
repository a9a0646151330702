"""The process that makes tetrahedra may die or hang; the caller may not."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from hipsta_bids.errors import GeometryError
from hipsta_bids.geometry import mesh
from hipsta_bids.geometry.mesh import tetra_volumes, tetrahedralize
from hipsta_bids.geometry.tetgen_worker import TetgenClient
from hipsta_bids.settings import TetraSettings
from hipsta_bids.types import Surface

SETTINGS = TetraSettings()
OPTIONS = {"plc": True, "quality": True, "minratio": 2.0, "nobisect": True, "quiet": True}

CORNERS = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
SQUARES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE = np.array([t for a, b, c, d in SQUARES for t in ((a, b, c), (a, c, d))], dtype=np.int32)


def cube(shift=(0.0, 0.0, 0.0)):
    return as_surface(CORNERS + shift, CUBE)


def as_surface(vertices, triangles):
    none = np.zeros(len(vertices), dtype=bool)
    return Surface(vertices=vertices, triangles=triangles, posterior_cap=none, anterior_cap=none)


def crossing_cubes():
    """Two cubes that run into each other."""
    return as_surface(
        np.vstack([CORNERS, 0.9 * CORNERS + [0.5, 0.21, 0.33]]), np.vstack([CUBE, CUBE + 8])
    )


@pytest.fixture
def client(monkeypatch):
    """A client of its own, so that killing its process disturbs no other test."""
    fresh = TetgenClient()
    monkeypatch.setattr(mesh, "_CLIENT", fresh)
    yield fresh
    fresh._stop()


@pytest.mark.usefixtures("client")
def test_a_self_intersecting_surface_is_an_error_and_the_next_call_works():
    with pytest.raises(GeometryError, match=r"the surface intersects itself.*RAS") as caught:
        tetrahedralize(crossing_cubes(), SETTINGS)
    assert caught.value.reason == "tetrahedralization"
    assert_works()


@pytest.mark.slow
@pytest.mark.usefixtures("client")
@pytest.mark.parametrize("what", ["nan", "index", "open"])
def test_garbage_is_an_error_and_the_next_call_works(what):
    vertices, triangles = CORNERS.copy(), CUBE.copy()
    if what == "nan":
        vertices[3] = np.nan
    elif what == "index":
        triangles[0, 0] = 10_000
    else:
        triangles = triangles[:1]
    patience = TetraSettings(timeout=1.0 if what == "nan" else 10.0)  # TetGen never ends on NaN
    with pytest.raises(GeometryError, match="TetGen") as caught:
        tetrahedralize(as_surface(vertices, triangles), patience)
    assert caught.value.reason == "tetrahedralization"
    assert_works()


@pytest.mark.usefixtures("client")
def test_tetgen_leaves_no_files_behind(tmp_path, monkeypatch):
    """It writes what it could not use into the working folder."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(GeometryError, match="intersect"):
        tetrahedralize(crossing_cubes(), SETTINGS)
    assert not list(tmp_path.iterdir())


def assert_works():
    mesh = tetrahedralize(cube(), SETTINGS)
    assert tetra_volumes(mesh.vertices, mesh.tetrahedra).sum() == pytest.approx(1.0)


@pytest.mark.slow
def test_a_process_killed_at_work_is_replaced_and_gives_the_same_mesh(client, arc):
    """Nothing is changed about the surface for a lack of memory, say."""
    expected = client.mesh(arc.surface.vertices, arc.surface.triangles, OPTIONS, 60.0)
    first = client._process.pid
    os.kill(first, signal.SIGSTOP)
    timer = threading.Timer(0.2, os.kill, (first, signal.SIGKILL))
    timer.start()
    answer = client.mesh(arc.surface.vertices, arc.surface.triangles, OPTIONS, 60.0)
    timer.join()
    assert client._process.pid != first
    for one, other in zip(answer, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def start_python(code):
    return subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


@pytest.mark.usefixtures("client")
def test_a_surface_that_ends_every_process_is_reported_and_the_next_call_works(arc):
    started = []

    class Ending(TetgenClient):
        def _running(self):
            started.append(1)
            code = "import sys; sys.stdin.buffer.read(8); sys.exit(3)"
            self._process, self._owner = start_python(code), os.getpid()
            return self._process

    answer = Ending().mesh(arc.surface.vertices, arc.surface.triangles, OPTIONS, 60.0)
    assert answer.startswith("TetGen crashed (exit status ")
    assert len(started) == 2
    assert_works()


def test_a_process_that_died_between_calls_is_replaced(client):
    assert_works()
    client._process.kill()
    client._process.wait()
    assert_works()


@pytest.mark.slow
def test_taking_too_long_is_reported_and_the_next_call_works(client, arc):
    busy = {"maxvolume": 1e-6, "fixedvolume": True, "nobisect": False}
    assert_works()
    process = client._process
    start = time.monotonic()
    answer = client.mesh(arc.surface.vertices, arc.surface.triangles, OPTIONS | busy, 0.3)
    assert answer == "TetGen took longer than 0.3 s"
    assert time.monotonic() - start < 5.0  # the time-out and the end of a process
    assert process.poll() is not None  # it does not go on working unseen
    assert_works()


@pytest.mark.usefixtures("client")
def test_a_time_out_is_a_geometry_error(arc):
    with pytest.raises(GeometryError, match=r"TetGen took longer than 0\.001 s") as caught:
        tetrahedralize(arc.surface, TetraSettings(timeout=1e-3))
    assert caught.value.reason == "tetrahedralization"


def test_one_process_serves_many_calls(client):
    assert_works()
    first = client._process.pid
    assert_works()
    assert client._process.pid == first


def test_moved_vertices_are_refused(client, monkeypatch):
    mesh = tetrahedralize(cube(), SETTINGS)
    moved = mesh.vertices.copy()
    moved[0] += 1e-3
    monkeypatch.setattr(client, "mesh", lambda *_: (moved, mesh.tetrahedra))
    with pytest.raises(GeometryError, match="TetGen moved vertices"):
        tetrahedralize(cube(), SETTINGS)


def test_inverted_and_flat_tetrahedra_are_put_right(client, monkeypatch):
    mesh = tetrahedralize(cube(), SETTINGS)
    cells = mesh.tetrahedra[:, [1, 0, 2, 3]]
    flat = np.array([[0, 1, 2, 3]])  # four corners of one side
    monkeypatch.setattr(client, "mesh", lambda *_: (mesh.vertices, np.vstack([cells, flat])))
    again = tetrahedralize(cube(), SETTINGS)
    volumes = tetra_volumes(again.vertices, again.tetrahedra)
    assert len(volumes) == len(mesh.tetrahedra)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(1.0)
