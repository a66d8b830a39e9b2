"""Surfaces of point clouds, and the files that contain point clouds."""

import struct

import numpy as np
import pytest
from messages import assert_names
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import InputError, creature_pair, geodesic_error, make_mesh, match, read_ground_truth, read_mesh
from jaxsmw.evaluation import GroundTruth
from jaxsmw.geometry import diagnose, triangulate_points
from jaxsmw.io import read_mesh_data, write_mesh
from jaxsmw.io.formats.pcd import lzf_decompressed

BUMPY = bumpy_mesh(4)
COARSE = bumpy_mesh(3)
POINTS = np.round(COARSE.vertices, 5)


_steps = np.linspace(0, 1, 3000)[:, None]
SKEW_LINES = np.concatenate([_steps * [1, 0, 0], [0, 0, 1] + _steps * [0, 1, 0]])


def triangles(mesh):
    return set(map(tuple, np.sort(mesh.faces, axis=1).tolist()))


def test_the_surface_of_a_body_is_closed_oriented_and_passes_through_all_points():
    cloud = triangulate_points(BUMPY.vertices, name="cloud")
    np.testing.assert_array_equal(cloud.vertices, BUMPY.vertices)
    found = diagnose(cloud)
    assert (found.boundary_edges, found.misoriented_edges, found.unreferenced_vertices) == (0, 0, 0)
    assert found.components == 1 and not cloud.is_inside_out
    assert cloud.area == pytest.approx(BUMPY.area, rel=0.01)
    assert ((cloud.vertex_normals * BUMPY.vertex_normals).sum(axis=1) > 0.9).mean() > 0.99
    assert cloud.notes == (f"A point cloud without faces: {len(cloud.faces)} triangles join the points.",)


def test_order_place_and_unit_do_not_matter():
    order = np.random.default_rng(0).permutation(len(BUMPY.vertices))
    turn = Rotation.random(random_state=1)
    moved = triangulate_points(1e-3 * turn.apply(BUMPY.vertices)[order] + 7)
    renumbered = {tuple(sorted(order[list(face)])) for face in triangles(moved)}
    expected = triangles(triangulate_points(BUMPY.vertices))
    assert len(renumbered ^ expected) < 0.01 * len(expected)


def test_sheets_that_nearly_touch_stay_apart():
    """Two balls have a gap of half the distance between neighbouring points."""
    ball = make_mesh(BUMPY.vertices / np.linalg.norm(BUMPY.vertices, axis=1, keepdims=True), BUMPY.faces)
    spacing = np.median(np.linalg.norm(np.diff(ball.vertices[ball.edges], axis=1)[:, 0], axis=1))
    turn = Rotation.from_euler("z", 0.3)
    other = turn.apply(ball.vertices) + np.array([2 + 0.5 * spacing, 0, 0])
    cloud = triangulate_points(np.concatenate([ball.vertices, other]))
    n = len(ball.vertices)
    joined = ((cloud.faces < n).any(axis=1) & (cloud.faces >= n).any(axis=1)).mean()
    assert joined < 0.01
    normals = np.concatenate([ball.vertex_normals, turn.apply(ball.vertex_normals)])
    assert ((cloud.vertex_normals * normals).sum(axis=1) > 0).mean() > 0.99


def test_noise_and_outliers_keep_the_shape():
    generator = np.random.default_rng(0)
    edge = np.median(np.linalg.norm(np.diff(BUMPY.vertices[BUMPY.edges], axis=1)[:, 0], axis=1))
    noisy = BUMPY.vertices + 0.2 * edge * generator.normal(size=BUMPY.vertices.shape)
    outliers = 1.5 * np.ptp(BUMPY.vertices, axis=0).max() * generator.uniform(-1, 1, (10, 3))
    cloud = triangulate_points(np.concatenate([noisy, outliers]))
    assert cloud.area == pytest.approx(BUMPY.area, rel=0.15)
    assert not cloud.referenced_vertices[len(noisy) :].any()
    assert cloud.referenced_vertices[: len(noisy)].mean() > 0.85
    used = cloud.referenced_vertices[: len(noisy)]
    agree = (cloud.vertex_normals[: len(noisy)] * BUMPY.vertex_normals).sum(axis=1)[used] > 0
    assert agree.mean() > 0.98


