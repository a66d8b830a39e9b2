"""Other libraries and MATLAB can use our spectra and maps, and bad input is refused.

Tests of packages that are not installed are skipped. Stand-ins for pyvista and geomfum are always tested.
`pip install '.[peers]' pyvista` installs all packages.
"""

import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
import trimesh
from synthetic import bumpy_mesh, random_spectrum, sphere_mesh

import jaxsmw
from jaxsmw import InputError, Mesh, Spectrum, decode, encode, make_mesh
from jaxsmw.geometry import add_bases
from jaxsmw.io import exchange, make_spectrum
from jaxsmw.io.maps import check_map_name, read_landmarks

K = 12


@pytest.fixture(scope="module")
def bodies() -> tuple[Mesh, Mesh]:
    """Two surfaces with different areas and different numbers of vertices."""
    x, (vertices, faces) = bumpy_mesh(3), sphere_mesh(2)
    return make_mesh(3 * x.vertices, x.faces, name="x"), make_mesh(vertices * [5, 7, 6], faces, name="y")


@pytest.fixture(scope="module")
def spectra(bodies) -> tuple[Spectrum, Spectrum]:
    return jaxsmw.paired_spectra(jaxsmw.Pair(*bodies), K)


@pytest.fixture(scope="module")
def pointwise_map(bodies) -> np.ndarray:
    x, y = bodies
    return np.random.default_rng(0).integers(0, len(y.vertices), len(x.vertices))


