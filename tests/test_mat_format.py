"""MATLAB files that would fill the memory are refused, and all other files are read."""

import io
import re
import struct
import sys
import zlib
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import refusal
from synthetic import bumpy_mesh

import jaxsmw
from jaxsmw import InputError
from jaxsmw.io.formats import mat
from jaxsmw.io.formats.mat import parse_variables, read_variables

HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
NUMERIC, CELL, STRUCT = 6, 1, 2


def element(kind: int, data: bytes, size: int | None = None) -> bytes:
    """Return a data element that declares `size` bytes, by default its true size."""
    return struct.pack("<II", kind, len(data) if size is None else size) + data + bytes(-len(data) % 8)


def array(kind: int, shape: tuple[int, ...], contents: bytes = b"", size: int | None = None) -> bytes:
    """Return an array named x of the MATLAB class `kind`."""
    flags, name = element(6, struct.pack("<II", kind, 0)), element(1, b"x")
    return element(14, flags + element(5, struct.pack(f"<{len(shape)}i", *shape)) + name + contents, size)


def compressed(data: bytes) -> bytes:
    packed = zlib.compress(data, 1)
    return struct.pack("<II", 15, len(packed)) + packed


ZEROS = element(9, bytes(8 * 1000))
HUGE = 3 << 30
BOMBS = {
    # name: (variables, part of the message)
    "a compressed variable": (compressed(array(NUMERIC, (1000, 1), ZEROS, size=HUGE)), "more than 1 GiB"),
    "four smaller variables": (4 * compressed(array(NUMERIC, (6250, 8), element(2, bytes(50_000_000)))), "more than 1 GiB"),
    "a cell array that declares too many elements": (array(CELL, (2**31 - 1, 2**10), 10 * element(14, b"")), "damaged"),
    "a nested cell array that declares too many elements": (array(CELL, (1, 1), array(CELL, (2**30, 2**30))), "damaged"),
    "a struct array without fields": (array(STRUCT, (2**20, 2**12), element(5, struct.pack("<i", 8)) + element(1, b"")), "damaged"),
    "a struct with a million fields": (
        compressed(array(STRUCT, (1, 1), element(5, struct.pack("<i", 1)) + element(1, b"a" * 10**6))), "damaged",
    ),
    "a negative shape": (array(CELL, (-1, -1), element(14, b"")), "damaged"),
    "more than it declares": (compressed(array(NUMERIC, (5000, 1000), element(9, bytes(40_000_000)), size=100)), "damaged"),
    "less than it declares": (compressed(array(NUMERIC, (1000, 1), ZEROS, size=10_000)), "damaged"),
    "no flags": (element(14, element(9, bytes(80))), "damaged"),
    "an array beyond its variable": (element(14, element(6, bytes(8)) + element(5, b"", size=1000)), "damaged"),
}  # fmt: skip


@pytest.mark.parametrize(("variables", "fault"), BOMBS.values(), ids=BOMBS)
def test_bombs_are_refused_before_they_fill_the_memory(tmp_path, variables, fault):
    path = tmp_path / "bomb.mat"
    path.write_bytes(HEADER + variables)
    assert re.search(fault, refusal(read_variables, path, most_memory=3e8))


CONTENTS = {
    "numbers": {"x": np.arange(40_000.0)},
    "small numbers": {"x": np.ones(40_000, np.uint8)},
    "complex numbers": {"x": np.ones(20_000) * 1j},
    "a sparse matrix": {"x": sp.eye_array(20_000).tocsc()},
    "a struct": {"s": {"a": {"b": np.arange(40_000.0)}}},
    "a cell array": {"c": np.array([np.arange(20_000.0), np.arange(30_000.0), "word"], dtype=object)},
    "a struct array": {"s": np.array([(np.arange(40_000.0),)] * 2, dtype=[("f", object)])},
    "many variables": {f"x{i}": np.arange(1000.0) for i in range(40)},
    "many small arrays": {"c": np.array([np.ones(i % 3) for i in range(75)], dtype=object)},
}


