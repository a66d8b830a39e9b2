"""Refinement of many pairs in stages. Each stage runs in batches on all devices."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from jaxsmw.core.spectrum import Spectrum
from jaxsmw.matching.judge import Outcome
from jaxsmw.matching.preparation import PreparedPair
from jaxsmw.matching.stages import Stage
from jaxsmw.runtime.batches import refine_pairs


def refine_batch(
    prepared: Sequence[PreparedPair],
    stages: Sequence[Stage],
    *,
    batch_size: int | None = None,
    devices: Sequence[jax.Device] | None = None,
) -> list[Outcome]:
    """Refine the initial maps of many pairs by the given stages in order, without repair.

    Each stage refines all pairs with `jaxsmw.refine_pairs`, before the next stage begins. The outcomes can be
    repaired with `refine_in_stages(…, refined=outcome)`.

    **Arguments:**

    - `prepared`: the prepared pairs, which must consist of full shapes. Pairs that share a shape should share
      its spectrum, so that the spectrum is copied to the devices once.
    - `stages`: the stages, in the order in which they run.
    - `batch_size`, `devices`: see `jaxsmw.refine_pairs`.

    **Returns:** One `Outcome` per pair, in the order of `prepared`. The maps of the outcomes are padded. The
    outcome of a pair contains no stages after the first stage that failed for this pair.
    """
    spectra: dict[int, Spectrum] = {}
    samples: dict[int, jax.Array | None] = {}
    for one in prepared:
        for side, spectrum in enumerate((one.spectrum_x, one.spectrum_y)):
            spectra.setdefault(id(spectrum), spectrum)
            samples.setdefault(id(spectrum), None if one.samples is None else one.samples[side])
    row = {key: number for number, key in enumerate(spectra)}
    pairs = [(row[id(one.spectrum_x)], row[id(one.spectrum_y)]) for one in prepared]
    maps = [np.asarray(one.initial_map) for one in prepared]
    outcomes = [Outcome([], one.padded_map(one.initial_map)) for one in prepared]
    for stage in stages:
        chosen = None
        if stage.number_of_samples is not None:
            chosen = [of_shape[: stage.number_of_samples] for of_shape in samples.values()]  # type: ignore[index]
        found_pairs = refine_pairs(
            [stage.view(spectrum, spectrum)[0] for spectrum in spectra.values()],
            pairs,
            maps,
            samples=chosen,
            batch_size=batch_size,
            devices=devices,
            **stage.settings,
        )
        for number, found in found_pairs:
            maps[number] = np.asarray(found.pointwise_map)
            padded = prepared[number].padded_map(maps[number].astype(np.int64))
            found = eqx.tree_at(lambda tree: tree.pointwise_map, found, padded)
            # After a failure, later stages still run for this pair, but their results are ignored.
            if outcomes[number].successful:
                refinements = [*outcomes[number].refinements, found]
                outcomes[number] = outcomes[number]._replace(refinements=refinements)
    return outcomes