def test_a_wide_opening_stays_open():
    kept = BUMPY.vertices[:, 2] < 0.3 * BUMPY.vertices[:, 2].max()
    cloud = triangulate_points(BUMPY.vertices[kept])
    inner = make_mesh(BUMPY.vertices, BUMPY.faces[kept[BUMPY.faces].all(axis=1)])
    assert cloud.area == pytest.approx(inner.area, rel=0.03)
    # Larger triangles fill the teeth of the jagged boundary.
    assert len(cloud.boundary_edges) > len(inner.boundary_edges) / 3
    assert cloud.vertices[cloud.boundary_edges][..., 2].min() > 0.8 * BUMPY.vertices[kept, 2].max()


@pytest.mark.parametrize("sign", [1, -1])
def test_normals_of_either_sign_give_the_same_surface(sign):
    plain = triangulate_points(BUMPY.vertices)
    guided = triangulate_points(BUMPY.vertices, 5 * sign * BUMPY.vertex_normals)
    assert not guided.is_inside_out
    assert len(triangles(plain) ^ triangles(guided)) < 0.02 * len(plain.faces)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_normals_without_a_direction_are_ignored(value):
    normals = np.full_like(BUMPY.vertices, value)
    cloud = triangulate_points(BUMPY.vertices, normals)
    assert triangles(cloud) == triangles(triangulate_points(BUMPY.vertices))
    assert_names(cloud.notes[0], "normals ignored", "2562", "without a direction")
    normals[:2000] = BUMPY.vertex_normals[:2000]
    assert triangulate_points(BUMPY.vertices, normals).area == pytest.approx(cloud.area, rel=0.05)


def test_points_without_a_position_and_repeated_points_keep_their_numbers():
    n = len(BUMPY.vertices)
    points = np.concatenate([BUMPY.vertices, BUMPY.vertices[:50], np.full((40, 3), np.nan), [[1e30, 0, 0]]])
    cloud = triangulate_points(points)
    assert len(cloud.vertices) == len(points)
    assert not cloud.referenced_vertices[n:].any() and cloud.referenced_vertices[:n].all()
    assert np.isfinite(cloud.vertices).all()
    assert any(note == "41 points without a usable position." for note in cloud.notes)


@pytest.mark.parametrize(
    ("points", "normals", "fault"),
    [
        (np.zeros((100, 3)), None, "1 different point cannot represent a surface"),
        (BUMPY.vertices[:19], None, "19 different points cannot represent a surface"),
        (np.full((100, 3), np.nan), None, "cannot represent a surface"),
        (np.random.default_rng(0).normal(size=(100, 3)) * [1, 1, 0], None, "only 0% of the points lie on"),
        (np.arange(300.0).reshape(100, 3), None, "only 0% of the points lie on"),
        (np.stack(np.mgrid[:9, :9, :9], axis=-1).reshape(-1, 3), None, "may fill a volume"),
        (SKEW_LINES, None, "on a line"),
        (1e308 * BUMPY.vertices, None, "choose another unit"),
        (BUMPY.vertices[:, :2], None, "must be a numeric array of shape"),
        (BUMPY.vertices, BUMPY.vertex_normals[1:], "give one normal for each point"),
    ],
    ids=["equal", "few", "not finite", "plane", "line", "volume", "two lines", "huge", "columns", "normals"],
)
def test_clouds_without_a_surface_are_refused(points, normals, fault, unchecked):
    with pytest.raises(InputError, match=fault) as refused:
        triangulate_points(points, normals, name="c.xyz")
    assert str(refused.value).startswith("c.xyz: ") and str(refused.value).count("\n") == 0