def same_spectrum(a: Spectrum, b: Spectrum, *, tolerance: float = 1e-6) -> None:
    """Check that two spectra are equal up to the signs of eigenvectors."""
    np.testing.assert_allclose(a.eigenvalues, b.eigenvalues, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(a.vertex_areas, b.vertex_areas, rtol=tolerance, atol=1e-12)
    signs = np.sign(np.sum(np.asarray(a.eigenvectors * b.eigenvectors), axis=0))
    np.testing.assert_allclose(np.asarray(a.eigenvectors) * signs, b.eigenvectors, atol=1e3 * tolerance)
    np.testing.assert_array_equal(a.mask, b.mask)


# -------------------------------------------------------------------------------------------- meshes


def as_trimesh(mesh: Mesh) -> object:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def as_pyfm(mesh: Mesh) -> object:
    return pytest.importorskip("pyFM.mesh", reason="pip install pyfmaps").TriMesh(mesh.vertices, mesh.faces)


def as_geomfum(mesh: Mesh) -> object:
    shape = pytest.importorskip("geomfum.shape", reason="pip install geomfum")
    return shape.TriangleMesh(mesh.vertices, mesh.faces)


def as_pyvista(mesh: Mesh) -> object:
    return pytest.importorskip("pyvista").PolyData.from_regular_faces(mesh.vertices, mesh.faces)


def like_pyvista(mesh: Mesh) -> object:
    table = np.insert(mesh.faces, 0, 3, axis=1).ravel()
    return SimpleNamespace(points=mesh.vertices, faces=table, n_faces=len(mesh.faces))


def as_tuple(mesh: Mesh) -> object:
    return mesh.vertices, mesh.faces


LIBRARIES: list[Callable[[Mesh], object]] = [
    as_trimesh,
    as_pyfm,
    as_geomfum,
    as_pyvista,
    like_pyvista,
    as_tuple,
]


@pytest.mark.parametrize("convert", LIBRARIES)
def test_meshes_of_other_libraries_are_read_unchanged(bodies, convert):
    for body in bodies:
        mesh = make_mesh(convert(body))
        np.testing.assert_allclose(mesh.vertices, body.vertices, rtol=1e-15)
        np.testing.assert_array_equal(mesh.faces, body.faces)


def test_make_mesh_accepts_a_mesh(bodies):
    np.testing.assert_array_equal(make_mesh(bodies[0]).faces, bodies[0].faces)


@pytest.mark.filterwarnings("ignore:.*wrong as a whole")  # one iteration leaves a poor map
def test_match_accepts_meshes_of_other_libraries(bodies, spectra, pointwise_map):
    stage = jaxsmw.Stage(jaxsmw.WaveletPreservation(), number_of_eigenvectors=K, iterations=1)
    x, y = bodies
    ours = jaxsmw.match(x, y, preset=stage, init=pointwise_map, mirror="no")
    theirs = jaxsmw.match(as_trimesh(x), as_tuple(y), preset=stage, init=pointwise_map, mirror="no")
    np.testing.assert_array_equal(theirs.pointwise_map, ours.pointwise_map)
    assert theirs.mesh_x.name == "source mesh" and theirs.mesh_y.name == "target mesh"


NOT_MESHES = {
    "a number": (3, "int is not a triangle mesh"),
    "vertices alone": (np.zeros((4, 3)), "ndarray is not a triangle mesh"),
    "a point cloud": (SimpleNamespace(vertices=np.zeros((4, 3)), faces=None), "lacks vertices or faces"),
    "polygons": (
        SimpleNamespace(points=np.eye(4, 3), faces=np.array([4, 0, 1, 2, 3])), "not all faces are triangles"),
    "triangles and a polygon": (
        SimpleNamespace(points=np.eye(5, 3), faces=np.array([3, 0, 1, 2, 7, 0, 1, 2, 3, 4, 0, 1])),
        "not all faces are triangles"),
    "three arrays": ((np.eye(3), np.eye(3), np.eye(3)), "tuple is not a triangle mesh"),
    "a path": ("body.off", "is a file name: read the file with jaxsmw.read_mesh first"),
}  # fmt: skip


@pytest.mark.parametrize(("given", "fault"), NOT_MESHES.values(), ids=NOT_MESHES)
def test_objects_that_are_not_meshes_are_refused(given, fault):
    with pytest.raises(InputError, match=fault) as caught:
        make_mesh(given, name="my body")
    assert str(caught.value).startswith("my body: ")


def test_the_package_does_not_import_other_libraries():
    code = (
        "import jaxsmw, jaxsmw.io.spectra, jaxsmw.matching.match, sys;"
        "print([name for name in ('pyFM', 'geomfum', 'trimesh', 'pyvista', 'torch', 'potpourri3d') "
        "if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# ------------------------------------------------------------------------------------------- spectra


@pytest.mark.parametrize("unit", [1e-3, 1.0, 50.0])
@pytest.mark.parametrize("form", ["list", "dense", "sparse", "object"])
def test_an_eigenbasis_in_any_unit_is_scaled_to_area_1(spectra, unit, form):
    spectrum = spectra[0].scale(unit**2)
    areas = np.asarray(spectrum.vertex_areas)
    if form == "object":
        found = make_spectrum(spectrum)
    else:
        given = {"list": areas, "dense": np.diag(areas), "sparse": sp.diags_array(areas)}[form]
        found = make_spectrum(spectrum.eigenvalues, spectrum.eigenvectors, given)
    same_spectrum(found, spectra[0], tolerance=1e-12)


def test_vertices_without_area_are_masked(spectra):
    padded = spectra[0].pad(spectra[0].mask.shape[0] + 3)
    vectors = np.asarray(padded.eigenvectors).copy()
    vectors[-1] = 7  # an eigensolver may return any value for a vertex without area
    found = make_spectrum(padded.eigenvalues, vectors, padded.vertex_areas)
    same_spectrum(found, padded, tolerance=1e-12)


def test_spectra_have_the_default_float_type():
    given = random_spectrum(30, 5)
    arrays = map(np.asarray, (given.eigenvalues, given.eigenvectors, given.vertex_areas))
    with jax.enable_x64(False):
        assert make_spectrum(*arrays).eigenvectors.dtype == jnp.float32


def test_the_spectrum_of_pyfm_equals_ours(bodies, spectra):
    for body, ours in zip(bodies, spectra, strict=True):
        theirs = as_pyfm(body)
        with pytest.raises(InputError, match="no eigenvectors yet"):
            make_spectrum(theirs)
        theirs.process(K)
        np.testing.assert_allclose(theirs.area, body.area)
        same_spectrum(make_spectrum(theirs), ours)


@pytest.mark.parametrize("use_k", [K, 5])
def test_the_spectrum_of_geomfum_equals_ours(bodies, spectra, use_k):
    laplacian = pytest.importorskip("geomfum.laplacian", reason="pip install geomfum")
    for body, ours in zip(bodies, spectra, strict=True):
        theirs = as_geomfum(body)
        finder = laplacian.LaplacianSpectrumFinder(K, laplacian_finder=laplacian.LaplacianFinder())
        theirs.laplacian.find_spectrum(laplacian_spectrum_finder=finder)
        theirs.basis.use_k = use_k
        same_spectrum(make_spectrum(theirs), ours.truncate(use_k))


def test_the_spectrum_of_a_stand_in_for_geomfum_is_read(spectra):
    ours = spectra[0].scale(9.0)
    shape = SimpleNamespace(
        basis=SimpleNamespace(vals=np.asarray(ours.eigenvalues), vecs=np.asarray(ours.eigenvectors)),
        laplacian=SimpleNamespace(mass_matrix=sp.dia_matrix(np.diag(np.asarray(ours.vertex_areas)))),
    )
    same_spectrum(make_spectrum(shape), spectra[0], tolerance=1e-12)


@pytest.mark.filterwarnings("ignore:Sparse CSC tensor support")
@pytest.mark.parametrize("layout", ["sparse_csc", "sparse_coo", "strided", "gradient"])
def test_tensors_of_pytorch_are_accepted(bodies, spectra, layout):
    torch = pytest.importorskip("torch", reason="pip install geomfum")
    ours = spectra[0].scale(4.0)
    values, vectors, areas = (
        torch.tensor(np.asarray(array)) for array in (ours.eigenvalues, ours.eigenvectors, ours.vertex_areas)
    )
    if layout == "gradient":
        vectors, mass = vectors.requires_grad_(), areas.requires_grad_()
    else:
        mass = (
            torch.diag(areas).to_sparse(layout=getattr(torch, layout))
            if layout != "strided"
            else torch.diag(areas)
        )
    same_spectrum(make_spectrum(values, vectors, mass), spectra[0], tolerance=1e-12)
    x = bodies[0]
    tensors = torch.tensor(x.vertices, requires_grad=True), torch.tensor(x.faces)
    np.testing.assert_array_equal(make_mesh(*tensors).vertices, x.vertices)


VALUES, (VECTORS, AREAS) = (
    np.array([0.0, 1.0, 2.0]),
    (np.asarray(random_spectrum(8, 3).eigenvectors), np.asarray(random_spectrum(8, 3).vertex_areas)),
)
BAD_SPECTRA = {
    "nothing": ((3,), "int has no eigenbasis"),
    "eigenvalues alone": ((VALUES,), "ndarray has no eigenbasis"),
    "no areas": ((VALUES, VECTORS), "vertex areas are not an array of real numbers"),
    "transposed": ((VALUES, VECTORS.T, AREAS), "do not fit each other"),
    "too many eigenvalues": ((np.arange(4.0), VECTORS, AREAS), "do not fit each other"),
    "too few areas": ((VALUES, VECTORS, AREAS[:-1]), "do not fit each other"),
    "a sparse mass matrix of another size": ((VALUES, VECTORS, sp.eye_array(7)), "do not fit each other"),
    "a sparse mass matrix that would fill the memory": (
        (VALUES, VECTORS, sp.csc_array(([1.0], [0], [0, 1]), shape=(2**40, 1))), "do not fit each other"),
    "a matrix of eigenvalues": ((np.diag(VALUES), VECTORS, AREAS), "do not fit each other"),
    "complex": ((VALUES * 1j, VECTORS, AREAS), "eigenvalues are not an array of real numbers"),
    "words": ((["a", "b", "c"], VECTORS, AREAS), "eigenvalues are not an array of real numbers"),
    "not finite": ((VALUES, VECTORS * np.nan, AREAS), "eigenvectors are not all finite"),
    "negative areas": ((VALUES, VECTORS, -AREAS), "some vertex areas are negative"),
    "no area": ((VALUES, VECTORS, 0 * AREAS), "or all are zero"),
    "negative semi-definite": ((-VALUES[::-1], VECTORS, AREAS), "change its sign"),
    "descending": ((VALUES[::-1], VECTORS, AREAS), "do not ascend"),
    "areas of another unit": ((VALUES, VECTORS, 100 * AREAS), "not orthonormal"),
    "orthonormal without areas": ((VALUES, np.linalg.qr(VECTORS)[0], AREAS), "not orthonormal"),
}  # fmt: skip


@pytest.mark.parametrize(("arrays", "fault"), BAD_SPECTRA.values(), ids=BAD_SPECTRA)
def test_bad_spectra_end_in_one_sentence(arrays, fault):
    with pytest.raises(InputError, match=fault) as caught:
        make_spectrum(*arrays, name="my basis")
    message = str(caught.value)
    assert message.startswith("my basis: ") and "\n" not in message and message.endswith(".")


# ---------------------------------------------------------------------------------- functional maps


def test_maps_of_pyfm_equal_ours(spectra, pointwise_map):
    """Shape 1 of pyFM is our Y, and shape 2 is our X, so `FM_12` is C and `p2p_21` is T."""
    convert = pytest.importorskip("pyFM.spectral", reason="pip install pyfmaps")
    x, y = spectra
    basis_1, basis_2 = np.asarray(y.eigenvectors), np.asarray(x.eigenvectors)
    theirs = convert.p2p_to_FM(pointwise_map, basis_1, basis_2, A2=np.asarray(x.vertex_areas))
    ours = encode(jnp.asarray(pointwise_map), x, y)
    np.testing.assert_allclose(theirs, ours, atol=1e-12)
    np.testing.assert_allclose(
        convert.p2p_to_FM(pointwise_map, basis_1, basis_2),
        encode(jnp.asarray(pointwise_map), x, y, pseudo_inverse="least_squares"),
        atol=1e-12,
    )
    rectangular = np.asarray(ours)[:, : K - 4]
    np.testing.assert_array_equal(
        convert.FM_to_p2p(rectangular, basis_1, basis_2),
        decode(jnp.asarray(rectangular), x, y.truncate(K - 4)),
    )


@pytest.mark.slow
def test_zoomout_of_pyfm_equals_ours_in_our_basis(spectra, pointwise_map):
    refine = pytest.importorskip("pyFM.refine", reason="pip install pyfmaps")
    x, y = spectra
    first = encode(jnp.asarray(pointwise_map), x.truncate(4), y.truncate(4))
    theirs, points = refine.zoomout_refine(
        np.asarray(first),
        np.asarray(y.eigenvectors),
        np.asarray(x.eigenvectors),
        nit=K - 4,
        A2=sp.diags_array(np.asarray(x.vertex_areas)).tocsr(),
        return_p2p=True,
    )
    ours = first
    for k in range(5, K + 1):
        found = decode(ours, x.truncate(k - 1), y.truncate(k - 1))
        ours = encode(found, x.truncate(k), y.truncate(k))
    np.testing.assert_allclose(theirs, ours, atol=1e-12)
    np.testing.assert_array_equal(points, decode(ours, x, y))


def test_maps_between_pyfm_meshes_differ_from_ours_by_a_known_factor(bodies, pointwise_map):
    """The factor sqrt(a_Y / a_X) converts a map of pyFM into a map between spectra of area 1."""
    functional = pytest.importorskip("pyFM.functional", reason="pip install pyfmaps")
    convert = pytest.importorskip("pyFM.spectral", reason="pip install pyfmaps")
    x, y = (as_pyfm(body).process(K) for body in bodies)
    theirs = convert.mesh_p2p_to_FM(pointwise_map, y, x)
    ours = encode(jnp.asarray(pointwise_map), make_spectrum(x), make_spectrum(y))
    np.testing.assert_allclose(theirs * np.sqrt(y.area / x.area), ours, atol=1e-10)
    assert abs(y.area / x.area - 1) > 1
    # Between meshes of area 1, both libraries have equal functional maps and equal pointwise maps.
    x, y = x.area_normalize(), y.area_normalize()
    model = functional.FunctionalMapping(y, x)
    model.FM_12 = np.asarray(ours)
    np.testing.assert_array_equal(model.get_p2p(), decode(ours, make_spectrum(x), make_spectrum(y)))


def test_maps_of_geomfum_equal_ours(spectra, pointwise_map):
    """Shape a of geomfum is our Y, and shape b is our X."""
    convert = pytest.importorskip("geomfum.convert", reason="pip install geomfum")
    basis = pytest.importorskip("geomfum.basis", reason="pip install geomfum")
    x, y = spectra
    b, a = (basis.EigenBasis(*map(np.asarray, (s.eigenvalues, s.eigenvectors))) for s in spectra)
    ours = encode(jnp.asarray(pointwise_map), x, y, pseudo_inverse="least_squares")
    np.testing.assert_allclose(convert.FmFromP2pConverter()(pointwise_map, a, b), ours, atol=1e-12)
    rectangular = np.asarray(ours)[:, : K - 4]
    np.testing.assert_array_equal(
        convert.P2pFromFmConverter()(rectangular, a, b),
        decode(jnp.asarray(rectangular), x, y.truncate(K - 4)),
    )


# --------------------------------------------------------------------------------------- .npy files


def test_maps_are_written_and_read_as_npy_files(tmp_path, bodies):
    x, y = bodies
    pointwise_map = np.random.default_rng(0).integers(0, len(y.vertices), len(x.vertices))
    path = tmp_path / "map.npy"
    jaxsmw.write_pointwise_map(path, pointwise_map)
    assert [file.name for file in tmp_path.iterdir()] == ["map.npy"]
    np.testing.assert_array_equal(np.load(path), pointwise_map)
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, x, y), pointwise_map)
    np.save(path, pointwise_map + 1)
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, x, y, index_base=1), pointwise_map)
    np.save(path, pointwise_map[None])
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, x, y), pointwise_map)
    np.save(path, np.stack([pointwise_map[:5]] * 2, axis=1))
    np.testing.assert_array_equal(read_landmarks(path, y, y), np.load(path))


