"""The interface of refiners, through which `jaxsmw.refine` runs any method of refinement."""

from __future__ import annotations

import abc
from typing import Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int32

from jaxsmw.core.functional_map import Convention
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.results import RESULTS
from jaxsmw.core.spectrum import Spectrum

Samples = tuple[Int[Array, " s_x"], Int[Array, " s_y"]]
"""The indices of the samples of X (s_x,) and of Y (s_y,): the vertices on which a refiner iterates."""


class Problem(eqx.Module):
    """The two shapes that a refiner matches, and the vertices on which the refiner iterates.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices). Unless
      `partial` is True, each shape should have area 1.
    - `samples`: the sampled 0-based vertices of X (s_x,) and of Y (s_y,), as a pair of integer arrays; None
      if the refiner iterates on all vertices.
    - `partial`: whether one shape is a part of the other. If True, both shapes must have the same unit of
      length.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    samples: Samples | None = None
    partial: bool = eqx.field(static=True, default=False)

    def query_spectra(self) -> tuple[Spectrum, Spectrum]:
        """Return the spectra of X and of Y at the vertices on which the refiner iterates.

        The refiner iterates on the samples or, if the problem has no samples, on all vertices.
        """
        if self.samples is None:
            return self.spectrum_x, self.spectrum_y
        return self.spectrum_x.sample(self.samples[0]), self.spectrum_y.sample(self.samples[1])


class Prepared(eqx.Module):
    """The values that a refiner computes once per problem.

    Each refiner can define a subclass with further fields.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the two spectra that `Problem.query_spectra` returns, each a `Spectrum`.
      Pointwise maps have one entry per vertex of `spectrum_x`.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum


class State(eqx.Module):
    """The values that a refiner passes from one iteration to the next.

    Each refiner can define a subclass with further fields.

    **Attributes:**

    - `functional_map`: C (k_out, k_in), without unit, in the convention that `Refiner.convention` returns. A
      pullback takes functions on Y ("in") to functions on X ("out").
    """

    functional_map: Float[Array, "k_out k_in"]

    @property
    def uncertainty(self) -> Float[Array, ""] | None:
        """An estimate of the uncertainty of the matches, as a scalar array; lower is better.

        The value is None if the refiner computes no such estimate.
        """
        return None


PreparedT = TypeVar("PreparedT", bound=Prepared)
StateT = TypeVar("StateT", bound=State)


