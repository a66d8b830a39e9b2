"""Surfaces of brains and overlays keep order, numbers, labels and colours; damaged files cause one sentence."""

import base64
import struct
import sys
import zlib
from pathlib import Path
from xml.etree import ElementTree

import nibabel
import numpy as np
import pytest
from command_line import assert_refused, write_pair
from mesh_samples import sample
from messages import refusal, refused

import jaxsmw
from jaxsmw.io import (
    LabelTable,
    MeshData,
    Overlay,
    read_mesh,
    read_mesh_data,
    read_overlay,
    write_mesh,
    write_mesh_data,
    write_overlay,
)

EXAMPLES = Path(nibabel.__file__).parent / "gifti" / "tests" / "data"
LABELS = LabelTable(
    ("unknown", "précuneus", "a b"),
    np.array([0, 1639705, 7]),
    np.array([[0.1, 0.2, 0.3, 1], [1, 0, 0, 1], [0, 0, 1, 0.5]]).round(2),
)
REGIONS = Overlay({"parcels": np.array([0, 1, 2, 1, 1, 0, 2])}, {"parcels": LABELS})
NUMBERS = Overlay({"curv": np.random.default_rng(0).normal(size=7).astype(np.float32)})


# --------------------------------------------------------------------------- surfaces


def test_freesurfer_surfaces_have_the_bytes_of_the_format(tmp_path):
    mesh = sample().mesh
    write_mesh(tmp_path / "lh.pial", mesh)
    content = (tmp_path / "lh.pial").read_bytes()
    head, _, rest = content.partition(b"\n\n")
    assert head == b"\xff\xff\xfecreated by jaxsmw"
    assert struct.unpack(">2i", rest[:8]) == (len(mesh.vertices), len(mesh.faces))
    numbers = np.frombuffer(rest[8 : 8 + 12 * len(mesh.vertices)], ">f4").reshape(-1, 3)
    assert np.allclose(numbers, mesh.vertices, atol=1e-6)
    # Any other name is known by the first bytes.
    (tmp_path / "lh.sphere.reg").write_bytes(content)
    assert np.array_equal(read_mesh(tmp_path / "lh.sphere.reg").vertices, numbers)


def test_the_comment_and_the_geometry_of_the_volume_do_not_disturb(tmp_path):
    mesh = sample().mesh
    volume = {"head": np.array([2, 0, 20]), "valid": "1", "filename": "a.mgz", "volume": np.array([256] * 3)}
    volume |= {"voxelsize": np.ones(3)} | {f"{axis}ras": np.eye(3)[0] for axis in "xyzc"}
    nibabel.freesurfer.write_geometry(tmp_path / "rh.white", mesh.vertices, mesh.faces, "by me", volume)
    assert np.array_equal(read_mesh(tmp_path / "rh.white").faces, mesh.faces)


def test_quads_of_old_surfaces_become_triangles(tmp_path):
    three = lambda number: struct.pack(">i", number)[1:]  # noqa: E731
    positions = np.array([[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 50]], ">i2").tobytes()
    content = b"\xff\xff\xff" + three(4) + three(1) + positions + b"".join(map(three, [0, 1, 2, 3]))
    (tmp_path / "lh.orig.white").write_bytes(content)
    mesh = read_mesh(tmp_path / "lh.orig.white")
    assert mesh.faces.tolist() == [[0, 1, 3], [2, 3, 1]] and mesh.vertices[3].tolist() == [0, 1, 0.5]


def test_gifti_surfaces_follow_the_standard(tmp_path):
    data = sample()
    labels = MeshData(
        data.mesh, data.faces, vertex_data={"side": np.arange(7) % 2}, label_names={"side": ("L", "R")}
    )
    assert write_mesh_data(tmp_path / "m.surf.gii", labels) == ()
    root = ElementTree.parse(tmp_path / "m.surf.gii").getroot()
    arrays = {array.get("Intent"): array for array in root.iter("DataArray")}
    assert set(arrays) == {"NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE", "NIFTI_INTENT_LABEL"}
    packed = arrays["NIFTI_INTENT_POINTSET"].findtext("Data")
    numbers = np.frombuffer(zlib.decompress(base64.b64decode(packed)), "<f4").reshape(-1, 3)
    assert np.allclose(numbers, data.mesh.vertices, atol=1e-6)
    assert [label.text for label in root.iter("Label")] == ["L", "R"]
    again = read_mesh_data(tmp_path / "m.surf.gii")
    assert again.label_names == labels.label_names
    assert np.array_equal(again.vertex_data["side"], np.arange(7) % 2)