@pytest.mark.parametrize(
    ("contents", "fault"),
    [
        (
            np.zeros((3, 2), int),
            "contains an array of type int64 and shape .3, 2.: give a file with a list of numbers",
        ),
        (np.zeros(0, int), "contains an array of type int64 and shape .0,.: give"),
        (np.zeros((1, 0), int), "contains an array of type int64 and shape .1, 0.: give"),
        (np.array(["a", "b"]), "contains an array of type <U1 and shape"),
        (np.array([None, 1]), "is not an array saved by NumPy"),
        (np.zeros(3, complex), "contains an array of type complex128 and shape"),
        (np.zeros(3), "has 3 rows, but needs one"),
        (None, "is not an array saved by NumPy"),
    ],
)
def test_hostile_arrays_are_refused(tmp_path, bodies, contents, fault):
    path = tmp_path / "map.npy"
    if contents is None:
        path.write_text("0\n1\n")
    else:
        np.save(path, contents, allow_pickle=True)
    with pytest.raises(jaxsmw.InputError, match=f"map.npy: {fault}"):
        jaxsmw.read_pointwise_map(path, *bodies)


def test_hostile_headers_of_arrays_are_refused(tmp_path, bodies):
    path = tmp_path / "map.npy"
    huge = b"{'descr': '<i8', 'fortran_order': False, 'shape': (10000000000000,)}\n"
    np.savez(tmp_path / "maps.npz", np.zeros(3))
    archive = (tmp_path / "maps.npz").read_bytes()
    started = b"\x93NUMPY\x01\x00"
    for data in (archive, *(started + len(h).to_bytes(2, "little") + h for h in (huge, b"(" * 3000, b""))):
        path.write_bytes(data)
        with pytest.raises(jaxsmw.InputError, match=r"map\.npy: is not an array saved by NumPy"):
            jaxsmw.read_pointwise_map(path, *bodies)
    path.unlink()
    with pytest.raises(jaxsmw.InputError, match=r"map\.npy: does not exist: check the path"):
        jaxsmw.read_pointwise_map(path, *bodies)


