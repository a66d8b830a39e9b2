"""Ground truth is read in all formats, bad files are refused, and geodesic errors and curves are correct."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from messages import assert_names, refused
from synthetic import bumpy_mesh, grid_mesh

from jaxsmw import InputError, make_mesh, read_mesh
from jaxsmw.evaluation.ground_truth import (
    GroundTruth,
    read_ground_truth,
    read_true_overlap,
    write_ground_truth,
)
from jaxsmw.evaluation.metrics import GeodesicError, OverlapScores, coverage, geodesic_error, overlap_scores
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.surface_points import SurfacePoints
from jaxsmw.io.maps import read_landmarks, read_pointwise_map, write_pointwise_map

# X has 4 vertices and 2 faces. Y has 9 vertices and 8 faces.
X = make_mesh(*grid_mesh(2, 2), name="mesh_x")
Y = make_mesh(*grid_mesh(3, 3), name="mesh_y")


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("JAXSMW_CACHE", "off")


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file and returns its path."""

    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


class TestReading:
    def test_a_pair_of_vts_files_counts_from_1(self, write):
        paths = write("x.vts", "4\n1\n1\n"), write("y.vts", "9\r\n2\r\n3\r\n\r\n")
        truth = read_ground_truth(paths, X, Y)
        assert truth.source_vertices.tolist() == [3, 0, 0] and truth.targets.tolist() == [8, 1, 2]

    def test_vertices_without_a_counterpart_are_left_out(self, write):
        for path in (write("x_y.vts", "8\n-1\n0\n-1\n"), write("x_y.map", "8\n-1\n0\n-1\n")):
            truth = read_ground_truth(path, X, Y)
            assert truth.source_vertices.tolist() == [0, 2] and truth.targets.tolist() == [8, 0]
        truth = read_ground_truth(write("x_y.vts", "9\n-1\n1\n-1\n"), X, Y, index_base=1)
        assert truth.source_vertices.tolist() == [0, 2] and truth.targets.tolist() == [8, 0]
        truth = read_ground_truth(write("x_y.vts", "8\n1\n0\n2\n"), X, Y, index_base=0)
        assert truth.targets.tolist() == [8, 1, 0, 2]
        with pytest.raises(InputError, match="line 2: -1 is not one of the vertices of mesh_y"):
            read_ground_truth(write("truth.txt", "8\n-1\n0\n1\n"), X, Y)

    def test_gaps_between_true_points_are_closed(self, write):
        mesh = make_mesh(*grid_mesh(7, 7), name="fine")
        corners = [16, 18, 30, 32]  # the square between them has side 2
        path = write("x_y.vts", "".join(f"{corner}\n" for corner in corners))
        mask_x, mask_y = read_true_overlap(path, X, mesh)
        assert mask_x.all() and mask_y[corners].all()
        square = [16, 17, 18, 23, 24, 25, 30, 31, 32]
        assert mask_y[24] and set(np.flatnonzero(mask_y)) <= set(square)
        reverse = write("y_x.vts", "-1\n" * 48 + "3\n")
        assert np.flatnonzero(read_true_overlap(path, X, mesh, reverse=reverse)[1]).tolist() == [48]

    def test_pair_with_other_suffixes_counts_from_0(self, write):
        paths = write("x.txt", "3\n0\n0\n"), write("y.txt", "8\n1\n2\n")
        truth = read_ground_truth(paths, X, Y)
        assert truth.source_vertices.tolist() == [3, 0, 0] and truth.targets.tolist() == [8, 1, 2]

    def test_one_column_has_a_match_for_each_vertex(self, write):
        path = write("truth.txt", "  8\n 1 \n1e0\n2.0")
        truth = read_ground_truth(path, X, Y)
        assert truth.source_vertices.tolist() == [0, 1, 2, 3] and truth.targets.tolist() == [8, 1, 1, 2]
        assert read_ground_truth(str(path), X, Y, index_base=1).targets.tolist() == [7, 0, 0, 1]
        assert read_ground_truth([path], X, Y).targets.tolist() == [8, 1, 1, 2]

    def test_unreferenced_vertices_are_left_out(self, write):
        """The mesh of a partial shape may still contain all vertices of the full shape."""
        part = make_mesh(X.vertices, X.faces[:1], name="part")
        path = write("truth.txt", "8\n1\n2\n3\n")
        with pytest.warns(UserWarning, match=r"truth.txt: 1 of 4 points are vertices that no face of part"):
            truth = read_ground_truth(path, part, Y)
        assert truth.source_vertices.tolist() == sorted(X.faces[0]) and len(truth.targets) == 3
        (left_out,) = set(range(4)) - set(X.faces[0].tolist())
        with refused("no face", "part", "ground truth of this mesh"):
            read_ground_truth(write("one.txt", f"{left_out} 0\n"), part, Y, index_base=0)

    def test_two_columns_are_pairs_of_vertices(self, write):
        path = write("kid01_ref.txt", "\ufeff     1      9 \n     4      1 \n")
        truth = read_ground_truth(path, X, Y)
        assert truth.source_vertices.tolist() == [0, 3] and truth.targets.tolist() == [8, 0]
        path = write("kid01_ref.txt", "0\t8\n3\t0\n")
        truth = read_ground_truth(path, X, Y, index_base=0)
        assert truth.source_vertices.tolist() == [0, 3] and truth.targets.tolist() == [8, 0]

    @pytest.mark.parametrize("suffix", ["baryc_gt", "baryc_gt_sym"])
    def test_barycentric_files_give_surface_points(self, write, suffix):
        lines = "   8.0000000e+00   -1.4e-16  2.5e-01   7.5e-01\n1 1 0 0\n2 .25 .5 .25\n1 0.33333 0.33333 0.33333\n"
        truth = read_ground_truth(write(f"part.{suffix}", lines), X, Y)
        assert truth.source_vertices.tolist() == [0, 1, 2, 3]
        assert truth.targets.faces.tolist() == [7, 0, 1, 0]
        expected = [[0, 0.25, 0.75], [1, 0, 0], [0.25, 0.5, 0.25], [1 / 3] * 3]
        np.testing.assert_allclose(truth.targets.weights, expected, rtol=1e-12)
        assert (truth.targets.weights >= 0).all()

    def test_barycentric_files_also_count_dropped_faces(self, write):
        vertices, faces = grid_mesh(3, 3)
        doubled = np.concatenate([faces[:3], faces[2:3, ::-1], faces[3:], faces[:1]])
        mesh = make_mesh(vertices, doubled, name="doubled")
        assert mesh.dropped_faces.tolist() == [3, 9]
        lines = "3 1 0 0\n5 0 1 0\n9 .5 .5 0\n1 0 0 1\n"
        truth = read_ground_truth(write("t.baryc_gt", lines), X, mesh)
        assert (mesh.faces[truth.targets.faces] == doubled[[2, 4, 8, 0]]).all()
        with pytest.raises(InputError, match="line 2: face 4 was dropped from doubled"):
            read_ground_truth(write("t.baryc_gt", lines.replace("5 0", "4 0")), X, mesh)
        with pytest.raises(InputError, match=r"line 2: 11 is not one of .* numbered 1 to 10"):
            read_ground_truth(write("t.baryc_gt", lines.replace("5 0", "11 0")), X, mesh)

    def test_pointwise_map_round_trip(self, tmp_path):
        path = tmp_path / "a.map"
        for pointwise_map in (np.array([8, 0, 0, 3]), np.array([1, 2, 3, 4], dtype=np.uint16), [0, 0, 0, 0]):
            write_pointwise_map(path, pointwise_map)
            assert path.read_bytes() == "".join(f"{i}\n" for i in pointwise_map).encode()
            result = read_pointwise_map(path, X, Y)
            assert result.dtype == np.int64 and (result == pointwise_map).all()
        write_pointwise_map(path, [9, 1, 1, 2])
        assert read_pointwise_map(path, X, Y, index_base=1).tolist() == [8, 0, 0, 1]
        assert [entry.name for entry in tmp_path.iterdir()] == ["a.map"]

    @pytest.mark.parametrize(
        "suffix",
        [
            ".png",
            ".JPG",
            ".svg",
            ".pdf",
            ".html",
            ".json",
            ".ply",
            ".off",
            ".glb",
            ".pcd",
            ".fcsv",
            ".mps",
        ],
    )
    def test_names_of_other_kinds_of_files_are_refused(self, tmp_path, suffix):
        with pytest.raises(
            InputError, match=f"not as {suffix.lower()}: choose a name with another suffix, such"
        ):
            write_pointwise_map(tmp_path / f"a{suffix}", [8, 0, 0, 3])
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("name", ["a.txt", "a.csv", "a.map", "a.npy", "a.mat", "a", "a.corr", "a.v2"])
    def test_maps_have_any_other_suffix(self, tmp_path, name):
        write_pointwise_map(tmp_path / name, [8, 0, 0, 3])
        assert read_pointwise_map(tmp_path / name, X, Y).tolist() == [8, 0, 0, 3]

    @given(st.lists(st.integers(0, 8), min_size=4, max_size=4))
    def test_any_map_survives_the_round_trip(self, tmp_path_factory, values):
        path = tmp_path_factory.getbasetemp() / "any.map"
        write_pointwise_map(path, values)
        assert read_pointwise_map(path, X, Y).tolist() == values

    def test_ground_truth_round_trip(self, tmp_path):
        generator = np.random.default_rng(0)
        points = SurfacePoints(generator.integers(0, 8, 4), generator.dirichlet([0.1, 0.1, 0.1], 4))
        points.weights[0] = [0, 1, 0]
        write_ground_truth(tmp_path / "truth.baryc_gt", GroundTruth.of_all_vertices(points), Y)
        truth = read_ground_truth(tmp_path / "truth.baryc_gt", X, Y)
        assert (truth.targets.faces == points.faces).all() and (truth.source_vertices == np.arange(4)).all()
        np.testing.assert_allclose(truth.targets.weights, points.weights, rtol=1e-15)
        others = (
            GroundTruth(np.array([1, 0]), points[np.arange(2)]),
            GroundTruth.of_all_vertices(np.arange(4)),
        )
        for other in others:
            with pytest.raises(InputError, match="needs a point on a face for each"):
                write_ground_truth(tmp_path / "other.baryc_gt", other, Y)

    def test_faces_are_numbered_as_in_the_file_of_the_mesh(self, tmp_path):
        repeated = make_mesh(Y.vertices, np.vstack([Y.faces[:1], [[0, 0, 1]], Y.faces]))
        assert len(repeated.faces) == len(Y.faces)
        points = SurfacePoints(np.array([0, 1, 7, 2]), np.full((4, 3), 1 / 3))
        path = tmp_path / "truth.baryc_gt"
        write_ground_truth(path, GroundTruth.of_all_vertices(points), repeated)
        assert [line.split()[0] for line in path.read_text().splitlines()] == ["1", "4", "10", "5"]
        assert (read_ground_truth(path, X, repeated).targets.faces == points.faces).all()

    def test_landmarks_are_pairs_of_vertices(self, write):
        path = write("landmarks.txt", "0 8\n3 0\n")
        assert read_landmarks(path, X, Y).tolist() == [[0, 8], [3, 0]]
        assert read_landmarks(write("l.txt", "4 1"), X, Y, index_base=1).tolist() == [[3, 0]]
        for content, message in (
            ("0\n", "has 1 number instead of 2"),
            ("4 0\n", "4 is not one .* of mesh_x"),
            ("0 8\n3,0\n", "line 2: '3,0' is not a number: separate numbers with spaces, not with ','"),
            ("1_0 8\n", "line 1: '1_0' is not a number: correct the line"),
        ):
            with pytest.raises(InputError, match=message):
                read_landmarks(write("l.txt", content), X, Y)

    @pytest.mark.slow
    def test_real_files_are_read(self, shared):
        data = shared / "data"

        def mesh(path):
            return read_mesh(data / path)

        for directory, names, rows in (
            ("faust_r", ("tr_reg_002", "tr_reg_007"), 5000),
            ("tosca_nonisometric", ("8_gorilla_01", "8_gorilla_02"), 900),
        ):
            x, y = (mesh(f"{directory}/off/{name}.off") for name in names)
            for suffix in (".vts", ".sym.vts"):
                paths = [data / directory / "corres" / f"{name}{suffix}" for name in names]
                assert len(read_ground_truth(paths, x, y).targets) == rows
        kid = mesh("shrec16_topology/kid01.off"), mesh("shrec16_topology/kid00.off")
        truth = read_ground_truth(data / "shrec16_topology/kid01_ref.txt", *kid)
        assert truth.source_vertices.tolist() == list(range(8608)) and truth.targets[:3].tolist() == [
            2,
            1,
            10724,
        ]
        part = mesh("shrec16_partial/holes/holes_dog_shape_1.off")
        null = mesh("shrec16_partial/null/dog.off")
        paths = [data / f"shrec16_partial/holes/holes_dog_shape_1.baryc_gt{end}" for end in ("", "_sym")]
        direct, mirrored = (read_ground_truth(path, part, null).targets.positions(null) for path in paths)
        # The dog stands upright and looks straight ahead, so its mirrored ground truth is a reflection.
        assert len(direct) == len(part.vertices)
        spread = np.abs(direct - mirrored).max(axis=0) / np.ptp(null.vertices, axis=0)
        assert spread.max() > 0.5