def test_examples_of_nibabel_are_read():
    surface = nibabel.load(EXAMPLES / "ascii.gii")
    assert np.array_equal(read_mesh(EXAMPLES / "ascii.gii").vertices, surface.darrays[0].data)
    curvature = read_overlay(EXAMPLES / "rh.shape.curv.gii")
    assert list(curvature.values) == ["rh.curv"] and curvature.values["rh.curv"].shape == (133764,)
    assert len(read_overlay(EXAMPLES / "task.func.gii").values) == 10
    named = read_overlay(EXAMPLES / "label.gii")
    assert named.labels["Activations"].names == ("???", "Positive", "Negative")
    # FreeSurfer's labels have the numbers of their colours. One number is missing in the table.
    regions = read_overlay(EXAMPLES / "rh.aparc.annot.gii")
    (labels,), (table,) = regions.values.values(), regions.labels.values()
    assert np.array_equal(table.keys[labels], nibabel.load(EXAMPLES / "rh.aparc.annot.gii").darrays[0].data)
    assert table.names[1] == "bankssts" and table.names[-1] == "0"
    with refused("gzipbase64.gii", "only data on one", "overlay"):
        read_mesh(EXAMPLES / "gzipbase64.gii")


# --------------------------------------------------------------------------- overlays


@pytest.mark.parametrize("name", ["lh.label.gii", "lh.annot"])
def test_labels_keep_names_and_colors(tmp_path, name):
    assert write_overlay(tmp_path / name, REGIONS) == ()
    again = read_overlay(tmp_path / name)
    ((found, labels),) = again.values.items()
    table = again.labels[found]
    assert np.array_equal(labels, REGIONS.values["parcels"])
    assert table.names == LABELS.names and np.allclose(table.colors, LABELS.colors, atol=1 / 255)
    if name.endswith("gii"):
        other = nibabel.load(tmp_path / name)
        assert np.array_equal(other.darrays[0].data, LABELS.keys[labels])
        assert other.labeltable.get_labels_as_dict() == dict(zip(LABELS.keys, LABELS.names, strict=True))
    else:
        found, _, names = nibabel.freesurfer.read_annot(tmp_path / name)
        assert np.array_equal(found, labels) and [text.decode() for text in names] == [*LABELS.names]


def test_vertices_without_a_label_stay_without_one(tmp_path):
    colors = np.array([[10, 20, 30, 0, 0], [40, 50, 60, 0, 0]])
    given = np.array([0, -1, 1, 1])
    nibabel.freesurfer.write_annot(tmp_path / "a.annot", given, colors, [b"x", b"y"], fill_ctab=True)
    overlay = read_overlay(tmp_path / "a.annot")
    assert overlay.labels["a"].names == ("x", "y", "???") and overlay.values["a"].tolist() == [0, 2, 1, 1]
    write_overlay(tmp_path / "b.annot", overlay)
    found, _, _ = nibabel.freesurfer.read_annot(tmp_path / "b.annot")
    assert np.array_equal(found, given)
    assert read_overlay(tmp_path / "b.annot").labels["b"].names == ("x", "y", "???")


@pytest.mark.parametrize("name", ["lh.curv", "rh.shape.gii"])
def test_numbers_are_kept(tmp_path, name):
    assert write_overlay(tmp_path / name, NUMBERS) == ()
    assert read_overlay(tmp_path / name).values["curv"].tolist() == NUMBERS.values["curv"].tolist()
    if name == "lh.curv":
        assert np.array_equal(nibabel.freesurfer.read_morph_data(tmp_path / name), NUMBERS.values["curv"])


