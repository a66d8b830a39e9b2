"""The interface of refiners, through which `jaxsmw.refine` runs any method of refinement."""

from __future__ import annotations

import abc
import dataclasses
from typing import Generic, TypeVar

from jaxtyping import Bool, Float, Int, Int32

from jaxsmw.core.arrays import Array, namespace, rows_at
from jaxsmw.core.functional_map import Convention
from jaxsmw.core.module import Module, field
from jaxsmw.core.pointwise_map import spectral_embeddings
from jaxsmw.core.results import RESULTS
from jaxsmw.core.search import nearest_neighbor
from jaxsmw.core.spectrum import Spectrum
from jaxsmw.errors import InputError

Samples = tuple[Int[Array, " s_x"], Int[Array, " s_y"]]
"""The indices of the samples of X (s_x,) and of Y (s_y,): the vertices on which a refiner iterates."""


class Problem(Module):
    """The two shapes that a refiner matches, and the vertices on which the refiner iterates.

    **Attributes:**

    - `spectrum_x`, `spectrum_y`: the `Spectrum` of source X (m vertices) and of target Y (n vertices). Unless
      `partial` is True, each shape should have area 1.
    - `samples`: the sampled 0-based vertices of X (s_x,) and of Y (s_y,); None if the refiner iterates on all
      vertices.
    - `partial`: whether one shape is a part of the other. Both shapes then need the same unit of length.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum
    samples: Samples | None = None
    partial: bool = field(static=True, default=False)

    def query_spectra(self) -> tuple[Spectrum, Spectrum]:
        """Return the spectra of X and of Y at the vertices on which the refiner iterates.

        Eigenvectors are not orthonormal on samples, so `encode` needs `pseudo_inverse="least_squares"` there.
        """
        if self.samples is None:
            return self.spectrum_x, self.spectrum_y
        return self.spectrum_x.sample(self.samples[0]), self.spectrum_y.sample(self.samples[1])


class Prepared(Module):
    """The values that a refiner computes once per problem. A refiner may add fields.

    The spectra are the result of `Problem.query_spectra`. Pointwise maps have one entry per vertex of
    `spectrum_x`.
    """

    spectrum_x: Spectrum
    spectrum_y: Spectrum


class State(Module):
    """The values that a refiner passes from one iteration to the next. A refiner may add fields.

    The functional map C (k_out, k_in), without unit, has the convention `Refiner.convention`.
    """

    functional_map: Float[Array, "k_out k_in"]

    @property
    def uncertainty(self) -> Float[Array, ""] | None:
        """The uncertainty of the matches, lower is better; None if the refiner does not estimate it."""
        return None


PreparedT = TypeVar("PreparedT", bound=Prepared)
StateT = TypeVar("StateT", bound=State)


class Refiner(Module, Generic[PreparedT, StateT]):
    """A method of refinement for `jaxsmw.refine`: the abstract base class of all refiners.

    Ready subclasses are `jaxsmw.WaveletPreservation`, `jaxsmw.FeatureRegression` and `jaxsmw.Registration`. A
    refiner defines both half-steps of an iteration: `update` computes a `State` from a pointwise map, and
    `recover` computes a pointwise map from a state. `jaxsmw.refine` calls `prepare` once for all vertices
    and, if there are samples, once more for the samples. Then it calls `update` and `recover_both` in each
    iteration. JAX traces all methods, so Python code in the methods must not branch on the values of arrays.

    A subclass is a frozen dataclass and a pytree; see `jaxsmw.core.module.Module`. It must define `prepare`,
    `update` and `energy`, and it may override the other methods and properties. In the shapes of arrays, m is
    the number of vertices of X to be matched, and n is the number of vertices of Y. All entries of maps are
    0-based.
    """

    @abc.abstractmethod
    def prepare(self, problem: Problem) -> PreparedT:
        """Return the values that stay the same in all iterations."""

    @abc.abstractmethod
    def update(
        self, prepared: PreparedT, pointwise_map: Int[Array, " m"], previous: StateT | None
    ) -> tuple[StateT, RESULTS]:
        """Compute a state from a pointwise map. Return the state and a status code.

        **Arguments:**

        - `prepared`: the result of `prepare`.
        - `pointwise_map`: T: X -> Y (m,), one vertex of Y per vertex of `prepared.spectrum_x`.
        - `previous`: the state from which the map was recovered, as `recover_both` returns it; None in the
          first iteration.
        """

    def recover(self, prepared: PreparedT, state: StateT) -> Int32[Array, " m"]:
        """Recover the pointwise map X -> Y (m,) from a state, as a valid argument of `update`.

        By default, the match of a vertex of X is the nearest vertex of Y in the `embeddings`.
        """
        queries, database = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.spectrum_y.mask)

    def recover_reverse(self, prepared: PreparedT, state: StateT) -> Int32[Array, " n"]:
        """Recover the reverse map Y -> X (n,), whose matches are the nearest vertices in the `embeddings`.

        `prepared` must be the result of `prepare` for a problem without samples.
        """
        database, queries = self.embeddings(prepared, state)
        return nearest_neighbor(queries, database, database_mask=prepared.spectrum_x.mask)

    def recover_both(self, prepared: PreparedT, state: StateT) -> tuple[Int32[Array, " m"], StateT]:
        """Return the result of `recover`, and the state with what `update` needs besides this map.

        `jaxsmw.refine` passes the returned state to `update` as `previous`, and then discards it. By default,
        the state is not changed. If `update` also uses a reverse map, `jaxsmw.core.search.nearest_in_both`
        computes both maps at once.
        """
        return self.recover(prepared, state), state

    @abc.abstractmethod
    def energy(self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]) -> Float[Array, ""]:
        """Return the quantity that the method minimises, in any unit, for `History.energy`.

        `state` is the state that `update` computed from the map `pointwise_map`.
        """

    def embeddings(
        self, prepared: PreparedT, state: StateT
    ) -> tuple[Float[Array, "m d"], Float[Array, "n d"]]:
        """Return a point for each vertex of X (m, d) and of Y (n, d), such that matched points are close.

        `jaxsmw.Correspondence.surface_points` searches the triangles around the match of a vertex for the
        point whose embedding is nearest. By default, the embeddings are the `spectral_embeddings` of the
        functional map. A refiner chooses the dimension d and the unit, which both point sets share.
        """
        return spectral_embeddings(
            state.functional_map, prepared.spectrum_x, prepared.spectrum_y, convention=self.convention
        )

    def objective(
        self, prepared: PreparedT, state: StateT, pointwise_map: Int[Array, " m"]
    ) -> Float[Array, ""]:
        """Return the area-weighted mean squared distance between matched points of the `embeddings`.

        The unit is the squared unit of the embeddings. `pointwise_map` is the map that was recovered from the
        state. `jaxsmw.refine` stores the result in `History.objective`.
        """
        queries, database = self.embeddings(prepared, state)
        xp, areas = namespace(queries), prepared.spectrum_x.vertex_areas
        return xp.sum(areas * xp.sum((queries - rows_at(database, pointwise_map)) ** 2, axis=1)) / xp.sum(
            areas
        )

    def is_settled(self, state: StateT) -> Bool[Array, ""]:
        """Return whether all iterations after a state use the same settings; True by default.

        Only then does a map that one iteration leaves unchanged stay unchanged, so that `jaxsmw.refine` may
        stop early.
        """
        return namespace(state.functional_map).asarray(True)

    @property
    def uses_namespaces(self) -> bool:
        """Whether the methods take their namespace from their arrays, so that NumPy runs them as well.

        The default is False, for refiners that are written with `jax.numpy`. See `jaxsmw.core.arrays`.
        """
        return False

    @property
    def matches_samples_with_all(self) -> bool:
        """Whether maps of samples contain vertices of Y, not positions in Y's samples (the default)."""
        return False

    @property
    def levels(self) -> tuple[int, ...]:
        """The number of eigenvectors in each iteration; empty if every iteration uses all eigenvectors."""
        return ()

    def with_levels(self, levels: tuple[int, ...]) -> Refiner[PreparedT, StateT]:
        """Return the refiner with other levels. By default, `levels` must be a field of the refiner.

        **Raises:** `InputError` if the refiner has no levels.
        """
        if not self.levels:
            raise InputError(f"{type(self).__name__} has no levels: use FeatureRegression or Registration.")
        return dataclasses.replace(self, levels=levels)  # type: ignore[call-arg]

    def with_traced_levels(self) -> Refiner[PreparedT, StateT]:
        """Return the refiner with levels as an array, so that refiners with other levels share its program.

        By default, the refiner is not changed.
        """
        return self

    @property
    def further_bases(self) -> tuple[str, ...]:
        """The names of the bases that the spectra need besides the Laplacian's, none by default."""
        return ()

    @property
    def convention(self) -> Convention:
        """The direction of the functional map, `"pullback"` by default."""
        return "pullback"
