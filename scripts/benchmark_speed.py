"""How fast things are, beside what they cannot do without.

    python scripts/benchmark_speed.py [--quick] [--only PART ...] [--output DIR]

- `refinement`: three iterations at the paper's setting in float32, at several sizes: with all compared with
  all, in patches, on samples; against three matrix products (m x k) (k x n) alone, in the fastest of
  several ways to have them, and against a plain argmin over stored distances;
- `eigenbasis`: 100 eigenpairs against SciPy's shift-invert `eigsh` with its defaults, in CPU time;
- `stages`: what else the host does for one shape;
- `command`: from starting Python to the map on the disk, with and without compiled programs from before.

What is compared runs in turns in one process, so that a busy moment hits all of it; ratios are of medians.
DIR gets the tables as `speed.md` and all numbers as `speed.json`. Quick does the smallest size only, in two
minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh
from threadpoolctl import threadpool_limits

from jaxsmw.core.refinement import Refiner, WaveletPreservation, refine
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.files import make_directory
from jaxsmw.geometry.creature import creature_pair
from jaxsmw.geometry.eigenbasis import compute_spectrum, eigenpairs
from jaxsmw.geometry.geodesics import geodesic_distances
from jaxsmw.geometry.laplacian import assemble_laplacian
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.geometry.mesh_files import read_mesh, write_mesh
from jaxsmw.geometry.sampling import farthest_point_samples
from jaxsmw.geometry.shot import shot_descriptors
from jaxsmw.matching import initial_map
from jaxsmw.report.summary import provenance
from jaxsmw.report.tables import markdown

ITERATIONS, EIGENVECTORS, SAMPLES = 3, 100, 500
SIZES = (7000, 20_000, 50_000)
# Beyond this many vertices a stored distance matrix would be gigabytes.
STORED = 10_000

Part = tuple[str, str, list[list[str]], dict[str, Any]]
"""A title, what was measured, a table, and its numbers."""


class PlainSearch(WaveletPreservation):
    """The same method with the search one writes first."""

    def recover(self, problem, functional_map):
        database = problem.spectrum_y.eigenvectors @ functional_map.T
        products = problem.spectrum_x.eigenvectors @ database.T
        return jnp.argmin(0.5 * jnp.sum(database**2, axis=1)[None, :] - products, axis=1).astype(jnp.int32)


def medians(
    candidates: dict[str, Callable[[], object]],
    repeats: int,
    clock: Callable[[], float] = time.perf_counter,
    *,
    warm: bool = True,
) -> dict[str, float]:
    """Median seconds of each candidate, run in turns; the first turn compiles and does not count."""
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for turn in range(repeats + warm):
        for name, candidate in candidates.items():
            start = clock()
            jax.block_until_ready(candidate())
            if turn >= warm:
                seconds[name].append(clock() - start)
    return {name: float(np.median(times)) for name, times in seconds.items()}


def compared(seconds: dict[str, float], of: str) -> list[list[str]]:
    """A table with a row for each candidate, and its ratio to one of them."""
    rows = [[name, f"{value:.3f}", f"{value / seconds[of]:.2f}"] for name, value in seconds.items()]
    return [["", "seconds", f"of {of}"], *rows]


def products(x: Spectrum, y: Spectrum) -> dict[str, Callable[[], object]]:
    """Ways to have the products of all eigenvectors' rows, `ITERATIONS` times."""
    # In blocks that stay in the processor's cache, of which as little as possible is kept.
    rows = x.eigenvectors
    blocks = jnp.pad(rows, ((0, -rows.shape[0] % 256), (0, 0))).reshape(-1, 256, rows.shape[1])
    blocked = jax.jit(lambda a, b: jax.lax.map(lambda block: jnp.max(block @ b.T, axis=1), a))
    found: dict[str, Callable[[], object]] = {
        "products, JAX in blocks": lambda: [blocked(blocks, y.eigenvectors) for _ in range(ITERATIONS)]
    }
    if rows.shape[0] <= STORED:
        product = jax.jit(lambda a, b: a @ b.T)
        a, b = np.asarray(rows), np.asarray(y.eigenvectors)
        out = np.empty((a.shape[0], b.shape[0]), a.dtype)
        found["products, JAX"] = lambda: [product(rows, y.eigenvectors) for _ in range(ITERATIONS)]
        found["products, NumPy"] = lambda: [np.matmul(a, b.T, out=out) for _ in range(ITERATIONS)]
    return found


def refinement(options: argparse.Namespace) -> Iterator[Part]:
    """One pair at several sizes."""
    for size in options.sizes:
        pair = creature_pair(vertices=size)
        meshes = pair.source, pair.target
        x, y = (compute_spectrum(mesh, EIGENVECTORS) for mesh in meshes)
        start = jnp.asarray(initial_map(*meshes, x, y, init="shot" if size <= STORED else "wks"))
        samples = [jnp.asarray(farthest_point_samples(mesh, SAMPLES)) for mesh in meshes]

        def refined(refiner: Refiner, *sampled: Any, x=x, y=y, start=start) -> Callable[[], Any]:
            chosen = dict(zip(("samples_x", "samples_y"), sampled, strict=False))
            return lambda: refine(x, y, start, refiner=refiner, iterations=ITERATIONS, **chosen)

        exhaustive, patches = (WaveletPreservation(search=search) for search in ("exhaustive", "patches"))
        candidates = {
            "all with all": refined(exhaustive),
            "in patches": refined(patches),
            "on samples": refined(exhaustive, *samples),
            "on samples, in patches": refined(patches, *samples),
        }
        if size <= STORED:
            candidates["plain argmin"] = refined(PlainSearch())
        alone = products(x, y)
        seconds = medians(alone | candidates, options.repeats if size <= STORED else 3)
        floor = min(alone, key=lambda name: seconds[name])
        same = [
            float(np.mean(np.asarray(candidates[a]().pointwise_map == candidates[b]().pointwise_map)))
            for a, b in (("all with all", "in patches"), ("on samples", "on samples, in patches"))
        ]
        m, n = (mesh.vertices.shape[0] for mesh in meshes)
        yield (
            f"Refinement, {m} x {n} vertices",
            f"k = {EIGENVECTORS}, {ITERATIONS} iterations, float32. In patches {same[0]:.3%} of the matches "
            f"are the same, on samples {same[1]:.3%}.",
            compared(seconds, floor),
            {"vertices": [m, n], "seconds": seconds, "same": same},
        )


