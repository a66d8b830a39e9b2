"""`transfer_volume` moves tetrahedra with the surface, and counts those that it inverts."""

import sys
from dataclasses import replace

import meshio
import numpy as np
import pytest
from command_line import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st
from igl.copyleft.tetgen import tetrahedralize
from synthetic import bumpy_mesh

from jaxsmw import Mesh, creature_pair, read_mesh, write_mesh
from jaxsmw.errors import InputError
from jaxsmw.geometry.surface_distance import distances_to_surface
from jaxsmw.io import Volume, read_volume, write_volume
from jaxsmw.io.volumes import signed_volumes
from jaxsmw.transfer import RegisteredMesh, transfer_volume
from jaxsmw.transfer.neighborhoods import Similarities

MESH = bumpy_mesh(2)
SUFFIXES = ".vtu", ".vtk", ".msh", ".mesh", ".inp"


def volume_inside(mesh: Mesh, flags: str = "pq1.3a0.02YQ") -> Volume:
    vertices, tets, *_ = tetrahedralize(mesh.vertices, mesh.faces.astype(np.int64), flags=flags)
    volume = Volume(vertices, tets.astype(np.int64), "body")
    assert len(vertices) > len(mesh.vertices)
    is_negative = bool(signed_volumes(vertices, volume.tets)[0] < 0)
    return volume.at(vertices, "body", mirrored=is_negative)


VOLUME = volume_inside(MESH)


def registered_at(
    vertices: np.ndarray, mesh: Mesh = MESH, rotation: np.ndarray | None = None
) -> RegisteredMesh:
    """The mesh on itself at other positions, each neighbourhood with the given rotation."""
    rotation = np.eye(3) if rotation is None else rotation
    rotations = np.broadcast_to(rotation, (len(vertices), 3, 3)).copy()
    faces = mesh.faces if np.linalg.det(rotation) > 0 else mesh.faces[:, ::-1].copy()
    return RegisteredMesh(
        mesh, Mesh(vertices, faces, "target"), vertices, Similarities(rotations, np.ones(len(vertices)))
    )


def counted(vertices: np.ndarray, tets: np.ndarray) -> int:
    """The number of tetrahedra whose volume is not positive, one by one."""
    return sum(
        np.dot(np.cross(b - a, c - a), d - a) <= 0 for a, b, c, d in (vertices[corners] for corners in tets)
    )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_an_affine_deformation_of_the_surface_is_exact_inside(seed, mirrored):
    generator = np.random.default_rng(seed)
    left, _, right = np.linalg.svd(generator.normal(size=(3, 3)))
    hand = np.sign(np.linalg.det(left @ right))
    turn = left @ np.diag([1, 1, hand * (-1 if mirrored else 1)]) @ right
    matrix = turn @ np.diag(generator.uniform(0.5, 2, 3))
    shift = generator.normal(size=3) * 100
    moved = transfer_volume(VOLUME, registered_at(MESH.vertices @ matrix.T + shift, rotation=turn))
    np.testing.assert_allclose(moved.volume.vertices, VOLUME.vertices @ matrix.T + shift, atol=1e-8)
    assert (signed_volumes(moved.volume.vertices, moved.volume.tets) > 0).all()
    np.testing.assert_array_equal(np.sort(moved.volume.tets), np.sort(VOLUME.tets))
    assert not moved.inverted.any() and "0 of" in moved.sentences()[0]


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_identity_changes_nothing_for_either_orientation(mirrored):
    volume = VOLUME.at(VOLUME.vertices, "body", mirrored=mirrored)
    moved = transfer_volume(volume, registered_at(MESH.vertices))
    np.testing.assert_allclose(moved.volume.vertices, volume.vertices, atol=1e-9)
    np.testing.assert_array_equal(moved.volume.tets, volume.tets)
    assert not moved.inverted.any()
    assert set(np.flatnonzero(moved.on_surface)) == set(range(len(MESH.vertices)))


