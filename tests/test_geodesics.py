import tracemalloc

import numpy as np
import pygeodesic.geodesic as pygeodesic
import pytest
from messages import refused
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from synthetic import grid_mesh, sphere_mesh

from jaxsmw import InputError, Mesh, make_mesh, read_mesh
from jaxsmw.geometry import geodesics
from jaxsmw.geometry.geodesics import (
    geodesic_distances,
    geodesic_distances_between,
    geodesic_graph,
    geodesic_matrix,
)
from jaxsmw.geometry.surface_points import SurfacePoints


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", "off")


def shaken_square(side: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (side^2, 2) and faces of the unit square, with irregular triangles and straight boundaries."""
    vertices, _ = grid_mesh(side, side)
    square = vertices[:, :2]
    inner = ((square > 0) & (square < 1)).all(axis=1)
    square[inner] += np.random.default_rng(seed).uniform(-0.3, 0.3, (inner.sum(), 2)) / (side - 1)
    return square, Delaunay(square).simplices.astype(np.int64)


def flat_sheet(side: int = 17, seed: int = 0) -> Mesh:
    """A flat square sheet, tilted in space. Its geodesics are straight lines."""
    square, faces = shaken_square(side, seed)
    return make_mesh(np.pad(square, ((0, 0), (0, 1))) @ Rotation.random(random_state=seed).as_matrix(), faces)


def blob(subdivisions: int = 3, seed: int = 0) -> Mesh:
    """A closed surface with hills, valleys and irregular triangles."""
    vertices, faces = sphere_mesh(subdivisions)
    generator = np.random.default_rng(seed)
    waves = generator.normal(size=(4, 3)) * 2
    radius = 1 + 0.2 * np.sin(vertices @ waves.T + generator.uniform(0, 6, 4)).sum(axis=1)
    return make_mesh(radius[:, None] * vertices + generator.normal(size=vertices.shape) * 0.01, faces)


def book(pages: int, n: int = 7) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Return a mesh of flat pages that meet in one spine, and each vertex's page and position.

    A position consists of the distance x from the spine and the coordinate y along the spine.
    """
    square, faces = shaken_square(n, 1)
    on_spine = np.flatnonzero(square[:, 0] == 0)
    vertices, triangles, page_of, place = [], [], [], []
    for page in range(pages):
        angle = 2.5 * page / pages
        vertices.append(
            np.stack([square[:, 0] * np.cos(angle), square[:, 0] * np.sin(angle), square[:, 1]], 1)
        )
        number = np.arange(n * n) + page * n * n
        number[on_spine] = on_spine
        triangles.append(number[faces] if page % 2 else number[faces][:, ::-1])
        page_of.append(np.full(n * n, page))
        place.append(square)
    mesh = make_mesh(np.concatenate(vertices), np.concatenate(triangles))
    return mesh, np.concatenate(page_of), np.concatenate(place)


CUBE = make_mesh(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    [
        *([0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4]),
        *([1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]),
    ],
)


def random_points(mesh: Mesh, number: int, seed: int = 0) -> SurfacePoints:
    generator = np.random.default_rng(seed)
    return SurfacePoints(
        generator.integers(0, len(mesh.faces), number), generator.dirichlet([1, 1, 1], number)
    )


def exact_distances(mesh: Mesh, sources) -> np.ndarray:
    algorithm = pygeodesic.PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces.astype(np.int32))
    return np.array([algorithm.geodesicDistances(np.array([s]), None)[0] for s in sources])


def with_points_as_vertices(mesh: Mesh, points: SurfacePoints) -> Mesh:
    """Return the surface with additional last vertices at the points, which are on different faces."""
    assert len(np.unique(points.faces)) == len(points)
    number = len(mesh.vertices) + np.arange(len(points))
    a, b, c = mesh.faces[points.faces].T
    split = [np.stack(corners, axis=1) for corners in ((a, b, number), (b, c, number), (c, a, number))]
    faces = np.concatenate([np.delete(mesh.faces, points.faces, axis=0), *split])
    return make_mesh(np.concatenate([mesh.vertices, points.positions(mesh)]), faces)


