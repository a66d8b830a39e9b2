r"""Partial functional maps: finds a functional map and the region of Y that X covers.

This module reconstructs the method of Rodolà, Cosmo, Bronstein, Torsello, Cremers, *Partial functional
correspondence*, Computer Graphics Forum 36(1), 2017. This implementation was written without the authors'
program and without the text of the paper. The formula of the weights W was written from memory.

X is the partial shape, and Y is the full shape. Functions F on X correspond to functions G on Y, but only
inside the region of Y that X covers. A membership function v on Y describes the region: eta(v) is near 1
inside the region and near 0 outside. The function eta is a smooth step. A and B(v) are the coefficients of
the functions in the eigenbases Phi_X and Phi_Y:

    eta(t) = (tanh(6 (t - 1/2)) + 1) / 2,    A = Phi_X^+ F,    B(v) = Phi_Y^+ (eta(v) G).

In the paper, the functional map C takes functions on X to functions on Y. In the code, C is the pullback,
which is the transpose of the paper's C. The paper minimises the following energy alternately over C and v:

    ||C A - B(v)||_{2,1}
        + mu_1 ||C * W||^2 + mu_2 sum_{i != j} (C^T C)_ij^2 + mu_3 sum_i ((C^T C)_ii - d_i)^2
        + mu_4 (area(X) - integral of eta(v))^2 + mu_5 integral of xi(v) ||grad v||

The first line of the energy is the fidelity term. The second line regularises the functional map, and the
third line regularises the region. The weights W grow with the distance from a slanted diagonal of C. The
slope of this diagonal is `r / k`. Here k is the number of eigenvectors of Y, and the r-th eigenvalue of X is
about as large as the k-th eigenvalue of Y. The slope of the diagonal is approximately the area of X divided
by the area of Y. The number d_i is 1 for i <= r and 0 for larger i.

This implementation differs from the paper in the following points.

- **Initial values.** The first C is computed from the initial map, from which all compared methods start.
  The paper starts from v = 1 and a C that does not depend on the pair.
- **Iterations.** A few steps of spectral ICP follow each minimisation over C. Like the final refinement in
  the paper, each step makes the rows of C orthonormal. On three real pairs, the intersection over union of
  the computed and the true region is 39, 21 and 21 % without spectral ICP, and 83, 81 and 43 % with it.
- **Region.** Each minimisation over v starts from the image of the constant function under C, clipped to
  [0, 1]. From v = 1 or the previous v, it does not correct wrong regions, because the derivative of eta
  nearly vanishes where v is near 0 or 1.
- **Descriptors.** The last column of F and of G is the constant function 1, which has as much weight as all
  other columns together: the first principal components of SHOT, scaled to mean square 1. In the paper, the
  columns are the 352 entries of SHOT, each with a large constant part. The number of components has little
  effect between 10 and 30. With 100 components, the energy of C = 0 is lower than that of the true C and v.
- **Rank.** Only the r nonzero columns of the paper's C are stored.
- **Length.** This implementation sets xi to 1. The term with the weight mu_5 is then the total variation of
  v. In the paper, xi(v) vanishes unless v is near 1/2.
- **Weights.** Y has area 1, and column norms are averaged instead of summed, so the units of the weights
  differ from those in the paper. The minimisation over C multiplies the fidelity term by `FIDELITY`.
  `FIDELITY` and mu_5 were chosen on four real pairs. No other value of mu_4 was tested.
- **Recovery.** The nearest-neighbour search includes all vertices of Y. A search in the region alone gives
  the same maps if the region is correct, and worse maps otherwise.
- **Solver.** L-BFGS of the library optimistix minimises the energies in a bounded number of steps. The
  variable v is scaled by the square roots of the vertex areas. All norms are smoothed at zero.

On 12 pairs of SHREC'16 that were not used to choose weights, the mean geodesic errors of the initial maps, of
this implementation and of MWP are 0.135, 0.015 and 0.011 (cuts), and 0.160, 0.018 and 0.017 (holes).

`PARTIAL_FUNCTIONAL_MAPS` has the settings of the benchmark: 100 eigenvectors, 15 descriptors and 5
iterations. Functional maps have the pullback convention of `jaxsmw.core.functional_map`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int, Int32

from jaxsmw.benchmark.opponents.base import Method, MethodInput, PointwiseMap, successful
from jaxsmw.core.arrays import Array
from jaxsmw.core.checks import all_finite
from jaxsmw.core.functional_map import dual_eigenvectors, encode
from jaxsmw.core.linear_algebra import product
from jaxsmw.core.module import Module
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.refinement import diagnose
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.batches import pad_rows, padded_size
from jaxsmw.runtime.compilation import compiled

FIDELITY = 60.0
"""The factor of the fidelity term in the minimisation over C. The fidelity term averages column norms."""
MAP_WEIGHTS = (1.0, 100.0, 1.0)
"""The published weights mu_1, mu_2 and mu_3 of the terms that regularise the functional map."""
REGION_WEIGHTS = (10.0, 0.01)
"""The weights mu_4 and mu_5 of the terms that regularise the region, for the unit in which Y has area 1."""

# The rate at which the slanted weights decay towards high frequencies (sigma of W in the paper).
_DECAY = 0.03
# `_smoothed_norm` smooths the norms of columns and of gradients below this threshold. By comparison, the
# norm of a descriptor is about 1.
_SMOOTHING = 1e-3
# The largest numbers of L-BFGS steps in a minimisation over C and in a minimisation over v.
_MAP_STEPS, _REGION_STEPS = 100, 60
_MAP_TOLERANCE, _REGION_TOLERANCE = 1e-4, 1e-6


class SurfaceGradient(Module):
    """The gradient operator for piecewise linear functions on a mesh.

    **Attributes:**

    - `faces`: the corners of each face (f, 3), 0-based. The array is padded with faces of area zero.
    - `hats`: the gradients of hat functions (f, 3, 3), indexed by face, corner and coordinate. The hat
      function of a corner is linear on the face, 1 at this corner, and 0 at the other two corners. The
      gradient is zero on faces of area zero.
    - `areas`: the area of each face (f,).
    """

    faces: Int32[Array, "f 3"]
    hats: Float[Array, "f 3 xyz"]
    areas: Float[Array, " f"]

    @classmethod
    def of(cls, mesh: Mesh, spectrum: Spectrum) -> SurfaceGradient:
        """Return the gradient operator of a mesh, in the unit of its spectrum, which may be padded.

        **Raises:** `InputError` if the spectrum has fewer rows than the mesh has vertices.
        """
        rows, n = spectrum.mask.shape[0], len(mesh.vertices)
        if rows < n:
            raise InputError(
                f"{mesh.name}: has {n} vertices, but its spectrum has {rows} rows: give the spectrum of this "
                "mesh."
            )
        scale = math.sqrt(float(jnp.sum(spectrum.vertex_areas)) / mesh.area)
        corners = scale * mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(normals, axis=1)
        opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
        # The gradient of a hat function is `n x e / (2 area)` for the unit normal n and the opposite edge e.
        # Each vector in `normals` has the length `2 area`.
        squared = np.where(doubled > 0, doubled, np.inf)[:, None, None] ** 2
        hats = np.cross(normals[:, None], opposite) / squared
        size = padded_size(len(mesh.faces))
        dtype = spectrum.eigenvectors.dtype
        return cls(
            jnp.asarray(pad_rows(mesh.faces, size), jnp.int32),
            jnp.asarray(pad_rows(hats, size), dtype),
            jnp.asarray(pad_rows(doubled / 2, size), dtype),
        )

    def total_variation(self, function: Float[Array, " n"]) -> Float[Array, ""]:
        """Return the integral of the gradient's length, smoothed at zero, for values at the vertices (n,)."""
        gradient = jnp.einsum("fc,fcd->fd", function[self.faces], self.hats)
        return jnp.sum(self.areas * _smoothed_norm(gradient, axis=1))