def twisted(vertices: np.ndarray, rate: float) -> np.ndarray:
    x, y, z = vertices.T
    cosine, sine = np.cos(rate * z), np.sin(rate * z)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def test_inverted_tetrahedra_are_mended_or_counted(monkeypatch):
    """A twist folds the harmonic volume; the lifted content unfolds it, where the boundary permits."""
    registered = registered_at(twisted(MESH.vertices, 3.0))
    moved = transfer_volume(VOLUME, registered)
    with monkeypatch.context() as patched:
        patched.setattr("jaxsmw.transfer.volumes._STEPS", 0)
        harmonic = transfer_volume(VOLUME, registered)
    for one in (moved, harmonic):
        assert counted(one.volume.vertices, one.volume.tets) == one.inverted.sum()
        assert f"{one.inverted.sum()} of {len(VOLUME.tets)} tetrahedra are inverted" in one.sentences()[0]
        assert distances_to_surface(one.volume.vertices[one.on_surface], registered.mesh_y).max() < 1e-9
    assert moved.inverted.sum() < harmonic.inverted.sum()


def test_vertices_off_the_surface_and_cavities_follow(monkeypatch):
    """A vertex of no tetrahedron moves with the surface, and the boundary of a cavity with the volume."""
    centers = VOLUME.vertices[VOLUME.tets].mean(axis=1)
    hollow = VOLUME.tets[np.linalg.norm(centers, axis=1) > 0.4]
    vertices = np.concatenate([VOLUME.vertices, [[0.0, 0, 1.5]]])
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = transfer_volume(
        Volume(vertices, hollow), registered_at(MESH.vertices @ turn.T + [0, 0, 5.0], rotation=turn)
    )
    used = np.append(np.unique(hollow), len(vertices) - 1)
    np.testing.assert_allclose(moved.volume.vertices[used], vertices[used] @ turn.T + [0, 0, 5.0], atol=1e-8)
    assert not moved.on_surface[-1] and not moved.inverted.any()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_keep_the_volume(tmp_path, suffix):
    path = tmp_path / f"body{suffix}"
    assert write_volume(path, VOLUME) == ()
    again = read_volume(path)
    np.testing.assert_allclose(again.vertices, VOLUME.vertices, atol=1e-11)
    np.testing.assert_array_equal(again.tets, VOLUME.tets)
    assert again.name == str(path) and len(list(tmp_path.iterdir())) == 1


def test_other_cells_and_data_are_kept(tmp_path):
    triangles, tets = MESH.faces, VOLUME.tets
    contents = meshio.Mesh(
        VOLUME.vertices,
        [("triangle", triangles), ("tetra", tets[:9]), ("tetra", tets[9:])],
        point_data={"heat": VOLUME.vertices[:, 0]},
        cell_data={"material": [np.arange(len(triangles)), np.arange(9), np.arange(9, len(tets))]},
    )
    meshio.write(tmp_path / "body.vtu", contents)
    mirror = np.diag([-1.0, 1, 1])
    moved = transfer_volume(
        read_volume(tmp_path / "body.vtu"), registered_at(MESH.vertices @ mirror, rotation=mirror)
    )
    write_volume(tmp_path / "moved.vtu", moved.volume)
    found = meshio.read(tmp_path / "moved.vtu")
    np.testing.assert_allclose(found.points, VOLUME.vertices @ mirror, atol=1e-9)
    np.testing.assert_array_equal(found.cells_dict["tetra"], moved.volume.tets)
    np.testing.assert_array_equal(found.cells_dict["triangle"], triangles[:, [0, 2, 1]])
    np.testing.assert_array_equal(found.point_data["heat"], VOLUME.vertices[:, 0])
    np.testing.assert_array_equal(found.cell_data_dict["material"]["tetra"], np.arange(len(tets)))


def changed(**changes: np.ndarray) -> Volume:
    return replace(VOLUME, **changes)


def nan_at(row: int) -> np.ndarray:
    vertices = VOLUME.vertices.copy()
    vertices[row] = np.nan
    return vertices