def test_faust_agrees_with_exact_distances(shared):
    mesh = read_mesh(shared / "data/faust_r/off/tr_reg_007.off")
    reference = np.load(shared / "oracle/faust_r_007_geodesics.npz")
    expected = reference["distances"].astype(np.float64)
    distances = geodesic_distances(mesh, reference["source_vertices"])
    elsewhere = expected > 0
    error = distances[elsewhere] / expected[elsewhere] - 1
    near = expected[elsewhere] < 0.02 * np.sqrt(mesh.area)
    assert error.min() > -1e-7  # the reference is stored in float32
    assert error.mean() < 0.0005 and np.quantile(error, 0.9999) < 0.005 and error.max() < 0.01
    assert near.sum() > 500 and error[near].max() < 1e-6
    assert (distances[~elsewhere] == 0).all()


def test_distances_on_a_flat_sheet_are_euclidean():
    mesh = flat_sheet()
    distances = geodesic_distances(mesh, np.arange(len(mesh.vertices)))
    expected = np.linalg.norm(mesh.vertices[:, None] - mesh.vertices, axis=2)
    error = distances - expected
    assert error.min() > -1e-12
    far = expected > 0
    assert (error[far] / expected[far]).mean() < 5e-4 and (error[far] / expected[far]).max() < 0.01
    near = expected < 0.08
    assert np.abs(error[near]).max() < 1e-12


def test_distances_on_a_grid_with_collinear_vertices_are_euclidean():
    vertices, faces = grid_mesh(9, 9)
    mesh = make_mesh(vertices, faces)
    distances = geodesic_distances(mesh, np.arange(81))
    expected = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    assert (distances - expected).min() > -1e-12
    # Lines along rows, columns and diagonals pass exactly through vertices.
    np.testing.assert_allclose(distances[0, ::9], expected[0, ::9], rtol=1e-12)
    np.testing.assert_allclose(distances[0, ::10], expected[0, ::10], rtol=1e-12)
    np.testing.assert_allclose(distances[8, 8:80:8], expected[8, 8:80:8], rtol=1e-12)
    off_diagonal = expected > 0
    assert (distances[off_diagonal] / expected[off_diagonal]).max() < 1.005


def test_distances_on_a_cube_are_exact():
    distances = geodesic_distances(CUBE, np.arange(8))
    np.testing.assert_allclose(distances[0], np.sqrt([0, 1, 2, 1, 1, 2, 5, 2]), rtol=1e-14)
    assert sorted(np.round(distances.ravel() ** 2).astype(int)) == [0] * 8 + [1] * 24 + [2] * 24 + [5] * 8
    # The centres of the bottom, top and front sides of the cube are on diagonal edges.
    centres = SurfacePoints(np.array([0, 2, 4]), np.array([[0.5, 0.5, 0], [0.5, 0, 0.5], [0.5, 0, 0.5]]))
    np.testing.assert_allclose(centres.positions(CUBE), [[0.5, 0.5, 0], [0.5, 0.5, 1], [0.5, 0, 0.5]])
    first, second = np.array([0, 0, 1, 0]), np.array([1, 2, 2, 0])
    np.testing.assert_allclose(
        geodesic_distances_between(CUBE, centres[first], centres[second]), [2, 1, 1, 0], rtol=1e-14
    )
    np.testing.assert_allclose(
        geodesic_distances(CUBE, centres[np.array([0])])[0], np.sqrt([0.5] * 4 + [2.5] * 4), rtol=1e-14
    )


