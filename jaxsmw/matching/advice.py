"""What `match` tells about a map that may be wrong, and how to get a better one."""

from __future__ import annotations

from collections.abc import Iterator

from jaxsmw.geometry.scans import SMALL_CLOSED
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.judge import discontinuous_parts, orientation_reversal
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.search.chirality import Decision


def advice(correspondence: Correspondence, decision: Decision) -> Iterator[str]:
    """Yield the warnings of a match: the map looks wrong, parts were left out, or the hand is uncertain."""
    if correspondence.suspicious:
        yield _suspicion(correspondence)
    if correspondence.left_out > SMALL_CLOSED:
        yield _omission(correspondence)
    if decision.doubtful:
        yield _doubt(correspondence.pair, decision)


def _omission(correspondence: Correspondence) -> str:
    """Say that small components have no counterpart."""
    return (
        f"{correspondence.pair.name}: {correspondence.left_out:.0%} of the source's area lies in small "
        "components that have no counterpart on the target, so they only move with their surroundings. If "
        "they are parts of one surface, join them, for example by welding (weld=True)."
    )


def _doubt(pair: Pair, decision: Decision) -> str:
    """Say that X and its mirror image match Y about equally well."""
    took = "the mirror image of the source" if decision.mirrored else "the source itself"
    return (
        f"{pair.name}: the source and its mirror image match the target about equally well (evidence "
        f"{decision.evidence:.2f} for the mirror image). {took.capitalize()} was matched. If both meshes are "
        'of the same hand, set mirror="no"; if not, set mirror="yes".'
    )


# If the map reverses the orientation of more than this share of the area, one shape may be a mirror image.
_MOSTLY = 0.5


def _suspicion(correspondence: Correspondence) -> str:
    """Say that the map looks wrong."""
    pair, repair = correspondence.pair, correspondence.preset.repair
    settings = correspondence.preset.criteria
    reversed_ = orientation_reversal(
        correspondence.matched_pair, correspondence.pointwise_map, correspondence.spectrum_x, settings.scores
    )
    cut_off = discontinuous_parts(correspondence.matched_pair, correspondence.pointwise_map, settings.scores)
    reversed_share, cut_off_share = (pair.mesh_x.average(fault) for fault in (reversed_, cut_off))
    more = "more" if correspondence.origin == "landmarks" else "a few"
    cure = f"use {more} landmarks as the initial map"
    if repair is None:
        cure = f'use preset="accurate", which repairs such maps, or {cure}'
    if reversed_share > _MOSTLY:
        cure += (
            '; if both meshes are of the same hand, set mirror="no"'
            if correspondence.mirrored
            else '; if one mesh is a mirror image of the other, set mirror="yes"'
        )
    if pair.partial and pair.scale == 1:
        cure += (
            ", and check that both meshes have the same unit of length, or estimate the scale with "
            'scale="unknown"'
        )
    if not pair.partial:
        cure += "; if one mesh is a partial shape, set partial=True"
    return (
        f"{pair.name}: limbs may be swapped or mirrored, or the body may be upside down. The map has "
        f"distortion {correspondence.distortion:.3f}, reverses the orientation of {reversed_share:.0%} of "
        f"the source's area, and separates {cut_off_share:.0%} of the source's area by discontinuities. "
        f"Correct maps between poses of one body have distortions up to {settings.suspicious}. Correct maps "
        "can have larger distortions between non-isometric shapes, with topological noise, or if one shape "
        "is mirrored. "
        "Look at the map with the option --report or, in Python, with jaxsmw.report.summary.write_report. If "
        f"the map is wrong, {cure}."
    )