def test_several_arrays_fit_into_gifti_files_only(tmp_path):
    several = Overlay({**NUMBERS.values, "flow": np.zeros((7, 3)), "big": np.full(7, 2**40)})
    (note,) = write_overlay(tmp_path / "a.func.gii", several)
    assert "'big'" in note
    assert read_overlay(tmp_path / "a.func.gii").values["flow"].shape == (7, 3)
    two = Overlay(
        {"a": np.zeros(3, int), "b": np.ones(3, int)},
        {"a": LABELS, "b": LABELS._replace(names=("x", "y", "z"))},
    )
    (note,) = write_overlay(tmp_path / "b.label.gii", two)
    assert "labels 'b'" in note and read_overlay(tmp_path / "b.label.gii").values["b"].tolist() == [1, 1, 1]
    (note,) = write_overlay(tmp_path / "lh.c", REGIONS)
    assert "names of labels" in note


# --------------------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A pair with its true map, and overlays of the source."""
    directory = write_pair(tmp_path_factory.mktemp("pair"))
    mesh = read_mesh(directory / "x.off")
    write_mesh(directory / "lh.pial", mesh)
    sides = (mesh.vertices[:, 0] > 0).astype(np.int64)
    table = LabelTable(("left", "right"), np.arange(2), np.array([[0.2, 0, 0, 1], [0, 1, 0, 1]]))
    write_overlay(directory / "lh.side.annot", Overlay({"side": sides}, {"side": table}))
    write_overlay(directory / "lh.height", Overlay({"height": mesh.vertices[:, 2]}))
    write_overlay(directory / "short.annot", REGIONS)
    return directory


def test_transfer_carries_a_label_map_and_curvature(run, pair, tmp_path):
    outcome = run(
        "transfer", pair / "lh.pial", pair / "y.ply", "--map", pair / "truth.txt",
        "--overlay", pair / "lh.side.annot", "--overlay", pair / "lh.height",
        "--overlay-output", tmp_path / "lh.side.annot", "--overlay-output", tmp_path / "height.func.gii",
        "--attributes", tmp_path / "y.surf.gii", "--registered", tmp_path / "rh.pial",
    )  # fmt: skip
    assert outcome.code == 0, outcome.errors
    source, truth = read_mesh(pair / "x.off"), np.loadtxt(pair / "truth.txt", dtype=int)
    labels, colors, names = nibabel.freesurfer.read_annot(tmp_path / "lh.side.annot")
    assert names == [b"left", b"right"] and colors[:, :3].tolist() == [[51, 0, 0], [0, 255, 0]]
    assert (labels[truth] == (source.vertices[:, 0] > 0)).mean() > 0.97
    height = nibabel.load(tmp_path / "height.func.gii").darrays[0].data
    assert np.corrcoef(height[truth], source.vertices[:, 2])[0, 1] > 0.99
    carried = read_mesh_data(tmp_path / "y.surf.gii")
    assert carried.label_names["side"] == ("left", "right")
    assert np.array_equal(carried.vertex_data["side"], labels)
    assert np.array_equal(nibabel.freesurfer.read_geometry(tmp_path / "rh.pial")[1], source.faces)


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ("--overlay {p}/lh.height", "nothing to write"),
        ("--overlay {p}/lh.height --map-output {t}/m.txt", "--overlay: has no effect without"),
        ("--overlay-output {t}/lh.a --map {p}/truth.txt", "1 times and --overlay 0 times"),
        ("--overlay {p}/lh.height --overlay-output {t}/a.txt", "overlays cannot be written as '.txt'"),
        ("--overlay {p}/lh.none --overlay-output {t}/lh.a", "lh.none"),
        ("--overlay {p}/short.annot --overlay-output {t}/lh.a", "for 7 vertices, but"),
        ("--overlay {p}/y.ply --overlay-output {t}/lh.a", "is neither a GIFTI overlay"),
        ("--overlay {p}/lh.height --overlay-output {p}/lh.height", "would be overwritten"),
        ("--map {p}/truth.txt --map-output {t}/m.txt", "--map-output: writes a computed map"),
        ("--map-output {t}/m.ply", "not as .ply"),
    ],
)
def test_what_cannot_be_used_is_refused(run, pair, tmp_path, arguments, fault):
    given = arguments.format(p=pair, t=tmp_path).split()
    assert_refused(run("transfer", pair / "x.off", pair / "y.ply", *given, "--quiet"), naming=fault)
    assert list(tmp_path.iterdir()) == []


