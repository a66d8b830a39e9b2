"""Imports between the rooms of the house point one way, and the public names stay few."""

import ast
import graphlib
from pathlib import Path

import jaxsmw

LIBRARY = Path(jaxsmw.__file__).parent
# From the ground floor up: a room imports from itself and from rooms before it.
ROOMS = (
    "errors",
    "choices",
    "core",
    "runtime",
    "geometry",
    "io",
    "pair",
    "descriptors",
    "initial_maps",
    "stage",
    "preparation",
    "repair",
    "presets",
    "matching",
    "evaluation",
    "report",
    "cli",
)


def imports():
    """Each module of the library with the modules of the library that it imports, anywhere in its code."""
    modules = {".".join(p.relative_to(LIBRARY).with_suffix("").parts): p for p in LIBRARY.rglob("*.py")}
    names = {name.removesuffix(".__init__"): path for name, path in modules.items() if name != "__init__"}
    found = {}
    for name, path in names.items():
        found[name] = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxsmw"):
                base = node.module.removeprefix("jaxsmw").removeprefix(".")
                inner = {f"{base}.{alias.name}".removeprefix(".") for alias in node.names}
                found[name] |= {one if one in names else base for one in inner} - {""}
    return found


def test_rooms_import_only_from_rooms_below():
    upwards = [
        f"{module} imports {other}"
        for module, others in imports().items()
        for other in others
        if (room := module.split(".")[0]) in ROOMS and ROOMS.index(other.split(".")[0]) > ROOMS.index(room)
    ]
    assert not upwards


def test_every_module_lives_in_a_room():
    namespaces = {"__main__", "banks", "functional_maps", "learning"}
    assert {module.split(".")[0] for module in imports()} <= {*ROOMS, *namespaces}


def test_imports_have_no_cycle():
    graphlib.TopologicalSorter(imports()).prepare()


def test_the_core_knows_no_host_libraries():
    """Traced code has no business with files, SciPy's solvers or meshes."""
    for path in (LIBRARY / "core").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            found = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in found} & {"scipy", "igl", "os", "pathlib", "io"}, path
