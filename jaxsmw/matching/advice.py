"""What `match` tells about a map that may be wrong, and how to get a better one."""

from __future__ import annotations

from collections.abc import Iterator

from jaxsmw.errors import WrongMapWarning
from jaxsmw.geometry.scale import may_be_part
from jaxsmw.geometry.scans import SMALL_CLOSED
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.wording import MOST_LISTED, percentage


def advice(correspondence: Correspondence, *, partial: bool) -> Iterator[UserWarning]:
    """Yield the warnings: a part was recognised, the map is probably wrong, or components were left out.

    `partial` tells whether the shapes were called partial.
    """
    if correspondence.pair.partial and not partial:
        yield UserWarning(_recognition(correspondence))
    if correspondence.suspicious:
        yield WrongMapWarning(_suspicion(correspondence))
    if correspondence.left_out > SMALL_CLOSED:
        yield UserWarning(_omission(correspondence))


def verdict(correspondence: Correspondence) -> str:
    """Say how probable it is that the map is wrong."""
    return (
        "the map is wrong as a whole with a probability of "
        f"{percentage(correspondence.wrong_probability())}: turned, mirrored, or with exchanged limbs."
    )


def _recognition(correspondence: Correspondence) -> str:
    """Say that one shape was matched as a part of the other."""
    pair = correspondence.pair
    (_, part), (_, whole) = sorted(zip(pair.areas, (mesh.name for mesh in pair.meshes), strict=True))
    unit = cure = ""
    if pair.scale != 1:
        unit = f" (lengths on the source are multiplied by {pair.scale:.3g})"
        cure = ' and scale="unknown"'
    return (
        f"{part} looks like a part of {whole}, and was matched as such{unit}. If it is a part, set "
        f"partial=True{cure}, which often gives a better map."
    )


def _omission(correspondence: Correspondence) -> str:
    """Say that small components have no counterpart."""
    return (
        f"{correspondence.pair.name}: {correspondence.left_out:.0%} of the source's area lies in small "
        "components that have no counterpart on the target, so they only move with their surroundings. If "
        "they are parts of one surface, join them, for example by welding (weld=True)."
    )


def _suspicion(correspondence: Correspondence) -> str:
    """Say that the map is probably wrong as a whole, and what could be done."""
    pair, others = correspondence.pair, correspondence.alternatives
    text = f"{pair.name}: {verdict(correspondence)}"
    if others:
        listed = [f"{other.difference} ({percentage(other.probability)})" for other in others[:MOST_LISTED]]
        more = [f"and {len(others) - MOST_LISTED} more"] if len(others) > MOST_LISTED else []
        text += f" Other maps could be right (see Correspondence.alternatives): {'; '.join(listed + more)}."
    cures = ["give a few landmarks as the initial map with init=landmarks"]
    if correspondence.origin == "landmarks":
        cures = ["give more landmarks with init=landmarks"]
    if correspondence.preset.search is None:
        cures.insert(0, 'use preset="accurate", which searches for the right map')
    if pair.partial and pair.scale == 1:
        cures.append('estimate the scale with scale="unknown" if the units of length differ')
    if pair.partial and correspondence.shared is None and all(map(may_be_part, pair.meshes)):
        cures.append(
            "match both meshes through a full shape of this kind with template=mesh, or with "
            'template="mammal" for four-legged animals, if both are parts'
        )
    if not pair.partial:
        cures.append("set partial=True if one mesh is a part of the other")
    return (
        f"{text} Look at the map on the page that jaxsmw.report.summary.write_report writes. If it is "
        f"wrong, {', or '.join(cures)}."
    )