class TestBadFiles:
    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("", "is empty"),
            ("\n \n", "is empty"),
            ("\n1\n2\n3\n4\n", "begins with an empty line"),
            (b"\x00\x01\x02\x03", "is not a text file"),
            (b"\x89PNG\r\n\x1a\n\xff\xfe", "is not a text file"),
            ("1\n2\n3\n", "has 3 lines, but needs one for each of the 4 vertices"),
            ("1\n2\n3\n4\n5\n", "has 5 lines"),
            ("1\n\n3\n4\n", "line 2: has 0 numbers instead of 1"),
            ("1\n2 3\n3\n4\n", "line 2: has 2 numbers instead of 1"),
            ("1\n2\n3.5\n4\n", "line 3: 3.5 is not one of the vertices of"),
            ("1\n2\n-3\n4\n", "line 3: -3 is not one of"),
            ("1\n9\n3\n4\n", "line 2: 9 is not one of .*looks 1-based: pass index_base=1[.]"),
            ("0\n9\n3\n4\n", "line 2: 9 is not one of .*0 to 8: correct the number"),
            ("1\n2\n3\n12\n", "line 4: 12 is not one of .*0 to 8: correct the number"),
            ("1\n2\n3\n99999999999999999999999999\n", "line 4: 9999999999.* is not one of"),
            ("1\n2\n3\n1e999\n", "line 4: 1e999 is not one of"),
            ("1\n2\nnan\n4\n", "line 3: 'nan' is not a number"),
            ("1\n2\ninf\n4\n", "line 3: 'inf' is not a number"),
            ("1\n2\n0x3\n4\n", "line 3: '0x3' is not a number"),
            ("1\n2\n1_0\n4\n", "line 3: '1_0' is not a number"),
            ("1\n2\n٣\n4\n", "line 3: '.u0663' is not a number"),
            ("1,\n2,\n3,\n4\n", "line 1: '1,' is not a number: separate numbers with spaces, not with ','"),
            ("1;2\n2\n3\n4\n", "line 1: '1;2' is not a number: separate numbers with spaces, not with ';'"),
            ("vertex\n1\n2\n3\n4", "line 1: 'vertex' is not a number"),
        ],
    )
    def test_bad_pointwise_maps_are_refused(self, write, content, message):
        path = write("bad.map", content)
        with pytest.raises(InputError, match=message) as raised:
            read_pointwise_map(path, X, Y)
        assert str(raised.value).startswith(str(path))
        with pytest.raises(InputError, match=message if "numbers instead" not in message else None):
            read_ground_truth(path, X, Y)

    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("x.vts", "1\n2\n", "x.vts: describes only one shape"),
            ("t.txt", "1 2 3\n", "line 1: has 3 numbers: give a file with one per line"),
            ("t.txt", "1 2\n3\n", "line 2: has 1 number instead of 2"),
            (
                "t.txt",
                "1 9\n5 1\n",
                "line 2: 5 is not one of the vertices of mesh_x, which are numbered 1 to 4",
            ),
            ("t.txt", "1 9\n4 10\n", "line 2: 10 is not one of the vertices of mesh_y, .* 1 to 9: correct"),
            ("t.txt", "0 8\n3 1\n", "line 1: 0 is not one of .*looks 0-based: pass index_base=0"),
            ("t.baryc_gt", "1 1 0 0\n" * 3, "has 3 lines, but needs one for each of the 4 .*of mesh_x"),
            ("t.baryc_gt", "1 1 0\n" * 4, "line 1: has 3 numbers instead of 4"),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "9 1 0 0\n", "line 4: 9 is not one of the faces of mesh_y"),
            (
                "t.baryc_gt",
                "1 1 0 0\n" * 3 + "0 1 0 0\n",
                "line 4: 0 is not one of the faces .*looks 0-based",
            ),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "1.5 1 0 0\n", "line 4: 1.5 is not one of the faces"),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "1 .5 .4 0\n", "line 4: .5 .4 0 are not barycentric weights"),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "1 2 -1 0\n", "line 4: 2 -1 0 are not barycentric weights"),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "1 1e999 0 0\n", "line 4: 1e999 0 0 are not barycentric"),
            ("t.baryc_gt", "1 1 0 0\n" * 3 + "1 NaN 0 1\n", "line 4: 'NaN' is not a number"),
        ],
    )
    def test_bad_ground_truth_is_refused(self, write, name, content, message):
        with pytest.raises(InputError, match=message):
            read_ground_truth(write(name, content), X, Y)

    def test_bad_pairs_of_files_are_refused(self, write):
        one, two = write("x.vts", "1\n2\n"), write("y.vts", "1\n2\n3\n")
        with pytest.raises(InputError, match=r"y.vts: has 3 lines and .*x.vts has 2"):
            read_ground_truth([one, two], X, Y)
        with pytest.raises(InputError, match=r"x.vts, line 1: has 2 numbers instead of 1"):
            read_ground_truth([write("x.vts", "1 2\n2 3\n"), one], X, Y)
        with pytest.raises(InputError, match="4 files were given"):
            read_ground_truth([one, two, two, two], X, Y)
        with refused("y.vts, line 1", "9", "vertices of mesh_x"):
            read_ground_truth([write("y.vts", "9\n"), write("x.vts", "1\n")], X, Y)

    def test_files_that_cannot_be_read_or_written_are_refused(self, tmp_path):
        with pytest.raises(InputError, match="missing: does not exist"):
            read_pointwise_map(tmp_path / "missing", X, Y)
        with pytest.raises(InputError, match="is not a regular file"):
            read_ground_truth(tmp_path, X, Y)
        with pytest.raises(InputError, match="cannot be written"):
            write_pointwise_map(tmp_path / "missing" / "a.map", [0])
        for nonsense in ([0.5], [-1], [[0]], ["a"]):
            with pytest.raises(InputError, match="not a pointwise map"):
                write_pointwise_map(tmp_path / "a.map", nonsense)
        assert not list(tmp_path.iterdir())


