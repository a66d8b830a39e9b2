"""What a method of refinement is: the interface between `jaxsmw.refine` and the methods that plug into it."""

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
"""Vertices of X and of Y on which a refiner iterates instead of all vertices."""


class Problem(eqx.Module):
    """The shapes that a refiner matches.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: source X (m vertices) and target Y (n vertices).
    - `samples`: the vertices on which the refiner iterates; None for all vertices.
    - `partial`: whether one shape is a partial view of the other, in the same unit of length.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    samples: Samples | None = None
    partial: bool = eqx.field(static=True, default=False)

    def query_spectra(self) -> tuple[Spectrum, Spectrum]:
        """The spectra of the vertices on which the refiner iterates: the samples, or all vertices."""
        if self.samples is None:
            return self.spectrum_x, self.spectrum_y
        return self.spectrum_x.sample(self.samples[0]), self.spectrum_y.sample(self.samples[1])


class Prepared(eqx.Module):
    """Everything that a refiner computes once per problem. Each refiner extends this class by its own fields.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: `Problem.query_spectra`. The pointwise map has one entry per vertex of
      `spectrum_x`.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum


class State(eqx.Module):
    """What a refiner passes from one iteration to the next. Refiners extend this class by their own fields.

    **Attributes:**

    - `functional_map`: C, in the refiner's convention.
    """

    functional_map: Float[Array, "k_out k_in"]

    @property
    def uncertainty(self) -> Float[Array, ""] | None:
        """How uncertain the refiner is of its matches, lower is better; None if the refiner does not say."""
        return None


PreparedT = TypeVar("PreparedT", bound=Prepared)
StateT = TypeVar("StateT", bound=State)


class Refiner(eqx.Module, Generic[PreparedT, StateT]):
    """A method of refinement: its two half-steps between pointwise map and state.

    `jaxsmw.refine` calls `prepare` once, then `update` and `recover` in each iteration.
    """

    @abc.abstractmethod
    def prepare(self, problem: Problem) -> PreparedT:
        """Computes everything that stays the same in all iterations."""

    @abc.abstractmethod
    def update(
        self, prepared: PreparedT, pointwise_map: Int[Array, " m"], previous: StateT | None
    ) -> tuple[StateT, RESULTS]:
        """The state that follows from a pointwise map, and how its computation ended.

        `previous` is the state from which the pointwise map was recovered; None in the first iteration.
        """

    @abc.abstractmethod
    def recover(self, prepared: PreparedT, state: StateT) -> Int32[Array, " m"]:
        """The pointwise map X -> Y that follows from a state."""

    @abc.abstractmethod
    def recover_reverse(self, prepared: PreparedT, state: StateT) -> Int32[Array, " n"]:
        """The reverse map Y -> X that follows from a state: the vertex of X nearest to each vertex of Y.

        Both are compared in `embeddings`. `prepared` must be of a problem without samples.
        """

    @abc.abstractmethod
    def energy(self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """The quantity that the method minimises, for the history."""

    def embeddings(
        self, prepared: PreparedT, state: StateT
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Two point sets in which a vertex of X lies close to its match on Y.

        One row per vertex of X to be matched, and one row per vertex of Y, in the units of the method.
        `jaxsmw.Correspondence.surface_points` finds points between the vertices of Y in this space.
        """
        return spectral_embeddings(state.functional_map, prepared.spectrum_x, prepared.spectrum_y)

    def objective(
        self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """The area-weighted mean squared distance between matched embeddings, for the history."""
        queries, database = self.embeddings(prepared, state)
        areas = prepared.spectrum_x.vertex_areas
        return jnp.sum(areas * jnp.sum((queries - database[pointwise_map]) ** 2, axis=1)) / jnp.sum(areas)

    def is_settled(self, state: StateT) -> Bool[Array, ""]:
        """Whether an unchanged pointwise map stays unchanged: False while the refiner's settings vary."""
        return jnp.asarray(True)

    @property
    def levels(self) -> tuple[int, ...]:
        """The number of eigenvectors in each iteration; empty if the refiner always uses all of them."""
        return ()

    @property
    def convention(self) -> Convention:
        """The direction of the functional map."""
        return "pullback"