# --------------------------------------------------------------------------- damaged files


def gifti(*arrays: str, table: str = "") -> bytes:
    head = '<?xml version="1.0" encoding="UTF-8"?><!DOCTYPE GIFTI SYSTEM "http://www.nitrc.org/frs/download.php/115/gifti.dtd">'
    return f'{head}<GIFTI Version="1.0" NumberOfDataArrays="{len(arrays)}">{table}{"".join(arrays)}</GIFTI>'.encode()


def array(
    numbers: str,
    shape: tuple[int, ...],
    intent: str,
    *,
    kind: str = "FLOAT32",
    encoding: str = "ASCII",
    more: str = "",
) -> str:
    dims = " ".join(f'Dim{i}="{size}"' for i, size in enumerate(shape))
    return (
        f'<DataArray Intent="NIFTI_INTENT_{intent}" DataType="NIFTI_TYPE_{kind}" Dimensionality="{len(shape)}" {dims} '
        f'ArrayIndexingOrder="RowMajorOrder" Encoding="{encoding}" Endian="LittleEndian" {more}><Data>{numbers}</Data></DataArray>'
    )


POINTS = array("0 0 0 1 0 0 0 1 0", (3, 3), "POINTSET")
FACES = array("0 1 2", (1, 3), "TRIANGLE", kind="INT32")
SURFACE = b"\xff\xff\xfeby me\n\n" + struct.pack(">2i", 3, 1) + bytes(48)
ANNOT = struct.pack(">9i", 3, 0, 5, 1, 5, 2, 0, 1, -2)

MESHES = {
    "empty.gii": (b"", "is empty"),
    "other.gii": (b"OFF\n3 1 0\n", "is not a complete GIFTI file"),
    "cut.gii": (gifti(POINTS, FACES)[:-30], "is not a complete GIFTI file"),
    "entities.gii": (gifti(POINTS).replace(b"<!DOCTYPE GIFTI", b'<!DOCTYPE x [<!ENTITY a "aaa">]'), "is not a complete"),
    "no faces.gii": (gifti(POINTS), "1 list of points and 0 lists of triangles"),
    "two surfaces.gii": (gifti(POINTS, FACES, POINTS, FACES), "2 lists of points"),
    "overlay.gii": (gifti(array("1 2 3", (3,), "SHAPE")), "only data on one"),
    "index.gii": (gifti(POINTS, FACES.replace("0 1 2", "0 1 3")), "uses vertex 3"),
    "nan.gii": (gifti(POINTS.replace("1 0 0", "nan 0 0", 1), FACES), "not a finite number"),
    "shape.gii": (gifti(POINTS.replace('Dim0="3"', 'Dim0="9"').replace('Dim1="3"', 'Dim1="1"'), FACES), "instead of three columns"),
    "count.gii": (gifti(POINTS.replace('Dim0="3"', 'Dim0="900000000"'), FACES), "is not a complete GIFTI file"),
    "word.gii": (gifti(POINTS.replace("1 0 0", "one 0 0", 1), FACES), "is not a complete GIFTI file"),
    "type.gii": (gifti(POINTS.replace("FLOAT32", "RGB24"), FACES), "is not a complete GIFTI file"),
    "external.gii": (gifti(array("", (3, 3), "POINTSET", encoding="ExternalFileBinary", more='ExternalFileName="/etc/passwd"')), "in another file"),
    "packed.gii": (gifti(array("AAAA", (3, 3), "POINTSET", encoding="GZipBase64Binary"), FACES), "is not a complete GIFTI"),
    "sparse.gii": (gifti(POINTS, FACES, array("0 2", (2,), "NODE_INDEX", kind="INT32")), "for some vertices only"),
    "text.pial": (b"OFF\n", "is not a complete file of FreeSurfer"),
    "cut.pial": (SURFACE[:-5], "is not a complete file of FreeSurfer"),
    "billion.pial": (SURFACE[:10] + struct.pack(">2i", 10**9, 1) + bytes(48), "is not a complete file of FreeSurfer"),
    "negative.pial": (SURFACE[:10] + struct.pack(">2i", -7, 1) + bytes(48), "is not a complete file of FreeSurfer"),
    "flat.pial": (SURFACE, "no triangle"),
    "scan.step": (b"ISO-10303-21;", "with FreeCAD to one of"),
    "scan.nii": (b"volume", "with 3D Slicer"),
    "lh.pial.gz": (b"\x1f\x8b", "a program that unpacks it"),
}  # fmt: skip
OVERLAYS = {
    "empty.annot": (b"", "is empty"),
    "surface.gii": (gifti(POINTS, FACES), "contains a surface, not an overlay"),
    "none.gii": (gifti(), "contains no data on vertices"),
    "cut.annot": (ANNOT[:20], "is not a complete annotation"),
    "no table.annot": (struct.pack(">3i", 1, 0, 5), "is not a complete annotation"),
    "billion.annot": (struct.pack(">6i", 1, 0, 5, 1, -2, 2**30), "is not a complete annotation"),
    "names.annot": (struct.pack(">8i", 1, 0, 5, 1, -2, 2, 2**30, 1), "is not a complete annotation"),
    "negative.annot": (struct.pack(">6i", -5, 0, 5, 1, -2, 1), "is not a complete annotation"),
    "lh.curv": (b"\xff\xff\xff" + struct.pack(">3i", 9, 1, 1) + bytes(8), "ends early"),
    "lh.none": (b"\xff\xff\xff" + struct.pack(">3i", 0, 0, 1), "ends early, or contains no numbers"),
    "cifti.dscalar.nii": (bytes(600), "wb_command -cifti-separate"),
}