def test_distances_on_a_prism_equal_those_on_the_unrolled_prism():
    sides, rings, seed = 12, 6, 0
    generator = np.random.default_rng(seed)
    corner, ring = np.meshgrid(np.arange(sides), np.arange(rings))
    height = ring + generator.uniform(-0.3, 0.3, ring.shape) * ((ring > 0) & (ring < rings - 1))
    angle = 2 * np.pi * corner / sides
    radius = 0.5 / np.sin(np.pi / sides)  # sides of length 1
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    a = (corner + sides * ring)[:-1].ravel()
    b = ((corner + 1) % sides + sides * ring)[:-1].ravel()
    faces = np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    mesh = make_mesh(vertices, faces)
    turn = np.abs(corner.ravel()[:, None] - corner.ravel())
    expected = np.hypot(np.minimum(turn, sides - turn), height.ravel()[:, None] - height.ravel())
    distances = geodesic_distances(mesh, np.arange(len(vertices)))
    assert (distances - expected).min() > -1e-12
    elsewhere = expected > 0
    error = distances[elsewhere] / expected[elsewhere] - 1
    assert error.mean() < 2e-4 and error.max() < 0.01
    assert error[expected[elsewhere] < 3].max() < 1e-12


def test_distances_on_a_curved_surface_agree_with_exact_distances():
    mesh = blob()
    sources = np.arange(0, 642, 40)
    distances, expected = geodesic_distances(mesh, sources), exact_distances(mesh, sources)
    error = distances / np.where(expected > 0, expected, 1) - (expected > 0)
    assert error.min() > -1e-12 and error.mean() < 1e-3 and error.max() < 0.01
    near = expected < 0.1 * np.sqrt(mesh.area)
    assert near.sum() > 200 and error[near].max() < 1e-12


def test_greater_depth_never_makes_distances_longer():
    mesh = blob(2)
    totals = []
    previous = np.full((len(mesh.vertices),) * 2, np.inf)
    for depth in (1, 2, 4, 8):
        graph = geodesic_graph(mesh, depth=depth)
        distances = geodesics.csgraph.dijkstra(graph)
        assert (distances <= previous + 1e-12).all()
        previous = distances
        totals.append(distances.sum())
    assert (np.diff(totals) < 0).all()


def test_the_graph_is_symmetric_and_not_shorter_than_straight_lines_in_space():
    mesh = blob()
    graph = geodesic_graph(mesh).tocoo()
    assert abs(graph - graph.T).max() == 0
    straight = np.linalg.norm(mesh.vertices[graph.row] - mesh.vertices[graph.col], axis=1)
    assert (graph.data >= straight - 1e-12).all() and (graph.row != graph.col).all()


def test_distances_are_a_metric():
    mesh = blob(2)
    distances = geodesic_distances(mesh, np.arange(len(mesh.vertices)))
    np.testing.assert_allclose(distances, distances.T, atol=1e-12)
    assert (np.diag(distances) == 0).all() and (distances[~np.eye(len(distances), dtype=bool)] > 0).all()
    detour = (distances[:, :, None] + distances[None, :, :]).min(axis=1)
    assert (distances <= detour + 1e-12).all()


@pytest.mark.parametrize("method", ["strips", "exact"])
@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e30])
def test_distances_scale_with_the_mesh_and_do_not_depend_on_motion_or_numbering(method, scale):
    mesh, generator = blob(2), np.random.default_rng(0)
    n = len(mesh.vertices)
    sources = np.array([0, 50, 100])
    expected = geodesic_distances(mesh, sources, method=method)
    number = generator.permutation(n)  # vertex i becomes number[i]
    vertices = np.empty((n, 3))
    vertices[number] = scale * (mesh.vertices @ Rotation.random(random_state=1).as_matrix() + [1, 2, 3])
    faces = generator.permutation(number[mesh.faces])
    faces = np.array([np.roll(face, k) for k, face in enumerate(faces)])
    faces[::3] = faces[::3, ::-1]  # distances do not depend on orientation
    moved = geodesic_distances(make_mesh(vertices, faces), number[sources], method=method)
    np.testing.assert_allclose(moved[:, number], scale * expected, rtol=1e-9, atol=1e-12 * scale)


