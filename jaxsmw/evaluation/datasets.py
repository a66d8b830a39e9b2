"""Data sets in the layouts in which they circulate: which shapes there are, which pairs, and what is true.

None of them comes with this library; their licences do not allow it. Where each is obtained stands in
`docs/datasets.md`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np

from jaxsmw.errors import InputError
from jaxsmw.evaluation.ground_truth import GroundTruth, read_ground_truth
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.io.map_files import IndexBase
from jaxsmw.io.mesh_files import MESH_SUFFIXES


@dataclass(frozen=True)
class DataPair:
    """Two shapes of a data set and where it says which points are the same.

    **Attributes:**

    - `source`, `target`: names of X and Y.
    - `source_file`, `target_file`: their meshes.
    - `truth`: the files `read_ground_truth` reads; none where vertex i is vertex i.
    - `mirrored_truth`: the same for the left-right mirrored body; None where there is none.
    - `index_base`: what the indices in these files count from; None for what their form says.
    - `partial`: whether the source is only a part of the target, in the same unit of length.
    """

    source: str
    target: str
    source_file: Path
    target_file: Path
    truth: tuple[Path, ...] = ()
    mirrored_truth: tuple[Path, ...] | None = None
    index_base: IndexBase | None = None
    partial: bool = False

    @property
    def name(self) -> str:
        """For messages and tables."""
        return f"{self.source} to {self.target}"

    @property
    def names(self) -> tuple[str, str]:
        """Of source and target."""
        return self.source, self.target

    @property
    def meshes(self) -> tuple[Path, Path]:
        """The files of source and target."""
        return self.source_file, self.target_file

    def ground_truth(self, mesh_x: Mesh, mesh_y: Mesh, *, mirrored: bool = False) -> GroundTruth:
        """The truth about the pair, given its meshes.

        **Raises:** `InputError` if a file is wrong, there is no mirrored truth, or vertices that should be
        the same differ in number.
        """
        files = self.mirrored_truth if mirrored else self.truth
        if files is None:
            raise InputError(f"{self.name}: its data set has no mirrored ground truth.")
        if files:
            return read_ground_truth(files, mesh_x, mesh_y, index_base=self.index_base)
        m, n = len(mesh_x.vertices), len(mesh_y.vertices)
        if m != n:
            raise InputError(
                f"{self.target_file}: has {n} vertices where {self.source_file} has {m}, but in this data "
                "set vertex i of one is vertex i of the other: give the original files."
            )
        return GroundTruth.of_all_vertices(np.arange(m))


@dataclass(frozen=True)
class DataSet:
    """What was found in a directory.

    **Attributes:**

    - `directory`: where.
    - `layout`: what was recognised, in words.
    - `pairs`: the pairs to be matched, in the set's own order where it has one.
    - `others`: further pairs whose truth is known.
    """

    directory: Path
    layout: str
    pairs: tuple[DataPair, ...]
    others: tuple[DataPair, ...] = ()

    @property
    def name(self) -> str:
        """The directory's name."""
        return self.directory.resolve().name

    @property
    def shapes(self) -> dict[str, Path]:
        """The meshes that occur in pairs, by name."""
        found = {}
        for pair in (*self.pairs, *self.others):
            found[pair.source], found[pair.target] = pair.source_file, pair.target_file
        return found


def open_data_set(directory: str | os.PathLike[str]) -> DataSet:
    """Recognise a data set by its files.

    - **Remeshed sets** (FAUST, TOSCA, SCAPE and others; Ren et al. 2018): meshes in one folder (`off/`,
      `shapes/`, …), for each a `corres/NAME.vts`, perhaps `corres/NAME.sym.vts`.
    - **SHREC'19 humans** (Melzi et al. 2019): meshes `1.obj`, … and for pairs `I_J.txt` in a folder
      `FARMgt_txt`; or, remeshed, `I_J.map` in `corres/`.
    - **SHREC'16 partial** (Cosmo et al. 2016): `null/` and `cuts/` or `holes/`; pairs are part to null.
    - **SHREC'16 topology** (Lähner et al. 2016): `kid00` and `kidNN` with `kidNN_ref.txt`; pairs are
      `kidNN` to `kid00`.
    - **FAUST registrations** `tr_reg_NNN`, **SCAPE** `meshNNN`, **TOSCA** (`cat0`, …): meshes alone, flat or
      in one folder; vertex i is vertex i, in TOSCA within a class.

    Pairs are those of a list where there is one (`test_pairs.txt`, `PAIRS_list_….txt`: two names per line);
    else all ordered pairs of different shapes, within a class where names have one (`cat0`, `cat1`).
    A directory that holds several sets is none.

    **Raises:** `InputError` that says what was expected, or what is missing.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"{directory}: is not a directory: give the one that a data set was unpacked to.")
    inner = [folder for folder in sorted(directory.iterdir()) if folder.is_dir() and _is_a_set(folder)]
    if len(inner) > 1:
        raise InputError(
            f"{directory}: holds several data sets ({', '.join(folder.name for folder in inner)}): give one."
        )
    found = _recognise(directory)
    if found is None:
        raise InputError(
            f"{directory}: is not laid out like a data set that is known ({'; '.join(_EXPECTED)}): give the "
            "directory that one was unpacked to."
        )
    layout, (pairs, others) = found
    if not pairs:
        raise InputError(
            f"{directory}: looks like {layout}, but no two of its shapes make a pair: complete the copy."
        )
    return DataSet(directory, layout, tuple(pairs), tuple(others))


def _recognise(directory: Path) -> tuple[str, _Pairs] | None:
    """The first layout that fits a directory, and its pairs."""
    for layout, open_layout in _LAYOUTS.items():
        if (pairs := open_layout(directory)) is not None:
            return layout, pairs
    return None


def _is_a_set(directory: Path) -> bool:
    try:
        return _recognise(directory) is not None
    except InputError:
        return False


_EXPECTED = (
    "remeshed sets: off/NAME.off with corres/NAME.vts",
    "SHREC'19: NAME.obj with FARMgt_txt/NAME_NAME.txt",
    "SHREC'16 partial: null/ with cuts/ or holes/",
    "SHREC'16 topology: kid00.off with kidNN_ref.txt",
    "FAUST: tr_reg_NNN.ply",
    "SCAPE: meshNNN.ply",
    "TOSCA: cat0.mat or cat0.off",
)


def _natural(name: str) -> list[tuple[int, str]]:
    """A sort key that puts cat2 before cat10."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", name)]