@pytest.mark.slow
def test_two_clouds_are_matched():
    pair = creature_pair(vertices=1000)
    clouds = [triangulate_points(mesh.vertices, name=mesh.name) for mesh in (pair.source, pair.target)]
    found = match(*clouds)
    error = geodesic_error(pair.target, found.pointwise_map, GroundTruth.of_all_vertices(pair.truth))
    assert error.mean < 0.03


@pytest.mark.sampled
def test_real_clouds_are_matched_like_meshes(shared):
    directory = shared / "data" / "faust_r"
    files = [directory / "off" / f"tr_reg_0{number}.off" for number in (30, 50)]
    meshes = [read_mesh(file) for file in files]
    truth = read_ground_truth([directory / "corres" / f"{file.stem}.vts" for file in files], *meshes)
    clouds = [triangulate_points(mesh.vertices) for mesh in meshes]
    found = [match(*pair, preset="fast") for pair in (meshes, clouds)]
    errors = [geodesic_error(meshes[1], each.pointwise_map, truth).mean for each in found]
    assert errors[1] < 1.5 * errors[0]


# ---- Files


def lines(table, separator=" "):
    return "".join(separator.join(map(repr, row)) + "\n" for row in np.asarray(table).tolist())


def pcd(encoding, body, fields="x y z", sizes="4 4 4", types="F F F", points=642, extra=""):
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n{extra}"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {encoding}\n"
    )
    return header.encode() + body


def lzf(data):
    """Compress data as literals, with one copy of the first 12 bytes at the start."""
    packed = b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))
    return struct.pack("<II", len(packed), len(data)) + packed


COLUMNS = POINTS.astype("<f4")
NPY_NAMES = {
    "points.npy": POINTS,
    "whole.npy": np.rint(1000 * POINTS).astype(int),
    "f.npy": np.asfortranarray(POINTS),
}
FILES = {
    "spaces.xyz": lines(POINTS).encode(),
    "commas.xyz": ("x, y, z\n" + lines(POINTS, ", ")).encode(),
    "tabs and count.xyz": (f"{len(POINTS)}\r\n" + lines(POINTS, "\t").replace("\n", "\r\n")).encode(),
    "decimal commas.xyz": (lines(POINTS, ";").replace(".", ",")).encode(),
    "decimal commas and tabs.xyz": (lines(POINTS, "\t").replace(".", ",")).encode(),
    "comments.xyz": ("# scanned\n" + lines(POINTS) + "\n\n").encode(),
    "colours.xyz": lines(np.hstack([POINTS, np.full((len(POINTS), 3), 128)])).encode(),
    "text.pcd": pcd("ascii", lines(POINTS).encode()),
    "binary.pcd": pcd("binary", COLUMNS.tobytes()),
    "padded.pcd": pcd(
        "binary",
        np.concatenate([COLUMNS, np.ones((len(POINTS), 2), "<f4")], axis=1).tobytes(),
        "x y z _ rgb", "4 4 4 1 4", "F F F U U", extra="COUNT 1 1 1 4 1\n",
    ),
    "packed.pcd": pcd("binary_compressed", lzf(np.ascontiguousarray(COLUMNS.T).tobytes())),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_files_of_points_are_read(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name])
    mesh = read_mesh(tmp_path / name)
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=1e-6)
    assert triangles(mesh) == triangles(triangulate_points(mesh.vertices))
    ignored = [note for note in mesh.notes if "columns ignored: 4 to 6" in note.casefold()]
    assert len(ignored) == (name == "colours.xyz")


@pytest.mark.parametrize("name", NPY_NAMES)
def test_arrays_are_read(tmp_path, name):
    np.save(tmp_path / name, NPY_NAMES[name])
    np.testing.assert_array_equal(read_mesh(tmp_path / name).vertices, NPY_NAMES[name])


