"""Measures registered meshes on remeshed bodies, and landmarks carried between scans of teeth, jaws and skulls.

    python scripts/benchmark_transfer.py DATA_DIRECTORY --output docs/results/transfer
    python scripts/benchmark_transfer.py DATA_DIRECTORY --pairs 5 --parts meshes mandibles

`DATA_DIRECTORY` contains `faust_r`, `tosca_r`, `smal_r`, `primate_molars`, `mouse_mandibles` and `mouse_skulls`. The
pairs are drawn with seed 0. Results are stored pair by pair in `OUTPUT/meshes.csv` and `OUTPUT/landmarks.csv`; the
same command continues where it was interrupted.

Registered meshes are compared with `surface_points`. Landmarks are compared with three other ways to carry them: rigid
alignment and the nearest point (the best of several initial rotations), non-rigid coherent point drift (pycpd) after
this alignment, and the map alone without projection. Distances are in thousandths of the diagonal of the target.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxsmw.errors import InputError
from jaxsmw.evaluation import geodesic_error, read_ground_truth
from jaxsmw.evaluation.journal import Journal
from jaxsmw.geometry import Mesh, farthest_point_samples, nearest_surface_points
from jaxsmw.geometry.surface_distance import bounding_box_diagonal
from jaxsmw.io import Landmarks, read_landmark_file, read_mesh
from jaxsmw.matching import Correspondence, match
from jaxsmw.runtime.provenance import provenance
from jaxsmw.transfer import RegisteredMesh, transfer_landmarks

BODIES = ("faust_r", "tosca_r", "smal_r")
SCANS = ("primate_molars", "mouse_mandibles", "mouse_skulls")