# --------------------------------------------------------------------------------------- .mat files


@pytest.mark.parametrize("suffix", [".mat", ".npz"])
def test_spectra_survive_a_round_trip_through_files(bodies, spectra, tmp_path, suffix):
    for body, spectrum in zip(bodies, spectra, strict=True):
        path = tmp_path / f"body{suffix}"
        jaxsmw.io.write_spectrum(path, spectrum.scale(4.0), body)
        same_spectrum(jaxsmw.io.read_spectrum(path), spectrum, tolerance=1e-12)


def test_a_shape_for_matlab_has_consistent_fields(bodies, spectra, tmp_path):
    body, spectrum = bodies[0], spectra[0]
    jaxsmw.io.write_spectrum(tmp_path / "x.mat", spectrum, body)
    shape = scipy.io.loadmat(tmp_path / "x.mat", squeeze_me=False)["S"][0, 0]
    n = len(body.vertices)
    assert shape["evals"].shape == (K, 1) and shape["evecs"].shape == (n, K) and shape["A"].shape == (n, n)
    assert shape["nv"].item() == n and shape["nf"].item() == len(body.faces)
    np.testing.assert_allclose(shape["evecs"].T @ shape["A"] @ shape["evecs"], np.eye(K), atol=1e-9)
    surface = shape["surface"][0, 0]
    assert surface["X"].shape == (n, 1) and surface["TRIV"].dtype == np.float64
    np.testing.assert_array_equal(surface["TRIV"], body.faces + 1)
    # All fields describe the surface after scaling to area 1.
    mesh = jaxsmw.read_mesh(tmp_path / "x.mat")
    np.testing.assert_allclose(mesh.area, shape["area"].item(), rtol=1e-12)
    np.testing.assert_allclose(mesh.vertex_areas, shape["A"].diagonal(), rtol=1e-9)
    np.testing.assert_allclose(mesh.vertices * np.sqrt(body.area), body.vertices, rtol=1e-12)


def mat_file(path: Path, **variables: object) -> Path:
    scipy.io.savemat(path, variables)
    return path


@pytest.mark.parametrize("form", ["sparse", "diagonal", "row"])
@pytest.mark.parametrize("nested", [False, True])
def test_shapes_of_other_matlab_code_are_read(spectra, tmp_path, form, nested):
    spectrum = spectra[0].scale(30.0)
    areas = np.asarray(spectrum.vertex_areas)
    field = {"sparse": {"A": sp.diags_array(areas)}, "diagonal": {"A": areas}, "row": {"area": areas[None]}}[
        form
    ]
    fields = {
        "evals": np.asarray(spectrum.eigenvalues)[None],
        "evecs": np.asarray(spectrum.eigenvectors),
        **field,
    }
    path = mat_file(tmp_path / "s.mat", **({"shape": fields, "about": "a body"} if nested else fields))
    same_spectrum(jaxsmw.io.read_spectrum(path), spectra[0], tolerance=1e-12)


def test_matlab_code_can_use_our_files(bodies, spectra, pointwise_map, tmp_path):
    """The code is C21 = S1.evecs' * S1.A * S2.evecs(T12, :) and T12 = knnsearch(S2.evecs * C21', S1.evecs)."""
    x, y = spectra
    ours = encode(jnp.asarray(pointwise_map), x, y)
    jaxsmw.io.write_spectrum(tmp_path / "1.mat", x, bodies[0])
    jaxsmw.io.write_spectrum(tmp_path / "2.mat", y)
    jaxsmw.io.write_functional_map(tmp_path / "c.mat", ours)
    jaxsmw.write_pointwise_map(tmp_path / "t.mat", pointwise_map)
    s_1, s_2 = (scipy.io.loadmat(tmp_path / f"{i}.mat")["S"][0, 0] for i in (1, 2))
    t_12, c_21 = scipy.io.loadmat(tmp_path / "t.mat")["T12"], scipy.io.loadmat(tmp_path / "c.mat")["C21"]
    assert t_12.shape == (len(pointwise_map), 1) and t_12.dtype == np.float64 and t_12.min() >= 1
    composed = s_1["evecs"].T @ s_1["A"] @ s_2["evecs"][t_12[:, 0].astype(int) - 1]
    np.testing.assert_allclose(c_21, composed, atol=1e-12)
    distances = np.linalg.norm((s_2["evecs"] @ c_21.T)[None] - s_1["evecs"][:, None], axis=2)
    np.testing.assert_array_equal(distances.argmin(axis=1), decode(ours, x, y))
    np.testing.assert_array_equal(jaxsmw.io.read_functional_map(tmp_path / "c.mat", x, y), np.asarray(ours))
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(tmp_path / "t.mat", *bodies), pointwise_map)