@pytest.mark.parametrize("compression", [False, True])
@pytest.mark.parametrize("contents", CONTENTS.values(), ids=CONTENTS)
def test_the_limit_holds_for_all_contents_together(monkeypatch, contents, compression):
    """The limit counts all numbers as float64, so 40 000 numbers take 320 000 bytes."""
    file = io.BytesIO()
    scipy.io.savemat(file, contents, do_compression=compression)
    monkeypatch.setattr(mat, "largest_contents", lambda size: 300_000)
    with pytest.raises(InputError, match="save only the variables that are needed"):
        parse_variables(file.getvalue())
    monkeypatch.setattr(mat, "largest_contents", lambda size: 1_000_000)
    assert parse_variables(file.getvalue()).keys() == contents.keys()


def test_unpacking_gives_the_contents_of_an_uncompressed_file():
    variables = {
        "matrix": np.random.default_rng(0).normal(size=(30, 4)),
        "flag": True,
        "text": "words",
        "empty": np.empty((0, 3)),
        "nested": {"list": np.arange(3), "inner": {"sparse": sp.eye_array(5).tocsc()}, "cell": np.array([1, "a"], object)},
    }  # fmt: skip
    plain, packed = io.BytesIO(), io.BytesIO()
    scipy.io.savemat(plain, variables, do_compression=False)
    scipy.io.savemat(packed, variables, do_compression=True)
    assert len(packed.getvalue()) < len(plain.getvalue())
    assert mat.unpacked(plain.getvalue()) == plain.getvalue()
    assert mat.unpacked(packed.getvalue())[128:] == plain.getvalue()[128:]


def test_files_of_big_endian_machines_are_read():
    parts = (6, (6, 0)), (5, (2, 1)), (9, np.array([3.5, -1], ">f8").tobytes())
    contents = [data if isinstance(data, bytes) else struct.pack(">2i", *data) for _, data in parts]
    elements = [struct.pack(">2I", kind, len(c)) + c for (kind, _), c in zip(parts, contents, strict=True)]
    elements.insert(2, struct.pack(">2H", 1, 1) + b"x\0\0\0")  # the name x as a small data element
    packed = zlib.compress(struct.pack(">2I", 14, sum(map(len, elements))) + b"".join(elements))
    data = HEADER[:124] + b"\x01\x00MI" + struct.pack(">2I", 15, len(packed)) + packed
    assert parse_variables(data)["x"].tolist() == [3.5, -1]


def test_files_of_level_4_are_read(tmp_path):
    path = tmp_path / "old.mat"
    mesh = bumpy_mesh(1)
    scipy.io.savemat(path, {"T12": np.arange(1.0, 43)}, format="4")
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, mesh, mesh), np.arange(42))


def test_eigenvectors_beyond_the_limit_are_read(monkeypatch, tmp_path):
    """Eigenvectors hardly compress, so a limit of four times the size of their file is enough."""
    monkeypatch.setattr(mat, "largest_contents", lambda size: max(10_000, 4 * size))
    spectrum = jaxsmw.compute_spectrum(bumpy_mesh(2), 20)
    jaxsmw.io.write_spectrum(tmp_path / "s.mat", spectrum)
    np.testing.assert_allclose(
        jaxsmw.io.read_spectrum(tmp_path / "s.mat").eigenvectors, spectrum.eigenvectors, rtol=1e-6
    )


# ------------------------------------------------------------------------------------------ format 7.3


def put(group, name: str, values: np.ndarray, kind: str = "double") -> None:
    """Write an array as MATLAB does: transposed, compressed, and with its class."""
    dataset = group.create_dataset(name, data=np.atleast_2d(values).T, compression="gzip")
    dataset.attrs["MATLAB_class"] = np.bytes_(kind)


def matlab_73(write, path: Path) -> Path:
    """Write a file of MATLAB's format 7.3, whose HDF5 part `write` fills."""
    h5py = pytest.importorskip("h5py")
    pytest.importorskip("pymatreader")
    with h5py.File(path, "w", userblock_size=512) as file:
        write(file)
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    path.write_bytes(header.ljust(512, b"\0") + path.read_bytes()[512:])
    return path


