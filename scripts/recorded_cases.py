"""The cases of `record_results.py`: settings of `match`, pairs of meshes, collections and commands."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import igl
import numpy as np

import jaxsmw
from jaxsmw import FeatureRegression, LeastSquares, Registration, Stage, WaveletPreservation
from jaxsmw.creature import CreaturePair
from jaxsmw.geometry import triangulate_points

STAGES = (
    Stage(number_of_eigenvectors=40, iterations=2),
    Stage(FeatureRegression(levels=(15, 20, 30)), number_of_descriptors=40),
    Stage(Registration(levels=(30, 60)), number_of_descriptors=20, number_of_samples=300),
)
LEAST_SQUARES = WaveletPreservation(bank=jaxsmw.CubicSpline(8), solution=LeastSquares())
ACCURATE = jaxsmw.PRESETS["accurate"]

SETTINGS: dict[str, dict[str, Any]] = {
    "accurate": {},
    "paper": {"preset": "paper"},
    "fast": {"preset": "fast"},
    "stage": {"preset": Stage(WaveletPreservation(bank=jaxsmw.Meyer(8)), number_of_eigenvectors=60)},
    "least-squares": {"preset": Stage(LEAST_SQUARES, number_of_eigenvectors=30, stop_when_unchanged=True)},
    "stages": {"preset": STAGES},
    "searched-stages": {"preset": jaxsmw.Preset(STAGES[:1], STAGES[1:], search=jaxsmw.SearchSettings())},
    "large-stages": {"preset": ACCURATE.large},
    "cotangent": {"laplacian": "cotangent"},
    "robust": {"laplacian": "robust", "preset": "paper"},
    "approximate": {"eigensolver": "approximate"},
    "history": {"history": True},
    "paper-history": {"history": True, "preset": "paper"},
    "mirrored": {"mirror": "yes"},
    "not-mirrored": {"mirror": "no"},
    "paper-mirrored": {"mirror": "yes", "preset": "paper"},
    **{init: {"init": init} for init in ("shot", "aligned", "wks", "hks", "wavelet", "functional")},
    **{f"paper-{init}": {"init": init, "preset": "paper"} for init in ("aligned", "wks", "functional")},
    # These initial maps are made from the ground truth of a creature.
    **{f"given-{kind}": {"init": kind} for kind in ("map", "points", "landmarks")},
    "paper-landmarks": {"init": "landmarks", "preset": "paper"},
    "fast-wks": {"init": "wks", "preset": "fast"},
    "fast-points": {"init": "points", "preset": "fast"},
    "partial": {"partial": True},
    "partial-paper": {"partial": True, "preset": "paper"},
    "partial-fast": {"partial": True, "preset": "fast"},
    "partial-stages": {"partial": True, "preset": STAGES},
    "partial-history": {"partial": True, "history": True},
    "partial-wks": {"partial": True, "init": "wks"},
    "unknown-scale": {"partial": True, "scale": "unknown"},
    "known-scale": {"partial": True, "scale": 0.5},
    "published": {"init": "tosca_nonisometric/maps/WKSini_direct/8_gorilla_01_8_man_01.map"},
}
# The pairs and their settings. A creature is described by its kind, number of vertices, seed and pose. A bar
# introduces a change of a mesh; see `changed`. Meshes of similar sizes share compiled programs, so most
# meshes have about 700, 1500 or 5000 vertices.
MATCHES = """
quadruped: quadruped 700 0 source -> quadruped 700 0 target: accurate paper fast stage least-squares stages
    searched-stages large-stages cotangent robust approximate history paper-history mirrored not-mirrored
    paper-mirrored shot aligned wks hks wavelet functional paper-aligned paper-wks paper-functional
    given-map given-points given-landmarks paper-landmarks fast-points
biped: biped 760 1 source -> biped 760 1 target: accurate paper fast stages aligned
opposite: quadruped 700 0 source | mirrored -> quadruped 700 0 target: accurate mirrored not-mirrored paper
loose: quadruped 700 0 source | loose 9 -> quadruped 700 0 target | loose 5: accurate paper fast mirrored
    partial
