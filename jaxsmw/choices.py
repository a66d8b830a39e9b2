"""The names that settings accept, and default sizes.

The help of the command line shows these names. This module imports nothing heavy, so the help need not wait
for JAX, NumPy and SciPy.
"""

from typing import Literal

PresetName = Literal["fast", "paper", "accurate"]
"""See `jaxsmw.PRESETS`."""
DEFAULT_PRESET: PresetName = "accurate"

InitialMap = Literal["shot", "wks", "hks", "wavelet", "functional"]
"""See `jaxsmw.initial_map`."""
DEFAULT_INITIAL_MAP: InitialMap = "shot"

Laplacian = Literal["auto", "cotangent", "robust"]
"""See `jaxsmw.compute_spectrum`."""

Eigensolver = Literal["auto", "exact", "approximate"]
"""See `jaxsmw.compute_spectrum`."""
APPROXIMATE_FROM = 50_000
"""The number of vertices from which the eigensolver `"auto"` is approximate."""

Search = Literal["auto", "exhaustive", "patches"]
"""How nearest neighbours are found. All settings find the same; `"auto"` chooses the faster search."""

GeodesicMethod = Literal["strips", "exact"]
"""See `jaxsmw.geodesic_distances`."""

IndexBase = Literal[0, 1]
"""The number of the first vertex in a file."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of a mesh that points up in pictures."""

MethodName = Literal[
    "initial",
    "mwp",
    "accurate",
    "mwp-sampled",
    "no-filter",
    "icp",
    "cpd",
    "bcicp",
    "pfm",
    "zoomout",
    "zoomout-sampled",
]
"""The methods of a benchmark; see `jaxsmw.evaluation.opponents.opponents.METHODS`."""
PeerName = Literal["pyfm-zoomout", "geomfum-zoomout"]
"""The methods of other libraries, for a benchmark where these libraries are installed."""

NUMBER_OF_EIGENVECTORS = 100
"""The number of eigenvectors per shape in the MWP paper."""
ITERATIONS = 3
"""The number of iterations in the MWP paper."""