class PartialMap(Module):
    """The result of `partial_functional_map`.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y; -1 everywhere if the method failed.
    - `functional_map`: C (r, k_Y) with orthonormal rows, where r is the smaller of k_X and k_Y.
    - `region`: eta(v) (n,), near 1 inside the region that X covers and near 0 outside. The value at masked
      vertices of Y is 0.
    - `result`: the status code, a member of `RESULTS`.
    """

    pointwise_map: Int32[Array, " m"]
    functional_map: Float[Array, "r k_y"]
    region: Float[Array, " n"]
    result: RESULTS


def partial_functional_map(
    spectrum_x: Spectrum,
    spectrum_y: Spectrum,
    gradient_y: SurfaceGradient,
    pointwise_map: Int[Array, " m"],
    *,
    iterations: int = 5,
    icp_steps: int = 5,
) -> PartialMap:
    """Match a partial shape X with a full shape Y by partial functional maps (Rodolà et al. 2017).

    The function is traced JAX code. The docstring of this module contains the equations.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the spectra of X and Y, in the unit of length in which Y has area 1. Both
      spectra must be cut to their common range of eigenvalues (`jaxsmw.matching.spectral_pair.common_range`).
      After this cut, the number k_X of eigenvectors of X is the rank r of the paper. If k_X is larger than
      k_Y, only the first k_Y eigenvectors of X are used. Both spectra need the same number of descriptors.
      The descriptors of X and Y must be comparable, and scaled to mean square 1.
    - `gradient_y`: the gradient of functions on Y, in the unit of length in which Y has area 1.
    - `pointwise_map`: the initial map X -> Y (m,), 0-based vertices of Y.
    - `iterations`: the number of iterations, at least 1. Each iteration minimises the energy over C, then
      over v.
    - `icp_steps`: the number of steps of spectral ICP after each minimisation over C.

    **Returns:** A `PartialMap`. No error is raised for NaN or infinite numbers, so check the attribute
    `result` of the `PartialMap`.

    **Raises:** `ValueError` if `iterations` is less than 1, if a spectrum has no descriptors, or if the
    numbers of descriptors differ.
    """
    if iterations < 1:
        raise ValueError(f"partial functional maps need at least 1 iteration, not {iterations}")
    energies = _Energies.of(spectrum_x, spectrum_y, gradient_y)
    spectra = energies.spectrum_x, spectrum_y

    def iterate(
        state: tuple[Float[Array, "r k_y"], Float[Array, " n"]], _: None
    ) -> tuple[tuple[Float[Array, "r k_y"], Float[Array, " n"]], None]:
        c, membership = state
        c = _spectral_icp(energies.best_map(c, membership), *spectra, icp_steps)
        return (c, energies.best_region(c)), None

    initial = encode(pointwise_map, *spectra)
    state, _ = lax.scan(iterate, (initial, energies.covered(initial)), None, length=iterations)
    functional_map, membership = state
    region = jnp.where(spectrum_y.mask, eta(membership), 0)
    # If an energy overflows, C and v stay unchanged and finite, so the fidelity term is checked as well.
    left = fidelity(functional_map, energies.coefficients_x, energies.inside(membership))
    finite = all_finite((functional_map, region, left))
    result = where(finite, RESULTS.successful, RESULTS.nonfinite_functional_map)
    result = diagnose(*spectra, pointwise_map.astype(jnp.int32), result)
    recovered = decode(functional_map, *spectra)
    return PartialMap(jnp.where(result == RESULTS.successful, recovered, -1), functional_map, region, result)


