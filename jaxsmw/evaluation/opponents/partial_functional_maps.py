r"""Partial functional maps: finds a functional map and the region of Y that X covers, in alternation.

E. Rodolà, L. Cosmo, M. M. Bronstein, A. Torsello, D. Cremers, *Partial functional correspondence*, Computer
Graphics Forum 36(1), 2017. Neither the authors' program nor the text of the paper was available for this
reconstruction. So no equation numbers are given, and W and its decay are from memory.

X is the partial shape, Y the full shape. Functions F on X correspond to functions G on Y, but only inside the
region of Y that X covers. A membership function v on Y describes the region: eta(v) is 1 inside and 0
outside the region. The definitions are

    eta(t) = (tanh(6 (t - 1/2)) + 1) / 2,    A = Phi_X^+ F,    B(v) = Phi_Y^+ (eta(v) G).

The paper alternately minimises over its functional map C (the transpose of C in the code, where the pullback
takes functions on Y to functions on X) and over v

    ||C A - B(v)||_{2,1}
        + mu_1 ||C * W||^2 + mu_2 sum_{i != j} (C^T C)_ij^2 + mu_3 sum_i ((C^T C)_ii - d_i)^2
        + mu_4 (area(X) - integral of eta(v))^2 + mu_5 integral of xi(v) ||grad v||

The first line is the fidelity term. The second line regularises the map, and the third line regularises the
region. W grows with the distance from a slanted diagonal: the r-th eigenvalue of X is about as large as the
k-th eigenvalue of Y, with r / k near the ratio of the areas. d_i is 1 for i <= r and 0 for larger i.

The reconstruction departs from the paper in the following points. Each departure gave better results, or
replaces a detail that was not available.

- **Initial values.** The paper starts from v = 1 and a C that does not depend on the pair. Here C starts from
  the functional map of the initial map, because all methods start from the initial map.
- **Iterations.** A few steps of spectral ICP follow each minimisation over C. They use the rank-r
  orthogonality of the refinement at the end of the paper. Without these steps the region is wrong. On three
  real pairs the intersection with the true region is 39, 21 and 21 % of the union without these steps, and
  83, 81 and 43 % with them.
- **Region.** Each minimisation over v starts from the image of the constant function under C, clipped to
  [0, 1]. A start from v = 1 or from the last v keeps wrong regions, because the derivative of eta nearly
  vanishes at these values.
- **Descriptors.** F and G are the constant function and the first principal components of SHOT on both
  shapes, scaled to mean square 1. The paper uses all 352 numbers of SHOT. These numbers are nonnegative, so
  their constant part is large. Here the constant has as much weight as all components together. Any number of
  components from 10 to 30 made little difference. With a hundred components, the true map of the true region
  had a higher energy than C = 0.
- **Rank.** Only the r nonzero columns of the paper's C are stored.
- **Length.** xi = 1, so the length term is the total variation, which worked in an earlier attempt. The
  narrow xi of the paper vanishes wherever v is not near 1/2. This xi was not tried again.
- **Weights.** Y has area 1, and column norms are averaged instead of summed. The weights therefore have other
  units than the published weights. mu_1 = mu_3 = 1 and mu_2 = 100 are the published values, and the fidelity
  term is multiplied by `FIDELITY`. `FIDELITY` and mu_5 were chosen on four real pairs; mu_4 was not varied.
- **Recovery.** Nearest neighbours are searched among all vertices of Y. A search among the vertices of the
  region gave the same maps, or worse maps if the region was wrong.
- **Solver.** Limited-memory BFGS of optimistix minimises the energies, with a bounded number of steps and
  with v in the metric of the vertex areas. All norms are smoothed at zero.

On 12 other pairs of SHREC'16 the mean geodesic error is 0.015 on 6 cuts and 0.018 on 6 holes. The initial
maps have 0.135 and 0.160. MWP from the same initial maps has 0.011 and 0.017.

`PARTIAL_FUNCTIONAL_MAPS` has the settings in use: 100 eigenvectors, 15 descriptors, 5 iterations. Functional
maps are in the pullback convention of `jaxsmw.core.functional_map`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Int32

from jaxsmw.core.checks import all_finite
from jaxsmw.core.functional_map import dual_eigenvectors, encode
from jaxsmw.core.pointwise_map import decode
from jaxsmw.core.products import product
from jaxsmw.core.refinement import diagnose
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.evaluation.opponents.base import Method, MethodInput, check_spectrum
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.runtime.compilation import compiled
from jaxsmw.runtime.padding import pad_rows, padded_size
from jaxsmw.stage import Stage

FIDELITY = 60.0
"""The weight of the fidelity term relative to the terms of mu_1 to mu_3, for averaged column norms."""
MAP_WEIGHTS = (1.0, 100.0, 1.0)
"""mu_1, mu_2 and mu_3, as published."""
REGION_WEIGHTS = (10.0, 0.01)
"""mu_4 and mu_5, for areas and lengths in the unit in which Y has area 1."""

# The rate at which the slanted weights decay towards high frequencies (sigma of W in the paper).
_DECAY = 0.03
# Norms of columns and of gradients are smoothed below this number. It is a thousandth of the norm of a
# descriptor, and a thousandth of the gradient of a function that changes by 1 over Y.
_SMOOTHING = 1e-3
# The largest numbers of L-BFGS steps in a minimisation over C and over v. Most minimisations use most of the
# steps.
_MAP_STEPS, _REGION_STEPS = 100, 60
_MAP_TOLERANCE, _REGION_TOLERANCE = 1e-4, 1e-6


class SurfaceGradient(eqx.Module):
    """The gradient of piecewise linear functions on a mesh, in the unit of length of a spectrum.

    **Attributes:**

    - `faces`: the corners of each face (f, 3), 0-based. The array is padded with faces of area zero.
    - `hats`: the gradient on each face of the hat function of each corner (f, 3, 3), zero on faces of area
      zero.
    - `areas`: the area of each face (f,).
    """

    faces: Int32[Array, "f 3"]
    hats: Float[Array, "f 3 xyz"]
    areas: Float[Array, " f"]

    @classmethod
    def of(cls, mesh: Mesh, spectrum: Spectrum) -> SurfaceGradient:
        """Returns the gradient on a mesh, in the unit of length of its spectrum.

        **Arguments:**

        - `mesh`: the mesh, with n vertices and f faces.
        - `spectrum`: its spectrum, padded or not.

        **Raises:** `InputError` if the spectrum has fewer rows than the mesh has vertices.
        """
        check_spectrum(mesh, spectrum)
        scale = math.sqrt(float(jnp.sum(spectrum.vertex_areas)) / mesh.area)
        corners = scale * mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(normals, axis=1)
        opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
        # The gradient is `n x e / (2 area)` for the unit normal n and the opposite edge e. The normals here
        # have length 2 area.
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
        """Returns the integral of the gradient's length over the surface (the Mumford-Shah term with xi = 1).

        The length of the gradient is smoothed at zero.

        **Arguments:**

        - `function`: the values at the vertices (n,).
        """
        gradient = jnp.einsum("fc,fcd->fd", function[self.faces], self.hats)
        return jnp.sum(self.areas * _smoothed_norm(gradient, axis=1))


class PartialMap(eqx.Module):
    """The result of `partial_functional_map`.

    **Attributes:**

    - `pointwise_map`: T: X -> Y (m,), 0-based vertices of Y; -1 everywhere if the method failed.
    - `functional_map`: C (r, k_Y) with orthonormal rows, where r is the smaller of k_X and k_Y.
    - `region`: eta(v) (n,), 1 inside the region that X covers and 0 outside; zero on masked vertices of Y.
    - `result`: a member of `RESULTS`.
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
    """Matches a partial shape X with a full shape Y by partial functional maps (Rodolà et al. 2017).

    The function is pure and can be compiled. The result does not depend on the signs of eigenvectors or on
    padding. The docstring of this module has the equations.

    **Arguments:**

    - `spectrum_x`, `spectrum_y`: the spectra of X and of Y in one unit of length, in which Y has area 1, cut
      to their common range (`jaxsmw.pair.common_range`). k_X is then the rank r of the paper. If k_X is
      larger than k_Y, only the first k_Y eigenvectors of X are used. Both spectra need the same number of
      comparable descriptors, scaled to mean square 1.
    - `gradient_y`: the gradient on Y.
    - `pointwise_map`: the initial map X -> Y (m,), 0-based vertices of Y.
    - `iterations`: the number of minimisations over C and over v; at least 1.
    - `icp_steps`: the number of steps of spectral ICP after each minimisation over C.

    **Returns:** A `PartialMap`. NaN and infinite numbers raise no error, so check its `result`.

    **Raises:** `ValueError` if `iterations` is less than 1, or if the spectra do not have the same number of
    descriptors, at least 1.
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
    # If an energy overflows, the minimisations leave C and v unchanged; only the energy shows the fault.
    left = fidelity(functional_map, energies.coefficients_x, energies.inside(membership))
    finite = all_finite((functional_map, region, left))
    result = where(finite, RESULTS.successful, RESULTS.nonfinite_functional_map)
    result = diagnose(*spectra, pointwise_map.astype(jnp.int32), result)
    found = decode(functional_map, *spectra)
    return PartialMap(jnp.where(result == RESULTS.successful, found, -1), functional_map, region, result)


class _Energies(eqx.Module):
    """The energies of one pair, and their minimisers over C and over v.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the spectra. X has r eigenvectors, at most k_Y.
    - `gradient_y`: the gradient on Y.
    - `dual_y`: the dual eigenvectors of Y (n, k_Y), whose transpose is Phi_Y^+.
    - `coefficients_x`: A, the coefficients of the descriptors and of the constant function on X (r,
      functions).
    - `functions_y`: G, the same functions on Y (n, functions).
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    gradient_y: SurfaceGradient
    dual_y: Float[Array, "n k_y"]
    coefficients_x: Float[Array, "r functions"]
    functions_y: Float[Array, "n functions"]

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
        # The rows of C are orthonormal, so there are at most k_Y. A shape with many holes can have more than
        # k_Y eigenvalues in the common range.
        spectrum_x = spectrum_x.truncate(spectrum_y.eigenvalues.shape[0])
        dual_x, dual_y = (dual_eigenvectors(spectrum, "area") for spectrum in (spectrum_x, spectrum_y))
        coefficients_x = product(dual_x.T, _functions(spectrum_x))
        return cls(spectrum_x, spectrum_y, gradient_y, dual_y, coefficients_x, _functions(spectrum_y))

    def covered(self, c: Float[Array, "r k_y"]) -> Float[Array, " n"]:
        """Returns the image of the constant function on X, clipped to [0, 1]."""
        coefficients = product(c.T, self.coefficients_x[:, -1])
        return jnp.clip(product(self.spectrum_y.eigenvectors, coefficients), 0, 1)

    def inside(self, membership: Float[Array, " n"]) -> Float[Array, "k_y functions"]:
        """Returns B(v), the coefficients of the functions on Y after their restriction to the region."""
        return product(self.dual_y.T, eta(membership)[:, None] * self.functions_y)

    def best_map(self, c: Float[Array, "r k_y"], membership: Float[Array, " n"]) -> Float[Array, "r k_y"]:
        """Returns the functional map that minimises the energy, starting from `c`."""
        coefficients_y = self.inside(membership)
        weights = slanted_weights(*c.shape).astype(self.coefficients_x.dtype)

        def energy(c: Float[Array, "r k_y"]) -> Float[Array, ""]:
            distance = fidelity(c, self.coefficients_x, coefficients_y)
            return FIDELITY * distance + map_energy(c, weights)

        return _minimum(energy, c, _MAP_TOLERANCE, _MAP_STEPS)

    def best_region(self, c: Float[Array, "r k_y"]) -> Float[Array, " n"]:
        """Returns the membership function that minimises the energy, starting from `covered`."""
        area_x = jnp.sum(self.spectrum_x.vertex_areas)
        # With the variable u = v sqrt(area), the density of the mesh has no influence on the solver.
        metric = jnp.sqrt(jnp.where(self.spectrum_y.mask, self.spectrum_y.vertex_areas, 1))

        def energy(scaled: Float[Array, " n"]) -> Float[Array, ""]:
            v = scaled / metric
            distance = fidelity(c, self.coefficients_x, self.inside(v))
            return distance + region_energy(v, area_x, self.spectrum_y, self.gradient_y)

        return _minimum(energy, self.covered(c) * metric, _REGION_TOLERANCE, _REGION_STEPS) / metric