cloud: quadruped 700 0 source | cloud -> quadruped 700 0 target: accurate paper
itself: quadruped 700 0 source -> quadruped 700 0 source: accurate
front: quadruped 700 0 source | part 0.6 -> quadruped 700 0 target: partial partial-paper partial-fast
    partial-stages partial-history partial-wks accurate
front-reversed: quadruped 700 0 target -> quadruped 700 0 source | part 0.6: partial partial-paper
    partial-fast partial-history
front-scaled: quadruped 700 0 source | part 0.6 | scaled 2 -> quadruped 700 0 target: unknown-scale
    known-scale
front-back: quadruped 700 0 source | part 0.6 -> quadruped 700 0 target | part -0.6: partial partial-paper
coarse: biped 500 3 source | coarse 128 -> biped 500 3 target | coarse 120: accurate paper wks paper-wks
    fast-wks
tiny: biped 500 3 source | coarse 30 -> biped 500 3 target | coarse 30: wks paper-wks partial
tetrahedron: quadruped 700 0 source | coarse 4 -> quadruped 700 0 target: accurate partial
eyes: quadruped 700 0 source | eyes 0.1 -> quadruped 700 0 target | eyes 0.1: accurate paper
dragon: dragon 1500 2 source -> dragon 1500 2 target: accurate paper fast stages
clouds: biped 1500 1 source | cloud -> biped 1500 1 target | cloud: accurate
wolves: tosca_r/off/wolf0.off | coarse 1500 -> tosca_r/off/wolf1.off | coarse 1500: accurate paper functional
hippo-fox: smal_r/off/hippo5.off | coarse 1500 -> smal_r/off/fox-06.off | coarse 1500: accurate fast
lions: smal_r/off/lion3.off | coarse 1500 -> smal_r/off/cougar.off | coarse 1500: accurate large-stages
woman-gorilla: tosca_nonisometric/off/8_woman_01.off | coarse 1500
    -> tosca_nonisometric/off/8_gorilla_03.off | coarse 1500: accurate
glued: shrec16_topology/kid01.off | coarse 1500 -> shrec16_topology/kid15.off | coarse 1500: accurate paper
molars: primate_molars/U05_sas.off | coarse 1500 -> primate_molars/H10_sas.off | coarse 1500:
    accurate aligned not-mirrored
opposite-molars: primate_molars/U05_sas.off | coarse 1500 -> primate_molars/K08_sas.off | coarse 1500:
    accurate mirrored not-mirrored paper
shells: open_shells/mask.off -> open_shells/head.off: unknown-scale accurate
parts: partial_smal/shapes/cuts_0_dog_01.off -> partial_smal/shapes/cuts_9_lion_01.off: partial
    unknown-scale
other-parts: partial_smal/shapes/cuts_11_wolf_02.off -> partial_smal/shapes/cuts_3_cow_03.off: partial
cut: shrec16_partial/cuts/cuts_wolf_shape_4.off -> shrec16_partial/null/wolf.off: partial partial-paper
    partial-fast
cut-reversed: shrec16_partial/null/wolf.off -> shrec16_partial/cuts/cuts_wolf_shape_4.off: partial
holes: shrec16_partial/holes/holes_wolf_shape_2.off -> shrec16_partial/null/wolf.off: partial
faust: faust_r/off/tr_reg_000.off -> faust_r/off/tr_reg_017.off: accurate paper fast
cats: tosca_r/off/cat0.off -> tosca_r/off/cat2.off: accurate paper aligned
gorilla-man: tosca_nonisometric/off/8_gorilla_01.off -> tosca_nonisometric/off/8_man_01.off:
    accurate published