class _Energies(Module):
    """The data of one pair, with methods that minimise the energy over C and over v."""

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    gradient_y: SurfaceGradient
    dual_y: Float[Array, "n k_y"]  # its transpose is Phi_Y^+
    coefficients_x: Float[Array, "r functions"]  # A
    functions_y: Float[Array, "n functions"]  # G

    @classmethod
    def of(cls, spectrum_x: Spectrum, spectrum_y: Spectrum, gradient_y: SurfaceGradient) -> _Energies:
        described_x, described_y = (
            0 if spectrum.descriptors is None else spectrum.descriptors.shape[1]
            for spectrum in (spectrum_x, spectrum_y)
        )
        if not described_x == described_y > 0:
            raise ValueError(
                "partial functional maps need the same number of descriptors on both shapes, at least 1, "
                f"not {described_x} and {described_y}"
            )
        # C (r, k_Y) has orthonormal rows, so r is at most k_Y. A partial shape with many holes can have more
        # than k_Y eigenvalues in the common range.
        spectrum_x = spectrum_x.truncate(spectrum_y.eigenvalues.shape[0])
        dual_x, dual_y = (dual_eigenvectors(spectrum, "area") for spectrum in (spectrum_x, spectrum_y))
        coefficients_x = product(dual_x.T, _functions(spectrum_x))
        return cls(spectrum_x, spectrum_y, gradient_y, dual_y, coefficients_x, _functions(spectrum_y))

    def covered(self, c: Float[Array, "r k_y"]) -> Float[Array, " n"]:
        """Map the constant function 1 on X to Y by `c`, and clip the result to [0, 1]."""
        coefficients = product(c.T, self.coefficients_x[:, -1])
        return jnp.clip(product(self.spectrum_y.eigenvectors, coefficients), 0, 1)

    def inside(self, membership: Float[Array, " n"]) -> Float[Array, "k_y functions"]:
        """Return B(v), the coefficients of the product of eta(v) and the functions on Y."""
        return product(self.dual_y.T, eta(membership)[:, None] * self.functions_y)

    def best_map(self, c: Float[Array, "r k_y"], membership: Float[Array, " n"]) -> Float[Array, "r k_y"]:
        """Minimise the energy over the functional map for a fixed membership function, starting from `c`."""
        coefficients_y = self.inside(membership)
        weights = slanted_weights(*c.shape).astype(self.coefficients_x.dtype)

        def energy(c: Float[Array, "r k_y"]) -> Float[Array, ""]:
            distance = fidelity(c, self.coefficients_x, coefficients_y)
            return FIDELITY * distance + map_energy(c, weights)

        return _minimum(energy, c, _MAP_TOLERANCE, _MAP_STEPS)

    def best_region(self, c: Float[Array, "r k_y"]) -> Float[Array, " n"]:
        """Minimise the energy over the membership function for a fixed `c`, starting from `covered(c)`."""
        area_x = jnp.sum(self.spectrum_x.vertex_areas)
        # The solver minimises over u = v sqrt(vertex area), so its convergence is nearly independent of the
        # mesh density.
        metric = jnp.sqrt(jnp.where(self.spectrum_y.mask, self.spectrum_y.vertex_areas, 1))

        def energy(scaled: Float[Array, " n"]) -> Float[Array, ""]:
            v = scaled / metric
            distance = fidelity(c, self.coefficients_x, self.inside(v))
            return distance + region_energy(v, area_x, self.spectrum_y, self.gradient_y)

        return _minimum(energy, self.covered(c) * metric, _REGION_TOLERANCE, _REGION_STEPS) / metric