@pytest.mark.parametrize("name", [*MESHES, *OVERLAYS])
def test_damaged_files_are_refused_in_one_sentence(tmp_path, name):
    content, fault = (MESHES | OVERLAYS)[name]
    (tmp_path / name).write_bytes(content)
    read = read_mesh_data if name in MESHES else read_overlay
    # nibabel's XML parser has a buffer of 35 MB.
    assert fault in refusal(read, tmp_path / name, most_memory=1e8)


def test_arrays_that_unpack_to_much_more_than_the_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxsmw.io.formats.brain.largest_contents", lambda size: 10**6)
    bomb = base64.b64encode(zlib.compress(bytes(10**7))).decode()
    packed = array(bomb, (10**7 // 12, 3), "POINTSET", encoding="GZipBase64Binary")
    (tmp_path / "bomb.gii").write_bytes(gifti(packed, FACES))
    assert "1 GiB" in refusal(read_mesh_data, tmp_path / "bomb.gii", most_memory=5e6)


@pytest.mark.parametrize(
    ("name", "overlay", "fault"),
    [
        ("a.annot", NUMBERS, "hold one array of labels"),
        ("a.annot", Overlay(REGIONS.values, {"parcels": LABELS._replace(colors=np.zeros((3, 4)))}), "the same colour"),
        ("lh.a", Overlay({**NUMBERS.values, **REGIONS.values}), "one number per vertex"),
        ("lh.a", Overlay({"flow": np.zeros((7, 3))}), "one number per vertex"),
        ("a.ply", NUMBERS, "cannot be written as '.ply'"),
        ("curv", NUMBERS, "cannot be written as ''"),
    ],
)  # fmt: skip
def test_what_a_format_cannot_hold_is_refused(tmp_path, name, overlay, fault):
    with refused(name, fault):
        write_overlay(tmp_path / name, overlay)
    assert list(tmp_path.iterdir()) == []


def test_without_nibabel_the_extra_is_named(tmp_path, monkeypatch):
    write_mesh(tmp_path / "lh.pial", sample().mesh)
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with refused("lh.pial", "pip install 'jaxsmw[brain]'"):
        jaxsmw.read_mesh(tmp_path / "lh.pial")
