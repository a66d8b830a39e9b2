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
"""Vertices of X (s_x,) and of Y (s_y,) on which a refiner iterates instead of all vertices."""


class Problem(eqx.Module):
    """The shapes that a refiner matches.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `samples`: the vertices on which the refiner iterates; None for all vertices.
    - `partial`: whether one shape is a part of the other. Both shapes must then have the same unit of length.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    samples: Samples | None = None
    partial: bool = eqx.field(static=True, default=False)

    def query_spectra(self) -> tuple[Spectrum, Spectrum]:
        """Returns the spectra of X and of Y at the vertices on which the refiner iterates.

        These vertices are the samples, or all vertices if there are no samples.
        """
        if self.samples is None:
            return self.spectrum_x, self.spectrum_y
        return self.spectrum_x.sample(self.samples[0]), self.spectrum_y.sample(self.samples[1])


class Prepared(eqx.Module):
    """The values that a refiner computes once per problem.

    Refiners extend this class with their own fields.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the result of `Problem.query_spectra`. The pointwise map has one entry per
      vertex of `spectrum_x`.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum


class State(eqx.Module):
    """The values that a refiner passes from one iteration to the next.

    Refiners extend this class with their own fields.

    **Attributes:**

    - `functional_map`: C (k_out, k_in), in the refiner's convention.
    """

    functional_map: Float[Array, "k_out k_in"]

    @property
    def uncertainty(self) -> Float[Array, ""] | None:
        """The uncertainty of the matches, a number; lower is better. None if the refiner has no estimate."""
        return None


PreparedT = TypeVar("PreparedT", bound=Prepared)
StateT = TypeVar("StateT", bound=State)


class Refiner(eqx.Module, Generic[PreparedT, StateT]):
    """A method of refinement: the two half-steps between pointwise map and state.

    `jaxsmw.refine` calls `prepare` once (with samples, a second time for the samples). Then it calls `update`
    and `recover` in each iteration.
    """

    @abc.abstractmethod
    def prepare(self, problem: Problem) -> PreparedT:
        """Computes everything that stays the same in all iterations."""

    @abc.abstractmethod
    def update(
        self, prepared: PreparedT, pointwise_map: Int[Array, " m"], previous: StateT | None
    ) -> tuple[StateT, RESULTS]:
        """Returns the state that follows from a pointwise map, and a member of `RESULTS`.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `pointwise_map`: T: X -> Y, one entry per vertex of `prepared.spectrum_x`.
        - `previous`: the state from which the pointwise map was recovered; None in the first iteration.
        """

    @abc.abstractmethod
    def recover(self, prepared: PreparedT, state: StateT) -> Int32[Array, " m"]:
        """Returns the pointwise map X -> Y that follows from a state.

        The map has one entry per vertex of `prepared.spectrum_x`. `update` must accept this map with the same
        `prepared`.
        """

    @abc.abstractmethod
    def recover_reverse(self, prepared: PreparedT, state: StateT) -> Int32[Array, " n"]:
        """Returns the reverse map Y -> X that follows from a state, (n,).

        The map assigns to each vertex of Y the nearest vertex of X. The search compares the `embeddings` of X
        and Y. `prepared` must belong to a problem without samples.
        """

    @abc.abstractmethod
    def energy(self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """Returns the quantity that the method minimises, a number for `History.energy`.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `state`: the state that follows from the pointwise map.
        - `pointwise_map`: T: X -> Y, one entry per vertex of `prepared.spectrum_x`.
        """

    def embeddings(
        self, prepared: PreparedT, state: StateT
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Returns two point sets in which each vertex of X is close to its match on Y.

        `jaxsmw.Correspondence.surface_points` finds points between the vertices of Y in this space.

        **Returns:** One row per vertex of X to be matched (m, d), and one row per vertex of Y (n, d), in the
        units of the method.
        """
        return spectral_embeddings(state.functional_map, prepared.spectrum_x, prepared.spectrum_y)

    def objective(
        self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Returns the area-weighted mean squared distance between matched embeddings, for the history.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `state`: the state that defines the `embeddings`.
        - `pointwise_map`: T: X -> Y, the map that `recover` returns for this state.
        """
        queries, database = self.embeddings(prepared, state)
        areas = prepared.spectrum_x.vertex_areas
        return jnp.sum(areas * jnp.sum((queries - database[pointwise_map]) ** 2, axis=1)) / jnp.sum(areas)

    def is_settled(self, state: StateT) -> Bool[Array, ""]:
        """Returns whether a map that one iteration leaves unchanged also stays unchanged in later iterations.

        The result is False while the refiner changes its settings between iterations.
        """
        return jnp.asarray(True)

    @property
    def levels(self) -> tuple[int, ...]:
        """The number of eigenvectors in each iteration; empty if the refiner always uses all of them."""
        return ()

    @property
    def convention(self) -> Convention:
        """The direction of the functional map: `"pullback"` or `"pushforward"`."""
        return "pullback"