def test_distances_across_an_edge_of_several_sheets():
    mesh, page, place = book(pages=4)
    used = mesh.referenced_vertices
    assert len(mesh.nonmanifold_edges) == 6
    distances = geodesic_distances(mesh, np.flatnonzero(used))[:, used]
    page, place = page[used], place[used]
    mirrored = place * [-1, 1]
    same = (page[:, None] == page) | (place[:, :1] == 0) | (place[:, 0] == 0)
    expected = np.where(
        same,
        np.linalg.norm(place[:, None] - place, axis=2),
        np.linalg.norm(place[:, None] - mirrored, axis=2),
    )
    error = distances - expected
    assert error.min() > -1e-12 and (error / np.maximum(expected, 0.1)).max() < 0.01


def test_sheets_that_touch_in_a_vertex_are_connected():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-3, 0, 0], [0, 0, -4]]
    mesh = make_mesh(vertices, [[0, 1, 2], [0, 3, 4]])
    np.testing.assert_allclose(geodesic_distances(mesh, [1]), [[1, 0, np.sqrt(2), 4, 5]])


def test_components_and_unreferenced_vertices_are_infinitely_far_apart():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    vertices = np.concatenate([square, [[5, 5, 5]], square])
    mesh = make_mesh(vertices, np.concatenate([faces, faces + 5]))
    distances = geodesic_distances(mesh, np.arange(9))
    one = np.sqrt([[0, 1, 2, 1], [1, 0, 1, 2], [2, 1, 0, 1], [1, 2, 1, 0]])
    expected = np.full((9, 9), np.inf)
    expected[:4, :4] = expected[5:, 5:] = one
    expected[4, 4] = 0
    np.testing.assert_allclose(distances, expected)
    pairs = np.array(np.meshgrid(np.arange(9), np.arange(9))).reshape(2, -1)
    np.testing.assert_allclose(geodesic_distances_between(mesh, *pairs), expected.ravel())
    np.testing.assert_allclose(geodesic_distances(mesh, np.arange(9), method="exact"), expected)


def test_edges_without_length_and_faces_without_area_have_no_effect():
    # The mesh is a square, cut along its diagonal and closed again with faces of zero width.
    vertices = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0]]
    mesh = make_mesh(vertices, [[0, 1, 2], [4, 5, 3], [0, 2, 5], [0, 5, 4]])
    assert mesh.degenerate_faces.sum() == 2
    distances = geodesic_distances(mesh, np.arange(6))
    np.testing.assert_allclose(distances, np.linalg.norm(mesh.vertices[:, None] - mesh.vertices, axis=2))


def test_a_limit_does_not_change_smaller_distances():
    mesh = blob()
    for method in ("strips", "exact"):
        everything = geodesic_distances(mesh, [0, 9], method=method)
        some = geodesic_distances(mesh, [0, 9], method=method, limit=1.0)
        np.testing.assert_array_equal(some, np.where(everything <= 1.0, everything, np.inf))
        assert np.isinf(some).any() and np.isfinite(some).sum() > 10


def test_the_exact_method_agrees_with_pygeodesic():
    mesh = blob(2)
    sources = np.array([3, 100])
    expected = exact_distances(mesh, sources)
    np.testing.assert_allclose(geodesic_distances(mesh, sources, method="exact"), expected, rtol=1e-12)
    first, second = np.array([3, 100, 3, 7]), np.array([5, 3, 3, 100])
    np.testing.assert_allclose(
        geodesic_distances_between(mesh, first, second, method="exact"),
        [expected[0, 5], expected[1, 3], 0, expected[1, 7]],
        rtol=1e-12,
    )
    strips = geodesic_distances(mesh, sources)
    assert (strips > expected * (1 + 1e-6)).any()  # the default method is not the exact method


