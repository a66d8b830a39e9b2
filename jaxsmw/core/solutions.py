"""How a functional map follows from a pointwise map: filtering, the exact solution, and beyond.

A `Solution` is one way to minimise the wavelet-preservation energy, for `WaveletPreservation` to use.
"""

from __future__ import annotations

import abc
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jaxtyping import Array, Float

from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import as_parameter, check_between, check_choice
from jaxsmw.core.functional_map import (
    Convention,
    Norm,
    PseudoInverse,
    QuadraticEnergy,
    dual_eigenvectors,
    multiscale_kernel,
    project_matches,
    wavelet_energy,
)
from jaxsmw.core.products import product
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.soft_maps import PointwiseMap
from jaxsmw.core.spectrum import Spectrum


class WaveletProblem(eqx.Module):
    """A pair of shapes, a filter bank on both, and the convention that C is to follow.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: source X and target Y.
    - `responses_x`, `responses_y`: the bank on their eigenvalues, (filters, k_x) and (filters, k_y).
    - `convention`: `"pullback"` or `"pushforward"`.
    - `sampled`: whether the spectra are sampled ones, whose eigenvectors are not orthonormal.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    responses_x: Float[Array, "filters k_x"]
    responses_y: Float[Array, "filters k_y"]
    convention: Convention = eqx.field(static=True, default="pullback")
    sampled: bool = eqx.field(static=True, default=False)

    @property
    def spectra(self) -> tuple[Spectrum, Spectrum]:
        """The shape that C leads to, and the shape that it comes from."""
        pair = self.spectrum_x, self.spectrum_y
        return pair if self.convention == "pullback" else pair[::-1]

    @property
    def responses(self) -> tuple[Float[Array, "filters k_out"], Float[Array, "filters k_in"]]:
        """The bank on the shape that C leads to, and on the shape that it comes from."""
        pair = self.responses_x, self.responses_y
        return pair if self.convention == "pullback" else pair[::-1]

    def energy(self, pointwise_map: PointwiseMap, *, norm: Norm = "area") -> QuadraticEnergy:
        """The energy (5) of functional maps under a pointwise map; see `wavelet_energy`."""
        return wavelet_energy(
            pointwise_map,
            self.spectrum_x,
            self.spectrum_y,
            self.responses_x,
            self.responses_y,
            convention=self.convention,
            norm=norm,
        )


class Solution(eqx.Module):
    """A way to a functional map that preserves wavelets under a given pointwise map."""

    def prepare(self, problem: WaveletProblem) -> Any:
        """Compute what stays the same for all pointwise maps of a problem, a pytree for `solve`."""
        return None

    @abc.abstractmethod
    def solve(
        self,
        problem: WaveletProblem,
        prepared: Any,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """The functional map that follows from a pointwise map, and how its computation ended.

        `previous` is the functional map of the iteration before, for a solver that can start from it.
        """


class Filtering(Solution):
    """No solve: `C = sum_l g_l(Lambda_out) C_0 g_l(Lambda_in)` (eq. 8), one elementwise product.

    For a Parseval frame this is the minimiser of the energy where the fed vectors are orthonormal (see
    `jaxsmw.core.functional_map`), and close to it otherwise. For any other bank it only smooths.

    **Arguments:**

    - `pseudo_inverse`: of the eigenvectors of the shape that C leads to; see `dual_eigenvectors`. Samples are
      always taken by least squares.
    """

    pseudo_inverse: PseudoInverse = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_choice("pseudo_inverse", self.pseudo_inverse, get_args(PseudoInverse))

    def prepare(self, problem: WaveletProblem) -> tuple[Array, Array]:
        """The multiscale kernel, and the dual eigenvectors of the shape that C leads to."""
        spectrum_out, _ = problem.spectra
        pseudo_inverse: PseudoInverse = "least_squares" if problem.sampled else self.pseudo_inverse
        return multiscale_kernel(*problem.responses), dual_eigenvectors(spectrum_out, pseudo_inverse)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: tuple[Array, Array],
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Eq. (8)."""
        kernel, dual_out = prepared
        _, spectrum_in = problem.spectra
        unfiltered = project_matches(
            pointwise_map, dual_out, spectrum_in.eigenvectors, convention=problem.convention
        )
        return unfiltered * kernel, RESULTS.successful  # type: ignore[return-value]


