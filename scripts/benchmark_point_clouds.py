"""Compares the maps of point clouds with the maps of the meshes from which the points were taken.

    python scripts/benchmark_point_clouds.py DATA_DIRECTORY/faust_r --pairs 20

Pairs are drawn with seed 0. A point cloud consists of all vertices of a mesh, displaced by normally
distributed noise (seed 0). Each pair is matched as two meshes, as two point clouds, and as a point cloud and
a mesh. Errors are geodesic errors on the mesh of the target, in thousandths of the square root of its area.
"""

from __future__ import annotations

import warnings

import numpy as np
from common import make_parser

from jaxsmw import Mesh, geodesic_error, match, read_mesh
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.geometry import triangulate_points
from jaxsmw.runtime.provenance import made_with


def main() -> None:
    """Match the pairs, and print the errors of each pair and their means."""
    parser = make_parser(__doc__, data="DATA_DIRECTORY", pairs=20)
    parser.add_argument(
        "--noise",
        type=float,
        default=0.0,
        help="standard deviation of the noise, in units of the median edge length (default: 0)",
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # suspicious maps are measured too
    rows = []
    for pair in choose_pairs(open_data_set(options.data), str(options.pairs), 0):
        meshes = [read_mesh(file) for file in pair.meshes]
        clouds = [_cloud(mesh, options.noise) for mesh in meshes]
        truth = pair.ground_truth(*meshes)
        errors = []
        for source, target in (meshes, clouds, (clouds[0], meshes[1])):
            pointwise_map = match(source, target).pointwise_map
            errors.append(1e3 * geodesic_error(meshes[1], pointwise_map, truth).mean)
        rows.append(errors)
        print(*pair.names, *(f"{error:.1f}" for error in errors), flush=True)
    of_meshes = np.mean(rows, axis=0)[0]
    for kind, values in zip(
        ("meshes", "point clouds", "point cloud to mesh"), np.transpose(rows), strict=True
    ):
        mean = values.mean()
        ratio = mean / of_meshes
        print(f"{kind}: mean {mean:.1f}, median {np.median(values):.1f}, {ratio:.2f} times the meshes'")
    print(made_with())


def _cloud(mesh: Mesh, noise: float) -> Mesh:
    """Displace the vertices of a mesh by noise, and triangulate the resulting points."""
    edge = np.median(np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1)[:, 0], axis=1))
    displacements = np.random.default_rng(0).normal(size=mesh.vertices.shape)
    return triangulate_points(mesh.vertices + noise * edge * displacements, name=mesh.name)


if __name__ == "__main__":
    main()