def _meshes(directory: Path) -> dict[str, Path]:
    """The mesh files in a directory, by name and in natural order."""
    if not directory.is_dir():
        return {}
    files = [file for file in directory.iterdir() if file.suffix.lower() in MESH_SUFFIXES and file.is_file()]
    found: dict[str, Path] = {}
    for file in sorted(files, key=lambda file: MESH_SUFFIXES.index(file.suffix.lower())):
        found.setdefault(file.stem, file)  # of two formats of one shape the first in the list
    return {name: found[name] for name in sorted(found, key=_natural)}


# Pairs to be matched and further ones whose truth is known.
_Pairs = tuple[list[DataPair], list[DataPair]]


def _mesh_folder(directory: Path, names: re.Pattern[str]) -> dict[str, Path]:
    """Meshes with such names, in a directory or in the first folder of it that has any."""
    folders = [directory, *sorted(folder for folder in directory.rglob("*") if folder.is_dir())]
    for folder in folders:
        found = {name: file for name, file in _meshes(folder).items() if names.fullmatch(name)}
        if found:
            return found
    return {}


def _listed_pairs(directory: Path, shapes: Mapping[str, Path]) -> list[tuple[str, str]] | None:
    """The pairs of a list that comes with a data set; None without one."""
    lists = sorted([*directory.glob("test_pairs.txt"), *directory.rglob("PAIRS_list*.txt")])
    if not lists:
        return None
    return read_pairs(lists[0], shapes)


def read_pairs(path: str | os.PathLike[str], shapes: Iterable[str]) -> list[tuple[str, str]]:
    """Read a list of pairs: in each line the names of source and target, with spaces or a comma between.

    What follows a `#` does not count.

    **Raises:** `InputError` that names the line that is not two of the shapes, or if there is no pair.
    """
    path, known, pairs = Path(path), set(shapes), []
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}): give a list of pairs.") from error
    for number, line in enumerate(lines, start=1):
        names = re.split(r"[,;\s]+", line.partition("#")[0].strip())
        if names == [""]:
            continue
        wrong = [name for name in names if name not in known]
        if len(names) != 2 or wrong:
            fault = f"{wrong[0][:60]!a} is none of the shapes" if wrong else "does not name two shapes"
            raise InputError(f"{path}, line {number}: {fault}: correct the line, or complete the data set.")
        pairs.append((names[0], names[1]))
    if not pairs:
        raise InputError(f"{path}: names no pair: write two names of shapes on each line.")
    return pairs


def class_of(name: str) -> str:
    """What the name of a shape says about its kind: all but the number at its end."""
    return re.sub(r"[_-]?\d+$", "", name)


def _within_classes(names: Iterable[str]) -> list[tuple[str, str]]:
    return [(x, y) for x, y in permutations(names, 2) if class_of(x) == class_of(y)]


def _listed_first(
    pair: Callable[[str, str], DataPair],
    listed: Iterable[tuple[str, str]] | None,
    known: Iterable[tuple[str, str]],
) -> _Pairs:
    """The listed pairs, if there is a list, and others whose truth is known; else all of these."""
    wanted = dict.fromkeys(known if listed is None else listed)
    others = (names for names in known if names not in wanted)
    return [pair(*names) for names in wanted], [pair(*names) for names in others]