class TestOverlapScores:
    def test_closed_forms(self):
        predicted, true = np.array([1, 1, 0, 0, 0], bool), np.array([1, 0, 1, 0, 0], bool)
        assert overlap_scores(predicted, true) == pytest.approx((1 / 3, (1 / 2 + 2 / 3) / 2))
        assert overlap_scores(true, true) == OverlapScores(1, 1)
        assert overlap_scores(~true, true) == OverlapScores(0, 0)
        # Without vertices outside the overlap, or inside it, only the other share counts.
        everything, nothing = np.ones(5, bool), np.zeros(5, bool)
        assert overlap_scores(predicted, everything) == pytest.approx((0.4, 0.4))
        assert overlap_scores(predicted, nothing) == pytest.approx((0, 0.6))
        assert overlap_scores(nothing, nothing) == OverlapScores(1, 1)

    @pytest.mark.parametrize(
        ("predicted", "true"),
        [([True], [True, False]), ([1, 0], [True, False]), ([], []), ([[True]], [[True]]), ([0.5], [0.5])],
    )
    def test_other_arrays_are_refused(self, predicted, true):
        with refused("overlap", "two Boolean masks"):
            overlap_scores(predicted, true)


class TestGeodesicError:
    def test_closed_form_on_a_square_of_any_size(self):
        vertices, faces = grid_mesh(3, 3)
        for scale in (1.0, 25.0):
            mesh = make_mesh(scale * vertices, faces)
            truth = GroundTruth(np.array([3, 1, 0, 0]), np.array([8, 4, 0, 6]))
            result = geodesic_error(mesh, np.array([0, 4, 1, 4]), truth)
            np.testing.assert_allclose(result.errors, [np.sqrt(0.5), 0, 0, 1])
            assert result.source_vertices.tolist() == [3, 1, 0, 0] and result.method == "strips"
            np.testing.assert_allclose(result.mean, (np.sqrt(0.5) + 1) / 4)
            np.testing.assert_allclose(result.median, np.sqrt(0.5) / 2)
            assert result.unreachable == 0

    def test_the_ground_truth_has_no_error_in_any_format(self):
        generator = np.random.default_rng(0)
        points = SurfacePoints(generator.integers(0, 8, 4), generator.dirichlet([1, 1, 1], 4))
        assert geodesic_error(Y, points, GroundTruth.of_all_vertices(points)).errors.tolist() == [0] * 4
        vertices = generator.integers(0, 9, 4)
        assert geodesic_error(Y, vertices, GroundTruth.of_all_vertices(vertices)).mean == 0

    def test_errors_are_measured_between_points_on_faces(self):
        centre = SurfacePoints(np.array([0, 7]), np.full((2, 3), 1 / 3))
        where = centre.positions(Y)
        truth = GroundTruth(np.array([1, 0]), centre)
        result = geodesic_error(Y, np.array([8, 0]), truth)
        expected = np.linalg.norm(where - Y.vertices[[0, 8]], axis=1)
        np.testing.assert_allclose(result.errors, expected, rtol=0.01)
        swapped = geodesic_error(Y, centre, GroundTruth(np.array([0, 1]), np.array([0, 8])))
        np.testing.assert_allclose(swapped.errors, expected, rtol=0.01)

    def test_both_methods_agree_with_reference_distances(self, shared):
        mesh = read_mesh(shared / "data/faust_r/off/tr_reg_007.off")
        reference = np.load(shared / "oracle/faust_r_007_geodesics.npz")
        targets = reference["source_vertices"][:6]
        pointwise_map = np.random.default_rng(0).integers(0, 5001, 6)
        expected = reference["distances"][np.arange(6), pointwise_map] / np.sqrt(mesh.area)
        truth = GroundTruth.of_all_vertices(targets)
        exact = geodesic_error(mesh, pointwise_map, truth, method="exact")
        np.testing.assert_allclose(exact.errors, expected, rtol=1e-6)
        strips = geodesic_error(mesh, pointwise_map, truth)
        np.testing.assert_allclose(strips.errors, expected, rtol=0.005)
        assert exact.method == "exact" and (strips.errors != exact.errors).any()

    def test_matches_on_another_component_are_unreachable(self):
        vertices, faces = grid_mesh(3, 3)
        twins = make_mesh(np.concatenate([vertices, vertices + 5]), np.concatenate([faces, faces + 9]))
        truth = GroundTruth.of_all_vertices(np.array([0, 0, 9, 9]))
        result = geodesic_error(twins, np.array([2, 9, 9, 11]), truth)
        assert np.isinf(result.errors).tolist() == [False, True, False, False]
        assert result.unreachable == 0.25
        np.testing.assert_allclose(result.mean, 2 / np.sqrt(2) / 3)
        assert result.correspondence_quality_curve([10]).tolist() == [0.75]
        nowhere = geodesic_error(twins, np.array([9, 9, 0, 0]), truth)
        assert nowhere.unreachable == 1 and nowhere.mean == nowhere.median == np.inf
        assert nowhere.area_under_curve() == 0

    def test_samples_are_reproducible_rows_without_replacement(self):
        truth = GroundTruth(np.arange(9).repeat(10), np.tile(np.arange(9), 10))
        pointwise_map = np.arange(9)
        everything = geodesic_error(Y, pointwise_map, truth)
        first = geodesic_error(Y, pointwise_map, truth, number_of_samples=40)
        again = geodesic_error(Y, pointwise_map, truth, number_of_samples=40, seed=0)
        other = geodesic_error(Y, pointwise_map, truth, number_of_samples=40, seed=1)
        assert len(first.errors) == 40
        np.testing.assert_array_equal(first.errors, again.errors)
        assert (first.source_vertices != other.source_vertices).any()
        # Drawing all rows without replacement only changes their order.
        most = geodesic_error(Y, pointwise_map, truth, number_of_samples=1000)
        np.testing.assert_array_equal(np.sort(most.errors), np.sort(everything.errors))
        assert (np.bincount(first.source_vertices) <= 10).all()
        table = geodesic_distances(Y, np.arange(9))
        rows = {(s, round(table[s, t], 9)) for s, t in zip(truth.source_vertices, truth.targets, strict=True)}
        pairs = zip(first.source_vertices, first.errors, strict=True)
        assert all((s, round(e, 9)) in rows for s, e in pairs)

    def test_renumbering_both_meshes_changes_nothing(self):
        generator = np.random.default_rng(0)
        vertices, faces = grid_mesh(6, 6)
        vertices = vertices + generator.normal(size=vertices.shape) * 0.03
        pointwise_map, targets = generator.integers(0, 36, (2, 20))
        expected = geodesic_error(
            make_mesh(vertices, faces), pointwise_map, GroundTruth.of_all_vertices(targets)
        )
        # Vertex i of X becomes vertex x[i], and vertex i of Y becomes vertex y[i].
        x, y = generator.permutation(20), generator.permutation(36)
        renumbered_map, moved = np.empty(20, dtype=np.int64), np.empty_like(vertices)
        renumbered_map[x], moved[y] = y[pointwise_map], vertices
        result = geodesic_error(make_mesh(moved, y[faces]), renumbered_map, GroundTruth(x, y[targets]))
        np.testing.assert_allclose(result.errors, expected.errors, rtol=1e-12)

    @pytest.mark.parametrize(
        ("pointwise_map", "truth", "message"),
        [
            ([0, 1, 9], ([0], [0]), "pointwise map on mesh_y: vertex indices must lie between 0 and 8"),
            ([0, 1, -1], ([0], [0]), "pointwise map on mesh_y: .*entry 2 is -1"),
            ([0.0, 1.0], ([0], [0]), "pointwise map on mesh_y: .*a list of integers"),
            ([], ([0], [0]), "pointwise map on mesh_y: .*a list of integers"),
            ([0, 1, 2], ([0], [9]), "ground truth on mesh_y: vertex indices must lie between 0 and 8"),
            ([0, 1, 2], ([3], [0]), "source vertices are numbered 3 to 3, but the pointwise map has 3"),
            ([0, 1, 2], ([-1], [0]), "source vertices are numbered -1"),
            ([0, 1, 2], ([], []), "has no rows"),
        ],
    )
    def test_arguments_that_do_not_fit_are_refused(self, pointwise_map, truth, message):
        with pytest.raises(InputError, match=message):
            geodesic_error(Y, pointwise_map, GroundTruth(*(np.array(part, dtype=np.int64) for part in truth)))

    def test_at_least_one_sample_is_needed(self):
        with pytest.raises(InputError, match="0 samples cannot be evaluated"):
            geodesic_error(Y, [0], GroundTruth.of_all_vertices(np.array([0])), number_of_samples=0)