@pytest.mark.parametrize("suffix", [".ply", ".off", ".obj", ".vtk", ".vtp"])
def test_mesh_files_without_faces_are_point_clouds(tmp_path, suffix):
    path = tmp_path / f"m{suffix}"
    write_mesh(path, COARSE)
    content = path.read_bytes()
    if suffix == ".ply":
        header, _, body = content.partition(b"end_header\n")
        header = header[: header.index(b"element face")]
        content = header + b"end_header\n" + body[: 24 * len(COARSE.vertices)]
    elif suffix == ".off":
        rows = content.decode().split("\n")
        content = "\n".join(
            ["OFF", f"{len(COARSE.vertices)} 0 0", *rows[2 : 2 + len(COARSE.vertices)], ""]
        ).encode()
    elif suffix == ".obj":
        content = b"\n".join(line for line in content.split(b"\n") if not line.startswith(b"f "))
    else:
        vtk = pytest.importorskip("vtk")
        from vtk.util.numpy_support import numpy_to_vtk

        cloud, places = vtk.vtkPolyData(), vtk.vtkPoints()
        places.SetData(numpy_to_vtk(COARSE.vertices, deep=True))
        cloud.SetPoints(places)
        writer = vtk.vtkPolyDataWriter() if suffix == ".vtk" else vtk.vtkXMLPolyDataWriter()
        writer.SetFileName(str(path))
        writer.SetInputData(cloud)
        writer.Write()
        content = path.read_bytes()
    path.write_bytes(content)
    data = read_mesh_data(path)
    np.testing.assert_allclose(data.mesh.vertices, COARSE.vertices, rtol=1e-6)
    assert len(data.mesh.faces) > 1.9 * len(COARSE.vertices)
    np.testing.assert_array_equal(data.faces, data.mesh.faces)