@pytest.mark.parametrize("shape", ["column", "row"])
def test_pointwise_maps_of_other_matlab_code_are_read(bodies, pointwise_map, tmp_path, shape):
    table = (pointwise_map + 1)[:, None] if shape == "column" else (pointwise_map + 1)[None]
    x, y = bodies
    for variables in (
        {"anything": table},
        {"T12": table.astype(np.int32), "T21": np.ones((len(y.vertices), 1)), "C21": np.eye(5), "note": "x"},
    ):
        path = mat_file(tmp_path / "t.mat", **variables)
        np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, x, y), pointwise_map)
        truth = jaxsmw.read_ground_truth(path, x, y) if len(variables) == 1 else None
        if truth is not None:
            np.testing.assert_array_equal(truth.targets, pointwise_map)
    zero_based = mat_file(tmp_path / "zero.mat", T12=table - 1)
    read = jaxsmw.read_pointwise_map(zero_based, x, y, index_base=0)
    np.testing.assert_array_equal(read, pointwise_map)


def test_pairs_of_vertices_in_mat_files_are_read(bodies, pointwise_map, tmp_path):
    x, y = bodies
    pairs = np.stack([np.arange(9), pointwise_map[:9]], axis=1)
    path = mat_file(tmp_path / "pairs.mat", pairs=pairs + 1)
    np.testing.assert_array_equal(read_landmarks(path, x, y), pairs)
    truth = jaxsmw.read_ground_truth(path, x, y)
    np.testing.assert_array_equal(np.stack([truth.source_vertices, truth.targets], axis=1), pairs)


def hostile_file(kind: str, path: Path) -> None:
    scipy.io.savemat(path, {"T12": np.arange(1.0, 400), "evals": np.ones(3)})
    whole = path.read_bytes()
    damaged = {
        "truncated": whole[:-30],
        "cut in its header": whole[:60],
        "empty": b"",
        "text": b"not MATLAB's at all\n" * 20,
        "7.3": b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n",
        "hdf5": b"\x89HDF\r\n\x1a\n".ljust(600),
    }
    path.write_bytes(damaged[kind])


@pytest.mark.parametrize("kind", ["truncated", "cut in its header", "empty", "text", "7.3", "hdf5"])
@pytest.mark.parametrize("reader", ["mesh", "spectrum", "functional map", "pointwise map"])
def test_damaged_mat_files_end_in_one_sentence(bodies, spectra, tmp_path, kind, reader):
    path = tmp_path / "hostile.mat"
    hostile_file(kind, path)
    with pytest.raises(InputError) as caught:
        READERS[reader](path, bodies, spectra)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and message.endswith(".")
    if kind in ("7.3", "hdf5"):
        assert "format 7.3" in message and "'-v7'" in message
    else:
        assert "damaged" in message


READERS = {
    "mesh": lambda path, *_: jaxsmw.read_mesh(path),
    "spectrum": lambda path, *_: jaxsmw.io.read_spectrum(path),
    "functional map": lambda path, _, spectra: jaxsmw.io.read_functional_map(path, *spectra),
    "pointwise map": lambda path, bodies, _: jaxsmw.read_pointwise_map(path, *bodies),
}
M, N = 642, 162
SURFACE = {
    "X": np.eye(4)[0],
    "Y": np.eye(4)[1],
    "Z": np.eye(4)[2],
    "TRIV": np.array([[1, 2, 3], [1, 2, 4.0]]),
}
BASIS = {"evals": np.arange(3.0), "evecs": np.eye(8, 3)}
BAD_VARIABLES = {
    "map counted from 0": ("pointwise map", {"T12": np.arange(M) % N}, r"row 1: 0 is not .* numbered 1 to 162.*index_base=0"),
    "map out of range": ("pointwise map", {"T12": np.arange(M) % N + 2}, "row 162: 163 is not one of the vertices of y"),
    "map of another pair": ("pointwise map", {"T12": np.ones(N)}, "has 162 rows, but needs one for each of the 642"),
    "map of fractions": ("pointwise map", {"T12": np.full(M, 1.5)}, "row 1: 1.5 is not one of"),
    "map of NaN": ("pointwise map", {"T12": np.full(M, np.nan)}, "row 1: nan is not one of"),
    "map as a matrix": ("pointwise map", {"T12": np.ones((M, 2))}, "contains 'T12', but no list of numbers"),
    "two maps": ("pointwise map", {"a": np.ones(M), "b": np.ones(M)}, "more than one list of numbers .a, b.: save the right one as T12"),
    "no variable": ("pointwise map", {}, "is empty"),
    "words": ("pointwise map", {"T12": "one two"}, "no list of numbers"),
    "complex": ("functional map", {"C21": np.eye(3) * 1j}, "no matrix"),
    "complex eigenvectors": ("spectrum", {**BASIS, "A": np.ones(8), "evecs": np.eye(8, 3) * (1 + 1j)}, "eigenvectors are not an array of real numbers"),
    "complex areas": ("spectrum", {**BASIS, "A": sp.diags_array(np.full(8, 1 + 1j)).tocsc()}, "vertex areas are not an array of real numbers"),
    "complex coordinates": ("mesh", {"surface": {**SURFACE, "Y": SURFACE["Y"] + 1j}}, "surface.Y is not an array of real numbers"),
    "complex positions": ("mesh", {"VERT": np.eye(4, 3) + 1j, "TRIV": SURFACE["TRIV"]}, "VERT is not an array of real numbers"),
    "complex faces": ("mesh", {"surface": {**SURFACE, "TRIV": SURFACE["TRIV"] + 1j}}, "surface.TRIV is not an array of real numbers"),
    "words for coordinates": ("mesh", {"surface": {**SURFACE, "X": "abcd"}}, "surface.X is not an array of real numbers"),
    "too large": ("functional map", {"C21": np.ones((K, K + 1))}, r"has shape \(12, 13\), but .* at most \(12, 12\): compute more eigenvectors"),
    "infinite": ("functional map", {"C21": np.full((3, 3), np.inf)}, "not finite"),
    "two matrices": ("functional map", {"C12": np.eye(3), "C": np.eye(4)}, "save the right one as C21"),
    "no basis": ("spectrum", {"S": {"evals": np.arange(3.0)}}, "no evals and evecs"),
    "two bases": ("spectrum", {"S1": BASIS, "S2": BASIS}, r"contains 2 eigenbases \(S1, S2\)"),
    "no areas": ("spectrum", BASIS, "contains evecs but no areas"),
    "one area": ("spectrum", {**BASIS, "area": 3.0}, "contains evecs but no areas"),
    "areas of another shape": ("spectrum", {**BASIS, "A": np.ones(7)}, "do not fit each other"),
    "another mass matrix": ("spectrum", {**BASIS, "A": np.full(8, 2.0)}, "not orthonormal"),
    "no faces": ("mesh", {"surface": {"X": np.ones(4)}}, "no struct 'surface' with X, Y, Z"),
    "no coordinates": ("mesh", {"surface": {"TRIV": np.ones((4, 3))}}, "no struct 'surface' with X, Y, Z"),
    "coordinates of other lengths": ("mesh", {"S": {"surface": {**SURFACE, "Z": np.ones(5)}}}, "no struct 'surface' with X, Y, Z"),
    "two shapes": ("mesh", {"S1": {"surface": SURFACE}, "S2": {"surface": SURFACE}}, r"contains 2 shapes \(S1.surface, S2.surface\)"),
    "faces from 0": ("mesh", {"surface": {**SURFACE, "TRIV": np.array([[0, 1, 2], [1, 2, 3]])}}, "triangle 0 uses vertex -1"),
}  # fmt: skip