def _remeshed(directory: Path) -> _Pairs | None:
    truths = directory / "corres"
    files = {file.name.removesuffix(".vts"): file for file in truths.glob("*.vts")}
    plain = {name: file for name, file in files.items() if not name.endswith(".sym")}
    if not plain:
        return None
    folders = (folder for folder in sorted(directory.iterdir()) if folder.is_dir() and folder != truths)
    shapes = next((found for found in map(_meshes, folders) if set(found) & set(plain)), {})
    if not shapes:
        raise InputError(
            f"{directory}: has {len(plain)} .vts files in corres/, but no folder with the meshes they belong "
            "to: put those beside it, in off/."
        )
    if missing := [name for name in shapes if name not in plain]:
        raise InputError(
            f"{truths / missing[0]}.vts: is missing, the ground truth of {shapes[missing[0]]}: complete the "
            "copy, or remove the mesh."
        )
    if missing := [name for name in plain if name not in shapes]:
        raise InputError(
            f"{directory}: has no mesh for {plain[missing[0]]}: complete the copy, or remove the file."
        )

    def pair(x: str, y: str) -> DataPair:
        mirrored = None
        if f"{x}.sym" in files:
            mirrored = (files[f"{x}.sym"], plain[y])
        return DataPair(x, y, shapes[x], shapes[y], (plain[x], plain[y]), mirrored)

    return _listed_first(pair, _listed_pairs(directory, shapes), _within_classes(shapes))


def _shrec19(directory: Path) -> _Pairs | None:
    between = re.compile(r"(\d+)_(\d+)")
    truths = {
        (match[1], match[2]): file
        for pattern in ("FARMgt_txt/*.txt", "corres/*.map")
        for file in sorted(directory.rglob(pattern), key=lambda file: _natural(file.stem))
        if (match := between.fullmatch(file.stem))
    }
    if not truths:
        return None
    shapes = _mesh_folder(directory, re.compile(r"\d+"))

    def pair(x: str, y: str) -> DataPair:
        if (x, y) not in truths:
            raise InputError(f"{directory}: the ground truth {x}_{y} of a listed pair is missing: add it.")
        return DataPair(x, y, shapes[x], shapes[y], (truths[x, y],), index_base=1)

    known = [names for names in truths if set(names) <= set(shapes)]
    return _listed_first(pair, _listed_pairs(directory, shapes), known)


def _partial(directory: Path) -> _Pairs | None:
    nulls = _meshes(directory / "null")
    parts = {**_meshes(directory / "cuts"), **_meshes(directory / "holes")}
    if not nulls and not parts:
        return None
    if not nulls or not parts:
        found = "cuts/ or holes/ but no null/" if parts else "null/ but no cuts/ or holes/"
        raise InputError(f"{directory}: has {found}: put all of them there.")
    pairs = []
    for name, file in parts.items():
        match = re.fullmatch(r"(?:cuts|holes)_(.+)_shape_\d+", name)
        if match is None or match[1] not in nulls:
            raise InputError(
                f"{file}: no full shape in {directory / 'null'} belongs to it: parts are called "
                "cuts_NULL_shape_N or holes_NULL_shape_N."
            )
        truth, mirrored = (file.with_suffix(suffix) for suffix in (".baryc_gt", ".baryc_gt_sym"))
        if not truth.is_file():
            raise InputError(f"{truth}: is missing, the ground truth of {file}: complete the copy.")
        null = match[1]
        sides = (mirrored,) if mirrored.is_file() else None
        pairs.append(DataPair(name, null, file, nulls[null], (truth,), sides, partial=True))
    return pairs, []


def _topology(directory: Path) -> _Pairs | None:
    shapes = _mesh_folder(directory, re.compile(r"kid\d+"))
    if not shapes:
        return None
    if "kid00" not in shapes:
        raise InputError(f"{directory}: has kids but no kid00, to which all others are matched: add it.")
    full = shapes.pop("kid00")
    pairs = []
    for name, file in shapes.items():
        truth = file.with_name(f"{name}_ref.txt")
        if not truth.is_file():
            raise InputError(f"{truth}: is missing, the ground truth of {file}: complete the copy.")
        pairs.append(DataPair(name, "kid00", file, full, (truth,)))
    return pairs, []


def _identical(names: str) -> Callable[[Path], _Pairs | None]:
    pattern = re.compile(names)

    def open_layout(directory: Path) -> _Pairs | None:
        shapes = _mesh_folder(directory, pattern)
        if not shapes:
            return None
        above = directory.resolve().parent
        if any((above / "corres").glob("*.vts")):
            raise InputError(f"{directory}: holds only the meshes of a remeshed set: give {above}.")

        def pair(x: str, y: str) -> DataPair:
            return DataPair(x, y, shapes[x], shapes[y])

        return _listed_first(pair, _listed_pairs(directory, shapes), _within_classes(shapes))

    return open_layout


_LAYOUTS: dict[str, Callable[[Path], _Pairs | None]] = {
    "a remeshed set": _remeshed,
    "SHREC'19 humans": _shrec19,
    "SHREC'16 partial": _partial,
    "SHREC'16 topology": _topology,
    "FAUST registrations": _identical(r"tr_reg_\d{3}"),
    "SCAPE": _identical(r"mesh\d{3}"),
    "TOSCA": _identical(r"(cat|centaur|david|dog|gorilla|horse|lioness|michael|seahorse|victoria|wolf)\d+"),
}
