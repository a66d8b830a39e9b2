"""3MF and COLLADA files are read as one surface with its parts, and damaged files are refused."""

import io
import sys
import zipfile
from pathlib import Path

import collada
import numpy as np
import pytest
from collada import geometry, scene, source
from messages import refusal

from jaxsmw.io import read_mesh, read_mesh_data

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
RELATIONSHIPS = (
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship '
    'Target="/3D/a.model" Id="r" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)


def refused(path: Path) -> str:
    return refusal(read_mesh, path, most_memory=1e7)


def mesh_of(vertices=SQUARE, faces=FACES) -> str:
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    return f"<mesh><vertices>{points}</vertices><triangles>{triangles}</triangles></mesh>"


def package(path: Path, resources: str, build: str, **parts: str) -> Path:
    """Write a 3MF package with one model, and perhaps with other parts in place of the usual ones."""
    model = f'<model xmlns="{CORE}"><resources>{resources}</resources><build>{build}</build></model>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("_rels/.rels", parts.get("relationships", RELATIONSHIPS))
        archive.writestr("3D/a.model", parts.get("model", model))
    return path


def test_objects_of_a_package_are_placed_and_named(tmp_path):
    square = f'<object id="1" name="square">{mesh_of()}</object>'
    # Rows of coordinates are multiplied by the transform from the right.
    turned = '<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 5 6 7"/>'
    both = f'<object id="2"><components><component objectid="1"/>{turned}</components></object>'
    mirrored = '<item objectid="2"/><item objectid="3" transform="-2 0 0 0 2 0 0 0 2 0 0 0"/>'
    other = f'<object id="3" name="other">{mesh_of()}</object>'
    data = read_mesh_data(package(tmp_path / "a.3mf", square + both + other, mirrored))
    moved = SQUARE @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [5, 6, 7]
    expected = np.concatenate([SQUARE, moved, SQUARE * [-2, 2, 2]])
    np.testing.assert_allclose(data.mesh.vertices, expected)
    np.testing.assert_array_equal(data.faces, np.concatenate([FACES, FACES + 4, FACES[:, ::-1] + 8]))
    assert data.label_names["group"] == ("square", "other")
    assert data.face_data["group"].tolist() == [0, 0, 0, 0, 1, 1]


def test_an_object_of_another_part_of_a_package_is_found(tmp_path):
    path = package(tmp_path / "a.3mf", "", "")
    production = 'xmlns:p="http://schemas.microsoft.com/3dmanufacturing/production/2015/06"'
    build = '<build><item objectid="1" p:path="/3D/b.model"/></build>'
    content = f'<model xmlns="{CORE}"><resources><object id="1">{mesh_of()}</object></resources></model>'
    path = package(path, "", "", model=f'<model xmlns="{CORE}" {production}>{build}</model>')
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("3D/b.model", content)
    np.testing.assert_array_equal(read_mesh(path).vertices, SQUARE)


ITEM = '<item objectid="1"/>'
ONE = f'<object id="1">{mesh_of()}</object>'
TWICE = "".join(
    f'<object id="{i}"><components>' + 2 * f'<component objectid="{i - 1}"/>' + "</components></object>"
    for i in range(2, 31)
)
HOSTILE = {
    "nothing many times": (('<object id="1"/>' + TWICE, '<item objectid="30"/>'), {}, "contains no triangles"),
    "much many times": ((ONE + TWICE, '<item objectid="30"/>'), {}, "unpacks to more bytes than any mesh needs"),
    "no objects": (("", ""), {}, "contains no triangles"),
    "no such object": (("", ITEM), {}, "the object '1' does not exist"),
    "no model": ((ONE, ITEM), {"relationships": "<a/>"}, "does not name its 3D model"),
    "another model": ((ONE, ITEM), {"relationships": RELATIONSHIPS.replace("a.m", "b.m")}, "has no part '3D/b.model'"),
    "no xml": ((ONE, ITEM), {"model": "<model"}, "the part '3D/a.model' is not valid XML"),
    "entities": ((ONE, ITEM), {"model": '<!DOCTYPE a [<!ENTITY b "c">]><a/>'}, "is not valid XML"),
    "no number": ((ONE.replace('x="1.0"', 'x="one"'), ITEM), {}, "does not have the numbers x, y, z"),
    "no corner": ((ONE.replace("v2=", "v4="), ITEM), {}, "does not have the numbers v1, v2, v3"),
    "out of range": ((ONE.replace('v2="1"', 'v2="4"'), ITEM), {}, "uses a vertex that does not exist"),
    "short transform": ((ONE, ITEM.replace("/>", ' transform="1 2 3"/>')), {}, "does not consist of 12 numbers"),
    "itself": (('<object id="1"><components><component objectid="1"/></components></object>', ITEM), {}, "contain themselves"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_packages_are_refused_in_one_sentence(tmp_path, name):
    contents, parts, fault = HOSTILE[name]
    assert fault in refused(package(tmp_path / "a.3mf", *contents, **parts))


def test_what_is_no_package_is_refused(tmp_path):
    path = tmp_path / "a.3mf"
    path.write_text("x")
    assert "not a complete 3MF package" in refused(path)
    content = package(path, ONE, ITEM).read_bytes()
    at = content.index(b"3D/a.model") + 10
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    assert "not a complete 3MF package" in refused(path)


def document(*names: str, transform: np.ndarray | None = None, faces: np.ndarray = FACES) -> collada.Collada:
    """A COLLADA document with one square for each name, drawn as a quadrilateral or as triangles."""
    made, nodes = collada.Collada(), []
    for name in names:
        positions = source.FloatSource(f"{name}-positions", SQUARE.ravel(), ("X", "Y", "Z"))
        inputs = source.InputList()
        inputs.addInput(0, "VERTEX", f"#{name}-positions")
        shape = geometry.Geometry(made, name, name, [positions])
        if name == "quadrilateral":
            sizes, corners = np.array([4], np.int32), np.arange(4, dtype=np.int32)
            shape.primitives.append(shape.createPolylist(corners, sizes, inputs, "none"))
        else:
            for face in faces.astype(np.int32):
                shape.primitives.append(shape.createTriangleSet(face, inputs, "none"))
        made.geometries.append(shape)
        transforms = [] if transform is None else [scene.MatrixTransform(transform.ravel())]
        nodes.append(scene.Node(name, children=[scene.GeometryNode(shape)], transforms=transforms))
    made.scene = scene.Scene("scene", nodes)
    made.scenes.append(made.scene)
    return made


def saved(made: collada.Collada, path: Path) -> Path:
    content = io.BytesIO()
    made.write(content)
    path.write_bytes(content.getvalue())
    return path


def test_geometries_of_a_scene_are_placed_and_named(tmp_path):
    mirrored = np.diag([2.0, -2, 2, 1])
    mirrored[:3, 3] = 1, 2, 3
    path = saved(document("triangles", "quadrilateral", transform=mirrored), tmp_path / "a.dae")
    data = read_mesh_data(path)
    # The primitives of a geometry share its vertices.
    np.testing.assert_allclose(data.mesh.vertices, np.tile(SQUARE * [2, -2, 2] + [1, 2, 3], (2, 1)))
    np.testing.assert_array_equal(data.faces, np.concatenate([FACES[:, ::-1], FACES[:, ::-1] + 4]))
    assert data.label_names["group"] == ("triangles", "quadrilateral")
    assert data.face_data["group"].tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize(("content", "fault"), [
    (b"x", "not a complete COLLADA file"),
    (b"<COLLADA/>", "not a complete COLLADA file"),
    (b'<!DOCTYPE a [<!ENTITY b "c">]><COLLADA/>', "not a complete COLLADA file"),
])  # fmt: skip
def test_what_is_no_scene_is_refused(tmp_path, content, fault):
    path = tmp_path / "a.dae"
    path.write_bytes(content)
    assert fault in refused(path)


def test_scenes_without_valid_triangles_are_refused(tmp_path):
    empty = saved(document(), tmp_path / "a.dae")
    assert "contains no triangles" in refused(empty)
    wrong = saved(document("a"), tmp_path / "b.dae")
    wrong.write_text(wrong.read_text().replace("<p>0 2 3</p>", "<p>0 2 9</p>"))
    assert "not a complete COLLADA file" in refused(wrong)


def test_collada_names_the_package_that_it_needs(tmp_path, monkeypatch):
    path = saved(document("a"), tmp_path / "a.dae")
    monkeypatch.setitem(sys.modules, "collada", None)
    assert "pip install 'jaxsmw[collada]'" in refused(path)