@pytest.mark.parametrize(("reader", "variables", "fault"), BAD_VARIABLES.values(), ids=BAD_VARIABLES)
def test_bad_variables_end_in_one_sentence(bodies, spectra, tmp_path, reader, variables, fault):
    path = mat_file(tmp_path / "bad.mat", **variables)
    with pytest.raises(InputError, match=fault) as caught:
        READERS[reader](path, bodies, spectra)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and message.endswith(".")


@pytest.mark.parametrize("reader", READERS)
def test_missing_files_are_refused(bodies, spectra, tmp_path, reader):
    with pytest.raises(InputError, match=r"nowhere\.mat: "):
        READERS[reader](tmp_path / "nowhere.mat", bodies, spectra)


def test_an_archive_that_would_fill_the_memory_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number in range(3):
            archive.writestr(f"{number}.npy", bytes(400_000_000))
    assert (tmp_path / "bomb.npz").stat().st_size < 10_000_000
    with pytest.raises(InputError, match=r"bomb\.npz: would take more than 1 GiB of memory"):
        jaxsmw.io.read_spectrum(tmp_path / "bomb.npz")


def test_unsupported_and_damaged_files_are_refused(bodies, spectra, tmp_path):
    x, _ = spectra
    (tmp_path / "damaged.npz").write_bytes(b"no archive")
    np.savez(tmp_path / "fields.npz", eigenvalues=np.ones(3))
    for fault, call in {
        "written as .npz, .safetensors or .mat": lambda: jaxsmw.io.write_spectrum(tmp_path / "x.txt", x),
        "x.mat: the spectrum has 642 vertices, but y has 162": lambda: jaxsmw.io.write_spectrum(
            tmp_path / "x.mat", x, bodies[1]
        ),
        "x.npz: the spectrum has 642 vertices, but y has 162": lambda: jaxsmw.io.write_spectrum(
            tmp_path / "x.npz", x, bodies[1]
        ),
        "maps are written as .npz, .safetensors or .mat": lambda: jaxsmw.io.write_functional_map(
            tmp_path / "c.txt", np.eye(3)
        ),
        "not all finite": lambda: jaxsmw.io.write_functional_map(tmp_path / "c.mat", np.eye(3) * np.nan),
        "read from .npz, .safetensors and .mat": lambda: jaxsmw.io.read_spectrum(tmp_path / "x.txt"),
        "does not exist": lambda: jaxsmw.io.read_spectrum(tmp_path / "x.npz"),
        "damaged or not a .npz file": lambda: jaxsmw.io.read_spectrum(tmp_path / "damaged.npz"),
        "lacks eigenvectors, vertex_areas": lambda: jaxsmw.io.read_spectrum(tmp_path / "fields.npz"),
        "not a pointwise map": lambda: jaxsmw.write_pointwise_map(tmp_path / "t.mat", [0.5]),
    }.items():
        with pytest.raises(InputError, match=fault):
            call()
    assert not list(tmp_path.glob("*.mat")) and not list(tmp_path.glob("*.txt"))


# ------------------------------------------------------------------------- files of named arrays


WRITERS = {
    "spectrum": lambda path, spectra, _: jaxsmw.io.write_spectrum(path, spectra[0]),
    "functional map": lambda path, spectra, T: jaxsmw.io.write_functional_map(path, encode(jnp.asarray(T), *spectra)),
    "pointwise map": lambda path, _, T: jaxsmw.write_pointwise_map(path, T),
}  # fmt: skip
NAMED = {
    "spectrum": ["eigenvalues", "eigenvectors", "vertex_areas"],
    "functional map": ["functional_map"],
    "pointwise map": ["pointwise_map"],
}


def named_arrays(path: Path) -> dict[str, np.ndarray]:
    if path.suffix == ".npz":
        return dict(np.load(path))
    return pytest.importorskip("safetensors.numpy", reason="pip install safetensors").load_file(path)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_results_survive_a_round_trip_through_named_arrays(bodies, spectra, pointwise_map, tmp_path, suffix):
    if suffix == ".safetensors":
        pytest.importorskip("safetensors")
    paths = {what: tmp_path / f"{what}{suffix}" for what in WRITERS}
    for what, path in paths.items():
        WRITERS[what](path, spectra, pointwise_map)
        assert sorted(named_arrays(path)) == NAMED[what]
    same_spectrum(jaxsmw.io.read_spectrum(paths["spectrum"]), spectra[0], tolerance=1e-12)
    read = jaxsmw.io.read_functional_map(paths["functional map"], *spectra)
    np.testing.assert_array_equal(read, np.asarray(encode(jnp.asarray(pointwise_map), *spectra)))
    read = jaxsmw.read_pointwise_map(paths["pointwise map"], *bodies)
    np.testing.assert_array_equal(read, pointwise_map)
    truth = jaxsmw.read_ground_truth(paths["pointwise map"], *bodies)
    np.testing.assert_array_equal(truth.targets, pointwise_map)


def test_arrays_of_any_name_are_read_if_they_are_alone(bodies, spectra, pointwise_map, tmp_path):
    np.savez(tmp_path / "map.npz", pointwise_map)
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(tmp_path / "map.npz", *bodies), pointwise_map)
    np.savez(tmp_path / "c.npz", pointwise_map=pointwise_map, functional_map=np.eye(3))
    np.testing.assert_array_equal(jaxsmw.io.read_functional_map(tmp_path / "c.npz", *spectra), np.eye(3))
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(tmp_path / "c.npz", *bodies), pointwise_map)