@pytest.mark.parametrize(
    ("volume", "fault"),
    [
        (changed(tets=np.empty((0, 4), np.int64)), "contains no tetrahedra"),
        (changed(tets=VOLUME.tets + 1), "seem to count from 1"),
        (changed(tets=VOLUME.tets - 1), "must lie between 0"),
        (changed(vertices=nan_at(7)), "position of vertex 7 is not finite"),
        (changed(tets=np.concatenate([VOLUME.tets, VOLUME.tets[:1, [0, 1, 2, 2]]])), "1 of .* have no volume"),
        (changed(tets=np.concatenate([VOLUME.tets, VOLUME.tets[:1, [0, 1, 3, 2]]])), "negative volume"),
        (changed(vertices=1000 * VOLUME.vertices), "in its unit and coordinates"),
        (changed(vertices=VOLUME.vertices + 100), "in its unit and coordinates"),
    ],
)  # fmt: skip
def test_unusable_volumes_are_refused(volume, fault):
    with pytest.raises(InputError, match=f"body.*{fault}"):
        transfer_volume(volume, registered_at(MESH.vertices))


def test_unusable_files_are_refused(tmp_path, monkeypatch):
    quadratic = [("tetra10", np.arange(10)[None])]
    for cells, fault in (
        ([("triangle", MESH.faces)], "types triangle: give a volume of tetrahedra"),
        (quadratic, "types tetra10: give a volume of tetrahedra with four corners"),
    ):
        meshio.write(tmp_path / "bad.vtu", meshio.Mesh(VOLUME.vertices, cells))
        with pytest.raises(InputError, match=fault):
            read_volume(tmp_path / "bad.vtu")
    write_volume(tmp_path / "body.vtu", VOLUME)
    whole = (tmp_path / "body.vtu").read_bytes()
    for suffix in SUFFIXES:
        for content in (b"", whole[: len(whole) // 2], b"\xff" * 100):
            (tmp_path / f"damaged{suffix}").write_bytes(content)
            with pytest.raises(
                InputError, match=r"damaged\..*: (is damaged|contains cells of the types none)"
            ):
                read_volume(tmp_path / f"damaged{suffix}")
    with pytest.raises(InputError, match=r"body\.stl: volumes are written as .*\.vtu"):
        write_volume(tmp_path / "body.stl", VOLUME)
    with pytest.raises(InputError, match=r"missing\.vtu: does not exist"):
        read_volume(tmp_path / "missing.vtu")
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(InputError, match=r"pip install 'jaxsmw\[volumes\]'"):
        read_volume(tmp_path / "body.vtu")


def test_the_command_writes_the_volume_inside_the_target(run, tmp_path):
    pair = creature_pair("quadruped", vertices=700)
    write_mesh(tmp_path / "x.ply", pair.source)
    write_mesh(tmp_path / "y.ply", pair.target)
    np.savetxt(tmp_path / "map.txt", pair.true_map, fmt="%d")
    volume = volume_inside(pair.source, "pq1.4YQ")
    write_volume(tmp_path / "x.vtu", volume)
    call = "transfer", tmp_path / "x.ply", tmp_path / "y.ply", "--map", tmp_path / "map.txt"
    outcome = run(
        *call, "--volume", tmp_path / "x.vtu", "--volume-output", tmp_path / "y.msh",
        "--registered", tmp_path / "r.ply",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    moved = read_back(tmp_path / "y.msh")
    inverted = counted(*moved)
    assert f"{inverted} of {len(volume.tets)} tetrahedra are inverted" in outcome.output
    assert inverted < 0.01 * len(volume.tets)
    surface = moved[0][: len(pair.source.vertices)]
    np.testing.assert_allclose(surface, read_mesh(tmp_path / "r.ply").vertices, atol=1e-5)
    assert distances_to_surface(surface, pair.target).mean() < 1e-3 * np.sqrt(pair.target.area)
    for options, fault in (
        (["--volume", "x.vtu", "--registered", "s.ply"], "--volume: has no effect without --volume-output"),
        (["--volume-output", "y.vtu"], "--volume-output: has no effect without --volume"),
        (["--volume", "x.vtu", "--volume-output", "x.vtu"], "would be overwritten"),
        (["--volume", "x.vtu", "--volume-output", "y.off"], "volumes are written as"),
        (["--volume", "z.vtu", "--volume-output", "y.vtu"], "does not exist"),
    ):
        places = [name if name.startswith("--") else tmp_path / name for name in options]
        assert_refused(run(*call, *places, "--quiet"), naming=fault)


def read_back(path) -> tuple[np.ndarray, np.ndarray]:
    contents = meshio.read(path, file_format="gmsh")
    return contents.points, contents.cells_dict["tetra"]