def test_data_of_no_faces_are_dropped(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 642\n" + "".join(f"property double {a}\n" for a in "xyzst")
    head += "element face 0\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    (tmp_path / "c.ply").write_text(head + lines(np.hstack([POINTS, POINTS[:, :2]])))
    data = read_mesh_data(tmp_path / "c.ply")
    assert data.texture is None and not data.face_data and len(data.faces) > 1250


def test_normals_and_fields_are_kept(tmp_path):
    rows = np.hstack([POINTS, COARSE.vertex_normals])
    (tmp_path / "n.xyz").write_text(lines(rows))
    np.testing.assert_array_equal(
        read_mesh_data(tmp_path / "n.xyz").vertex_data["normals"], COARSE.vertex_normals
    )
    fields = "x y z normal_x normal_y normal_z curvature"
    table = np.hstack([rows, np.arange(len(rows))[:, None]])
    (tmp_path / "n.pcd").write_bytes(pcd("ascii", lines(table).encode(), fields, "4 " * 7, "F " * 7))
    data = read_mesh_data(tmp_path / "n.pcd").vertex_data
    np.testing.assert_array_equal(data["normals"], COARSE.vertex_normals)
    np.testing.assert_array_equal(data["curvature"], np.arange(len(rows)))


def test_lzf_copies_overlap_their_own_end():
    assert lzf_decompressed(bytes([2]) + b"abc" + bytes([(3 << 5), 2]), 8) == b"abcabcab"
    assert lzf_decompressed(bytes([0]) + b"a" + bytes([7 << 5, 3, 0]), 13) == b"a" * 13


HOSTILE = {
    "empty.xyz": (b"", "is empty"),
    "header only.xyz": (b"x y z\n", "contains no points"),
    "two columns.xyz": (b"1 2 3\n" * 30 + b"1 2\n", "is written where 3 numbers should be"),
    "damaged first.xyz": (b"1O 2 3\n" + b"1 2 3\n" * 30, "'1O 2 3' is written where"),
    "wrong count.xyz": (b"900\n" + b"1 2 3\n" * 30, "declares 900 points, but 30 lines follow"),
    "utf-16.xyz": (lines(POINTS).encode("utf-16"), "not a text file in ASCII or UTF-8"),
    "words.xyz": (b"1 2 3\n" * 30 + b"a b c\n", "'a b c' is written where"),
    "few.xyz": (b"1 2 3\n0 0 1\n", "2 different points cannot represent a surface"),
    "nan.xyz": (b"nan nan nan\n" * 30, "cannot represent a surface"),
    "binary.xyz": (bytes(range(256)) * 4, "not a text file"),
    "empty.npy": (b"", "is empty"),
    "text.npy": (b"1 2 3\n" * 30, "is not an array saved by NumPy"),
    "no data.pcd": (b"FIELDS x y z\n", "no line DATA"),
    "empty.pcd": (b"", "is empty"),
    "no header.pcd": (b"DATA ascii\n" + lines(POINTS).encode(), "the header is damaged"),
    "no z.pcd": (pcd("ascii", lines(POINTS[:, :2]).encode(), "x y", "4 4", "F F"), "no field z"),
    "short.pcd": (pcd("ascii", lines(POINTS[1:]).encode()), "is followed by"),
    "short binary.pcd": (pcd("binary", COLUMNS.tobytes()[:-1]), "the file ends earlier"),
    "word.pcd": (pcd("ascii", lines(POINTS[1:]).encode() + b"a b c\n"), "'a b c' is written where"),
    "unknown data.pcd": (pcd("zip", COLUMNS.tobytes()), "the header is damaged"),
    "unknown type.pcd": (pcd("binary", COLUMNS.tobytes(), types="F F X"), "the header is damaged"),
    "unknown size.pcd": (pcd("binary", COLUMNS.tobytes(), sizes="4 4 3"), "the header is damaged"),
    "huge size.pcd": (pcd("binary", COLUMNS.tobytes(), sizes=f"4 4 {2**70}"), "the header is damaged"),
    "huge count.pcd": (pcd("binary", COLUMNS.tobytes(), extra=f"COUNT 1 1 {2**40}\n"), "the header is damaged"),
    "huge text count.pcd": (
        pcd("ascii", b"1 2 3\n", points=1, extra="COUNT 1 1 300000000\n"), "the first point has 3 numbers"
    ),
    "no count.pcd": (pcd("binary", COLUMNS.tobytes(), extra="COUNT 0 0 0\n"), "the header is damaged"),
    "two x.pcd": (
        pcd("binary", np.repeat(COLUMNS, 2, axis=1).tobytes(), extra="COUNT 2 2 2\n"), "has no field x with one"
    ),
    "packed cut.pcd": (pcd("binary_compressed", lzf(bytes(12))[:-1], points=1), "ends within the compressed"),
    "packed large.pcd": (
        pcd("binary_compressed", struct.pack("<II", 1, 12 * 2**25) + b"a", points=2**25), "384 MiB of compressed"
    ),
    "negative.pcd": (pcd("binary", b"", points=-4), "the header is damaged"),
    "2^60 points.pcd": (pcd("binary", COLUMNS.tobytes(), points=2**60), "the file ends earlier"),
    "2^60 packed.pcd": (pcd("binary_compressed", lzf(bytes(12)), points=2**60), "the file is damaged"),
    "packed short.pcd": (pcd("binary_compressed", lzf(bytes(12)), points=2), "the file is damaged"),
    "packed damaged.pcd": (
        pcd("binary_compressed", struct.pack("<II", 2, 12) + bytes([255, 255]), points=1),
        "damaged compressed points",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(tmp_path, name):
    content, fault = HOSTILE[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as refused:
        read_mesh(tmp_path / name)
    message = str(refused.value)
    assert message.startswith(f"{tmp_path / name}: ") and fault in message and message.endswith(".")
    assert "\n" not in message and len(message) < 400


@pytest.mark.parametrize(
    "array",
    [np.zeros((30, 2)), np.zeros(30), np.zeros((30, 3), complex), np.array([["a"] * 3] * 30)],
    ids=str,
)
def test_other_arrays_are_refused(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match="contains an array of"):
        read_mesh(tmp_path / "a.npy")


def test_arrays_of_objects_are_not_loaded(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="pickled objects"):
        read_mesh(tmp_path / "a.npy")
