"""The published protocols: the shapes and pairs of a data set on which papers report errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain, permutations

from jaxsmw.benchmark.datasets import DataPair, DataSet, class_of, first_three, read_shapes
from jaxsmw.errors import InputError


@dataclass(frozen=True)
class Protocol:
    """The shapes and pairs of a data set on which papers report errors.

    **Attributes:**

    - `layouts`: the names of the accepted layouts of the data set; see `DataSet.layout`.
    - `choose`: a function that takes a `DataSet` and returns the pairs of the protocol.
    - `files`: the needed files, as a text.
    - `pairs`: the chosen pairs, as a text.
    - `papers`: the papers that use the protocol.
    - `source`: the address at which the files circulate.
    """

    layouts: tuple[str, ...]
    choose: Callable[[DataSet], list[DataPair]]
    files: str
    pairs: str
    papers: str
    source: str


def protocol_pairs(name: str, data_set: DataSet) -> list[DataPair]:
    """Return the pairs of a published protocol, each a `DataPair` of a complete `DataSet`.

    **Raises:** `InputError` if there is no such protocol, or if the data set has another layout or lacks
    files that the protocol needs.
    """
    if name not in PROTOCOLS:
        raise InputError(f"{name!r} is not a protocol: choose {', '.join(PROTOCOLS)}.")
    protocol = PROTOCOLS[name]
    if data_set.layout not in protocol.layouts:
        raise InputError(
            f"{data_set.directory}: has the layout of {data_set.layout}, but the protocol {name} needs "
            f"{' or '.join(protocol.layouts)}: give the directory of {protocol.files} ({protocol.source})."
        )
    try:
        return protocol.choose(data_set)
    except _MissingError as missing:
        raise InputError(
            f"{data_set.directory}: {missing}, which the protocol {name} needs: complete the data set from "
            f"{protocol.source}, or choose pairs with --pairs."
        ) from None


class _MissingError(Exception):
    """A protocol needs something that the data set lacks."""


def _between(data_set: DataSet, names: Iterable[tuple[str, str]]) -> list[DataPair]:
    """Return the pairs with the given names, or raise `_MissingError`."""
    names, shapes = list(names), data_set.shapes
    if missing := [shape for shape in dict.fromkeys(chain.from_iterable(names)) if shape not in shapes]:
        raise _MissingError(f"lacks the shapes {first_three(missing)}")
    by_names = data_set.known_pairs
    if unknown := [pair for pair in names if pair not in by_names]:
        raise _MissingError(f"lacks the ground truth of {' to '.join(unknown[0])}")
    return [by_names[pair] for pair in names]


def _among(*shapes: str) -> Callable[[DataSet], list[DataPair]]:
    """Return a function that chooses all ordered pairs of different shapes among the given shapes."""
    return lambda data_set: _between(data_set, permutations(shapes, 2))


def _listed_shapes(data_set: DataSet, name: str) -> list[str]:
    """Return the shapes that a text file in the directory of the data set lists."""
    if (path := data_set.directory / name).is_file():
        return read_shapes(path)
    raise _MissingError(f"lacks {name}, the list of its test shapes")


def _test_animals(data_set: DataSet) -> list[DataPair]:
    return _between(data_set, permutations(_listed_shapes(data_set, "test_cat.txt"), 2))


def _whole_humans(data_set: DataSet) -> list[DataPair]:
    """Choose all pairs with ground truth, except for pairs with the shape 40, which is a partial shape."""
    shapes = [str(number) for number in range(1, 45) if number != 40]
    if missing := [shape for shape in shapes if shape not in data_set.shapes]:
        raise _MissingError(f"lacks {len(missing)} of the shapes 1 to 44, such as {missing[0]}")
    return [pair for names, pair in data_set.known_pairs.items() if "40" not in names]


_TOSCA_CLASSES = {"cat", "centaur", "david", "dog", "gorilla", "horse", "michael", "victoria", "wolf"}


def _tosca(data_set: DataSet) -> list[DataPair]:
    if pairs := [pair for pair in data_set.pairs if class_of(pair.source) in _TOSCA_CLASSES]:
        return pairs
    raise _MissingError("lacks the shapes of TOSCA, such as cat0")


def _kind(kind: str) -> Callable[[DataSet], list[DataPair]]:
    """Return a function that chooses the partial shapes of one kind, cuts or holes."""

    def choose(data_set: DataSet) -> list[DataPair]:
        if pairs := [pair for pair in data_set.pairs if pair.source.startswith(f"{kind}_")]:
            return pairs
        raise _MissingError(f"lacks the folder {kind}/")

    return choose


def _scans(partial: bool) -> Callable[[DataSet], list[DataPair]]:
    """Return a function that chooses the listed pairs whose source is a partial scan, or is not."""

    def choose(data_set: DataSet) -> list[DataPair]:
        if pairs := [pair for pair in data_set.pairs if pair.partial == partial]:
            return pairs
        raise _MissingError(f"lacks {'test-set0.txt' if partial else 'test-set1.txt'}, a list of its pairs")

    return choose


# Li 2022 and Cao 2023 leave this class out.
_IGNORED_CLASS = "pumpkinhulk"


def _test_characters(same: bool) -> Callable[[DataSet], list[DataPair]]:
    """Return a function that chooses pairs of test characters, of the same class or of different classes."""

    def choose(data_set: DataSet) -> list[DataPair]:
        listed = _listed_shapes(data_set, "test.txt")
        shapes = [shape for shape in listed if class_of(shape) != _IGNORED_CLASS]
        if same:
            pairs = permutations(shapes, 2)
            return _between(data_set, (pair for pair in pairs if class_of(pair[0]) == class_of(pair[1])))
        between = [pair for pair in data_set.others if set(shapes).issuperset(pair.names)]
        if not between:
            raise _MissingError("lacks the folder corres/cross_category_corres")
        return between

    return choose


def _listed(data_set: DataSet) -> list[DataPair]:
    return list(data_set.pairs)


_REMESHED, _CHARACTERS = ("a remeshed set",), ("DeformingThings4D",)
_REN = "https://github.com/llorz/SGA18_orientation_BCICP_dataset"
_CAO = "https://github.com/dongliangcao/Unsupervised-Learning-of-Robust-Spectral-Shape-Matching"
_DYKE = "http://robertodyke.com/shrec2020/"
_TRAINED = "Donati 2020, Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM), Bastian 2024 (hybrid functional maps)"

PROTOCOLS: dict[str, Protocol] = {
    "faust-r": Protocol(
        _REMESHED,
        _among(*(f"tr_reg_{number:03}" for number in range(80, 100))),
        "the remeshed FAUST set",
        "the ordered pairs of the shapes tr_reg_080 to tr_reg_099 (380)",
        _TRAINED,
        _REN,
    ),
    "scape-r": Protocol(
        _REMESHED,
        _among(*(f"mesh{number:03}" for number in range(52, 72))),
        "the remeshed SCAPE set",
        "the ordered pairs of the shapes mesh052 to mesh071 (380)",
        _TRAINED,
        _REN,
    ),
    "shrec19-r": Protocol(
        ("SHREC'19 humans",),
        _whole_humans,
        "SHREC'19 humans with the shapes 1 to 44, remeshed or original",
        "all pairs with ground truth, without the partial shape 40",
        "Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM)",
        _CAO,
    ),
    "smal-r": Protocol(
        _REMESHED,
        _test_animals,
        "the remeshed SMAL set with test_cat.txt, which lists 20 cougars, hippos and horses",
        "the ordered pairs of the listed shapes (380)",
        "Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM), Bastian 2024 (hybrid functional maps)",
        _CAO,
    ),
    "topkids": Protocol(
        ("SHREC'16 topology",),
        _listed,
        "SHREC'16 topology",
        "every shape kidNN to kid00",
        "Lähner 2016, Eisenberger 2020 (smooth shells), Cao 2023 (ULRSSM)",
        _CAO,
    ),
    "shrec16-cuts": Protocol(
        ("SHREC'16 partial",),
        _kind("cuts"),
        "the test set of SHREC'16 partial with cuts/ and null/",
        "every cut to its full shape (200 in the test set)",
        "Cosmo 2016, Attaiki 2021 (DPFM)",
        "https://www.dais.unive.it/~shrec2016/",
    ),
    "shrec16-holes": Protocol(
        ("SHREC'16 partial",),
        _kind("holes"),
        "the test set of SHREC'16 partial with holes/ and null/",
        "every shape with holes to its full shape (200 in the test set)",
        "Cosmo 2016, Attaiki 2021 (DPFM)",
        "https://www.dais.unive.it/~shrec2016/",
    ),
    "partial-smal": Protocol(
        ("PARTIALSMAL",),
        _listed,
        "the test half of PARTIALSMAL with shapes/ and maps/",
        "every pair of two parts with ground truth (100 in the test half), or the listed pairs",
        "Ehm 2024, Xie 2025 (EchoMatch)",
        "https://github.com/vikiehm/gc-ppsm",
    ),
    "cp2p24": Protocol(
        ("CP2P24",),
        _listed,
        "the test half of CP2P24 with off/ and maps/",
        "every pair of two cuts with ground truth",
        "Xie 2025 (EchoMatch)",
        "https://huggingface.co/datasets/xieyizheng/CP2P24",
    ),
    "shrec20": Protocol(
        ("SHREC'20",),
        _scans(partial=False),
        "SHREC'20 with models/ and test-sets/, and its ground truth in a second directory",
        "the pairs of full scans in test-set1.txt to test-set4.txt",
        "Dyke 2020",
        _DYKE,
    ),
    "shrec20-partial": Protocol(
        ("SHREC'20",),
        _scans(partial=True),
        "SHREC'20 with models/ and test-sets/, and its ground truth in a second directory",
        "the pairs of a partial scan and a full scan in test-set0.txt",
        "Dyke 2020",
        _DYKE,
    ),
    "tosca": Protocol(
        ("TOSCA", "a remeshed set"),
        _tosca,
        "TOSCA, original or remeshed",
        "the listed pairs of a remeshed set, or all ordered pairs within a class",
        "Ren 2018, Hu 2021 (MWP)",
        _REN,
    ),
    "dt4d-intra": Protocol(
        _CHARACTERS,
        _test_characters(same=True),
        "remeshed characters of DeformingThings4D (DT4D-H) with test.txt",
        "the ordered pairs of listed shapes of one class, without the class pumpkinhulk",
        "Magnet 2022, Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM)",
        _CAO,
    ),
    "dt4d-inter": Protocol(
        _CHARACTERS,
        _test_characters(same=False),
        "remeshed characters of DeformingThings4D (DT4D-H) with test.txt and corres/cross_category_corres",
        "the pairs of listed shapes of classes A and B with a file A_B.vts, without the class pumpkinhulk",
        "Magnet 2022, Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM)",
        _CAO,
    ),
}
"""A dictionary from the names of the protocols to the protocols, each a `Protocol`."""
