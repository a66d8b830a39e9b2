"""The types of arguments that accept names, and the default settings.

The help text of the command line shows these names. Names of things that the library makes are the keys of
their registries, such as `jaxsmw.benchmark.protocols.PROTOCOLS`. This module does not import JAX, NumPy or
SciPy, because these imports would delay the help text.
"""

from typing import Literal

PresetName = Literal["fast", "paper", "accurate"]
"""The names of the presets; see `jaxsmw.PRESETS`."""
DEFAULT_PRESET: PresetName = "accurate"

InitialMap = Literal["shot", "wks", "hks", "wavelet", "functional", "aligned", "positions"]
"""The names of the initial maps; see `jaxsmw.initial_map`."""
DEFAULT_INITIAL_MAP: InitialMap = "shot"
MatchInit = Literal["auto", InitialMap]
"""The names that `jaxsmw.match` accepts; `"auto"` begins with `"shot"` and may try others."""
DEFAULT_MATCH_INIT: MatchInit = "auto"

Mirror = Literal["auto", "no", "yes"]
"""Whether the mirror image of the source is matched instead of the source; see `jaxsmw.match`."""
MirrorCollection = Literal["auto", "no"]
"""Whether mirror images of some meshes are matched instead of the meshes; see `jaxsmw.match_collection`."""
DEFAULT_MIRROR: MirrorCollection = "auto"

Sliding = Literal["bending", "procrustes"]
"""What semilandmarks minimise when they slide; see `jaxsmw.collection.slide_semilandmarks`."""

EDGES_PER_SHAPE = 4
"""The default number of matched pairs of a collection, divided by the number of shapes."""

Scale = Literal["unknown"]
"""The name of a scale of a partial pair that must be estimated; see `jaxsmw.match`."""

Template = Literal["mammal"]
"""The names of built-in full shapes through which two partial shapes can be matched; see `jaxsmw.match`."""

Laplacian = Literal["auto", "cotangent", "robust"]
"""The discretizations of the Laplacian; see `jaxsmw.compute_spectrum`."""

Eigensolver = Literal["auto", "exact", "approximate"]
"""The methods that compute eigenvectors; see `jaxsmw.compute_spectrum`."""
APPROXIMATE_FROM = 50_000
"""The smallest number of vertices for which the eigensolver `"auto"` chooses `"approximate"`."""

Backend = Literal["auto", "numpy", "jax"]
"""What refines one pair; `"auto"` chooses NumPy on machines without accelerators, see `jaxsmw.match`."""
DEFAULT_BACKEND: Backend = "auto"

GeodesicMethod = Literal["strips", "exact"]
"""The methods that compute geodesic distances; see `jaxsmw.geometry.geodesic_distances`."""

IndexBase = Literal[0, 1]
"""The possible indices of the first vertex in a file."""

Split = Literal["train", "test"]
"""The two parts of a data set for learned methods; see `jaxsmw.benchmark.DataSet.split`."""

CoordinateSystem = Literal["LPS", "RAS"]
"""The names of coordinate systems of medical images; the letters say in which directions x, y, z increase.

LPS means left, posterior (back), superior (up); RAS means right, anterior (front), superior. A change from
one system to the other reverses the signs of x and y.
"""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""The axis of a mesh that points up in pictures."""

NUMBER_OF_EIGENVECTORS = 100
"""The number of eigenvectors per shape in the MWP paper."""
ITERATIONS = 3
"""The number of iterations in the MWP paper."""