def eta(membership: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns eta(v) (n,) for a membership function v (n,): near 0 outside the region and near 1 inside."""
    return (jnp.tanh(6 * (membership - 0.5)) + 1) / 2


def slanted_weights(k_x: int, k_y: int) -> Float[Array, "k_x k_y"]:
    """Returns W of the paper for the pullback (k_x, k_y): weights that grow with the distance to a diagonal.

    The slanted diagonal starts at the first entry and moves k_x / k_y rows per column. The weight of an entry
    is its distance to the diagonal, measured in entries, times `exp(-0.03 sqrt(i^2 + j^2))`. Rows i and
    columns j are counted from 1.

    **Arguments:**

    - `k_x`, `k_y`: the numbers of rows and columns of the functional map.
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
    """Returns the fidelity term `||C A - B||_{2,1}`, with column norms averaged and smoothed at zero.

    The value is the mean norm of the columns of descriptors, plus the norm of the last column, which belongs
    to the constant function.

    **Arguments:**

    - `functional_map`: C in the pullback convention (k_x, k_y), the transpose of C in the formula.
    - `coefficients_x`, `coefficients_y`: A (k_x, functions) and B (k_y, functions).
    """
    norms = _smoothed_norm(product(functional_map.T, coefficients_x) - coefficients_y, axis=0)
    return jnp.mean(norms[:-1]) + norms[-1]


def map_energy(functional_map: Float[Array, "k_x k_y"], weights: Float[Array, "k_x k_y"]) -> Float[Array, ""]:
    """Returns the sum of the terms of mu_1 to mu_3, multiplied by these weights.

    The terms keep C near the slanted diagonal, and keep its rows orthonormal.

    **Arguments:**

    - `functional_map`: C in the pullback convention (k_x, k_y).
    - `weights`: the result of `slanted_weights` (k_x, k_y).
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
    """Returns the sum of the terms of mu_4 and mu_5, multiplied by these weights.

    The terms keep the region as large as X, and keep its boundary short.

    **Arguments:**

    - `membership`: the membership function v on Y (n,).
    - `area_x`: the area of X, in the unit in which Y has area 1.
    - `spectrum_y`, `gradient_y`: the spectrum of Y and the gradient on Y, in the same unit.
    """
    area, length = REGION_WEIGHTS
    missing = area_x - jnp.sum(spectrum_y.vertex_areas * eta(membership))
    return area * missing**2 + length * gradient_y.total_variation(membership)


def _functions(spectrum: Spectrum) -> Float[Array, "n functions"]:
    """Returns the descriptors and, as the last column, the constant function."""
    assert spectrum.descriptors is not None
    constant = spectrum.mask.astype(spectrum.descriptors.dtype)
    return jnp.concatenate([spectrum.descriptors, constant[:, None]], axis=1)


def _smoothed_norm(vectors: Float[Array, "a b"], *, axis: int) -> Float[Array, " c"]:
    """Returns Euclidean norms, smoothed to be differentiable at zero. A zero vector has norm zero."""
    return jnp.sqrt(jnp.sum(vectors**2, axis=axis) + _SMOOTHING**2) - _SMOOTHING


def _spectral_icp(
    functional_map: Float[Array, "k_x k_y"], spectrum_x: Spectrum, spectrum_y: Spectrum, steps: int
) -> Float[Array, "k_x k_y"]:
    """Refines C by some steps of spectral ICP (the refinement at the end of the paper).

    Each step searches nearest neighbours, then computes the nearest C with orthonormal rows.
    """

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
    """Returns the point that L-BFGS reaches in at most `steps` steps.

    It is not an error if the point is not yet a minimum.
    """
    import optimistix as optx  # imported here because the import is slow

    solver: optx.LBFGS = optx.LBFGS(tolerance, tolerance)
    return optx.minimise(lambda y, _: energy(y), solver, initial, max_steps=steps, throw=False).value


@dataclass(frozen=True)
class PartialFunctionalMaps(Method):
    """Matches a partial shape X with a full shape Y by `partial_functional_map`.

    **Attributes:** those of `Method`, and

    - `iterations`: see `partial_functional_map`.
    """

    reference: str
    number_of_eigenvectors: int = 100
    number_of_descriptors: int = 15
    iterations: int = 5
    partial_only: bool = True

    def __call__(self, pair: MethodInput) -> tuple[Int[Array, " m"], RESULTS]:
        """Returns the map X -> Y and the status code; see `Method`."""
        assert pair.meshes is not None
        spectra = pair.seen_in(
            Stage(
                number_of_eigenvectors=self.number_of_eigenvectors,
                number_of_descriptors=self.number_of_descriptors,
            )
        )
        gradient = SurfaceGradient.of(pair.meshes[1], spectra[1])
        found = compiled(partial_functional_map)(
            *spectra, gradient, pair.initial_map, iterations=self.iterations
        )
        return found.pointwise_map, found.result


PARTIAL_FUNCTIONAL_MAPS = PartialFunctionalMaps(
    "our reconstruction of Rodolà, Cosmo, Bronstein, Torsello, Cremers 2017, partial functional maps: "
    "k = 100, 5 iterations"
)