def eta(membership: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return eta(v) (n,) for a membership function v (n,): near 0 outside the region and near 1 inside."""
    return (jnp.tanh(6 * (membership - 0.5)) + 1) / 2


def slanted_weights(k_x: int, k_y: int) -> Float[Array, "k_x k_y"]:
    """Return the weights W of the paper (k_x, k_y), which grow with the distance to a slanted diagonal.

    The diagonal starts at the first entry and moves k_x / k_y rows per column. The weight of an entry is its
    distance to the diagonal in entries, times `exp(-0.03 sqrt(i^2 + j^2))`, with i and j counted from 1.
    """
    row, column = jnp.meshgrid(*(jnp.arange(1, k + 1, dtype=float) for k in (k_x, k_y)), indexing="ij")
    slope = k_x / k_y
    distance = jnp.abs((row - 1) - slope * (column - 1)) / math.hypot(1, slope)
    return jnp.exp(-_DECAY * jnp.hypot(row, column)) * distance


def fidelity(
    functional_map: Float[Array, "k_x k_y"],
    coefficients_x: Float[Array, "k_x functions"],
    coefficients_y: Float[Array, "k_y functions"],
) -> Float[Array, ""]:
    """Return the fidelity term for C^T (k_x, k_y), A (k_x, functions) and B (k_y, functions).

    It is the norm of the last column of `C A - B`, which belongs to the constant function, plus the mean norm
    of the other columns. The norms are smoothed at zero.
    """
    norms = _smoothed_norm(product(functional_map.T, coefficients_x) - coefficients_y, axis=0)
    return jnp.mean(norms[:-1]) + norms[-1]


def map_energy(functional_map: Float[Array, "k_x k_y"], weights: Float[Array, "k_x k_y"]) -> Float[Array, ""]:
    """Return the sum of the terms with the weights mu_1, mu_2 and mu_3, given C and its `slanted_weights`.

    These terms keep the large entries of C near the slanted diagonal, and its rows nearly orthonormal.
    """
    slant, orthogonality, length = MAP_WEIGHTS
    gram = product(functional_map, functional_map.T)
    lengths = jnp.diagonal(gram)
    return (
        slant * jnp.sum((functional_map * weights) ** 2)
        + orthogonality * (jnp.sum(gram**2) - jnp.sum(lengths**2))
        + length * jnp.sum((lengths - 1) ** 2)
    )


def region_energy(
    membership: Float[Array, " n"],
    area_x: Float[Array, ""],
    spectrum_y: Spectrum,
    gradient_y: SurfaceGradient,
) -> Float[Array, ""]:
    """Return the sum of the terms with the weights mu_4 and mu_5, for v on Y (n,), where Y has area 1.

    These terms keep the area of the region close to the area of X, and its boundary short.
    """
    area, length = REGION_WEIGHTS
    missing = area_x - jnp.sum(spectrum_y.vertex_areas * eta(membership))
    return area * missing**2 + length * gradient_y.total_variation(membership)


def _functions(spectrum: Spectrum) -> Float[Array, "n functions"]:
    """Return the descriptors and, in the last column, the constant function 1."""
    assert spectrum.descriptors is not None
    constant = spectrum.mask.astype(spectrum.descriptors.dtype)
    return jnp.concatenate([spectrum.descriptors, constant[:, None]], axis=1)


def _smoothed_norm(vectors: Float[Array, "a b"], *, axis: int) -> Float[Array, " c"]:
    """Return Euclidean norms, smoothed to be differentiable at zero. A zero vector has norm zero."""
    return jnp.sqrt(jnp.sum(vectors**2, axis=axis) + _SMOOTHING**2) - _SMOOTHING


def _spectral_icp(
    functional_map: Float[Array, "k_x k_y"], spectrum_x: Spectrum, spectrum_y: Spectrum, steps: int
) -> Float[Array, "k_x k_y"]:
    """Refine C by `steps` steps of spectral ICP, which is also the final refinement in the paper."""

    def step(c: Float[Array, "k_x k_y"], nothing: None) -> tuple[Float[Array, "k_x k_y"], None]:
        matched = encode(decode(c, spectrum_x, spectrum_y), spectrum_x, spectrum_y)
        left, _, right = jnp.linalg.svd(matched, full_matrices=False)
        return product(left, right), None

    refined, _ = lax.scan(step, functional_map, None, length=steps)
    return refined


def _minimum(
    energy: Callable[[Float[Array, " ..."]], Float[Array, ""]],
    initial: Float[Array, " ..."],
    tolerance: float,
    steps: int,
) -> Float[Array, " ..."]:
    """Return the point after at most `steps` steps of L-BFGS, even if it is not a minimum."""
    import optimistix as optx  # optimistix is imported here because its import is slow

    solver: optx.LBFGS = optx.LBFGS(tolerance, tolerance)
    return optx.minimise(lambda y, _: energy(y), solver, initial, max_steps=steps, throw=False).value  # type: ignore[arg-type]


@dataclass(frozen=True)
class PartialFunctionalMaps(Method):
    """A method that matches a partial shape X with a full shape Y by `partial_functional_map`."""

    reference: str
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 15
    iterations: int = 5
    partial_only: bool = True

    def __call__(self, pair: MethodInput) -> PointwiseMap:
        assert pair.meshes is not None
        stage = Stage(
            number_of_eigenvectors=self.number_of_eigenvectors,
            number_of_descriptors=self.number_of_descriptors,
        )
        spectra = pair.spectra.seen_by(stage).both
        gradient = SurfaceGradient.of(pair.meshes[1], spectra[1])
        partial_map = compiled(partial_functional_map)(
            *spectra, gradient, pair.initial_map, iterations=self.iterations
        )
        return successful(partial_map.pointwise_map, partial_map.result)


PARTIAL_FUNCTIONAL_MAPS = PartialFunctionalMaps(
    "our reconstruction of Rodolà, Cosmo, Bronstein, Torsello, Cremers 2017, partial functional maps: "
    "k = 100, 5 iterations"
)