BAD_ARRAYS = {
    "two maps": ("pointwise map", dict(a=np.ones(M), b=np.ones(M)), "contains 'a', 'b', but no pointwise_map: save the array"),
    "no array": ("pointwise map", {}, "is empty, but no pointwise_map: save"),
    "a map of another pair": ("pointwise map", dict(pointwise_map=np.ones(N)), "has 162 rows, but needs one for each of the 642"),
    "a map as a matrix": ("pointwise map", dict(pointwise_map=np.ones((M, 2))), "contains an array of type float64 and shape"),
    "a map out of range": ("pointwise map", dict(pointwise_map=np.arange(M) % N + 1), "row 162: 162 is not one of the vertices"),
    "a list for a matrix": ("functional map", dict(functional_map=np.ones(3)), r"has shape \(3,\): give a functional map, which"),
    "a number": ("functional map", dict(functional_map=np.float64(1)), r"has shape \(\): give a functional map, which"),
    "words": ("functional map", dict(functional_map=np.array([["a"]])), "entries of the functional map are not an array of real"),
    "infinite": ("functional map", dict(functional_map=np.full((3, 3), np.inf)), "entries of the functional map are not all finite"),
    "too large": ("functional map", dict(functional_map=np.ones((K, K + 1))), r"has shape \(12, 13\), but .* at most \(12, 12\)"),
    "no areas": ("spectrum", dict(eigenvalues=np.ones(3), eigenvectors=np.eye(8, 3)), "lacks vertex_areas: write"),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
@pytest.mark.parametrize(("reader", "arrays", "fault"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_bad_named_arrays_end_in_one_sentence(bodies, spectra, tmp_path, suffix, reader, arrays, fault):
    path = tmp_path / f"bad{suffix}"
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        save_file = pytest.importorskip("safetensors.numpy").save_file
        if any(array.dtype.kind == "U" for array in arrays.values()):
            pytest.skip("safetensors has no words")
        save_file({name: np.asarray(array) for name, array in arrays.items()}, path)
    with pytest.raises(InputError, match=fault) as caught:
        READERS[reader](path, bodies, spectra)
    message = str(caught.value)
    assert message.startswith(str(path)) and "\n" not in message and message.endswith(".")


def tensors_file(header: str | bytes, body: bytes = b"") -> bytes:
    header = header.encode() if isinstance(header, str) else header
    return len(header).to_bytes(8, "little") + header + body


DAMAGED_TENSORS = {
    "empty": b"",
    "text": b"no tensors at all\n" * 20,
    "a huge header": (2**62).to_bytes(8, "little") + b"{}",
    "no JSON": tensors_file("{" * 2000),
    "more than the file": tensors_file('{"pointwise_map":{"dtype":"I64","shape":[900],"data_offsets":[0,7200]}}', b"123"),
    "a negative shape": tensors_file('{"pointwise_map":{"dtype":"I64","shape":[-1],"data_offsets":[0,8]}}', b"12345678"),
    "a type that NumPy lacks": tensors_file('{"pointwise_map":{"dtype":"BF16","shape":[4],"data_offsets":[0,8]}}', b"12345678"),
}  # fmt: skip


@pytest.mark.parametrize("reader", [reader for reader in READERS if reader != "mesh"])
@pytest.mark.parametrize("case", DAMAGED_TENSORS)
def test_damaged_safetensors_end_in_one_sentence(bodies, spectra, tmp_path, reader, case):
    pytest.importorskip("safetensors")
    path = tmp_path / "damaged.safetensors"
    path.write_bytes(DAMAGED_TENSORS[case])
    with pytest.raises(
        InputError, match=r"is damaged, or contains numbers of a type .*: write the file again"
    ) as caught:
        READERS[reader](path, bodies, spectra)
    assert str(caught.value).startswith(f"{path}: ")


def test_missing_safetensors_is_explained(bodies, spectra, pointwise_map, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    path = tmp_path / "map.safetensors"
    fault = r"map.safetensors: this format needs the package safetensors: run pip install 'jaxsmw\[safetensors\]', or use"
    with pytest.raises(InputError, match=fault):
        jaxsmw.write_pointwise_map(path, pointwise_map)
    with pytest.raises(InputError, match=fault):  # commands call this before they match
        check_map_name(path)
    assert not path.exists()
    path.write_bytes(b"")
    for reader in ("pointwise map", "functional map", "spectrum"):
        with pytest.raises(InputError, match=fault):
            READERS[reader](path, bodies, spectra)


# ------------------------------------------------------------------- objects of other libraries


@pytest.fixture(scope="module")
def result(bodies):
    x, y = bodies
    stage = jaxsmw.Stage(jaxsmw.WaveletPreservation(), number_of_eigenvectors=K, iterations=1)
    init = np.random.default_rng(0).integers(0, len(y.vertices), len(x.vertices))
    with pytest.warns(UserWarning, match="wrong as a whole"):
        return jaxsmw.match(x, y, preset=stage, init=init, mirror="no")


def same_memory(tensor: Any, array: Any) -> bool:
    pointer = array.ctypes.data if isinstance(array, np.ndarray) else array.unsafe_buffer_pointer()
    return tensor.data_ptr() == pointer


@pytest.mark.parametrize("kind", ["numpy", "jax"])
def test_tensors_share_the_memory_of_results(spectra, result, kind):
    torch = pytest.importorskip("torch", reason="pip install torch")
    convert = np.asarray if kind == "numpy" else jnp.asarray
    spectrum = jax.tree.map(convert, spectra[0])
    tensors = jaxsmw.io.to_torch(spectrum)
    assert {"eigenvalues", "eigenvectors", "vertex_areas", "mask"} <= set(tensors)
    for name, tensor in tensors.items():
        array = getattr(spectrum, name)
        assert isinstance(tensor, torch.Tensor) and same_memory(tensor, array)
        np.testing.assert_array_equal(tensor, array)
    matrix = convert(np.arange(6, dtype=np.float32).reshape(2, 3))
    tensor = jaxsmw.io.to_torch(matrix)
    assert same_memory(tensor, matrix)
    # The opposite direction is one call of JAX, which needs memory that is aligned as PyTorch aligns it.
    tensor = torch.arange(6.0).reshape(2, 3)
    back = jnp.from_dlpack(tensor)
    assert same_memory(tensor, back)
    np.testing.assert_array_equal(back, tensor)


def test_a_result_becomes_tensors_in_one_call(result):
    pytest.importorskip("torch", reason="pip install torch")
    tensors = jaxsmw.io.to_torch(result)
    assert list(tensors) == ["pointwise_map", "functional_map", "spectrum_x", "spectrum_y"]
    assert same_memory(tensors["pointwise_map"], result.pointwise_map)
    np.testing.assert_array_equal(tensors["functional_map"], result.functional_map)
    np.testing.assert_array_equal(tensors["spectrum_y"]["eigenvalues"], result.spectrum_y.eigenvalues)
    assert list(jaxsmw.io.to_torch(result.refinement)) == ["pointwise_map", "functional_map"]
    with pytest.raises(InputError, match="int contains no map and no spectrum: give an array"):
        jaxsmw.io.to_torch(3)


def test_a_result_goes_to_pyfm_and_back(bodies, result):
    pytest.importorskip("pyFM.functional", reason="pip install pyfmaps")
    x, y = bodies
    mapping = result.to_pyfm()
    np.testing.assert_array_equal(mapping.mesh1.vertices, y.vertices)
    np.testing.assert_allclose(mapping.mesh2.area, x.area)
    # Their pointwise map of our functional map is that of `decode`, although the areas differ.
    spectra = result.spectrum_x, result.spectrum_y
    ours = decode(jnp.asarray(result.functional_map), *spectra)
    encoded = mapping.mesh2.project(mapping.mesh1.eigenvectors[np.asarray(ours)])
    expected = encode(ours, *spectra)
    np.testing.assert_allclose(encoded, np.asarray(expected) * np.sqrt(x.area / y.area), atol=1e-5)
    imported = jaxsmw.io.make_functional_map(mapping)
    np.testing.assert_allclose(imported.functional_map, result.functional_map, atol=1e-5)
    for theirs, spectrum in zip(imported[1:], spectra, strict=True):
        same_spectrum(theirs, spectrum, tolerance=1e-5)
    assert np.mean(np.asarray(decode(*imported)) == np.asarray(ours)) > 0.99


def test_a_result_goes_to_geomfum_and_back(bodies, result):
    convert = pytest.importorskip("geomfum.convert", reason="pip install geomfum")
    a, b, fmap_matrix = result.to_geomfum()
    x, y = bodies
    np.testing.assert_array_equal(a.vertices, y.vertices)
    np.testing.assert_allclose(b.laplacian.mass_matrix.sum(), x.area)
    imported = jaxsmw.io.make_functional_map(fmap_matrix, b, a)
    np.testing.assert_allclose(imported.functional_map, result.functional_map, atol=1e-5)
    theirs = convert.FmFromP2pConverter()(result.pointwise_map, a.basis, b.basis)
    ours = encode(
        jnp.asarray(result.pointwise_map),
        result.spectrum_x,
        result.spectrum_y,
        pseudo_inverse="least_squares",
    )
    np.testing.assert_allclose(theirs, np.asarray(ours) * np.sqrt(x.area / y.area), atol=1e-4)


def test_functional_maps_of_stand_ins_are_scaled(spectra):
    x, y = (spectrum.scale(area) for spectrum, area in zip(spectra, (4.0, 9.0), strict=True))
    matrix = np.arange(12.0).reshape(3, 4)
    mapping = SimpleNamespace(mesh1=y, mesh2=x, FM_12=matrix)
    for imported in (
        jaxsmw.io.make_functional_map(mapping),
        jaxsmw.io.make_functional_map(matrix, shape_x=x, shape_y=y),
    ):
        np.testing.assert_allclose(imported.functional_map, 1.5 * matrix, rtol=1e-12)
        same_spectrum(imported.spectrum_x, spectra[0].truncate(3), tolerance=1e-12)
        same_spectrum(imported.spectrum_y, spectra[1].truncate(4), tolerance=1e-12)


def test_maps_that_cannot_be_imported_are_refused(spectra):
    x, y = spectra
    for fault, arguments in {
        "has no functional map yet: call its method fit first": (
            SimpleNamespace(mesh1=y, mesh2=x, FM_12=None),
        ),
        "needs the eigenbases of both shapes: give shape_x and shape_y": (np.eye(3), x),
        "has no eigenbasis: give eigenvalues": (np.eye(3), x, SimpleNamespace()),
        "the map: has shape": (np.ones(3), x, y),
        "entries of the functional map are not all finite": (np.eye(3) * np.nan, x, y),
        "at most .12, 12.: compute more eigenvectors": (np.eye(13), x, y),
    }.items():
        with pytest.raises(InputError, match=fault):
            jaxsmw.io.make_functional_map(*arguments)


@pytest.mark.parametrize(
    ("library", "convert"), [("torch", "to_torch"), ("pyFM", "to_pyfm"), ("geomfum", "to_geomfum")]
)
def test_missing_libraries_are_explained(bodies, monkeypatch, library, convert):
    for module in list(sys.modules):
        if module.split(".")[0] == library:
            monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, library, None)
    package = {"pyFM": "pyfmaps"}.get(library, library)
    argument = bodies[0].vertices if library == "torch" else bodies[0]
    with pytest.raises(InputError, match=f"{package} is not installed: run pip install {package}."):
        getattr(jaxsmw.io, convert)(argument)


def test_the_spectrum_of_a_cut_mesh_is_not_converted(bodies, spectra):
    with pytest.raises(
        InputError, match=r"y: has 162 vertices, but its spectrum has 642, because the mesh was cut: compute"
    ):
        exchange.unit_factor(bodies[1], spectra[0])


def test_tensors_of_further_bases_have_the_names_of_the_bases(monkeypatch):
    """Runs without PyTorch."""
    library = SimpleNamespace(from_dlpack=np.asarray)
    monkeypatch.setattr("jaxsmw.io.exchange._library", lambda *names: library)
    mesh = bumpy_mesh(3)
    spectrum = jaxsmw.compute_spectrum(mesh, K)
    plain, joined = (exchange.to_torch(one) for one in (spectrum, add_bases(mesh, spectrum, ["crease"])))
    assert set(joined) - set(plain) == {"eigenvalues_of_basis_crease", "eigenvectors_of_basis_crease"}
    np.testing.assert_array_equal(plain["eigenvalues"], spectrum.eigenvalues)
