"""Bodies stand upright in pictures, whatever the up axis of their file is."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_helpers import TALL, ellipsoid, renumbered
from sampled_cases import first_always
from synthetic import grid_mesh

from jaxsmw.creature import creature_pair
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.meshes import read_mesh
from jaxsmw.report.rendering import camera_axes, choose_azimuth
from jaxsmw.report.standing import facing, guess_up, placement, stand, stand_pair


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_stand_turns_the_named_axis_up(up: Any) -> None:
    direction = {"x": 0, "y": 1, "z": 2}[up[-1]]
    marked = replace(TALL, vertices=np.concatenate([TALL.vertices, np.zeros((3, 3)), np.eye(3)]))
    standing = stand(marked, up)
    frame = (standing.vertices[-3:] - standing.vertices[-6:-3]) * np.sqrt(TALL.area)
    assert np.allclose(frame[direction], [0, -1 if up[0] == "-" else 1, 0])
    assert np.linalg.det(frame) == pytest.approx(1)
    assert standing.area == pytest.approx(1)
    used = standing.vertices[: len(TALL.vertices)]
    assert np.allclose(used.min(axis=0), -used.max(axis=0))


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_placement_takes_a_standing_mesh_back_to_its_file(up: Any) -> None:
    # Vertex 0 has no face, and the body is far from the origin.
    stray = np.concatenate([[[900.0, 1, 2]], TALL.vertices * [1, 1.3, 0.7]])
    body = replace(TALL, vertices=40 * stray + [1e4, -300, 5], faces=TALL.faces + 1)
    for standing in (stand(body, up), stand_pair(body, replace(body, vertices=0.5 * body.vertices), up)[0]):
        matrix, offset = placement(body, standing)
        assert np.allclose(standing.vertices @ matrix + offset, body.vertices, rtol=0, atol=1e-9)
        assert np.linalg.det(matrix) > 0
    # A flat mesh determines the rotation as well.
    vertices, faces = grid_mesh(5, 4)
    flat = Mesh(np.asarray(vertices, dtype=float), faces.astype(np.int64))
    standing = stand(flat, up)
    matrix, offset = placement(flat, standing)
    assert np.allclose(standing.vertices @ matrix + offset, flat.vertices, rtol=0, atol=1e-12)


# The rotations convert y-up coordinates (x across the body, y up, z forward) to each convention.
FROM_Y_UP = {
    "y": np.eye(3),
    "z": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.diag([-1, -1, 1]),
}


def in_convention(mesh: Mesh, up: str) -> Mesh:
    """Convert a body from y-up coordinates to the coordinates of another convention."""
    return replace(mesh, vertices=mesh.vertices @ FROM_Y_UP[up].T)


@pytest.mark.slow
@pytest.mark.parametrize("kind", first_always(["biped", "quadruped"]))
def test_up_is_guessed_in_every_convention(kind: str) -> None:
    pair = creature_pair(kind, vertices=1500)
    for up in ("y", "z", "-y"):
        for mesh in (pair.source, pair.target):
            assert guess_up(in_convention(mesh, up)) == up


def test_up_does_not_depend_on_vertex_numbers_units_or_unreferenced_vertices() -> None:
    body = in_convention(creature_pair("quadruped", vertices=800).source, "-y")
    stray = np.concatenate([body.vertices, [[50.0, -9, 7]]])
    for same in (
        renumbered(body)[0],
        replace(body, vertices=1e4 * body.vertices + [1e5, 0, -3e5]),
        replace(body, vertices=stray),
    ):
        assert guess_up(same) == "-y"


def test_up_is_guessed_for_bodies_without_limbs() -> None:
    vertices, faces = grid_mesh(9, 9)
    assert guess_up(Mesh(vertices, faces)) == "y"
    assert guess_up(Mesh(vertices[:, [0, 2, 1]], faces)) == "z"
    assert guess_up(Mesh(np.eye(3), np.array([[0, 1, 2]]))) == "z"
    # If a body without limbs is slender along y, it is treated as a standing person. Otherwise z is up.
    person, animal = np.array([0.4, 1, 0.3]), np.array([0.3, 0.6, 1])
    assert guess_up(ellipsoid(*person)) == "y" and guess_up(ellipsoid(*person[[0, 2, 1]])) == "z"
    assert guess_up(ellipsoid(*animal[[0, 2, 1]])) == "z"


@pytest.mark.parametrize(
    ("name", "up"),
    [
        *((f"faust_r/off/tr_reg_{number}.off", "y") for number in ("002", "057", "069")),  # 057 stands on one leg
        *((f"tosca_r/off/{name}.off", "z") for name in ("cat0", "cat6", "dog2", "centaur3", "michael8", "horse5")),
        *((f"smal_r/off/{name}.off", "-y") for name in ("cow_alph", "fox-05", "hippo5", "lion6", "cougar")),
        ("shrec19_r/off/10.off", "y"),
        ("shrec19_r/off/16.off", "z"),
        ("tosca_nonisometric/off/8_woman_02.off", "z"),
    ],
)  # fmt: skip
def test_real_bodies_stand_upright(shared: Path, name: str, up: str) -> None:
    assert guess_up(read_mesh(shared / "data" / name)) == up


@pytest.mark.sampled
@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_real_animals_stand_upright_in_every_convention(shared: Path, up: str) -> None:
    for name in ("cat0", "dog0", "wolf0", "horse0", "horse6"):
        mesh = read_mesh(shared / f"data/tosca_r/off/{name}.off")
        y_up = replace(mesh, vertices=mesh.vertices @ FROM_Y_UP["z"])
        assert guess_up(in_convention(y_up, up)) == up


def test_stand_orients_faces_outward() -> None:
    mixed = TALL.faces.copy()
    mixed[::3] = mixed[::3, ::-1]
    for faces in (TALL.faces, TALL.faces[:, ::-1], mixed):
        standing = stand(replace(TALL, faces=faces))
        outwards = np.einsum("ij,ij->i", standing.vertex_normals, standing.vertices)
        assert np.all(outwards > 0)
        assert np.array_equal(np.sort(standing.faces), np.sort(faces))


def shell(cut: float) -> Mesh:
    """Return the part of a sphere of radius 1 with z above the cut."""
    whole = ellipsoid(1, 1, 1)
    return replace(whole, faces=whole.faces[whole.vertices[whole.faces, 2].min(axis=1) > cut])


def seen_outside(mesh: Mesh, up: Any = None) -> float:
    """Return the projected area of the outside minus that of the inside, seen by the camera."""
    standing = stand(mesh, up)
    return float(facing(standing) @ camera_axes(choose_azimuth([standing]))[2])


@pytest.mark.parametrize("cut", [-0.3, 0.1, 0.6])
def test_the_camera_sees_the_outside_of_open_surfaces(cut: float) -> None:
    cap = shell(cut)
    assert np.linalg.norm(facing(stand(cap))) == pytest.approx((1 + cut) / 2, abs=0.1)
    for degrees in (0, 40, 90, 135, 180, 260):
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        turned = replace(cap, vertices=cap.vertices @ turn.T)
        for file in (turned, replace(turned, faces=turned.faces[:, ::-1]), renumbered(turned)[0]):
            assert seen_outside(file, "y") > 0.4 * np.linalg.norm(facing(stand(cap)))
    # Shells that lie on their rim or hang from it are shown from outside, too.
    for axes in ([0, 1, 2], [0, 2, 1], [2, 0, 1]):
        for sign in (1, -1):
            assert seen_outside(replace(cap, vertices=sign * cap.vertices[:, axes])) > 0


def test_the_camera_stays_in_front_of_closed_bodies_with_holes() -> None:
    punctured = replace(TALL, faces=TALL.faces[8:])
    for mesh in (TALL, punctured):
        assert choose_azimuth([stand(mesh, "y")]) == pytest.approx(
            choose_azimuth([stand(TALL, "y")]), abs=0.1
        )


def test_a_mask_and_a_head_with_an_open_neck_look_at_the_camera(shared: Path) -> None:
    mask, head = (read_mesh(shared / f"data/open_shells/{name}.off") for name in ("mask", "head"))
    assert guess_up(mask) == guess_up(head) == "y"
    azimuth = choose_azimuth([stand(mask), stand(head)])
    assert abs(np.degrees(azimuth)) < 45 and seen_outside(mask) > 0.5


@pytest.mark.usefixtures("unchecked")
def test_stand_refuses_meshes_without_area_and_unknown_axes() -> None:
    for flattened in ([0, 0, 0], [0, 1, 0]):
        for function in (stand, guess_up):
            with pytest.raises(InputError, match="nothing to draw"):
                function(replace(TALL, vertices=TALL.vertices * flattened))
    with pytest.raises(InputError, match="choose x, y, z"):
        stand(TALL, "w")  # type: ignore[arg-type]


def test_nearly_rigid_copies_are_turned_alike() -> None:
    numbers = np.arange(len(TALL.vertices))
    noise = 0.01 * np.random.default_rng(0).normal(size=TALL.vertices.shape)
    overturned = replace(TALL, vertices=(TALL.vertices + noise) @ np.diag([1.0, -1, -1]))
    alone = stand(overturned, "y")
    shown_x, shown_y = stand_pair(overturned, TALL, None, numbers)
    assert np.abs(shown_x.vertices - shown_y.vertices).max() < 0.1
    matrix, offset = placement(overturned, shown_x)
    assert np.allclose(shown_x.vertices @ matrix + offset, overturned.vertices)
    # An axis that the user gives holds for both meshes, and a map that scatters the vertices turns nothing.
    scattered = np.random.default_rng(0).permutation(numbers)
    assert np.array_equal(stand_pair(overturned, TALL, "y", numbers)[0].vertices, alone.vertices)
    assert np.array_equal(
        stand_pair(overturned, TALL, None, scattered)[0].vertices, stand(overturned).vertices
    )


def test_a_partial_shape_keeps_its_size_next_to_the_full_shape() -> None:
    part = replace(TALL, faces=TALL.faces[TALL.vertices[TALL.faces, 1].min(axis=1) > 0])
    assert part.area < 0.5 * TALL.area
    whole = stand(TALL)
    shown_part, shown_whole = stand_pair(part, TALL)
    assert shown_whole.area == pytest.approx(1) and shown_part.area == pytest.approx(part.area / TALL.area)
    assert np.array_equal(shown_whole.vertices, whole.vertices)
    assert stand_pair(TALL, part)[0].area == pytest.approx(TALL.area / part.area)
    # A copy that is 1.2 times as large is treated as a full shape. A copy that is 1000 times as large is
    # treated as a full shape in another unit. Both copies are scaled to area 1.
    for other in (1.2, 1000.0):
        assert stand_pair(replace(TALL, vertices=other * TALL.vertices), TALL)[0].area == pytest.approx(1)