def shape_of(spectrum, mesh):
    """Return a function that writes a shape as a struct, with its mass matrix and a name."""

    def write(file) -> None:
        shape, surface = file.create_group("S"), file.create_group("S/surface")
        for axis, values in zip("XYZ", mesh.vertices.T, strict=True):
            put(surface, axis, values[:, None])
        put(surface, "TRIV", mesh.faces + 1.0)
        put(shape, "evals", np.asarray(spectrum.eigenvalues, np.float64)[:, None])
        put(shape, "evecs", np.asarray(spectrum.eigenvectors, np.float64))
        put(shape, "name", np.array([[*b"body"]], np.uint16), "char")
        n = len(mesh.vertices)
        mass = file.create_group("S/A")
        mass.attrs["MATLAB_sparse"] = np.uint64(n)
        mass["data"], mass["ir"], mass["jc"] = (
            np.asarray(spectrum.vertex_areas, np.float64),
            np.arange(n),
            np.arange(n + 1),
        )
        cells = file.create_group("#refs#")
        put(cells, "a", np.ones((2, 2)))
        import h5py

        put(file, "list", np.array([cells["a"].ref] * 2, h5py.ref_dtype), "cell")

    return write  # fmt: skip


def test_files_of_format_7_3_are_read(tmp_path):
    mesh = bumpy_mesh(2)
    with jax.enable_x64():
        spectrum = jaxsmw.compute_spectrum(mesh, 10)
        path = matlab_73(shape_of(spectrum, mesh), tmp_path / "s.mat")
        again = jaxsmw.io.read_spectrum(path)
        np.testing.assert_allclose(again.eigenvectors, spectrum.eigenvectors, rtol=1e-10)
        np.testing.assert_allclose(again.vertex_areas, spectrum.vertex_areas, rtol=1e-10)
    same = jaxsmw.read_mesh(path)
    assert same.vertices.tobytes() == mesh.vertices.tobytes() and np.array_equal(same.faces, mesh.faces)
    assert list(read_variables(path)) == ["S", "list"]
    path = matlab_73(lambda file: put(file, "T12", np.arange(1.0, 163)[:, None]), tmp_path / "map.mat")
    np.testing.assert_array_equal(jaxsmw.read_pointwise_map(path, mesh, mesh), np.arange(162))


def test_format_7_3_without_its_library_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "m.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384) + b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "pymatreader", None)
    with pytest.raises(InputError) as caught:
        jaxsmw.read_mesh(path)
    message = str(caught.value)
    assert (
        message.startswith(f"{path}: ") and "pip install 'jaxsmw[matlab]'" in message and "'-v7'" in message
    )


def declares(shape: tuple[int, ...], kind: str = "f8"):
    """Return a function that declares an array without numbers."""
    return lambda file: file.create_dataset("x", shape, kind, chunks=(1024,) * len(shape))


def doubled(file) -> None:
    """Groups that each contain the next one twice, so that a walk through them never ends."""
    group = file.create_group("x0")
    for i in range(1, 60):
        below = file.create_group(f"x{i}")
        group["a"] = group["b"] = below
        group = below


def circle(file) -> None:
    file.create_group("x")
    file["x/x"] = file["x"]


def elsewhere(file) -> None:
    import h5py

    file["x"] = h5py.ExternalLink("/etc/hosts", "x")


BOMBS_73 = {
    "a billion numbers": (declares((2**30,)), "more than 1 GiB"),
    "letters": (declares((2**27,), "u2"), "more than 1 GiB"),
    "doubled groups": (doubled, "format 7.3"),
    "a circle": (circle, "format 7.3"),
    "another file": (elsewhere, "format 7.3"),
}


@pytest.mark.parametrize(("write", "fault"), BOMBS_73.values(), ids=BOMBS_73)
def test_bombs_in_format_7_3_are_refused(tmp_path, write, fault):
    path = matlab_73(write, tmp_path / "bomb.mat")
    assert re.search(fault, refusal(read_variables, path, most_memory=3e8))


@given(
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(max_size=8)), min_size=1, max_size=4),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_damaged_files_of_format_7_3_are_read_or_refused(tmp_path_factory, damages, cut):
    folder = tmp_path_factory.getbasetemp()
    mesh = bumpy_mesh(1)
    sound = folder / "sound.mat"
    if not sound.exists():
        matlab_73(shape_of(jaxsmw.compute_spectrum(mesh, 5), mesh), sound)
    content = bytearray(sound.read_bytes())
    for place, new in damages:
        at = int(place * len(content))
        content[at : at + len(new)] = new
    path = folder / "damaged.mat"
    path.write_bytes(content[: int(damages[0][0] * len(content))] if cut else content)
    try:
        read_variables(path)
    except InputError as error:
        assert str(error).startswith(f"{path}: ") and "\n" not in str(error)  # noqa: PT017
