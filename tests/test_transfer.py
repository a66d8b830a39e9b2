"""Transfer moves positions, landmarks and data between meshes without flips, averaged labels or torn textures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh, grid_mesh, sphere_mesh

from jaxsmw import Mesh, creature_pair, make_mesh, read_ground_truth, read_mesh
from jaxsmw.errors import InputError
from jaxsmw.geometry import SurfacePoints
from jaxsmw.geometry.alignment import nearest_rotations
from jaxsmw.geometry.surface_distance import (
    distances_to_surface,
    nearest_facing_points,
    nearest_points_of_triangles,
    nearest_surface_points,
)
from jaxsmw.io import Landmarks, MeshData, Skeleton, Skin, Texture, read_mesh_data, write_mesh_data
from jaxsmw.transfer import (
    RegisteredMesh,
    register_mesh,
    registered_data,
    transfer_attributes,
    transfer_landmarks,
)
from jaxsmw.transfer.coverage import UncoveredVertices, at_slits
from jaxsmw.transfer.landmarks import landmark_vertices
from jaxsmw.transfer.neighborhoods import Neighborhoods, Similarities
from jaxsmw.transfer.registered_mesh import _follow

TURN = Rotation.from_euler("zyx", [40, -70, 110], degrees=True).as_matrix()
MIRROR = TURN @ np.diag([-1.0, 1, 1])
SHIFT = np.array([3.0, -20, 7])


def moved(mesh: Mesh, matrix: np.ndarray, shift: np.ndarray = SHIFT, *, turned_over: bool = False) -> Mesh:
    faces = mesh.faces[:, ::-1].copy() if turned_over else mesh.faces
    return Mesh(mesh.vertices @ matrix.T + shift, faces, "moved")


def at_vertices(mesh: Mesh, vertices: np.ndarray) -> SurfacePoints:
    """The points at vertices of a mesh."""
    corner = np.zeros(len(mesh.vertices), np.int64)
    corner[mesh.faces.ravel()] = np.arange(mesh.faces.size)
    faces, corners = np.divmod(corner[vertices], 3)
    return SurfacePoints(faces, np.eye(3)[corners])


def on_same_numbering(mesh_x: Mesh, mesh_y: Mesh) -> RegisteredMesh:
    return register_mesh(mesh_x, mesh_y, at_vertices(mesh_y, np.arange(len(mesh_y.vertices))))


def by_position(mesh_x: Mesh, mesh_y: Mesh) -> RegisteredMesh:
    """Register a mesh on a mesh with (almost) the same shape at the same place."""
    return register_mesh(mesh_x, mesh_y, nearest_surface_points(mesh_x.vertices, mesh_y)[0])


def spiked_sphere() -> Mesh:
    """A unit sphere with a round spike of height 0.4 at its north pole."""
    vertices, faces = sphere_mesh(4)
    distances = np.arccos(np.clip(vertices[:, 2], -1, 1))
    return make_mesh(vertices * (1 + 0.4 * np.exp(-((distances / 0.25) ** 2)))[:, None], faces)


def in_percent(offsets: np.ndarray, mesh: Mesh) -> np.ndarray:
    return 100 * np.linalg.norm(offsets, axis=1) / np.sqrt(mesh.area)


class TestRegisteredMesh:
    @pytest.mark.parametrize(
        ("matrix", "turned_over"),
        [(np.eye(3), False), (2.5 * TURN, False), (1000 * TURN, False), (MIRROR, False), (MIRROR, True)],
    )
    def test_similar_meshes_are_exact(self, matrix, turned_over):
        mesh_x = bumpy_mesh(3)
        mesh_y = moved(mesh_x, matrix, turned_over=turned_over)
        registered = on_same_numbering(mesh_x, mesh_y)
        assert in_percent(registered.vertices - mesh_y.vertices, mesh_y).max() < 1e-3
        assert not registered.flipped_faces.any()
        found = registered.similarities.scales[:, None, None] * registered.similarities.rotations
        assert np.abs(found - matrix).max() < 1e-3 * np.abs(matrix).max()
        assert np.abs(registered.area_ratios - 1).max() < 1e-3
        assert registered.angle_distortions.max() < 0.01
        assert "0 flipped triangles" in registered.sentences()[1]

    def test_noise_is_smoothed_without_flips(self):
        mesh_x = bumpy_mesh(4)
        mesh_y = moved(mesh_x, TURN)
        noise = np.random.default_rng(0).normal(size=mesh_x.vertices.shape) * 0.04  # about half an edge
        points, _ = nearest_surface_points(mesh_y.vertices + noise, mesh_y)
        before = in_percent(points.positions(mesh_y) - mesh_y.vertices, mesh_y)
        raw = Mesh(points.positions(mesh_y), mesh_x.faces)
        normals = [np.cross(*np.diff(m.vertices[m.faces], axis=1).swapaxes(0, 1)) for m in (raw, mesh_y)]
        assert ((normals[0] * normals[1]).sum(axis=1) < 0).sum() > 20
        registered, stiffer = (
            register_mesh(mesh_x, mesh_y, points, stiffness=stiffness) for stiffness in (0.01, 0.05)
        )
        assert registered.flipped_faces.sum() == stiffer.flipped_faces.sum() == 0
        after = [in_percent(r.vertices - mesh_y.vertices, mesh_y).mean() for r in (registered, stiffer)]
        assert after[1] < after[0] < 0.7 * before.mean()
        assert stiffer.angle_distortions.mean() < 0.7 * registered.angle_distortions.mean()

    @pytest.mark.parametrize(("level_x", "level_y"), [(3, 4), (4, 3)])
    def test_other_resolutions(self, level_x, level_y):
        mesh_x, mesh_y = bumpy_mesh(level_x), bumpy_mesh(level_y)
        registered = by_position(mesh_x, moved(mesh_y, np.eye(3), np.zeros(3)))
        assert np.quantile(100 * registered.distances / np.sqrt(mesh_y.area), 0.99) < 0.5
        assert not registered.flipped_faces.any()
        assert np.allclose(registered.surface_points.positions(mesh_y), registered.vertices, atol=0.05)

    def test_creatures_in_two_poses(self):
        pair = creature_pair(vertices=1500)
        registered = register_mesh(pair.source, pair.target, pair.truth)
        assert np.quantile(100 * registered.distances / np.sqrt(pair.target.area), 0.99) < 0.5
        assert registered.flipped_faces.mean() < 1e-3
        offsets = registered.vertices - pair.truth.positions(pair.target)
        assert np.quantile(in_percent(offsets, pair.target), 0.99) < 0.5
        back = registered.points_of_target.positions(registered.mesh)
        distances = np.linalg.norm(back - pair.target.vertices, axis=1)
        same = np.isclose(distances, registered.target_distances, rtol=0, atol=1e-12)
        assert same.mean() > 0.99  # nearest points on triangles that face away are replaced
        assert (distances > registered.target_distances)[~same].all()

    @pytest.mark.parametrize("matrix", [2.5 * TURN, MIRROR])
    def test_points_return_from_the_other_mesh(self, matrix):
        mesh_x = bumpy_mesh(3)
        registered = on_same_numbering(mesh_x, moved(mesh_x, matrix, turned_over=matrix is MIRROR))
        generator = np.random.default_rng(0)
        faces = generator.integers(len(mesh_x.faces), size=50)
        points = SurfacePoints(faces, generator.dirichlet([1, 1, 1], size=50))
        there = registered.project(points)
        expected = points.positions(mesh_x) @ matrix.T + SHIFT
        assert np.allclose(there.positions(registered.mesh_y), expected, atol=1e-4)
        back = registered.project_back(there)
        assert np.allclose(back.positions(mesh_x), points.positions(mesh_x), atol=1e-4)

    def test_points_stay_on_their_side_of_touching_layers(self):
        vertices, faces = grid_mesh(9, 9)
        n = len(vertices)
        gap = np.array([0, 0, 1e-3])
        layers = make_mesh(
            np.vstack([vertices + gap, vertices - gap]), np.vstack([faces, faces[:, ::-1] + n])
        )
        # At one edge, the layers cross each other, as the registered meshes of two touching thighs can.
        edge = layers.vertices[:, 0] < np.quantile(layers.vertices[:, 0], 0.15)
        crossed = np.where(edge[:, None], layers.vertices * [1, 1, -1], layers.vertices)
        one = Similarities(np.tile(np.eye(3), (2 * n, 1, 1)), np.ones(2 * n))
        registered = RegisteredMesh(layers, layers, crossed, one)
        points = SurfacePoints(np.arange(len(layers.faces)), np.full((len(layers.faces), 3), 1 / 3))
        for project in (registered.project, registered.project_back):
            same = project(points).positions(layers)[:, 2] == points.positions(layers)[:, 2]
            assert same.all()

    def test_units_and_places_do_not_matter(self):
        pair = creature_pair(vertices=700)
        usual = register_mesh(pair.source, pair.target, pair.truth)
        large = moved(pair.target, 1000 * np.eye(3), np.array([1e6, -1e6, 1e6]))
        for size in (1e-3, 1e3):
            other = register_mesh(moved(pair.source, size * np.eye(3), size * SHIFT * 100), large, pair.truth)
            offsets = (other.vertices - [1e6, -1e6, 1e6]) / 1000 - usual.vertices
            assert in_percent(offsets, pair.target).max() < 1e-3
            assert np.allclose(other.similarities.scales, usual.similarities.scales * 1000 / size, rtol=1e-4)
            assert np.allclose(other.similarities.rotations, usual.similarities.rotations, atol=1e-4)

    def test_a_small_partial_shape_keeps_its_size(self):
        mesh_y = bumpy_mesh(4)
        mesh_x = make_mesh(
            mesh_y.vertices, mesh_y.faces[(mesh_y.vertices[mesh_y.faces, 0] > 0.95).all(axis=1)]
        )
        points = nearest_surface_points(mesh_x.vertices, mesh_y)[0]
        used = mesh_x.referenced_vertices
        scales, offsets = [], []
        for scale in (1.0, None):
            registered = register_mesh(mesh_x, mesh_y, points, scale=scale)
            scales.append(np.abs(registered.similarities.scales[used] - 1).max())
            offsets.append(in_percent((registered.vertices - mesh_y.vertices)[used], mesh_y).max())
        assert scales[0] < 1e-4 and offsets[0] < 1e-3
        assert scales[1] > 0.1  # the size of the whole would be the size of the part

    def test_tips_are_reached_that_the_map_misses(self):
        mesh_y = spiked_sphere()
        height = mesh_y.vertices[:, 2]
        low = np.flatnonzero(height < 1.3)
        points = at_vertices(mesh_y, low[KDTree(mesh_y.vertices[low]).query(mesh_y.vertices)[1]])
        tip = height > 1.3
        mapped = replace(mesh_y, vertices=points.positions(mesh_y))
        before = distances_to_surface(mesh_y.vertices[tip], mapped)
        registered = register_mesh(mesh_y, mesh_y, points)
        assert registered.target_distances[tip].mean() < 0.7 * before.mean()
        assert not registered.flipped_faces.any()

    def test_a_part_is_not_drawn_to_what_it_lacks(self):
        mesh_y = spiked_sphere()
        below = (mesh_y.vertices[mesh_y.faces, 2] < 1.02).all(axis=1)
        mesh_x = make_mesh(mesh_y.vertices, mesh_y.faces[below])
        points = nearest_surface_points(mesh_x.vertices, mesh_y)[0]
        used = mesh_x.referenced_vertices
        for scale in (None, 1.0):
            registered = register_mesh(mesh_x, mesh_y, points, scale=scale)
            assert in_percent((registered.vertices - mesh_y.vertices)[used], mesh_y).max() < 1e-3

    def test_uncovered_vertices_draw_their_nearest_points(self):
        mesh_y = spiked_sphere()
        positions = np.minimum(mesh_y.vertices, [9, 9, 1.15])
        uncovered, strengths = UncoveredVertices(mesh_y, mesh_y), np.full(len(positions), 0.5)
        attraction = uncovered.attraction(positions, strengths)
        deformed = replace(mesh_y, vertices=positions)
        distances = distances_to_surface(mesh_y.vertices, deformed) / np.sqrt(mesh_y.area)
        expected = (distances > 0.005) & (distances < 0.03)
        assert 5 < expected.sum() == len(attraction.weights)
        np.testing.assert_array_equal(attraction.positions, mesh_y.vertices[expected])
        np.testing.assert_allclose(attraction.weights, 0.5 * mesh_y.vertex_areas[expected])
        nearest = attraction.interpolation @ positions
        np.testing.assert_allclose(
            np.linalg.norm(nearest - attraction.positions, axis=1) / np.sqrt(mesh_y.area), distances[expected]
        )
        # The quadratic form is the weighted sum of squared distances, up to a constant.
        moved_up = positions + np.array([0, 0, 0.1])
        energies = [
            0.5 * np.sum(p * (attraction.matrix() @ p)) - np.sum(p * attraction.right_side())
            for p in (positions, moved_up)
        ]
        squares = [
            0.5
            * attraction.weights
            @ ((attraction.interpolation @ p - attraction.positions) ** 2).sum(axis=1)
            for p in (positions, moved_up)
        ]
        assert energies[1] - energies[0] == pytest.approx(squares[1] - squares[0])
        assert uncovered.attraction(mesh_y.vertices, strengths) is None

    @pytest.mark.parametrize("flatness", [1, 1e-2, 1e-6, 0])
    def test_the_nearest_rotations_are_those_of_the_singular_value_decomposition(self, flatness):
        moments = np.random.default_rng(0).normal(size=(500, 3, 3)) * [1, 1, flatness]
        moments[0] = 0
        moments[1] = np.outer([1, 2, 3], [1, 0, 1])  # many rotations maximise the trace
        left, singular, right = np.linalg.svd(moments)
        signs = np.sign(np.linalg.det(left @ right))
        expected = (left * np.stack([np.ones(500), np.ones(500), signs], axis=1)[:, None]) @ right
        rotations, traces = nearest_rotations(moments)
        np.testing.assert_allclose(rotations[2:], expected[2:], atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-9)
        np.testing.assert_allclose(traces, singular[:, :2].sum(axis=1) + signs * singular[:, 2], atol=1e-12)
        np.testing.assert_allclose(np.einsum("nij,nij->n", rotations, moments), traces, atol=1e-9)

    def test_a_deformation_solves_its_linear_system(self):
        mesh, generator = bumpy_mesh(3), np.random.default_rng(0)
        targets = mesh.vertices + 0.05 * generator.normal(size=mesh.vertices.shape)
        weights = mesh.vertex_areas * np.where(mesh.vertices[:, 2] > 0.5, 1e-3, 1.0)
        around, stiffness = Neighborhoods(mesh), 0.1
        similarities = around.similarities(targets)
        found = _follow(around, similarities, weights, targets, stiffness, targets)
        # The same system, written with the edges.
        first, second = mesh.edges.T
        matrices = similarities.rotations * similarities.scales[:, None, None]
        turned = np.einsum("eij,ej->ei", 0.5 * (matrices[first] + matrices[second]), around.vectors)
        right = weights[:, None] * targets
        np.add.at(right, first, stiffness**2 * around.weights[:, None] * turned)
        np.subtract.at(right, second, stiffness**2 * around.weights[:, None] * turned)
        system = np.diag(weights)
        for i, j in ((first, first), (second, second)):
            np.add.at(system, (i, j), stiffness**2 * around.weights)
        for i, j in ((first, second), (second, first)):
            np.subtract.at(system, (i, j), stiffness**2 * around.weights)
        expected = np.linalg.solve(system, right)
        assert np.abs(found - expected).max() < 0.05 * stiffness < 0.1 * np.abs(targets - expected).max()
        # Few vertices move after the change of one target.
        targets[0] += 0.5
        again = _follow(around, similarities, weights, targets, stiffness, found)
        still = (again == found).all(axis=1)
        assert 0.5 < still.mean() < 1
        # Each deformation reaches further vertices.
        for _ in range(5):
            again = _follow(around, similarities, weights, targets, stiffness, again)
        right[0] += weights[0] * 0.5
        assert np.abs(again - np.linalg.solve(system, right)).max() < 0.05 * stiffness

    def test_a_flat_mesh_is_rotated_and_not_mirrored(self):
        mesh_x = make_mesh(*grid_mesh(9, 9))
        registered = on_same_numbering(mesh_x, moved(mesh_x, TURN))
        assert np.allclose(registered.similarities.rotations, TURN, atol=1e-4)
        assert not registered.flipped_faces.any()

    def test_degenerate_triangles(self):
        vertices, faces = sphere_mesh(2)
        a, b = faces[0, :2]
        vertices = np.vstack([vertices, (vertices[a] + vertices[b]) / 2, vertices[a]])
        n = len(vertices)
        mesh_x = make_mesh(vertices, np.vstack([faces, [a, n - 2, b], [a, n - 1, b]]))
        assert mesh_x.degenerate_faces.sum() == 2
        mesh_y = moved(mesh_x, 2 * TURN)
        registered = on_same_numbering(mesh_x, mesh_y)
        assert in_percent(registered.vertices - mesh_y.vertices, mesh_y).max() < 1e-2

    def test_vertices_without_faces_move_with_their_neighbours(self):
        data, mesh_y = with_loose_vertices()
        mesh_x = data.mesh
        registered = register_mesh(mesh_x, mesh_y, nearest_surface_points(mesh_y.vertices, mesh_y)[0])
        assert (~mesh_x.referenced_vertices).sum() == 11
        assert in_percent(registered.vertices - mesh_y.vertices, mesh_y).max() < 1e-2
        at = np.flatnonzero(~mesh_x.referenced_vertices)[:6]
        assert np.array_equal(registered.vertices[at], registered.vertices[:6])
        assert registered.mesh.dropped_faces.tolist() == mesh_x.dropped_faces.tolist()

    def test_invalid_arguments_are_refused(self):
        mesh = bumpy_mesh(2)
        points = at_vertices(mesh, np.arange(len(mesh.vertices)))
        with pytest.raises(InputError, match="161 points for 162 vertices: give one"):
            register_mesh(mesh, mesh, points[np.arange(161)])
        for stiffness in (0.0, -1.0, 1e100, np.inf, np.nan):
            with pytest.raises(InputError, match="give a positive number"):
                register_mesh(mesh, mesh, points, stiffness=stiffness)
        with pytest.raises(InputError, match="points on mesh: face indices must lie between"):
            register_mesh(mesh, mesh, SurfacePoints(points.faces + 5, points.weights))
        with pytest.raises(InputError, match="barycentric weights"):
            register_mesh(mesh, mesh, SurfacePoints(points.faces, 2 * points.weights))
        with pytest.raises(InputError, match="points on mesh"):
            on_same_numbering(mesh, mesh).carry(SurfacePoints(np.array([999]), np.array([[1.0, 0, 0]])))


def with_loose_vertices() -> tuple[MeshData, Mesh]:
    """A mesh with six welded duplicates, a speck of four vertices and one vertex alone, and the same moved."""
    vertices, faces = sphere_mesh(3)
    n = len(vertices)
    speck = np.array([1.2, 0.1, 0.3]) + 0.01 * np.vstack([np.zeros(3), np.eye(3)])
    everything = np.vstack([vertices, vertices[:6], speck, [[0, 1.5, 0]]])
    first = np.unique(faces, return_index=True)[1][:6]
    faces = faces.copy()
    faces.ravel()[first] = n + np.arange(6)
    tetrahedron = n + 6 + np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    faces = np.vstack([tetrahedron[:2], faces, tetrahedron[2:]])
    mesh = make_mesh(everything, faces, name="loose", weld=True)
    smile = np.random.default_rng(0).normal(size=(len(everything), 3))
    data = MeshData(mesh, faces, blend_shapes={"smile": smile}, vertex_data={"number": np.arange(n + 11)})
    return data, moved(mesh, 3 * TURN)


def test_islands_of_the_map_move_with_their_surroundings():
    """A dozen neighbours are mapped to the other side of the body."""
    mesh_x = bumpy_mesh(4)
    mesh_y = moved(mesh_x, 3 * TURN)
    island = KDTree(mesh_x.vertices).query(mesh_x.vertices[700], 12)[1]
    matches = np.arange(len(mesh_x.vertices))
    matches[island] = KDTree(mesh_x.vertices).query(-mesh_x.vertices[island])[1]
    registered = register_mesh(mesh_x, mesh_y, at_vertices(mesh_y, matches))
    offsets = in_percent(registered.vertices - mesh_y.vertices, mesh_y)
    assert offsets[island].max() < 1 and np.delete(offsets, island).max() < 0.5
    assert registered.flipped_faces.sum() == 0


class TestLandmarks:
    mesh_x = bumpy_mesh(4)
    mesh_y = moved(mesh_x, 10 * TURN)
    registered = on_same_numbering(mesh_x, mesh_y)

    def landmarks(self, **changes) -> Landmarks:
        points = SurfacePoints(np.arange(0, 5000, 1000), np.tile([0.2, 0.3, 0.5], (5, 1)))
        positions = points.positions(self.mesh_x)
        return Landmarks(tuple("abcde"), positions, **changes)

    def test_similar_meshes_are_exact(self):
        landmarks = self.landmarks(coordinates="RAS")
        moved = transfer_landmarks(landmarks, self.registered)
        assert np.allclose(moved.landmarks.positions, 10 * landmarks.positions @ TURN.T + SHIFT, atol=1e-3)
        assert moved.landmarks.names == landmarks.names and moved.landmarks.coordinates == "RAS"
        assert moved.source_distances.max() < 1e-12
        assert moved.expected_errors is None and moved.notes == ()

    def test_landmarks_at_vertices_give_the_vertices(self):
        shared = {"a": (3, 30), "b": (3, 30), "c": (5, 50), "d": (5, 51)}  # d contradicts c, b agrees with a

        def at(mesh: Mesh, names: str, column: int) -> Landmarks:
            return Landmarks(tuple(names), mesh.vertices[[shared[name][column] for name in names]])

        landmarks = (at(self.mesh_x, "abc", 0), at(self.mesh_y, "abc", 1))
        assert landmark_vertices(*landmarks, self.mesh_x, self.mesh_y).tolist() == [[3, 30], [3, 30], [5, 50]]
        with pytest.raises(InputError, match="'c' and 'd' have the same nearest vertex"):
            landmark_vertices(
                at(self.mesh_x, "abcd", 0), at(self.mesh_y, "abcd", 1), self.mesh_x, self.mesh_y
            )

    def test_a_far_landmark_is_noted(self):
        landmarks = self.landmarks()
        positions = landmarks.positions.copy()
        positions[2] *= 1.5
        moved = transfer_landmarks(replace(landmarks, positions=positions), self.registered)
        assert len(moved.notes) == 1 and "'c'" in moved.notes[0]
        assert moved.source_distances[2] > 0.3 > 1e-9 > moved.source_distances[[0, 1, 3, 4]].max()

    @pytest.mark.parametrize("matrix", [TURN, MIRROR])
    def test_landmarks_off_the_surface_follow_the_space_around(self, matrix):
        """A similarity moves all points of space exactly. On the surface, the result is the usual one."""
        mesh = bumpy_mesh(3)
        registered = on_same_numbering(mesh, moved(mesh, 2 * matrix))
        off = Landmarks(
            ("middle", "inside", "outside"), np.array([[0.0, 0, 0], [0.2, 0.1, 0.3], [1.5, 0.2, 0.1]])
        )
        carried = transfer_landmarks(off, registered, off_surface=True)
        assert np.allclose(carried.landmarks.positions, off.positions @ (2 * matrix).T + SHIFT, atol=1e-4)
        assert carried.notes == () and (carried.source_distances > 0.2).all()
        on = Landmarks(("a", "b"), mesh.vertices[[3, 100]])
        usual, spline = (transfer_landmarks(on, registered, off_surface=off) for off in (False, True))
        assert np.allclose(spline.landmarks.positions, usual.landmarks.positions, atol=1e-6)

    def test_landmarks_of_another_place_are_refused(self):
        mesh = bumpy_mesh(2)
        registered = on_same_numbering(mesh, moved(mesh, np.eye(3)))
        with pytest.raises(InputError, match=r"'far' is .* whose diagonal is .* in its unit"):
            transfer_landmarks(Landmarks(("far",), np.full((1, 3), 1000.0)), registered, off_surface=True)

    def test_the_other_coordinate_system_is_refused(self):
        mesh_x = moved(self.mesh_x, np.eye(3))
        registered = on_same_numbering(mesh_x, self.mesh_y)
        landmarks = self.landmarks(coordinates="LPS")
        flipped = (landmarks.positions + SHIFT) * [-1, -1, 1]
        with pytest.raises(InputError, match='coordinates="RAS"'):
            transfer_landmarks(replace(landmarks, positions=flipped), registered)

    def test_expected_errors_have_the_unit_of_the_target(self):
        expected = np.random.default_rng(0).uniform(size=len(self.mesh_x.vertices))
        found = transfer_landmarks(self.landmarks(), self.registered, expected_error=expected).expected_errors
        at = expected[self.mesh_x.faces[:5000:1000]] @ [0.2, 0.3, 0.5]
        assert np.allclose(found, at * np.sqrt(self.mesh_y.area), rtol=1e-9)
        with pytest.raises(InputError, match="one for each vertex"):
            transfer_landmarks(self.landmarks(), self.registered, expected_error=expected[:-1])


def decorated(mesh: Mesh) -> MeshData:
    """A mesh with smooth functions, labels of halves, and four joints per vertex."""
    random, n, f = np.random.default_rng(0), len(mesh.vertices), len(mesh.faces)
    weights = np.zeros((n, 12))
    joints = (8 * (mesh.vertices[:, 2] - mesh.vertices[:, 2].min()) / np.ptp(mesh.vertices[:, 2])).astype(int)
    for k in range(4):
        weights[np.arange(n), joints + k] = random.uniform(0.1, 1, n)
    upper = mesh.vertices[:, 2] > 0
    return MeshData(
        mesh,
        mesh.faces,
        vertex_data={
            "colors": np.clip(128 + 60 * mesh.vertices, 0, 255).astype(np.uint8),
            "height": mesh.vertices[:, 2].astype(np.float32),
            "place": mesh.vertices,
            "half": np.where(upper, 9, 2),
            "flag": upper,
            "pair": np.where(upper[:, None], [[5, -1]], [[-1, 5]]).astype(np.int16),
        },
        face_data={
            "group": (mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0) * 2,
            "middle": mesh.vertices[mesh.faces].mean(axis=1),
            "colors": np.full((f, 3), 200, np.uint8),
        },
        skin=Skin(tuple(map(str, range(12))), weights / weights.sum(axis=1, keepdims=True)),
        blend_shapes={"smile": random.normal(size=(n, 3))},
        label_names={"group": ("left", "unused", "right")},
    )


def without_strip(mesh: Mesh, width: float) -> Mesh:
    """The mesh without the faces whose centroid has an x coordinate of at most half the width."""
    x = mesh.vertices[mesh.faces, 0].mean(axis=1)
    return mesh.without_faces(np.abs(x) <= width / 2)


class TestSlits:
    """The registered mesh bridges thin slits of the target."""

    PLATE = make_mesh((grid_mesh(21, 21)[0] - 0.5) * [1, 1, 0], grid_mesh(21, 21)[1])

    def test_both_lips_of_a_slit_are_found(self):
        slit = without_strip(self.PLATE, 0.11)
        x, y = slit.vertices[:, 0], slit.vertices[:, 1]
        lips = np.isclose(np.abs(x), 0.05) & (np.abs(y) < 0.49)
        found = at_slits(slit, 0.12)
        assert lips.sum() == 38 and found[lips].all()
        assert not found[np.abs(x) > 0.06].any()  # the outer boundary has no opposite lip
        assert not at_slits(slit, 0.09).any()

    def test_the_result_does_not_depend_on_numbers_and_place(self):
        slit = without_strip(self.PLATE, 0.11)
        order = np.random.default_rng(0).permutation(len(slit.vertices))
        turned = make_mesh(5 * slit.vertices[order] @ TURN.T + SHIFT, np.argsort(order)[slit.faces])
        assert np.array_equal(at_slits(turned, 5 * 0.12), at_slits(slit, 0.12)[order])

    def test_bridges_seams_and_back_to_back_boundaries_are_no_slits(self):
        x = np.abs(self.PLATE.vertices[self.PLATE.faces, 0].mean(axis=1))
        bridge = self.PLATE.without_faces((x > 0.05) & (x < 0.3))  # a strip of surface between two wide holes
        assert not at_slits(bridge, 0.12).any()
        left = self.PLATE.vertices[self.PLATE.faces, 0].mean(axis=1) < 0
        copies = np.where(left[:, None], self.PLATE.faces, self.PLATE.faces + len(self.PLATE.vertices))
        seam = make_mesh(np.vstack([self.PLATE.vertices, self.PLATE.vertices]), copies)
        assert len(seam.boundary_edges) > len(self.PLATE.boundary_edges) and not at_slits(seam, 0.12).any()
        tube = cylinder(20, 60).mesh  # opposite sides of an open end are nearer than the width
        assert len(tube.boundary_edges) and not at_slits(tube, 3.0).any()
        assert not at_slits(bumpy_mesh(3), 1.0).any()

    def test_a_map_that_is_drawn_to_the_lips_is_bridged(self):
        mesh, width = bumpy_mesh(4), 0.02
        slit = without_strip(mesh, width)
        drawn = mesh.vertices.copy()
        near = np.abs(drawn[:, 0]) < 0.1
        drawn[near, 0] = np.where(drawn[near, 0] < 0, -0.05, 0.05)
        points = nearest_surface_points(drawn, slit)[0]
        with pytest.warns(UserWarning, match=r"thin slits cut the target\. \d+% of the area"):
            registered = register_mesh(mesh, slit, points, scale=1.0)
        on_closed = register_mesh(mesh, mesh, nearest_surface_points(points.positions(slit), mesh)[0])
        error, without = (
            in_percent(one.vertices - mesh.vertices, mesh)[near].mean() for one in (registered, on_closed)
        )
        assert error < 0.5 * without
        assert 0.05 < registered.bridged < 0.5 and on_closed.bridged == 0
        assert any("slits" in sentence for sentence in registered.sentences())
        assert not any("slits" in sentence for sentence in on_closed.sentences())

    def test_slits_of_the_source_itself_are_kept(self):
        """A mouth, for example, is matched to a mouth."""
        slit = without_strip(bumpy_mesh(4), 0.02)
        registered = register_mesh(slit, slit, nearest_surface_points(slit.vertices, slit)[0], scale=1.0)
        assert registered.bridged == 0
        used = slit.referenced_vertices
        assert in_percent(registered.vertices - slit.vertices, slit)[used].max() < 1e-3


class TestAttributes:
    @pytest.mark.parametrize("level", [3, 5])
    def test_values_of_other_resolutions(self, level):
        data, mesh_y = decorated(bumpy_mesh(4)), bumpy_mesh(level)
        out = transfer_attributes(data, by_position(data.mesh, mesh_y), mesh_y)
        for name, values in data.vertex_data.items():
            assert out.vertex_data[name].dtype == values.dtype
            assert out.vertex_data[name].shape[1:] == values.shape[1:]
        assert np.abs(out.vertex_data["place"] - mesh_y.vertices).max() < 0.03
        assert np.abs(out.vertex_data["height"] - mesh_y.vertices[:, 2]).max() < 0.03
        assert np.abs(out.vertex_data["colors"] - (128 + 60 * mesh_y.vertices)).max() < 3
        assert np.abs(out.face_data["middle"] - mesh_y.vertices[mesh_y.faces].mean(axis=1)).max() < 0.08
        assert (out.face_data["colors"] == 200).all() and out.face_data["colors"].dtype == np.uint8
        assert out.label_names == data.label_names and np.array_equal(out.faces, mesh_y.faces)

    @pytest.mark.parametrize("level", [3, 5])
    def test_labels_are_never_averaged(self, level):
        data, mesh_y = decorated(bumpy_mesh(4)), bumpy_mesh(level)
        out = transfer_attributes(data, by_position(data.mesh, mesh_y))
        assert set(out.vertex_data["half"]) == {2, 9} and set(out.vertex_data["flag"]) == {0, 1}
        assert {tuple(row) for row in out.vertex_data["pair"].tolist()} == {(5, -1), (-1, 5)}
        assert set(out.face_data["group"]) == {0, 2}
        clear = np.abs(mesh_y.vertices[:, 2]) > 0.08
        assert np.array_equal(out.vertex_data["half"][clear] == 9, mesh_y.vertices[clear, 2] > 0)
        middles = mesh_y.vertices[mesh_y.faces].mean(axis=1)[:, 0]
        clear = np.abs(middles) > 0.12
        assert np.array_equal(out.face_data["group"][clear] == 2, middles[clear] > 0)

    def test_the_same_mesh_keeps_everything(self):
        data = decorated(bumpy_mesh(3))
        rows = np.random.default_rng(1).integers(0, 99, (2, len(data.faces)))
        data = replace(data, face_data={**data.face_data, "random": rows[0], "rows": rows.T})
        out = transfer_attributes(data, on_same_numbering(data.mesh, moved(data.mesh, MIRROR)))
        for found, own in [(out.vertex_data, data.vertex_data), (out.face_data, data.face_data)]:
            for name, values in own.items():
                exact = values.dtype.kind in "iu" and name != "colors"
                assert np.allclose(found[name], values, atol=0 if exact else 1 if name == "colors" else 1e-4)
        assert np.allclose(out.skin.weights, data.skin.weights, atol=1e-3)
        assert out.mesh.notes == ()

    @pytest.mark.parametrize("matrix", [2 * TURN, 0.01 * MIRROR])
    def test_blend_shapes_turn_with_the_target(self, matrix):
        data = decorated(bumpy_mesh(3))
        registered = on_same_numbering(data.mesh, moved(data.mesh, matrix))
        expected = data.blend_shapes["smile"] @ matrix.T
        limit = 1e-3 * np.abs(expected).max()
        found = transfer_attributes(data, registered).blend_shapes["smile"]
        assert np.abs(found - expected).max() < 3 * limit
        assert np.abs(registered_data(data, registered).blend_shapes["smile"] - expected).max() < 3 * limit

    def test_skin_weights(self):
        data, mesh_y = decorated(bumpy_mesh(4)), bumpy_mesh(5)
        skin = transfer_attributes(data, by_position(data.mesh, mesh_y)).skin
        assert skin.joints == data.skin.joints
        assert skin.weights.min() == 0 and np.allclose(skin.weights.sum(axis=1), 1, atol=1e-12)
        assert (skin.weights > 0).sum(axis=1).max() == 4

    @pytest.mark.parametrize("angle", [0, 40, 80])
    def test_a_skeleton_takes_the_pose_and_the_size_of_the_target(self, angle):
        """A forearm that is bent about the elbow, on a body that is turned and three times as large."""
        mesh = make_mesh(sphere_mesh(4)[0] * [0.5, 0.5, 3], sphere_mesh(4)[1])
        height = mesh.vertices[:, 2]
        bent = 1 / (1 + np.exp(-8 * height))
        weights = np.stack(
            [1 - bent, bent, np.zeros_like(bent), np.arange(len(bent)) == height.argmax()], axis=1
        )
        matrices = np.tile(np.eye(4), (4, 1, 1))
        matrices[:, :3, :3] = Rotation.random(4, rng=1).as_matrix()
        # Shoulder, elbow, a joint that moves no vertex, and one that moves a single vertex.
        matrices[:, 2, 3] = [-2.5, 0, 2.5, 2.8]
        skeleton = Skeleton(np.array([-1, 0, 1, 2]), matrices)
        data = MeshData(
            mesh, mesh.faces, skin=Skin(("upper arm", "forearm", "hand", "tip"), weights, skeleton)
        )
        bend = Rotation.from_euler("x", angle, degrees=True)
        posed = Rotation.from_rotvec(bent[:, None] * bend.as_rotvec()).apply(mesh.vertices)
        target = make_mesh(3 * posed @ TURN.T + SHIFT, mesh.faces)
        registered = on_same_numbering(mesh, target)
        expected = matrices.copy()
        expected[1:, :3] = bend.as_matrix() @ expected[1:, :3]
        expected[:, :3] = TURN @ expected[:, :3]
        expected[:, :3, 3] = 3 * expected[:, :3, 3] + SHIFT
        for skin in (transfer_attributes(data, registered).skin, registered_data(data, registered).skin):
            found = skin.skeleton
            assert np.array_equal(found.parents, skeleton.parents)
            assert np.abs(found.bind_matrices[:, :3, 3] - expected[:, :3, 3]).max() < 0.25  # of 18
            rotations = found.bind_matrices[:, :3, :3] @ expected[:, :3, :3].swapaxes(1, 2)
            assert np.degrees(Rotation.from_matrix(rotations).magnitude()).max() < 1 + 0.1 * angle
        assert np.array_equal(found.bind_matrices[:, 3], [[0, 0, 0, 1]] * 4)

    def test_a_skeleton_of_a_flat_mesh_is_moved(self):
        flat, faces = grid_mesh(8, 8)
        mesh = make_mesh(np.c_[flat[:, :2], np.zeros(len(flat))], faces)
        target = moved(mesh, 2 * TURN)
        matrices = np.tile(np.eye(4), (2, 1, 1))
        matrices[1, :2, 3] = [0.5, 0.6]
        weights = np.stack([1 - flat[:, 0], flat[:, 0]], axis=1)
        skin = Skin(("a", "b"), weights, Skeleton(np.array([-1, 0]), matrices))
        data = MeshData(mesh, mesh.faces, skin=skin)
        found = registered_data(data, on_same_numbering(mesh, target)).skin.skeleton.bind_matrices
        assert np.abs(found[:, :3, 3] - (2 * matrices[:, :3, 3] @ TURN.T + SHIFT)).max() < 0.05

    def test_values_that_are_not_finite_do_not_spread(self):
        data, mesh_y = decorated(bumpy_mesh(4)), bumpy_mesh(5)
        height = np.where(data.mesh.vertices[:, 2] > 0.5, np.nan, 1.0)
        data = replace(data, vertex_data={"height": height})
        out = transfer_attributes(data, by_position(data.mesh, mesh_y)).vertex_data["height"]
        known = np.isfinite(out)
        assert np.allclose(out[known], 1)
        assert known[mesh_y.vertices[:, 2] < 0.45].all() and not known[mesh_y.vertices[:, 2] > 0.55].any()

    def test_data_of_the_target_are_kept_without_a_clash(self):
        data, mesh_y = decorated(bumpy_mesh(3)), bumpy_mesh(4)
        n, f = len(mesh_y.vertices), len(mesh_y.faces)
        up = np.tile([0.0, 0, 1], (n, 1))
        target = MeshData(
            mesh_y,
            mesh_y.faces,
            vertex_data={"own": np.arange(n), "half": np.zeros(n), "group": np.ones(n, int), "normals": up},
            face_data={"kind": np.ones(f, int)},
            label_names={"kind": ("a", "b"), "group": ("one", "two")},
            blend_shapes={"frown": up, "smile": up},
            skin=Skin(("j",), np.ones((n, 1))),
        )
        data = replace(
            data, vertex_data={**data.vertex_data, "normals": np.zeros((len(data.mesh.vertices), 3))}
        )
        out = transfer_attributes(data, by_position(data.mesh, mesh_y), target)
        assert np.array_equal(out.vertex_data["own"], np.arange(n))
        assert np.array_equal(out.vertex_data["normals"], up) and "group" not in out.vertex_data
        assert out.label_names == {"kind": ("a", "b"), "group": ("left", "unused", "right")}
        assert set(out.blend_shapes) == {"frown", "smile"} and len(out.skin.joints) == 12
        assert np.array_equal(out.blend_shapes["frown"], up)
        first, second = out.mesh.notes
        assert "normals" in first
        assert second.endswith("by those of the source: 'half', 'group', 'smile', the skin.")

    def test_parts_that_the_source_lacks_are_noted(self):
        mesh_y = bumpy_mesh(4)
        kept = (mesh_y.vertices[mesh_y.faces, 0] < 0.3).all(axis=1)
        data = decorated(make_mesh(mesh_y.vertices, mesh_y.faces[kept]))
        points = nearest_surface_points(mesh_y.vertices, mesh_y)[0]
        registered = register_mesh(data.mesh, mesh_y, points, scale=1.0)
        out = transfer_attributes(data, registered)
        far = (registered.target_distances > 0.03 * np.sqrt(mesh_y.area)).sum()
        assert 500 < far < 1200
        (note,) = out.mesh.notes
        assert note.startswith(f"{far} vertices of 2562 farther from the registered source than 3%")
        assert np.isfinite(out.vertex_data["place"]).all()

    def test_data_of_other_meshes_are_refused(self):
        data, other = decorated(bumpy_mesh(3)), bumpy_mesh(2)
        registered = on_same_numbering(data.mesh, moved(data.mesh, TURN))
        with pytest.raises(InputError, match="differ from those of moved"):
            transfer_attributes(data, registered, other)
        for function in (transfer_attributes, registered_data):
            with pytest.raises(InputError, match="differ from those of mesh"):
                function(decorated(other), registered)
        for faces in (data.faces[:-1], data.faces[::-1]):
            with pytest.raises(InputError, match="not those of their mesh"):
                transfer_attributes(MeshData(data.mesh, faces), registered)

    def test_welded_duplicates_and_dropped_faces(self):
        data, mesh_y = with_loose_vertices()
        registered = register_mesh(data.mesh, mesh_y, nearest_surface_points(mesh_y.vertices, mesh_y)[0])
        faces = data.faces
        data = replace(
            data, face_data={"number": np.arange(len(faces))}, vertex_data={"place": data.mesh.vertices}
        )
        out = transfer_attributes(data, registered)
        assert np.array_equal(out.face_data["number"], data.mesh.face_numbers)
        used = data.mesh.referenced_vertices
        assert np.allclose(out.vertex_data["place"][used], data.mesh.vertices[used], atol=1e-3)

    def test_a_target_with_duplicates_and_a_speck(self):
        target, _ = with_loose_vertices()
        data = cylinder(30, 60)
        points = nearest_surface_points(data.mesh.vertices, target.mesh)[0]
        out = transfer_attributes(
            replace(data, vertex_data={"place": data.mesh.vertices}),
            register_mesh(data.mesh, target.mesh, points),
            target,
        )
        assert np.array_equal(out.faces, target.faces) and out.texture.corners.shape == target.faces.shape
        assert np.array_equal(out.vertex_data["place"][642:648], out.vertex_data["place"][:6])
        assert np.array_equal(out.vertex_data["number"], target.vertex_data["number"])
        assert np.array_equal(out.blend_shapes["smile"], target.blend_shapes["smile"])


class TestRegisteredData:
    def test_faces_and_order_are_kept(self, tmp_path):
        data, mesh_y = with_loose_vertices()
        normals = data.mesh.vertices.astype(np.float32)
        data = replace(data, vertex_data={**data.vertex_data, "normals": normals})
        registered = register_mesh(data.mesh, mesh_y, nearest_surface_points(mesh_y.vertices, mesh_y)[0])
        out = registered_data(data, registered)
        assert np.array_equal(out.faces, data.faces)
        assert np.array_equal(out.mesh.vertices, registered.vertices)
        assert np.array_equal(out.vertex_data["number"], data.vertex_data["number"])
        assert np.allclose(out.blend_shapes["smile"], 3 * data.blend_shapes["smile"] @ TURN.T, atol=0.01)
        found = out.vertex_data["normals"]
        assert found.dtype == np.float32 and np.allclose(found, normals @ TURN.T, atol=0.01)
        assert write_mesh_data(tmp_path / "out.npz", out) == ()
        assert np.array_equal(read_mesh_data(tmp_path / "out.npz").faces, data.faces)


def cylinder(rows: int, columns: int, turn: float = 0.0) -> MeshData:
    """A tube around the z axis. Its texture is the unit square: one chart, which meets itself at one seam."""
    flat, corners = grid_mesh(rows, columns + 1)
    faces = corners // (columns + 1) * columns + corners % (columns + 1) % columns
    kept = np.arange(rows * (columns + 1)).reshape(rows, -1)[:, :-1].ravel()
    angle = 2 * np.pi * flat[kept, 0] + turn
    vertices = np.stack([np.cos(angle), np.sin(angle), 3 * flat[kept, 1]], axis=1)
    return MeshData(make_mesh(vertices, faces), faces, texture=Texture(flat[:, :2], corners))


def uv_areas(texture: Texture) -> np.ndarray:
    a, b, c = np.moveaxis(texture.coordinates[texture.corners], 1, 0)
    return 0.5 * np.linalg.det(np.stack([b - a, c - a], axis=1))


class TestTexture:
    @pytest.mark.parametrize(
        ("rows", "columns", "turn"), [(20, 33, 0.1), (41, 80, 0.3), (9, 17, 0.05), (12, 24, 0)]
    )
    def test_no_face_crosses_the_seam_of_a_tube(self, rows, columns, turn):
        data, mesh_y = cylinder(24, 40), cylinder(rows, columns, turn).mesh
        out = transfer_attributes(data, by_position(data.mesh, mesh_y)).texture
        at = out.coordinates[out.corners]
        assert np.ptp(at[..., 0], axis=1).max() < 1.5 / columns + 0.005
        areas = uv_areas(out)
        assert areas.min() > -1e-9 and areas.sum() == pytest.approx(1, abs=0.02)
        assert 0.5 * len(areas) < (areas > 0.5 / len(areas)).sum()
        # Vertices at the seam have two texture vertices, and the others have one.
        pairs = np.unique(np.column_stack([mesh_y.faces.ravel(), out.corners.ravel()]), axis=0)
        counts = np.bincount(pairs[:, 0])
        assert counts.max() == 2 and rows <= (counts == 2).sum() <= 2 * rows + 2
        assert len(pairs) == len(out.coordinates)

    def test_the_same_mesh_keeps_its_seam(self):
        data = cylinder(12, 20)
        out = transfer_attributes(data, on_same_numbering(data.mesh, moved(data.mesh, MIRROR)))
        own = data.texture.coordinates[data.texture.corners]
        assert np.allclose(out.texture.coordinates[out.texture.corners], own, atol=1e-3)
        assert len(out.texture.coordinates) == len(data.texture.coordinates)

    @pytest.mark.parametrize("level", [2, 3, 5])
    @pytest.mark.parametrize("split", [False, True])
    def test_no_face_crosses_two_charts(self, level, split):
        """Each half of a sphere is a disc in the texture. Texture vertices may be listed once per corner."""
        mesh_x, mesh_y = make_mesh(*sphere_mesh(4)), make_mesh(*sphere_mesh(level))
        upper = mesh_x.vertices[mesh_x.faces].mean(axis=1)[:, 2] > 0
        uv = mesh_x.vertices[mesh_x.faces][..., :2] + np.where(upper, 2, -2)[:, None, None] * [1, 0]
        coordinates, corners = uv.reshape(-1, 2), np.arange(uv.size // 2).reshape(-1, 3)
        if not split:
            coordinates, inverse = np.unique(coordinates, axis=0, return_inverse=True)
            corners = inverse.reshape(-1, 3)
        data = MeshData(mesh_x, mesh_x.faces, texture=Texture(coordinates, corners))
        out = transfer_attributes(data, by_position(mesh_x, mesh_y)).texture
        at = out.coordinates[out.corners]
        side = np.sign(at[..., 0])
        assert (side == side[:, :1]).all()
        middle = mesh_y.vertices[mesh_y.faces].mean(axis=1)[:, 2]
        clear = np.abs(middle) > 0.2
        assert np.array_equal(side[clear, 0] > 0, middle[clear] > 0)
        area = np.abs(uv_areas(out)[side[:, 0] > 0]).sum()
        assert area == pytest.approx(np.abs(uv_areas(data.texture)[upper]).sum(), rel=0.15 / level)
        pairs = np.unique(np.column_stack([mesh_y.faces.ravel(), out.corners.ravel()]), axis=0)
        assert np.bincount(pairs[:, 0]).max() == 2 and len(pairs) == len(out.coordinates)

    def test_faces_without_texture(self):
        mesh_x, mesh_y = make_mesh(*sphere_mesh(4)), make_mesh(*sphere_mesh(3))
        upper = mesh_x.vertices[mesh_x.faces].mean(axis=1)[:, 2] > 0
        corners = np.where(upper[:, None], mesh_x.faces, -1)
        data = MeshData(mesh_x, mesh_x.faces, texture=Texture(mesh_x.vertices[:, :2], corners))
        registered = by_position(mesh_x, mesh_y)
        out = transfer_attributes(data, registered).texture
        shown = out.corners >= 0
        assert (shown == shown[:, :1]).all()
        middle = mesh_y.vertices[mesh_y.faces].mean(axis=1)[:, 2]
        assert np.array_equal(shown[np.abs(middle) > 0.1, 0], middle[np.abs(middle) > 0.1] > 0)
        bare = replace(data, texture=Texture(np.empty((0, 2)), np.full_like(corners, -1)))
        assert (transfer_attributes(bare, registered).texture.corners == -1).all()

    @pytest.mark.parametrize("turn", [np.eye(3), TURN])
    def test_a_registered_leg_stays_on_its_leg(self, turn):
        """Two spheres nearly touch. The registered mesh reaches a little into the other sphere."""
        unit, triangles = sphere_mesh(4)
        offset = np.array([1.01, 0, 0])
        vertices = np.vstack([unit - offset, unit + offset])
        faces = np.vstack([triangles, triangles + len(unit)])
        target = make_mesh(vertices @ turn.T, faces)
        shifted = vertices + np.repeat([[0.08, 0, 0], [-0.08, 0, 0]], len(unit), axis=0)
        source = make_mesh(shifted @ turn.T, faces)
        found, _ = nearest_surface_points(source.vertices, target)
        sphere = np.arange(len(vertices)) >= len(unit)
        assert (sphere != (found.faces >= len(triangles))).sum() > 10
        facing = nearest_facing_points(source.vertices, source.vertex_normals, found, target)
        np.testing.assert_array_equal(sphere, facing.faces >= len(triangles))
        distances = np.linalg.norm(facing.positions(target) - source.vertices, axis=1)
        assert distances.max() < 0.1
        # The normals of triangles without a consistent orientation decide nothing.
        mixed = replace(target, faces=np.where(np.arange(len(faces))[:, None] % 2, faces, faces[:, ::-1]))
        same = nearest_facing_points(source.vertices, source.vertex_normals, found, mixed)
        np.testing.assert_array_equal(same.faces, found.faces)

    def test_nearest_points_of_single_triangles(self):
        random = np.random.default_rng(0)
        points, triangles = random.normal(size=(300, 3)), random.normal(size=(300, 3, 3))
        triangles[:20, 2] = triangles[:20, 1]  # a segment
        triangles[20:40] = triangles[20:40, :1]  # a point
        weights, distances = nearest_points_of_triangles(points, triangles)
        faces = np.array([[0, 1, 2]])
        expected = [
            nearest_surface_points(p[None], Mesh(t, faces))[1][0]
            for p, t in zip(points, triangles, strict=True)
        ]
        assert np.allclose(distances, expected, atol=1e-12)
        reached = np.einsum("pk,pkx->px", weights, triangles)
        assert np.allclose(np.linalg.norm(points - reached, axis=1), distances, atol=1e-12)
        assert weights.min() >= 0 and np.allclose(weights.sum(axis=1), 1)


@pytest.mark.sampled
@pytest.mark.parametrize("y", ["tr_reg_001", "tr_reg_004"])
def test_real_people(shared, y):
    directory = shared / "data" / "faust_r"
    mesh_x, mesh_y = (read_mesh(directory / "off" / f"{name}.off") for name in ("tr_reg_000", y))
    truth = read_ground_truth(
        [directory / "corres" / f"{name}.vts" for name in ("tr_reg_000", y)], mesh_x, mesh_y
    )
    # The ground truth lists points of a common template, not one for each vertex.
    first = np.unique(truth.source_vertices, return_index=True)
    matches = np.full(len(mesh_x.vertices), -1)
    matches[first[0]] = truth.targets[first[1]]
    known = matches >= 0
    nearest = nearest_known(mesh_x, known)
    # A smaller stiffness than the default smooths fewer details.
    points = at_vertices(mesh_y, matches[nearest])
    registered = register_mesh(mesh_x, mesh_y, points, stiffness=0.003)
    assert np.quantile(registered.distances, 0.95) < 0.005 * np.sqrt(mesh_y.area)
    assert not registered.flipped_faces.any()
    assert np.median(in_percent((registered.vertices - mesh_y.vertices[matches])[known], mesh_y)) < 0.2


def nearest_known(mesh: Mesh, known: np.ndarray) -> np.ndarray:
    """The nearest vertex with a known match for each vertex."""
    distances = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices[known], axis=2)
    return np.flatnonzero(known)[distances.argmin(axis=1)]


@pytest.mark.sampled
def test_real_wolves(shared):
    """The poses of TOSCA's wolf have the same triangles."""
    mesh_x, mesh_y = (read_mesh(shared / "data" / "tosca" / "off" / f"wolf{pose}.off") for pose in (0, 1))
    data = decorated(mesh_x)
    registered = on_same_numbering(mesh_x, mesh_y)
    assert in_percent(registered.vertices - mesh_y.vertices, mesh_y).max() < 0.5
    assert registered.flipped_faces.mean() < 1e-3
    out = transfer_attributes(data, registered)
    offsets = out.vertex_data["place"] - mesh_x.vertices
    assert np.quantile(in_percent(offsets, mesh_x), 0.99) < 0.5
    assert (out.face_data["group"] == data.face_data["group"]).mean() > 0.99
