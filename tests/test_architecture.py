"""Layers import only from lower layers, imports have no cycle, and the package exports few names."""

import ast
import graphlib
from pathlib import Path
from typing import get_args

from draw_imports import NAMESPACES, imported_modules

import jaxsmw
from jaxsmw.choices import PresetName

LIBRARY = Path(jaxsmw.__file__).parent
# The layers from bottom to top: a layer imports only from itself and from layers before it.
LAYERS = (
    "errors",
    "choices",
    "wording",
    "core",
    "runtime",
    "geometry",
    "creature",
    "io",
    "transfer",
    "evaluation",
    "matching",
    "collection",
    "report",
    "benchmark",
    "cli",
)


def test_layers_import_only_from_lower_layers():
    upwards = [
        f"{module} imports {other}"
        for module, others in imported_modules().items()
        for other in others
        if (layer := module.split(".")[0]) in LAYERS
        and LAYERS.index(other.split(".")[0]) > LAYERS.index(layer)
    ]
    assert not upwards


def test_matching_is_read_from_the_top():
    """The package lists its modules in an order in which each imports only from modules above it."""
    import jaxsmw.matching

    listed = [line.split(":")[0] for line in jaxsmw.matching.__doc__.splitlines() if line.startswith("- `")]
    order = [name for line in listed for name in line.replace("-", "").replace("`", "").split(", ")]
    order = [name.strip() for name in order]
    inside: dict[str, set[str]] = {name: set() for name in order}
    for module, others in imported_modules().items():
        if module.startswith("matching."):
            name = module.split(".")[1]
            within = {other.split(".")[1] for other in others if other.startswith("matching.")}
            inside.setdefault(name, set()).update(within - {"search"} if name == "search" else within)
    assert set(order) == set(inside)
    for module, others in inside.items():
        assert all(order.index(other) < order.index(module) for other in others)


def test_every_module_belongs_to_a_layer_or_a_namespace():
    assert {module.split(".")[0] for module in imported_modules()} <= {*LAYERS, *NAMESPACES}


def test_the_package_exports_at_most_50_names():
    """Further names belong in subpackages such as `jaxsmw.banks`, `jaxsmw.io` and `jaxsmw.evaluation`."""
    assert len(jaxsmw.__all__) <= 50


def test_only_its_command_imports_the_benchmark():
    importers = {
        module
        for module, others in imported_modules().items()
        if module.split(".")[0] != "benchmark" and any(other.split(".")[0] == "benchmark" for other in others)
    }
    assert importers == {"cli.benchmark"}


def test_the_names_of_presets_are_written_once_more_only_in_their_type():
    assert tuple(jaxsmw.PRESETS) == get_args(PresetName)


def test_imports_have_no_cycle():
    graphlib.TopologicalSorter(imported_modules()).prepare()


def test_the_core_imports_no_host_libraries():
    """JAX traces the code of the core, so this code must not use files, SciPy's solvers or meshes.

    Only the versions for NumPy arrays of searches and factorisations, which JAX never traces, use SciPy. The
    default type of floats is a setting of the environment.
    """
    for_numpy = {LIBRARY / "core" / name for name in ("arrays.py", "host_search.py", "linear_algebra.py")}
    for path in set((LIBRARY / "core").rglob("*.py")) - for_numpy:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            found = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in found} & {"scipy", "igl", "os", "pathlib", "io"}, path
