"""Minimisation of a sum of the wavelet-preservation energy and other terms."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Bool, Float

from jaxsmw.core.arrays import Array
from jaxsmw.core.banks import frame_function
from jaxsmw.core.checks import as_parameter, check_between, check_option
from jaxsmw.core.functional_map import FunctionalMap, Norm, PointwiseMap, QuadraticEnergy, WaveletProblem
from jaxsmw.core.linear_algebra import (
    cholesky,
    is_regular,
    product,
    rounding,
    solve_lower,
    solve_positive_definite,
)
from jaxsmw.core.module import field, jitted
from jaxsmw.core.results import RESULTS, where
from jaxsmw.core.solutions.closed_form import Solution
from jaxsmw.core.solutions.descriptors import DescriptorPair

Weight = Float[Array, ""] | None
Mask = Literal["standard", "resolvent"]

_TERMS = (
    "wavelet_preservation",
    "laplacian_commutativity",
    "orthogonality",
    "descriptor_preservation",
    "descriptor_commutativity",
)


def _as_weight(value: Array | float | None) -> Array | None:
    return None if value is None else as_parameter(value)


class RegularizedLeastSquares(Solution[None]):
    """A solution that minimises a sum of the wavelet-preservation energy and other terms.

    The functional map C (k_out, k_in) minimises a weighted sum of five terms:

    - Wavelet preservation is the energy of equation (5) of the MWP paper, divided by the mean of the frame
      function.
    - Laplacian commutativity is `||mask * C||²`, with an elementwise product. The mask (k_out, k_in) depends
      on the eigenvalues of the shapes "out" and "in", divided by the largest eigenvalue of both. With the
      standard mask `lambda_out - lambda_in`, this is `||Lambda_out C - C Lambda_in||²`, where the diagonal
      matrices Lambda contain the eigenvalues. The entries of the resolvent mask (Ren et al. 2019) are
      `|(a - i)^-1 - (b - i)^-1|` for `a = lambda_out^p` and `b = lambda_in^p`. The resolvent mask is bounded
      for any number of eigenvalues.
    - Orthogonality is `||C^T C - I||²`, or `||C C^T - I||²` if C has fewer rows than columns. This is the
      only term that is not quadratic in C.
    - Descriptor preservation is `||C F_in - F_out||²`, where F_in and F_out contain the coefficients of the
      descriptors (Ovsjanikov et al. 2012), scaled so that the squared norm of `F_out` is k_out.
    - Descriptor commutativity is `sum_d ||C D_in - D_out C||²`, where the operators D_in and D_out multiply a
      function by descriptor d (Nogneng and Ovsjanikov 2017). They are scaled so that the squared norms of the
      operators `D_out` sum to k_out.

    The scales make the weights comparable for all banks and all units of descriptors.

    Without orthogonality and descriptor commutativity, one batched solve of k_out linear systems gives the
    exact minimiser, as in the layer of Donati et al. 2020 (docs/mathematics.md). Otherwise,
    `optimistix.least_squares` takes Gauss–Newton steps, whose linear systems conjugate gradients solve. The
    sums over thousands of columns in the quadratic terms are then replaced by sums over k_in equivalent
    columns. The solver starts from the previous functional map, or from an estimate. In both cases, the
    derivatives of C are computed by implicit differentiation at the minimum. `jax.vmap` solves a batch of
    pairs.

    **Arguments:**

    - `wavelet_preservation`, `laplacian_commutativity`, `orthogonality`, `descriptor_preservation`,
      `descriptor_commutativity`: the weights of the five terms. Each weight is a positive number, or None to
      omit the term. The defaults are 1, 1, 0.1, None and None.
    - `descriptors`: a `DescriptorPair`, which the two descriptor terms need. Descriptor commutativity needs
      the result of `DescriptorPair.project(..., operators=True)`.
    - `norm`: the weights of the vertices of X in the wavelet term, `"area"` (the default) or `"frobenius"`;
      see `WaveletProblem.energy`.
    - `mask`: the mask of Laplacian commutativity, `"standard"` (the default) or `"resolvent"`.
    - `resolvent_power`: the exponent p of the resolvent mask, above 0 and at most 1, by default 0.5.
    - `tolerance`: the relative and absolute tolerance of `optimistix.GaussNewton`, positive, by default 1e-3.
    - `max_steps`: the maximum number of Gauss–Newton steps, at least 1, by default 256. If these steps do not
      reach the tolerance, the status code is `RESULTS.solver_not_converged`.

    **Raises:** `ValueError` if an argument is out of its range, if neither `wavelet_preservation` nor
    `descriptor_preservation` has a weight, or if the descriptors or their operators do not fit the weights of
    the descriptor terms.
    """

    wavelet_preservation: Weight = field(converter=_as_weight, default=1.0)
    laplacian_commutativity: Weight = field(converter=_as_weight, default=1.0)
    orthogonality: Weight = field(converter=_as_weight, default=0.1)
    descriptor_preservation: Weight = field(converter=_as_weight, default=None)
    descriptor_commutativity: Weight = field(converter=_as_weight, default=None)
    descriptors: DescriptorPair | None = None
    norm: Norm = field(static=True, default="area")
    mask: Mask = field(static=True, default="standard")
    resolvent_power: float = field(static=True, default=0.5)
    tolerance: float = field(static=True, default=1e-3)
    max_steps: int = field(static=True, default=256)

    def __check_init__(self) -> None:
        check_option("norm", self.norm, get_args(Norm))
        check_option("mask", self.mask, get_args(Mask))
        if not 0 < self.resolvent_power <= 1:
            raise ValueError(
                f"resolvent_power must be above 0 and at most 1, but it is {self.resolvent_power}"
            )
        for term in _TERMS:
            if getattr(self, term) is not None:
                check_between(self, term, getattr(self, term))
        if self.wavelet_preservation is None and self.descriptor_preservation is None:
            raise ValueError(
                "C is undetermined without a weight for wavelet_preservation or descriptor_preservation: "
                "give at least one of these weights"
            )
        weighted = self.descriptor_preservation is not None or self.descriptor_commutativity is not None
        if weighted != (self.descriptors is not None):
            raise ValueError(
                "descriptors need a weight, descriptor_preservation or descriptor_commutativity, and these "
                "weights need descriptors: give both or neither"
            )
        if not self.tolerance > 0 or self.max_steps < 1:
            raise ValueError(
                "tolerance and max_steps must be positive, but "
                f"tolerance={self.tolerance} and max_steps={self.max_steps}"
            )
        if (
            self.descriptor_commutativity is not None
            and self.descriptors is not None
            and (self.descriptors.x.operators is None or self.descriptors.y.operators is None)
        ):
            raise ValueError(
                "descriptor_commutativity needs operators, which the descriptors lack: compute the "
                "descriptors with DescriptorPair.project(..., operators=True)"
            )

    def solve(
        self,
        problem: WaveletProblem,
        prepared: None,
        pointwise_map: PointwiseMap,
        previous: FunctionalMap | None,
    ) -> tuple[FunctionalMap, RESULTS]:
        """Return the minimiser C (k_out, k_in) of the weighted terms, and a status code (`RESULTS`).

        **Raises:** `ValueError` if the descriptors and the functional map have different numbers of
        eigenvectors.
        """
        energy = None
        if self.wavelet_preservation is not None:
            responses_out, _ = problem.responses
            height = jnp.mean(frame_function(responses_out))
            energy = (1 / height) * problem.energy(pointwise_map, norm=self.norm)
        oriented = self
        if self.descriptors is not None:
            pair = DescriptorPair(*problem.out_and_in(self.descriptors.x, self.descriptors.y))
            oriented = eqx.tree_at(lambda solution: solution.descriptors, self, pair)
        eigenvalues = (spectrum.eigenvalues for spectrum in problem.spectra)
        return oriented.minimize(energy, *eigenvalues, initial=previous)

    @jitted
    def minimize(
        self,
        energy: QuadraticEnergy | None,
        eigenvalues_out: Float[Array, " k_out"],
        eigenvalues_in: Float[Array, " k_in"],
        *,
        initial: FunctionalMap | None = None,
    ) -> tuple[FunctionalMap, RESULTS]:
        """Minimise the weighted terms, with a given energy in place of the wavelet-preservation energy.

        **Arguments:**

        - `energy`: any `QuadraticEnergy`, which is multiplied by the weight `wavelet_preservation`; None if
          this weight is None.
        - `eigenvalues_out`, `eigenvalues_in`: the eigenvalues of the shapes "out" and "in", in the same unit.
          `descriptors.x` must belong to the shape "out", as in the pullback convention.
        - `initial`: the functional map from which the solver starts, by default an estimate.

        **Returns:** The minimiser C (k_out, k_in), without unit, and a status code, which is a member of
        `RESULTS`.

        **Raises:** `ValueError` if only one of `energy` and the weight `wavelet_preservation` is None, or if
        the descriptors and C have different numbers of eigenvectors.
        """
        shape, dtype = (eigenvalues_out.size, eigenvalues_in.size), eigenvalues_in.dtype
        quadratic = self._quadratic_energy(energy, shape, dtype)
        terms = self._terms(quadratic, eigenvalues_out, eigenvalues_in)
        curvature = functools.reduce(operator.add, (t.curvature for t in terms if t.curvature is not None))
        determined = curvature > rounding(quadratic.gram)
        finite = jnp.all(jnp.isfinite(curvature)) & jnp.all(jnp.isfinite(quadratic.cross))
        solvable = finite & jnp.all(determined)
        if self.orthogonality is None and self.descriptor_commutativity is None:
            functional_map, regular = _solve_rows(quadratic, terms[1:])
            result = where(regular, RESULTS.successful, RESULTS.singular_system)
        else:
            # The quadratic terms have the same curvature in each entry of `C / unit`, so conjugate gradients
            # need few steps.
            unit = jax.lax.rsqrt(jnp.where(determined, curvature, 1))
            initial = quadratic.cross * unit**2 if initial is None else initial
            functional_map, result = self._gauss_newton(terms, unit, initial, solvable)
            # Traced weights are not checked, so a negative weight can make the residuals NaN.
            residuals = jnp.stack([jnp.sum(term.residual(functional_map)) for term in terms])
            finite &= jnp.all(jnp.isfinite(residuals))
        result = where(solvable, result, RESULTS.undetermined_functional_map)
        return functional_map, where(finite, result, RESULTS.nonfinite_functional_map)

    def _quadratic_energy(
        self, energy: QuadraticEnergy | None, shape: tuple[int, int], dtype: DTypeLike
    ) -> QuadraticEnergy:
        if (energy is None) != (self.wavelet_preservation is None):
            raise ValueError(
                "an energy needs the weight wavelet_preservation, and the weight needs an energy: "
                "give both or neither"
            )
        quadratic = QuadraticEnergy.zero(*shape, dtype)
        if energy is not None and self.wavelet_preservation is not None:
            quadratic += self.wavelet_preservation.astype(dtype) * energy
        if self.descriptors is not None and self.descriptor_preservation is not None:
            f_out, f_in = self.descriptors.x.coefficients, self.descriptors.y.coefficients
            if (f_out.shape[0], f_in.shape[0]) != shape:
                raise ValueError(
                    f"the descriptors are expressed in {f_out.shape[0]} and {f_in.shape[0]} eigenvectors, "
                    f"but the functional map is {shape[0]} x {shape[1]}: project the descriptors onto the "
                    "spectra for which the functional map is computed, in the same order"
                )
            size = jnp.sum(f_out**2)
            weight = self.descriptor_preservation.astype(dtype) * shape[0] / size
            quadratic += weight * QuadraticEnergy(product(f_in, f_in.T), product(f_out, f_in.T), size)
        return quadratic

    def _terms(
        self,
        quadratic: QuadraticEnergy,
        eigenvalues_out: Float[Array, " k_out"],
        eigenvalues_in: Float[Array, " k_in"],
    ) -> list[_Term]:
        """Return the terms of the objective that have a weight, the quadratic energy first."""
        dtype = eigenvalues_in.dtype
        terms = [_energy_term(quadratic)]
        if self.laplacian_commutativity is not None:
            weight = self.laplacian_commutativity.astype(dtype)
            mask = _laplacian_mask(eigenvalues_out, eigenvalues_in, self.mask, self.resolvent_power)
            terms.append(_mask_term(weight, mask))
        if self.orthogonality is not None:
            weight = self.orthogonality.astype(dtype)
            terms.append(_orthogonality_term(weight, eigenvalues_out.size, eigenvalues_in.size))
        if self.descriptors is not None and self.descriptor_commutativity is not None:
            d_out, d_in = self.descriptors.x.operators, self.descriptors.y.operators
            assert d_out is not None and d_in is not None  # `__check_init__` requires them
            terms.append(_operator_term(self.descriptor_commutativity.astype(dtype), d_out, d_in))
        return terms

    def _gauss_newton(
        self,
        terms: Sequence[_Term],
        unit: Float[Array, "k_out k_in"],
        initial: FunctionalMap,
        solvable: Bool[Array, ""],
    ) -> tuple[FunctionalMap, RESULTS]:
        """Minimise over `C / unit`. Unless `solvable`, all residuals are zero and the solver stops."""
        # The imports are inside the method because importing both packages takes as long as computing an
        # eigenbasis.
        import lineax as lx
        import optimistix as optx

        precision = 0.1 * self.tolerance
        inner = lx.Normal(lx.CG(precision, precision, max_steps=10 * max(unit.shape)))
        with jax.default_matmul_precision("highest"):
            # The solver has no trust region. On real pairs, a trust region never shortened a step. The
            # trust-region solvers of optimistix also do not accept float32 while jax_enable_x64 is set.
            solution: optx.Solution = optx.least_squares(
                lambda scaled, _: [jnp.where(solvable, term.residual(scaled * unit), 0) for term in terms],
                optx.GaussNewton(self.tolerance, self.tolerance, linear_solver=inner),
                jax.lax.stop_gradient(initial / unit),
                max_steps=self.max_steps,
                # GMRES would call LAPACK, which can deadlock in a batch on CPUs; see `linear_algebra`.
                adjoint=optx.ImplicitAdjoint(lx.Normal(lx.CG(precision, precision))),
                throw=False,
            )
        converged = solution.result == optx.RESULTS.successful
        return solution.value * unit, where(converged, RESULTS.successful, RESULTS.solver_not_converged)


class _Term(NamedTuple):
    """One term of the objective: the squared norm of a residual.

    `curvature` is half the second derivative with respect to each entry of C, or None if it is not constant.
    """

    residual: Callable[[FunctionalMap], Array]
    curvature: Float[Array, "k_out k_in"] | None


def _energy_term(energy: QuadraticEnergy) -> _Term:
    """Return the energy, up to a constant, as the squared norm of a residual (k_out, k_in)."""
    # The energy is a sum of squares over many columns. The Cholesky factor of the gram matrix has the same
    # inner products as these columns. A singular matrix has no factor, so the rounding error is added.
    (k_out, k_in), dtype = energy.cross.shape, energy.gram.dtype
    factor = cholesky(energy.gram + rounding(energy.gram) * jnp.eye(k_in, dtype=dtype))
    target = solve_lower(factor, energy.cross.T).T
    curvature = jnp.broadcast_to(jnp.diagonal(energy.gram)[None, :], (k_out, k_in))
    return _Term(lambda c: product(c, factor) - target, curvature)


def _mask_term(weight: Float[Array, ""], mask: Float[Array, "k_out k_in"]) -> _Term:
    scaled = mask * jnp.sqrt(weight)
    return _Term(lambda c: scaled * c, scaled**2)


def _laplacian_mask(
    eigenvalues_out: Float[Array, " k_out"], eigenvalues_in: Float[Array, " k_in"], mask: Mask, power: float
) -> Float[Array, "k_out k_in"]:
    """Return the mask of Laplacian commutativity, of which the sign does not matter, without unit."""
    largest = jnp.maximum(eigenvalues_out[-1], eigenvalues_in[-1])
    a, b = eigenvalues_out[:, None] / largest, eigenvalues_in[None, :] / largest
    if mask == "standard":
        return a - b
    # At the eigenvalue 0, which rounding can make negative, the power has no derivative.
    a, b = (jnp.where(values > 0, jnp.where(values > 0, values, 1) ** power, 0) for values in (a, b))
    # The difference of the resolvents 1 / (a - i) and 1 / (b - i) is (b - a) / ((a - i) (b - i)).
    return (a - b) * jax.lax.rsqrt((1 + a**2) * (1 + b**2))


def _orthogonality_term(weight: Float[Array, ""], k_out: int, k_in: int) -> _Term:
    root, identity = jnp.sqrt(weight), jnp.eye(min(k_out, k_in), dtype=weight.dtype)
    return _Term(lambda c: root * ((product(c.T, c) if k_in <= k_out else product(c, c.T)) - identity), None)


def _operator_term(
    weight: Float[Array, ""], d_out: Float[Array, "d k_out k_out"], d_in: Float[Array, "d k_in k_in"]
) -> _Term:
    scale = jnp.sqrt(weight * d_out.shape[1] / jnp.sum(d_out**2))
    diagonal_out, diagonal_in = (jnp.diagonal(d, axis1=1, axis2=2) for d in (d_out, d_in))
    squares = jnp.sum(d_out**2, axis=(0, 1))[:, None] + jnp.sum(d_in**2, axis=(0, 2))[None, :]
    return _Term(
        lambda c: scale * (product(c[None], d_in) - product(d_out, c[None])),
        scale**2 * (squares - 2 * product(diagonal_out.T, diagonal_in)),
    )


def _solve_rows(
    quadratic: QuadraticEnergy, masks: Sequence[_Term]
) -> tuple[Float[Array, "k_out k_in"], Bool[Array, ""]]:
    """Minimise a quadratic energy and at most one term of a mask, and return whether C is unique."""
    if not masks:
        return quadratic.minimizer(), quadratic.is_regular()
    (mask,) = masks
    assert mask.curvature is not None
    rows, regular = jax.vmap(_solve_row, (None, 0, 0))(quadratic.gram, mask.curvature, quadratic.cross)
    return rows, jnp.all(regular)


@jitted
def _solve_row(
    gram: Float[Array, "k_in k_in"], curvature: Float[Array, " k_in"], cross: Float[Array, " k_in"]
) -> tuple[Float[Array, " k_in"], Bool[Array, ""]]:
    """Return the row c that solves `(gram + diag(curvature)) c = cross`, and whether the row is unique."""
    system = gram + jnp.diag(curvature)
    factor = cholesky(jax.lax.stop_gradient(system))
    return solve_positive_definite(system, cross[:, None], factor)[:, 0], is_regular(system, factor)