class NearestOrthogonal(Solution):
    """The matrix of orthonormal rows or columns nearest to another solution.

    With `Filtering` and the bank `Identity` this is the update of spectral ICP (Ovsjanikov et al. 2012).
    """

    solution: Solution = Filtering()

    def prepare(self, problem: WaveletProblem) -> Any:
        """What the other solution prepares."""
        return self.solution.prepare(problem)

    def solve(
        self,
        problem: WaveletProblem,
        prepared: Any,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """The polar factor, by a singular value decomposition."""
        functional_map, result = self.solution.solve(problem, prepared, pointwise_map, previous)
        left, _, right = jnp.linalg.svd(functional_map, full_matrices=False)
        return product(left, right), result


class LeastSquares(Solution):
    """The minimiser of the wavelet-preservation energy, for any frame: one Cholesky factorisation.

    **Arguments:**

    - `norm`: in which vertices count; see `wavelet_energy`.

    Ends with `RESULTS.undetermined_functional_map` where no filter passes one of the eigenvalues.
    """

    norm: Norm = eqx.field(static=True, default="area")

    def __check_init__(self) -> None:
        check_choice("norm", self.norm, get_args(Norm))

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """The closed form."""
        energy = problem.energy(pointwise_map, norm=self.norm)
        _, responses_in = problem.responses
        frame = frame_function(responses_in)
        precision = frame.shape[0] * jnp.finfo(frame.dtype).eps
        covers = jnp.min(frame) > precision * jnp.max(frame)
        result = where(energy.is_regular(), RESULTS.successful, RESULTS.singular_system)
        return energy.minimizer(), where(covers, result, RESULTS.undetermined_functional_map)


Weight = Float[Array, ""] | None


class DescriptorPair(eqx.Module):
    """Functions on both shapes that correspond to each other, in the eigenbases.

    **Attributes:**

    - `coefficients_x`, `coefficients_y`: `Phi^+ f` of each function, (k_x, d) and (k_y, d).
    - `operators_x`, `operators_y`: `Phi^+ diag(f) Phi`, multiplication by each function (Nogneng and
      Ovsjanikov 2017), (d, k_x, k_x) and (d, k_y, k_y); None where they are not needed.
    """

    coefficients_x: Float[Array, "k_x d"]
    coefficients_y: Float[Array, "k_y d"]
    operators_x: Float[Array, "d k_x k_x"] | None = None
    operators_y: Float[Array, "d k_y k_y"] | None = None

    def __check_init__(self) -> None:
        shapes = self.coefficients_x.shape, self.coefficients_y.shape
        if len(shapes[0]) != 2 or len(shapes[1]) != 2 or shapes[0][1] != shapes[1][1]:
            raise ValueError(
                f"descriptors with coefficients of shapes {shapes[0]} on X and {shapes[1]} on Y are not "
                "(k_x, d) and (k_y, d) of the same d functions"
            )

    @classmethod
    def project(
        cls,
        descriptors_x: Float[Array, "m d"],
        descriptors_y: Float[Array, "n d"],
        spectrum_x: Spectrum,
        spectrum_y: Spectrum,
        *,
        operators: bool = False,
    ) -> DescriptorPair:
        """Express descriptors, one value per vertex, in the eigenbases.

        **Arguments:**

        - `descriptors_x`, `descriptors_y`: values of the same d functions on X and on Y.
        - `operators`: whether to make the operators, too: d matrices of size k x k per shape.

        **Raises:** `ValueError` if the values are not one row per vertex and one column per function.
        """
        for name, values, spectrum in (("X", descriptors_x, spectrum_x), ("Y", descriptors_y, spectrum_y)):
            n = spectrum.mask.shape[0]
            if values.ndim != 2 or values.shape[0] != n:
                raise ValueError(f"descriptors of {name} have shape {values.shape}, where ({n}, d) is needed")
        sides = []
        for values, spectrum in ((descriptors_x, spectrum_x), (descriptors_y, spectrum_y)):
            dual = dual_eigenvectors(spectrum, "area")

            def multiply(f: Array, dual: Array = dual, phi: Array = spectrum.eigenvectors) -> Array:
                return product((dual * f[:, None]).T, phi)

            # One at a time: side by side they would take d arrays of the eigenvectors' size.
            sides.append((product(dual.T, values), jax.lax.map(multiply, values.T) if operators else None))
        (coefficients_x, operators_x), (coefficients_y, operators_y) = sides
        return cls(coefficients_x, coefficients_y, operators_x, operators_y)

    def coefficients(self, convention: Convention) -> tuple[Float[Array, "k_out d"], Float[Array, "k_in d"]]:
        """The coefficients on the shape that C leads to, and on the shape that it comes from."""
        pair = self.coefficients_x, self.coefficients_y
        return pair if convention == "pullback" else pair[::-1]

    def operators(
        self, convention: Convention
    ) -> tuple[Float[Array, "d k_out k_out"] | None, Float[Array, "d k_in k_in"] | None]:
        """The operators on the shape that C leads to, and on the shape that it comes from."""
        pair = self.operators_x, self.operators_y
        return pair if convention == "pullback" else pair[::-1]


_TERMS = (
    "wavelet_preservation",
    "laplacian_commutativity",
    "orthogonality",
    "descriptor_preservation",
    "descriptor_commutativity",
)


def _as_weight(value: Any) -> Array | None:
    return None if value is None else as_parameter(value)


class RegularizedLeastSquares(Solution):
    """The wavelet-preservation energy together with other wishes, minimised iteratively.

    The functional map minimises the weighted sum of

    - the wavelet-preservation energy (5);
    - Laplacian commutativity, `||Lambda_out C - C Lambda_in||^2` with eigenvalues as fractions of the
      largest;
    - orthogonality, `||C^T C - I||^2` (`||C C^T - I||^2` where C has fewer rows than columns), which is not
      quadratic;
    - descriptor preservation, `||C F_in - F_out||^2` (Ovsjanikov et al. 2012);
    - descriptor commutativity, `sum_d ||C D_in - D_out C||^2` (Nogneng and Ovsjanikov 2017).

    The terms are scaled so that what C = 0 or either side of a difference costs is about k_out: the wavelet
    term is divided by the mean of the frame function, which is one for a Parseval frame, `F_out` and all
    `D_out` are brought to the squared norm k_out. So weights near one are comparable, whatever the height
    of a bank or the units of descriptors.

    The many thousand columns of the wavelet and of the descriptor term are first reduced to k_in, exactly.
    Then `optimistix.least_squares` takes Gauss–Newton steps, each solved by conjugate gradients: no matrix
    of size k² x k² is ever formed. It starts from the previous functional map where there is one. The
    result can be differentiated, implicitly at the minimum.

    **Arguments:**

    - `wavelet_preservation`, `laplacian_commutativity`, `orthogonality`, `descriptor_preservation`,
      `descriptor_commutativity`: positive weights; None leaves a term out.
    - `descriptors`: for the last two.
    - `norm`: of the wavelet term; see `wavelet_energy`.
    - `tolerance`: when to stop, relative to C and to the residuals.
    - `max_steps`: when to give up, with `RESULTS.solver_not_converged`.

    **Raises:** `ValueError` if a weight is not positive, or weights and descriptors do not fit together.
    """

    wavelet_preservation: Weight = eqx.field(converter=_as_weight, default=1.0)
    laplacian_commutativity: Weight = eqx.field(converter=_as_weight, default=1.0)
    orthogonality: Weight = eqx.field(converter=_as_weight, default=0.1)
    descriptor_preservation: Weight = eqx.field(converter=_as_weight, default=None)
    descriptor_commutativity: Weight = eqx.field(converter=_as_weight, default=None)
    descriptors: DescriptorPair | None = None
    norm: Norm = eqx.field(static=True, default="area")
    tolerance: float = eqx.field(static=True, default=1e-3)
    max_steps: int = eqx.field(static=True, default=256)

    def __check_init__(self) -> None:
        check_choice("norm", self.norm, get_args(Norm))
        for term in _TERMS:
            if getattr(self, term) is not None:
                check_between(self, term, getattr(self, term))
        if self.wavelet_preservation is None and self.descriptor_preservation is None:
            raise ValueError("without wavelet and descriptor preservation nothing ties C to the shapes")
        weighted = self.descriptor_preservation is not None or self.descriptor_commutativity is not None
        if weighted != (self.descriptors is not None):
            raise ValueError("descriptors and a weight for their preservation or commutativity go together")
        if not self.tolerance > 0 or self.max_steps < 1:
            raise ValueError(f"tolerance={self.tolerance} and max_steps={self.max_steps} must be positive")
        if (
            self.descriptor_commutativity is not None
            and self.descriptors is not None
            and self.descriptors.operators_x is None
        ):
            raise ValueError("descriptor_commutativity needs DescriptorPair.project(..., operators=True)")

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: Float[Array, "k_out k_in"] | None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Minimise, starting from the previous functional map."""
        energy = None
        if self.wavelet_preservation is not None:
            responses_out, _ = problem.responses
            height = jnp.mean(frame_function(responses_out))
            energy = (1 / height) * problem.energy(pointwise_map, norm=self.norm)
        eigenvalues_out, eigenvalues_in = (spectrum.eigenvalues for spectrum in problem.spectra)
        return self.minimize(
            energy, eigenvalues_out, eigenvalues_in, convention=problem.convention, start=previous
        )

    def minimize(
        self,
        energy: QuadraticEnergy | None,
        eigenvalues_out: Float[Array, " k_out"],
        eigenvalues_in: Float[Array, " k_in"],
        *,
        convention: Convention = "pullback",
        start: Float[Array, "k_out k_in"] | None = None,
    ) -> tuple[Float[Array, "k_out k_in"], RESULTS]:
        """Minimise with the given energy in the place of wavelet preservation.

        **Arguments:**

        - `energy`: of any kind, weighed by `wavelet_preservation`; None if and only if that is None.
        - `eigenvalues_out`, `eigenvalues_in`: of the shape that C leads to, and that it comes from.
        - `convention`: says on which side of `descriptors` those are.
        - `start`: where to start; by default a guess.

        **Raises:** `ValueError` for an energy without a weight, or a weight without an energy.
        """
        if (energy is None) != (self.wavelet_preservation is None):
            raise ValueError("an energy and a weight for it, wavelet_preservation, go together")
        (k_out,), (k_in,), dtype = eigenvalues_out.shape, eigenvalues_in.shape, eigenvalues_in.dtype
        columns = QuadraticEnergy.zero(k_out, k_in, dtype)
        if energy is not None and self.wavelet_preservation is not None:
            columns += self.wavelet_preservation.astype(dtype) * energy
        if self.descriptors is not None and self.descriptor_preservation is not None:
            f_out, f_in = self.descriptors.coefficients(convention)
            if (f_out.shape[0], f_in.shape[0]) != (k_out, k_in):
                raise ValueError(
                    f"the descriptors are in bases of {f_out.shape[0]} and {f_in.shape[0]} eigenvectors, the "
                    f"functional map is {k_out} x {k_in}: project them on the same spectra, in the same order"
                )
            size = jnp.sum(f_out**2)
            weight = self.descriptor_preservation.astype(dtype) * k_out / size
            columns += weight * QuadraticEnergy(product(f_in, f_in.T), product(f_out, f_in.T), size)

        # The Cholesky factor has the same inner products as all the columns that were summed over, so it
        # can stand for them. A ridge below rounding lets it exist also where other terms have to decide.
        ridge = columns.rounding()
        factor = jnp.linalg.cholesky(columns.gram + ridge * jnp.eye(k_in, dtype=dtype))
        target = jsp.linalg.solve_triangular(factor, columns.cross.T, lower=True).T
        terms = [lambda c: product(c, factor) - target]
        curvature = jnp.broadcast_to(jnp.diagonal(columns.gram)[None, :], (k_out, k_in))
        if self.laplacian_commutativity is not None:
            largest = jnp.maximum(eigenvalues_out[-1], eigenvalues_in[-1])
            gaps = (eigenvalues_out[:, None] - eigenvalues_in[None, :]) / largest
            gaps = gaps * jnp.sqrt(self.laplacian_commutativity.astype(dtype))
            terms.append(lambda c: gaps * c)
            curvature = curvature + gaps**2
        if self.orthogonality is not None:
            root = jnp.sqrt(self.orthogonality.astype(dtype))
            identity = jnp.eye(min(k_out, k_in), dtype=dtype)
            terms.append(
                lambda c: root * ((product(c.T, c) if k_in <= k_out else product(c, c.T)) - identity)
            )
        if self.descriptors is not None and self.descriptor_commutativity is not None:
            operators: Any = self.descriptors.operators(convention)
            d_out, d_in = operators
            scale = jnp.sqrt(self.descriptor_commutativity.astype(dtype) * k_out / jnp.sum(d_out**2))
            terms.append(lambda c: scale * (product(c[None], d_in) - product(d_out, c[None])))
            diagonal_out, diagonal_in = (jnp.diagonal(d, axis1=1, axis2=2) for d in (d_out, d_in))
            squares = jnp.sum(d_out**2, axis=(0, 1))[:, None] + jnp.sum(d_in**2, axis=(0, 2))[None, :]
            curvature = curvature + scale**2 * (squares - 2 * product(diagonal_out.T, diagonal_in))

        # In units in which the quadratic terms curve the same everywhere, conjugate gradients take few steps.
        determined = curvature > ridge
        finite = jnp.all(jnp.isfinite(curvature)) & jnp.all(jnp.isfinite(columns.cross))
        solvable = finite & jnp.all(determined)
        unit = jax.lax.rsqrt(jnp.where(determined, curvature, 1))
        if start is None:
            start = columns.cross * unit**2
        # Full Gauss–Newton steps: on real pairs a trust region never shortened one (and those of optimistix
        # do not take float32 while jax_enable_x64 is set). What cannot be solved is not tried at length.
        import lineax as lx  # here, as importing them takes as long as an eigenbasis
        import optimistix as optx

        precision = 0.1 * self.tolerance
        inner = lx.Normal(lx.CG(precision, precision, max_steps=10 * max(k_out, k_in)))
        with jax.default_matmul_precision("highest"):
            solution: optx.Solution = optx.least_squares(
                lambda scaled, _: [jnp.where(solvable, term(scaled * unit), 0) for term in terms],
                optx.GaussNewton(self.tolerance, self.tolerance, linear_solver=inner),
                jax.lax.stop_gradient(start / unit),
                max_steps=self.max_steps,
                adjoint=optx.ImplicitAdjoint(lx.GMRES(precision, precision, restart=50)),
                throw=False,
            )
        result = where(
            solution.result == optx.RESULTS.successful, RESULTS.successful, RESULTS.solver_not_converged
        )
        if len(terms) == 1:
            result = where(columns.is_regular(), result, RESULTS.singular_system)
        # A NaN that is not in the quadratic terms, such as that of a negative weight, shows in the residuals.
        functional_map = solution.value * unit
        finite &= jnp.all(jnp.isfinite(jnp.stack([jnp.sum(term(functional_map)) for term in terms])))
        result = where(solvable, result, RESULTS.undetermined_functional_map)
        return functional_map, where(finite, result, RESULTS.nonfinite_functional_map)
