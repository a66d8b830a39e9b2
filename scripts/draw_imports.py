"""Draws the imports between the layers of the library as docs/pictures/imports.png.

    pip install -e ".[report]"
    python scripts/draw_imports.py

A layer is a module or a package directly below `jaxsmw/`. Each arrow points from an importing layer to an
imported layer. The picture leaves out an arrow if a chain of other arrows already connects the two layers.
"""

from __future__ import annotations

import ast
import graphlib
from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from jaxsmw.report.figures import save_figure

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "pictures" / "imports.png"
# These modules only re-export names of other layers, so they are not layers themselves.
NAMESPACES = ("__main__", "banks", "functional_maps", "learning")


def imported_modules(library: Path = ROOT / "jaxsmw") -> dict[str, set[str]]:
    """Return a dictionary from each module of the library to the set of library modules that it imports.

    Names are dotted and relative to the library. For example, `core.banks` is the package in `core/banks/`.
    """
    modules = {".".join(p.relative_to(library).with_suffix("").parts): p for p in library.rglob("*.py")}
    names = {name.removesuffix(".__init__"): path for name, path in modules.items() if name != "__init__"}
    imports: dict[str, set[str]] = {}
    for name, path in names.items():
        imported: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                imported |= {m if m.removeprefix("jaxsmw.") in names else node.module for m in inner}
        imports[name] = {m.removeprefix("jaxsmw.") for m in imported if m.startswith("jaxsmw.")}
    return imports


def imported_layers() -> dict[str, set[str]]:
    """Return a dictionary from each layer to the set of other layers that its modules import."""
    layers: dict[str, set[str]] = {}
    for module, others in imported_modules().items():
        layer = module.split(".")[0]
        if layer not in NAMESPACES:
            layers.setdefault(layer, set()).update(other.split(".")[0] for other in others)
    return {layer: others - {layer} for layer, others in layers.items()}


def heights(layers: dict[str, set[str]]) -> dict[str, int]:
    """Return the length of the longest import chain below each layer; 0 if the layer imports no other layer.

    **Raises:** `graphlib.CycleError` if layers import each other in a circle.
    """
    height: dict[str, int] = {}
    for layer in graphlib.TopologicalSorter(layers).static_order():
        height[layer] = 1 + max((height[other] for other in layers[layer]), default=-1)
    return height


def direct(layers: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the imports that no chain of other imports implies (the transitive reduction)."""
    reachable: dict[str, set[str]] = {}
    for layer in graphlib.TopologicalSorter(layers).static_order():
        reachable[layer] = layers[layer].union(*(reachable[other] for other in layers[layer]))
    return {
        layer: {a for a in others if not any(a in reachable[b] for b in others - {a})}
        for layer, others in layers.items()
    }


def draw(axes: Axes, layers: dict[str, set[str]]) -> None:
    """Draw every layer above the layers that it imports."""
    height = heights(layers)
    in_row = Counter(height.values())
    placed: Counter[int] = Counter()
    places = {}
    for layer in sorted(layers, key=lambda layer: (height[layer], layer)):
        row = height[layer]
        places[layer] = (placed[row] - (in_row[row] - 1) / 2 + 0.3 * (-1) ** row, row)
        placed[row] += 1
    box = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": "0.2"}
    texts = {
        layer: axes.text(*place, layer, ha="center", va="center", fontsize=9, bbox=box, zorder=2)
        for layer, place in places.items()
    }
    for layer, others in direct(layers).items():
        for other in others:
            rows = height[layer] - height[other]
            bend = 0 if rows == 1 else min(0.15 * rows, 0.5)  # curves the arrow around the layers in between
            style = {
                "arrowstyle": "-|>",
                "color": "0.4",
                "connectionstyle": f"arc3,rad={bend}",
                "patchA": texts[layer].get_bbox_patch(),
                "patchB": texts[other].get_bbox_patch(),
            }
            axes.annotate("", places[other], places[layer], arrowprops=style, zorder=1)
    across = [x for x, _ in places.values()]
    axes.set(xlim=(min(across) - 0.7, max(across) + 0.7), ylim=(-0.6, max(height.values()) + 0.6))
    axes.axis("off")


def main() -> None:
    layers = imported_layers()
    figure, axes = plt.subplots(figsize=(6, 0.62 * (1 + max(heights(layers).values()))))
    draw(axes, layers)
    figure.tight_layout(pad=0.2)
    save_figure(PICTURE, figure)


if __name__ == "__main__":
    main()