def test_the_exact_method_refuses_unsuitable_meshes():
    point = SurfacePoints(np.array([0]), np.array([[1.0, 0, 0]]))
    with pytest.raises(InputError, match="not to points on faces: use method='strips'"):
        geodesic_distances(CUBE, point, method="exact")
    with pytest.raises(InputError, match=r"edges with more than two faces \(6\): use"):
        geodesic_distances(book(3)[0], [0], method="exact")
    bowtie = make_mesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [-3, 0, 0], [0, 0, -4]], [[0, 1, 2], [0, 3, 4]], name="tie"
    )
    with pytest.raises(InputError, match=r"tie: .*join separate fans of faces \(1\): use"):
        geodesic_distances_between(bowtie, [0], [1], method="exact")
    sliver = make_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, -1e-9, 0]], [[0, 1, 2], [1, 0, 3]])
    with pytest.raises(InputError, match=r"almost without height \(1\): use"):
        geodesic_distances(sliver, [0], method="exact")


def test_distances_between_pairs_equal_those_of_the_full_table():
    mesh, generator = blob(), np.random.default_rng(0)
    distances = geodesic_distances(mesh, np.arange(642))
    for few, many in ((642, 642), (5, 642), (642, 5)):
        first, second = generator.integers(0, few, 2000), generator.integers(0, many, 2000)
        second[:500] = np.argsort(distances[first[:500]], axis=1)[:, 3]  # neighbours
        second %= many
        np.testing.assert_allclose(
            geodesic_distances_between(mesh, first, second), distances[first, second], rtol=1e-12
        )


def test_distances_between_pairs_do_not_store_the_full_table():
    mesh = blob(4)
    n = len(mesh.vertices)
    geodesic_graph(mesh)
    tracemalloc.start()
    geodesic_distances_between(mesh, mesh.edges[:, 0], mesh.edges[:, 1])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < n * n * 8 / 2


def test_points_at_corners_act_as_vertices():
    mesh, generator = blob(2), np.random.default_rng(0)
    corner = generator.integers(0, 3, 50)
    points = random_points(mesh, 50)
    points = SurfacePoints(points.faces, np.eye(3)[corner])
    vertices = mesh.faces[points.faces, corner]
    np.testing.assert_allclose(
        geodesic_distances(mesh, points), geodesic_distances(mesh, vertices), atol=1e-12
    )
    others = random_points(mesh, 50, seed=1)
    expected = geodesic_distances_between(mesh, vertices, others)
    np.testing.assert_allclose(geodesic_distances_between(mesh, points, others), expected, atol=1e-12)
    np.testing.assert_allclose(geodesic_distances_between(mesh, others, points), expected, atol=1e-12)


def test_distances_between_points_on_a_flat_sheet_are_euclidean():
    mesh = flat_sheet()
    points, others = random_points(mesh, 1500), random_points(mesh, 1500, seed=1)
    # Some points are on vertices or edges. Some pairs of points are on the same face, and some coincide.
    points.weights[:100], others.weights[:50] = [0, 1, 0], [0, 0, 1]
    points.weights[100:300], others.weights[200:400] = [0.3, 0, 0.7], [0.8, 0.2, 0]
    others.faces[300:600] = points.faces[300:600]
    others.faces[590:600], others.weights[590:600] = points.faces[590:600], points.weights[590:600]
    others.faces[600:900] = [
        np.flatnonzero(np.isin(mesh.faces, mesh.faces[f]).any(axis=1))[-1] for f in points.faces[600:900]
    ]
    expected = np.linalg.norm(points.positions(mesh) - others.positions(mesh), axis=1)
    distances = geodesic_distances_between(mesh, points, others)
    assert (distances - expected).min() > -1e-12
    assert (distances - expected)[300:900].max() < 1e-12  # exact if the faces share a vertex
    assert (distances / np.maximum(expected, 0.05) - 1).max() < 0.02
    np.testing.assert_allclose(geodesic_distances_between(mesh, others, points), distances, atol=1e-12)
    to_vertices = np.linalg.norm(points.positions(mesh)[:, None] - mesh.vertices, axis=2)
    error = geodesic_distances(mesh, points) - to_vertices
    assert error.min() > -1e-12 and (error / np.maximum(to_vertices, 0.05)).max() < 0.02