brain: brain_halves/left.off -> brain_halves/right.off: accurate
mandibles: mouse_mandibles/08_6a.vtk -> mouse_mandibles/13_5b.vtk: accurate aligned
large-molars: primate_molars/B03_sas.off -> primate_molars/K03_sas.off: accurate
cow-dog: smal_r/off/cow_alph.off -> smal_r/off/dog2.off: accurate paper
people: shrec19_r/off/1.off -> shrec19_r/off/15.off | coarse 1500: accurate
kids: shrec16_topology/kid01.off -> shrec16_topology/kid00.off: accurate
centaurs: tosca/off/centaur0.off -> tosca/off/centaur1.off: accurate paper
large-cats: tosca/off/cat0.off -> tosca/off/cat1.off: fast
skulls: mouse_skulls/CAST_EIJ.ply -> mouse_skulls/PWK.ply: paper fast
"""
FOUR = [f"quadruped {vertices} 0 {side}" for vertices in (700, 720) for side in ("source", "target")]
MIRRORED = [FOUR[0], f"{FOUR[1]} | mirrored", *FOUR[2:]]
TEETH = [f"primate_molars/{name}_sas.off | coarse 1500" for name in ("B03", "K03", "H10", "P31")]
PEOPLE = [f"faust_r/off/tr_reg_0{number}.off | coarse 1500" for number in ("00", "11", "23", "35")]
# The commands run in a directory with the files that `command` writes.
COMMANDS = {
    "match": "match source.off target.off --output map.txt --expected-error error.txt",
    "partial": "match part.off target.off --partial --preset paper --output map.txt",
    "transfer": "transfer source.off target.off --registered registered.ply",
    "collection": "collection scape --output result --preset paper",
    "benchmark": "benchmark scape --output result --workers 1 "
    "--methods initial mwp accurate mwp-sampled no-filter icp zoomout",
    "aligned": "benchmark scape --output result --workers 1 --methods mwp accurate --init aligned --pairs 2",
    "parts": "benchmark DATA/shrec16_partial --output result --workers 1 "
    "--methods initial mwp accurate pfm --pairs one.txt",
    "animals": "benchmark DATA/tosca_r --output result --workers 1 --mirrored "
    "--methods mwp accurate --pairs 2",
}


@cache
def creatures(name: str) -> CreaturePair:
    """Return two poses of a creature, whose kind, number of vertices and seed the first words state."""
    kind, vertices, seed = name.split()[:3]
    return jaxsmw.creature_pair(kind, vertices=int(vertices), seed=int(seed))


def read(place: str, data: Path) -> jaxsmw.Mesh:
    """Return the pose of a creature or the mesh of a file, with the changes that follow each bar."""
    name, *changes = place.split(" | ")
    is_file = "/" in name
    mesh = jaxsmw.read_mesh(data / name) if is_file else getattr(creatures(name), name.split()[3])
    for change in changes:
        kind, *numbers = change.split()
        mesh = changed(mesh, kind, *map(float, numbers))
    return mesh


def changed(mesh: jaxsmw.Mesh, kind: str, number: float = 0) -> jaxsmw.Mesh:
    """Return a mesh with one change."""
    vertices, faces = mesh.vertices, mesh.faces
    if kind == "cloud":
        return triangulate_points(vertices)
    if kind == "mirrored":
        vertices, faces = vertices * [-1, 1, 1], faces[:, ::-1]
    elif kind == "scaled":
        vertices = vertices * number
    elif kind == "coarse":
        vertices, faces, *_ = igl.decimate(vertices, faces, 2 * int(number) - 4)
    elif kind == "loose":  # unreferenced vertices
        vertices, faces = np.concatenate([vertices[: int(number)] + 1, vertices]), faces + int(number)
    elif kind == "eyes":  # a second component
        faces = np.concatenate([faces, faces + len(vertices)])
        vertices = np.concatenate([vertices, number * vertices])
    elif kind == "part":  # the front for a positive share, the back for a negative share
        along = np.sign(number) * vertices[faces].mean(axis=1)[:, 2]
        used, faces = np.unique(faces[along > np.quantile(along, 1 - abs(number))], return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
    return jaxsmw.make_mesh(vertices, faces, name=f"{mesh.name} ({kind})")