class Refiner(eqx.Module, Generic[PreparedT, StateT]):
    """A method of refinement for `jaxsmw.refine`: the abstract base class of all refiners.

    Ready subclasses are `jaxsmw.WaveletPreservation`, `jaxsmw.FeatureRegression` and `jaxsmw.Registration`. A
    refiner defines both half-steps of an iteration: `update` computes a state from a pointwise map, and
    `recover` computes a pointwise map from a state. The state contains the functional map. `jaxsmw.refine`
    calls `prepare` once for all vertices and, if there are samples, once more for the samples. Then it calls
    `update` and `recover_both` in each iteration. JAX traces all methods, so Python code in the methods must
    not branch on the values of arrays.

    A subclass is an equinox module. In the shapes of arrays, m is the number of vertices of X to be matched,
    and n is the number of vertices of Y.

    **Methods that a subclass must define:**

    - `prepare(problem)`: takes a `Problem` and returns a `Prepared`, which contains the values that all
      iterations share.
    - `update(prepared, pointwise_map, previous)`: takes a pointwise map X -> Y (m,) and the previous `State`
      (None in the first iteration). It returns the next `State` and a status code, which is a member of
      `RESULTS`.
    - `recover(prepared, state)`: returns the pointwise map X -> Y, an int32 array (m,) of 0-based vertices of
      Y.
    - `recover_reverse(prepared, state)`: returns the reverse map Y -> X, an int32 array (n,) of 0-based
      vertices of X.
    - `energy(prepared, state, pointwise_map)`: returns the quantity that the method minimises, as a scalar
      array in any unit. `jaxsmw.refine` stores this quantity in `History.energy`.

    **Methods that a subclass can override:** `recover_both`, `embeddings`, `objective` and `is_settled`, and
    the properties `levels`, `convention` and `matches_samples_with_all`.
    """

    @abc.abstractmethod
    def prepare(self, problem: Problem) -> PreparedT:
        """Return the values that stay the same in all iterations, as a `Prepared`.

        **Arguments:**

        - `problem`: a `Problem`, which contains both spectra, the samples or None, and the flag `partial`.
        """

    @abc.abstractmethod
    def update(
        self, prepared: PreparedT, pointwise_map: Int[Array, " m"], previous: StateT | None
    ) -> tuple[StateT, RESULTS]:
        """Compute a state from a pointwise map. Return the state and a status code (a member of `RESULTS`).

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `pointwise_map`: T: X -> Y (m,), one 0-based vertex of Y per vertex of `prepared.spectrum_x`.
        - `previous`: the state from which the pointwise map was recovered, as `recover_both` returns it; None
          in the first iteration.
        """

    @abc.abstractmethod
    def recover(self, prepared: PreparedT, state: StateT) -> Int32[Array, " m"]:
        """Recover the pointwise map X -> Y (m,) from a state.

        The map contains one 0-based vertex of Y per vertex of `prepared.spectrum_x`. The map must be a valid
        argument `pointwise_map` of `update`.
        """

    def recover_both(self, prepared: PreparedT, state: StateT) -> tuple[Int32[Array, " m"], StateT]:
        """Recover the pointwise map X -> Y (m,), and add to the state what `update` needs besides this map.

        `jaxsmw.refine` passes the returned state to `update` as `previous`, and then discards it. By default,
        the method returns the result of `recover` and the state without changes. If `update` also uses a
        reverse map, both maps can be computed here by one call of `jaxsmw.core.search.nearest_in_both`.
        """
        return self.recover(prepared, state), state

    @abc.abstractmethod
    def recover_reverse(self, prepared: PreparedT, state: StateT) -> Int32[Array, " n"]:
        """Recover the reverse map Y -> X (n,) from a state.

        The map sends each vertex of Y to the nearest vertex of X in the `embeddings`. `prepared` must be the
        result of `prepare` for a problem without samples.
        """

    @property
    def matches_samples_with_all(self) -> bool:
        """Whether `recover` matches samples of X with all vertices of Y, not only with samples of Y.

        If True, pointwise maps of samples contain vertices of Y. If False (the default), they contain
        positions in the list of Y's samples.
        """
        return False

    @abc.abstractmethod
    def energy(self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """Return the quantity that the method minimises, as a scalar array.

        `jaxsmw.refine` stores this quantity in `History.energy`.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `state`: the state that `update` computed from the pointwise map.
        - `pointwise_map`: T: X -> Y (m,), one 0-based vertex of Y per vertex of `prepared.spectrum_x`.
        """

    def embeddings(
        self, prepared: PreparedT, state: StateT
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Return two point sets in which each vertex of X is close to its match on Y.

        For each vertex of X, `jaxsmw.Correspondence.surface_points` searches the triangles around its match.
        Its result is the point on these triangles whose embedding is nearest to the embedding of the vertex.
        By default, the embeddings are the `spectral_embeddings` of the functional map in the refiner's
        `convention`.

        **Returns:** Two arrays: one point for each vertex of X to be matched (m, d), and one point for each
        vertex of Y (n, d). Each refiner chooses the dimension d and the unit, which is the same for both
        point sets.
        """
        return spectral_embeddings(
            state.functional_map, prepared.spectrum_x, prepared.spectrum_y, convention=self.convention
        )

    def objective(
        self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the area-weighted mean squared distance between matched points of the `embeddings`.

        The result is a scalar array in the squared unit of the embeddings. `jaxsmw.refine` stores it in
        `History.objective`.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `state`: the state that defines the `embeddings`.
        - `pointwise_map`: T: X -> Y (m,), the map that `recover` returns for this state.
        """
        queries, database = self.embeddings(prepared, state)
        areas = prepared.spectrum_x.vertex_areas
        return jnp.sum(areas * jnp.sum((queries - database[pointwise_map]) ** 2, axis=1)) / jnp.sum(areas)

    def is_settled(self, state: StateT) -> Bool[Array, ""]:
        """Return whether all iterations after a state use the same settings, such as the same eigenvectors.

        If the settings stay the same, a map that one iteration leaves unchanged also stays unchanged in all
        later iterations. `jaxsmw.refine` therefore stops early only if this method returns True. The default
        is True.
        """
        return jnp.asarray(True)

    @property
    def levels(self) -> tuple[int, ...]:
        """The number of eigenvectors in each iteration; empty if every iteration uses all eigenvectors."""
        return ()

    @property
    def convention(self) -> Convention:
        """The direction of the functional map, `"pullback"` (the default) or `"pushforward"`.

        A pullback (k_X, k_Y) takes functions on Y to functions on X. A pushforward (k_Y, k_X) takes functions
        on X to functions on Y.
        """
        return "pullback"


def reverse_map(refiner: Refiner, problem: Problem, state: State) -> Int32[Array, " n"]:
    """Recover the reverse map Y -> X (n,) of all vertices from a refiner's state.

    **Arguments:**

    - `refiner`: the refiner that computed the state.
    - `problem`: a `Problem` without samples.
    - `state`: a `State` of the refiner.
    """
    return refiner.recover_reverse(refiner.prepare(problem), state)