def test_distances_between_points_on_a_curved_surface_agree_with_exact_distances():
    mesh = blob()
    faces = np.random.default_rng(0).permutation(len(mesh.faces))[:40]
    for k in range(0, 20, 2):  # half of the pairs are on faces that share a corner or a side
        touching = np.isin(mesh.faces, mesh.faces[faces[k]]).sum(axis=1) == 1 + k // 2 % 2
        touching[faces] = False
        faces[k + 1] = np.flatnonzero(touching)[0]
    points = SurfacePoints(faces, random_points(mesh, 40).weights)
    first, second = np.arange(0, 40, 2), np.arange(1, 40, 2)
    finer = with_points_as_vertices(mesh, points)
    expected = exact_distances(finer, 642 + first)[np.arange(20), 642 + second]
    error = geodesic_distances_between(mesh, points[first], points[second]) / expected - 1
    assert error.min() > -1e-12 and error[:10].max() < 1e-12 and error.max() < 0.005


def test_a_straight_line_between_points_need_not_be_the_shortest_path():
    mesh = blob(1)
    points = SurfacePoints(np.arange(60), random_points(mesh, 60).weights)
    first, second = np.triu_indices(60, 1)
    expected = exact_distances(with_points_as_vertices(mesh, points), 42 + np.arange(60))[first, 42 + second]
    straight = geodesics._straight_distances(mesh, points[first], points[second])
    longer = np.isfinite(straight) & (straight > expected * 1.02)
    assert longer.sum() > 10
    distances = geodesic_distances_between(mesh, points[first], points[second])
    assert (distances >= expected * (1 - 1e-12)).all()
    assert (distances / expected)[longer].max() < 1.01


def test_distances_between_points_on_sheets_that_meet_in_an_edge():
    mesh, *_ = book(pages=3)
    near_spine = np.flatnonzero(np.isin(mesh.faces, np.unique(mesh.nonmanifold_edges)).sum(axis=1) == 2)
    first, second = np.array(np.meshgrid(near_spine, near_spine)).reshape(2, -1)
    weights = np.tile([0.2, 0.3, 0.5], (len(first), 1))
    points, others = SurfacePoints(first, weights), SurfacePoints(second, weights)

    def unrolled(where):
        """The distance from the spine, the position along the spine, and the angle of the page."""
        x, y, z = where.T
        return np.hypot(x, y), z, np.round(np.arctan2(y, x), 6)

    x, z, page = unrolled(points.positions(mesh))
    other_x, other_z, other_page = unrolled(others.positions(mesh))
    across = page != other_page
    expected = np.hypot(np.where(across, x + other_x, x - other_x), z - other_z)
    assert len(np.unique(page)) == 3
    distances = geodesic_distances_between(mesh, points, others)
    assert (distances - expected).min() > -1e-12
    assert (distances / np.maximum(expected, 1e-3) - 1).max() < 0.02
    close = across & (expected < 0.25)
    assert close.sum() > 50
    np.testing.assert_allclose(distances[close], expected[close], rtol=1e-12)


def test_distances_do_not_depend_on_the_other_points():
    mesh = flat_sheet(8)
    points, others = random_points(mesh, 400), random_points(mesh, 400, seed=1)
    together = geodesic_distances_between(mesh, points, others)
    for row in (np.array([k]) for k in range(0, 400, 29)):
        np.testing.assert_allclose(
            geodesic_distances_between(mesh, points[row], others[row]), together[row], rtol=1e-12
        )