class TestStatistics:
    def error(self, values) -> GeodesicError:
        return GeodesicError(np.array(values, dtype=np.float64), np.arange(len(values)), "strips")

    def test_curve_of_a_small_example(self):
        error = self.error([0.3, 0.0, 0.1, 0.1, np.inf])
        curve = error.correspondence_quality_curve([0.0, 0.05, 0.1, 0.2, 0.3, 1e9])
        np.testing.assert_array_equal(curve, [0.2, 0.2, 0.6, 0.6, 0.8, 0.8])
        np.testing.assert_allclose(error.area_under_curve(0.2), (0.2 * 0.1 + 0.6 * 0.1) / 0.2)
        assert error.median == 0.1

    @given(st.lists(st.floats(0, 1), min_size=1, max_size=50), st.floats(0.01, 2))
    def test_area_under_curve_is_its_integral(self, values, largest):
        error = self.error(values)
        steps = np.unique(np.clip([0, *values, largest], 0, largest))
        heights = error.correspondence_quality_curve(steps[:-1])
        assert error.area_under_curve(largest) == pytest.approx((heights * np.diff(steps)).sum() / largest)

    def test_text_and_json_contain_all_figures(self):
        error = self.error([0.1, 0.2, np.inf, 0.0])
        within = ("25.0% within 0.02", "25.0% within 0.05", "50.0% within 0.1")
        assert_names(str(error), "mean 0.10000", "median 0.15000", *within)
        assert_names(str(error), "curve 0.4500", "4 points", "strips", "25.00% on another component")
        assert "component" not in str(self.error([0.1]))
        figures = json.loads(json.dumps(error.as_dictionary(), allow_nan=False))
        curve = figures.pop("curve")
        assert curve["shares"] == error.correspondence_quality_curve(np.array(curve["thresholds"])).tolist()
        assert figures == {
            "within": {"0.02": 0.25, "0.05": 0.25, "0.1": 0.5},
            "mean": pytest.approx(0.1),
            "median": pytest.approx(0.15),
            "area_under_curve": pytest.approx(0.45),
            "unreachable": 0.25,
            "points": 4,
            "method": "strips",
        }
        nothing = self.error([np.inf]).as_dictionary()
        assert nothing["mean"] is None and nothing["median"] is None

    def test_area_under_curve_lies_between_0_and_1(self):
        assert self.error([0, 0]).area_under_curve() == 1
        assert self.error([0.25, 3]).area_under_curve() == 0
        assert self.error([0.125]).area_under_curve() == 0.5
        with pytest.raises(InputError, match="largest threshold"):
            self.error([0]).area_under_curve(0.0)

    def test_coverage_is_the_area_of_matched_vertices(self):
        assert coverage(Y, np.arange(9)) == pytest.approx(1)
        np.testing.assert_allclose(coverage(Y, [4, 4, 4]), Y.vertex_areas[4])
        np.testing.assert_allclose(coverage(Y, [0, 8, 0]), Y.vertex_areas[[0, 8]].sum())
        with pytest.raises(InputError, match="pointwise map on mesh_y"):
            coverage(Y, [9])