def eigenbasis(options: argparse.Namespace) -> Iterator[Part]:
    """Of one shape."""
    for size in options.sizes:
        mesh = creature_pair(vertices=size).source
        stiffness, areas = assemble_laplacian(mesh)
        masses = sp.diags(areas / areas.sum()).tocsc()

        def usual(stiffness=stiffness, masses=masses) -> object:
            with threadpool_limits(1, "blas"):
                return eigsh(stiffness, EIGENVECTORS, masses, sigma=-1e-2)

        candidates = {"SciPy's eigsh": usual, "ours": lambda mesh=mesh: eigenpairs(mesh, EIGENVECTORS)}
        seconds = medians(candidates, 3, time.process_time, warm=False)
        yield (
            f"Eigenbasis, {len(mesh.vertices)} vertices",
            f"{EIGENVECTORS} eigenpairs, one thread, CPU time. Ours includes the Laplacian and a check.",
            compared(seconds, "SciPy's eigsh"),
            {"vertices": len(mesh.vertices), "seconds": seconds},
        )


def stages(options: argparse.Namespace) -> Iterator[Part]:
    """Of the host, for one shape."""
    for size in options.sizes:
        mesh = creature_pair(vertices=size).source
        sources = np.arange(0, len(mesh.vertices), len(mesh.vertices) // 100)
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory) / "mesh.off"
            write_mesh(file, mesh)
            seconds = medians(
                {
                    "eigenbasis": lambda mesh=mesh: eigenpairs(mesh, EIGENVECTORS),
                    "SHOT": lambda mesh=mesh: shot_descriptors(mesh),
                    "farthest points": lambda mesh=mesh: farthest_point_samples(mesh, SAMPLES),
                    "geodesics from 100": lambda mesh=mesh, at=sources: geodesic_distances(mesh, at),
                    "reading OFF": lambda file=file: read_mesh(file),
                },
                3,
                warm=False,
            )
        yield (
            f"Stages, {len(mesh.vertices)} vertices",
            f"k = {EIGENVECTORS}, {SAMPLES} samples.",
            compared(seconds, "eigenbasis"),
            {"vertices": len(mesh.vertices), "seconds": seconds},
        )


def command(options: argparse.Namespace) -> Iterator[Part]:
    """New processes, two meshes of 7000 vertices, nothing kept but compiled programs."""
    pair = creature_pair(vertices=SIZES[0])
    with tempfile.TemporaryDirectory() as directory:
        files = [str(Path(directory) / f"{side}.off") for side in ("source", "target")]
        for file, mesh in zip(files, (pair.source, pair.target), strict=True):
            write_mesh(Path(file), mesh)
        output = str(Path(directory) / "map.txt")
        matching = ["-m", "jaxsmw", "match", *files, "--output", output]

        def started(*arguments: str, programs: str | None = None) -> Callable[[], object]:
            environment = {**os.environ, "JAXSMW_CACHE": "off"}
            environment.pop("JAX_COMPILATION_CACHE_DIR", None)
            if programs:
                environment["JAX_COMPILATION_CACHE_DIR"] = programs
            call = [sys.executable, *arguments]
            return lambda: subprocess.run(call, check=True, capture_output=True, env=environment)

        def both(meshes: tuple[Mesh, Mesh] = (pair.source, pair.target)) -> object:
            return [eigenpairs(mesh, EIGENVECTORS) for mesh in meshes]

        kept = str(Path(directory) / "programs")
        started(*matching, programs=kept)()
        seconds = medians(
            {
                "two eigenbases": both,
                "import jax": started("-c", "import jax"),
                "import jaxsmw": started("-c", "import jaxsmw"),
                "jaxsmw --help": started("-m", "jaxsmw", "--help"),
                "jaxsmw match": started(*matching),
                "jaxsmw match, compiled before": started(*matching, programs=kept),
            },
            3,
            warm=False,
        )
    yield (
        "Commands",
        "New processes; no spectra kept.",
        compared(seconds, "two eigenbases"),
        {"seconds": seconds},
    )


PARTS = {part.__name__: part for part in (refinement, eigenbasis, stages, command)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--output", type=Path, default=Path("speed"), metavar="DIR")
    options = parser.parse_args()
    options.sizes, options.repeats = (SIZES[:1], 3) if options.quick else (SIZES, 9)
    os.environ["JAXSMW_CACHE"] = "off"

    output = make_directory(options.output)
    origin = provenance()
    parts, numbers = [f"# Speed\n\n{json.dumps(origin)}"], {"provenance": origin}
    print(parts[0])
    for name in options.only:
        numbers[name] = []
        for title, note, rows, measured in PARTS[name](options):
            parts.append(f"## {title}\n\n{note}\n\n{markdown(rows)}")
            print(f"\n{parts[-1]}", flush=True)
            numbers[name].append(measured)
            (output / "speed.md").write_text("\n\n".join(parts), "utf-8")
            (output / "speed.json").write_text(json.dumps(numbers, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