def test_graphs_are_read_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path))
    mesh = blob(2)
    geodesic_graph.cache_clear()
    first = geodesic_distances(mesh, [0, 1])
    assert geodesic_graph(mesh, depth=2).nnz < geodesic_graph(mesh).nnz
    assert len(list(tmp_path.glob("geodesic-graph-*.npz"))) == 2
    geodesic_graph.cache_clear()
    monkeypatch.setattr(geodesics, "_unfold", None)  # a new computation would fail
    np.testing.assert_array_equal(geodesic_distances(mesh, [0, 1]), first)


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ([0, 642], r"vertex indices must lie between 0 and 641, but entry 1 is 642: subtract 1"),
        ([0, 7, 10**18], r"entry 2 is 1000000000000000000: correct it"),
        ([-1], r"entry 0 is -1"),
        ([0.0, 1.0], r"a list of integers, but are float64 of shape \(2,\)"),
        ([[0, 1]], r"a list of integers, but are int64 of shape \(1, 2\)"),
        ([True], "bool"),
        (SurfacePoints(np.array([1280]), np.array([[1.0, 0, 0]])), "face indices must lie .* 0 is 1280"),
        (SurfacePoints(np.array([5, 6]), np.array([[1.0, 0, 0], [2, 0, -1]])), "number 1 has .*at least 0"),
        (SurfacePoints(np.array([5]), np.array([[0.5, 0.4, 0]])), "sum to 1"),
        (SurfacePoints(np.array([5]), np.array([[np.nan, 0.5, 0.5]])), "nan"),
        (SurfacePoints(np.array([5]), np.array([[np.inf, 0.5, 0.5]])), "inf"),
    ],
)
def test_points_outside_the_mesh_are_refused(sources, message):
    mesh = blob()
    with pytest.raises(InputError, match=message):
        geodesic_distances(mesh, sources)
    with pytest.raises(InputError, match=message):
        geodesic_distances_between(mesh, np.zeros(1, dtype=np.int64), sources)


def test_every_point_needs_a_partner():
    with pytest.raises(InputError, match="there are 2 points and 3 partners"):
        geodesic_distances_between(CUBE, [0, 1], [0, 1, 2])


def test_an_unknown_method_is_refused(unchecked):
    for call in (
        lambda: geodesic_distances(CUBE, [0], method="heat"),
        lambda: geodesic_distances_between(CUBE, [0], [1], method="heat"),
    ):
        with refused("'heat'", "method", "strips, exact"):
            call()


def test_no_sources_give_no_distances():
    nothing = np.empty(0, dtype=np.int64)
    for method in ("strips", "exact"):
        assert geodesic_distances(CUBE, nothing, method=method).shape == (0, 8)
        assert geodesic_distances_between(CUBE, nothing, nothing, method=method).shape == (0,)
    none = SurfacePoints(nothing, np.empty((0, 3)))
    assert geodesic_distances(CUBE, none).shape == (0, 8)
    assert geodesic_distances_between(CUBE, none, none).shape == (0,)


def test_a_matrix_of_distances_is_read_from_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", str(tmp_path))
    monkeypatch.setattr(geodesics, "_ROWS_IN_CACHE", 30)
    mesh = make_mesh(*sphere_mesh(1))
    for method in ("exact", "strips"):
        matrix = geodesic_matrix(mesh, method=method)
        expected = geodesic_distances(mesh, np.arange(42), method=method)
        np.testing.assert_allclose(matrix, expected, rtol=1e-6)
        assert matrix.dtype == np.float32
    monkeypatch.setattr(geodesics, "geodesic_distances", lambda *_, **__: pytest.fail("was not cached"))
    np.testing.assert_array_equal(geodesic_matrix(mesh, method="strips"), matrix)
    assert len(list(tmp_path.glob("geodesic-rows-*.npz"))) == 4