@pytest.mark.sampled
def test_errors_agree_with_published_errors_of_the_same_maps(shared):
    # The published means use exact distances at 1000 selected vertices. This test uses other rows of the same
    # ground truth, so the difference is mainly a sampling error.
    published = {
        ("002", "007"): {
            "T0": 362,
            "demo_T": [53.0, 21.4, 19.1, 19.4, 18.7],
            "paper_T": [50.5, 22.7, 21.7, 21.7, 21.8],
            "demo_Tfast": 21.5,
            "paper_Tfast": 22.8,
        },
        ("000", "004"): {
            "T0": 213,
            "demo_T": [15.0, 12.3, 12.1, 12.4, 12.5],
            "paper_T": [19.5, 13.0, 13.1, 13.0, 12.9],
            "demo_Tfast": 13.5,
            "paper_Tfast": 12.1,
        },
    }
    for (a, b), expected in published.items():
        x, y = (read_mesh(shared / f"data/faust_r/off/tr_reg_{k}.off") for k in (a, b))
        paths = [shared / f"data/faust_r/corres/tr_reg_{k}.vts" for k in (a, b)]
        truth = read_ground_truth(paths, x, y)
        maps = np.load(shared / f"oracle/faust_r_{a}_{b}.npz")
        for name, means in expected.items():
            columns = maps[name].reshape(len(x.vertices), -1).T.astype(np.int64)
            for pointwise_map, mean in zip(columns, np.atleast_1d(means), strict=True):
                errors = 1000 * geodesic_error(y, pointwise_map, truth, number_of_samples=700).errors
                standard_error = errors.std() * np.sqrt(1 / 1000 + 1 / 700)
                assert abs(errors.mean() - mean) < 3.5 * standard_error, (a, b, name)


def test_vertices_without_ground_truth_take_the_match_of_the_nearest_vertex():
    mesh = bumpy_mesh(2)
    known = np.arange(0, 162, 2)
    found = GroundTruth(known, known + 1).everywhere(mesh)
    np.testing.assert_array_equal(found[known], known + 1)
    other = np.linalg.norm(mesh.vertices[1] - mesh.vertices[known], axis=1).argmin()
    assert found[1] == known[other] + 1
