"""A reader of 3MF packages: all objects of the build, joined to one surface.

The specification is https://github.com/3MFConsortium/spec_core. The library lib3mf returns the same numbers
through ctypes, and needs the same loop over objects and components.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from posixpath import join, normpath
from xml.etree import ElementTree

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.io.formats.polygons import Part, Polygons, joined, placed
from jaxsmw.io.formats.text import damaged, excerpt, export_again, refuse_entities
from jaxsmw.runtime.files import largest_contents

# The part of a package that lists its other parts, and the end of the type of the part with the model.
_RELATIONSHIPS, _MODEL = "_rels/.rels", "/3dmodel"
# The attribute of the production extension that names another part.
_PATH = "{http://schemas.microsoft.com/3dmanufacturing/production/2015/06}path"
# Objects of objects may be nested this deeply.
_DEPTH = 32
# What each use of a mesh counts beside its bytes, so that no file can nest small objects nearly without end.
_OVERHEAD = 100_000


def parse_3mf(data: bytes) -> Polygons:
    """Parse a `.3mf` file. If it has several objects, the face data `group` numbers them."""
    return joined(_Package(data).build())


class _Package:
    """The models of a package by their paths, which are read when they are needed."""

    def __init__(self, data: bytes) -> None:
        with _readable():
            self.archive = zipfile.ZipFile(io.BytesIO(data))
        self.budget = largest_contents(len(data))
        self.models: dict[str, ElementTree.Element] = {}
        self.objects: dict[tuple[str, str | None], list[Part]] = {}

    def build(self) -> Iterator[Part]:
        """Yield the meshes of all objects of the build."""
        root = self.root()
        for item in _children(self.model(root), "build", "item"):
            yield from self.used(root, item, 0)

    def root(self) -> str:
        """Return the path of the part with the model."""
        for relationship in self.xml(_RELATIONSHIPS):
            if relationship.get("Type", "").endswith(_MODEL):
                return relationship.get("Target", "").lstrip("/")
        raise damaged("the package does not name its 3D model")

    def xml(self, path: str) -> ElementTree.Element:
        """Return the XML of a part."""
        try:
            self.spend(self.archive.getinfo(path).file_size)
        except KeyError:
            raise damaged(f"the package has no part {excerpt(path)}") from None
        with _readable():
            content = self.archive.read(path)
        try:
            refuse_entities(content)
            return ElementTree.fromstring(content)
        except (ElementTree.ParseError, ValueError, LookupError):
            raise damaged(f"the part {excerpt(path)} is not valid XML") from None

    def model(self, path: str) -> ElementTree.Element:
        if path not in self.models:
            self.models[path] = self.xml(path)
        return self.models[path]

    def spend(self, number_of_bytes: int) -> None:
        self.budget -= number_of_bytes
        if self.budget < 0:
            raise InputError("unpacks to more bytes than any mesh needs: export the mesh again.")

    def used(self, path: str, use: ElementTree.Element, depth: int) -> list[Part]:
        """Return the name, the vertices (n, 3) and the faces (f, 3) of the meshes that an element uses."""
        path = normpath(join("/", use.get(_PATH, path))).lstrip("/")
        meshes, matrix = self.meshes(path, use.get("objectid"), depth), _matrix(use.get("transform"))
        self.spend(sum(_OVERHEAD + vertices.nbytes + faces.nbytes for _, vertices, faces in meshes))
        return [(name, *placed(vertices, faces, matrix)) for name, vertices, faces in meshes]

    def meshes(self, path: str, number: str | None, depth: int) -> list[Part]:
        """Return the meshes of an object, which is read once even if it is used many times."""
        if depth > _DEPTH:
            raise damaged("objects contain themselves")
        if (path, number) not in self.objects:
            for shown in _children(self.model(path), "resources", "object"):
                if shown.get("id") == number:
                    break
            else:
                raise damaged(f"the object {excerpt(str(number))} does not exist")
            components = _children(shown, "components", "component")
            found = [mesh for component in components for mesh in self.used(path, component, depth + 1)]
            vertices = _numbers(_children(shown, "mesh", "vertices", "vertex"), "xyz", float)
            faces = _numbers(_children(shown, "mesh", "triangles", "triangle"), ("v1", "v2", "v3"), int)
            if len(faces):
                found.append((shown.get("name") or f"object {number}", vertices, faces))
            self.objects[path, number] = found
        return self.objects[path, number]


@contextmanager
def _readable() -> Iterator[None]:
    try:
        yield
    except Exception:  # zipfile can raise any exception for damaged archives
        raise export_again("is not a complete 3MF package, which is a ZIP archive") from None


def _children(element: ElementTree.Element, *names: str) -> Iterator[ElementTree.Element]:
    """Return the elements below an element at a path of names, in any namespace."""
    return element.iterfind("/".join(f"{{*}}{name}" for name in names))


def _numbers(elements: Iterator[ElementTree.Element], names: tuple[str, ...] | str, kind: type) -> np.ndarray:
    """Return attributes of elements as numbers (elements, 3)."""
    try:
        rows = [[kind(element.get(name, "")) for name in names] for element in elements]
        return np.array(rows, kind).reshape(-1, 3)
    except (ValueError, OverflowError):
        raise damaged(f"a vertex or a triangle does not have the numbers {', '.join(names)}") from None


def _matrix(words: str | None) -> np.ndarray:
    """Return a transform (4, 4), which the file states for rows of coordinates, without the last column."""
    if words is None:
        return np.eye(4)
    try:
        columns = np.array([float(word) for word in words.split()]).reshape(4, 3)
    except ValueError:
        raise damaged(f"the transform {excerpt(words)} does not consist of 12 numbers") from None
    return np.vstack([columns.T, [0, 0, 0, 1]])
