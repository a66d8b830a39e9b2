"""Readers for data sets in their published directory layouts: shapes, pairs, splits and ground truth.

This library contains no data set, because the licences of the data sets do not allow copies.
`docs/datasets.md` says where to obtain each data set. Importing this module imports neither JAX nor NumPy,
and reading a data set does not import JAX, so any training framework can use this module.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from jaxsmw.choices import IndexBase, Split
from jaxsmw.errors import InputError, check_choice

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Bool

    from jaxsmw.evaluation.ground_truth import GroundTruth
    from jaxsmw.geometry.mesh import Mesh


@dataclass(frozen=True)
class _NamedPair:
    source: str
    target: str

    @property
    def name(self) -> str:
        """The text "SOURCE to TARGET" with the names of both shapes."""
        return f"{self.source} to {self.target}"

    @property
    def names(self) -> tuple[str, str]:
        """The names of the source and the target."""
        return self.source, self.target


@dataclass(frozen=True)
class DataPair(_NamedPair):
    """A pair of shapes in a data set: their names, their mesh files, and the files of their ground truth.

    **Attributes:**

    - `source`, `target`: the names of the source X and the target Y.
    - `source_file`, `target_file`: the mesh files of X and Y.
    - `truth`: one to three files for `read_ground_truth`. Without files, vertex i of X corresponds to vertex
      i of Y.
    - `mirrored_truth`: the files of a ground truth in which left and right are exchanged; None without one.
    - `index_base`: the index of the first vertex in these files, 0 or 1; None for the default of the format.
    - `partial`: whether X or both are parts of full shapes. Their meshes then have the same unit of length.
    - `both_partial`: whether both are parts. `truth` is then one file, as `read_true_overlap` reads it.
    - `reverse_truth`: if both are parts, the file of the ground truth from Y to X; None without one.
    """

    source_file: Path
    target_file: Path
    truth: tuple[Path, ...] = ()
    mirrored_truth: tuple[Path, ...] | None = None
    index_base: IndexBase | None = None
    partial: bool = False
    both_partial: bool = False
    reverse_truth: Path | None = None

    @property
    def meshes(self) -> tuple[Path, Path]:
        """The mesh files of the source and the target."""
        return self.source_file, self.target_file

    def read(self) -> tuple[Mesh, Mesh, GroundTruth]:
        """Read the pair. All arrays of the result are NumPy arrays.

        **Returns:** The meshes of X and Y, with `vertices` in the unit of their file and 0-based `faces`, and
        the direct `GroundTruth`; see `GroundTruth.vertex_pairs`.

        **Raises:** `InputError` if a file cannot be read, or the files do not fit each other.
        """
        from jaxsmw.io.meshes import read_mesh

        mesh_x, mesh_y = read_mesh(self.source_file), read_mesh(self.target_file)
        return mesh_x, mesh_y, self.ground_truth(mesh_x, mesh_y)

    def ground_truth(self, mesh_x: Mesh, mesh_y: Mesh, *, mirrored: bool = False) -> GroundTruth:
        """Read and return the direct or the mirrored `GroundTruth` of the pair.

        **Arguments:**

        - `mesh_x`, `mesh_y`: the meshes in `source_file` and `target_file`.
        - `mirrored`: whether to return the mirrored ground truth instead of the direct ground truth.

        **Raises:** `InputError` if a file cannot be read or does not fit the meshes, or if there is no
        mirrored ground truth.
        """
        import numpy as np

        from jaxsmw.evaluation.ground_truth import GroundTruth, read_ground_truth

        files = self.mirrored_truth if mirrored else self.truth
        if files is None:
            raise InputError(
                f"{self.name}: the data set has no mirrored ground truth: use the direct ground truth."
            )
        if files:
            return read_ground_truth(files, mesh_x, mesh_y, index_base=self.index_base)
        m, n = len(mesh_x.vertices), len(mesh_y.vertices)
        if m != n:
            raise InputError(
                f"{self.target_file}: has {n} vertices and {self.source_file} has {m}, but in this data "
                "set vertex i of one shape corresponds to vertex i of the other: use the original mesh files."
            )
        return GroundTruth.of_all_vertices(np.arange(m))

    def true_overlap(
        self, mesh_x: Mesh, mesh_y: Mesh
    ) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " n"]] | None:
        """Read the overlap of two parts with `jaxsmw.evaluation.read_true_overlap`.

        **Returns:** A mask of the vertices of X (m,) and a mask of the vertices of Y (n,), True for vertices
        with a counterpart on the other part; None unless both shapes are parts.

        **Raises:** `InputError` if a file cannot be read or does not fit the meshes.
        """
        from jaxsmw.evaluation.ground_truth import read_true_overlap

        if not self.both_partial:
            return None
        return read_true_overlap(self.truth[0], mesh_x, mesh_y, reverse=self.reverse_truth)


@dataclass(frozen=True, eq=False)
class MeshPair(_NamedPair):
    """A pair of meshes in memory with ground truth, which a benchmark measures like a `DataPair`.

    **Attributes:**

    - `source`, `target`: the names of the source X and the target Y.
    - `mesh_x`, `mesh_y`: the meshes of X and Y.
    - `truth`: the ground truth.
    """

    mesh_x: Mesh
    mesh_y: Mesh
    truth: GroundTruth
    partial: ClassVar[bool] = False

    @property
    def meshes(self) -> tuple[Mesh, Mesh]:
        """The meshes of X and Y."""
        return self.mesh_x, self.mesh_y

    def ground_truth(self, mesh_x: Mesh, mesh_y: Mesh, *, mirrored: bool = False) -> GroundTruth:
        """Return the ground truth. `InputError` is raised for a mirrored one, which does not exist."""
        if mirrored:
            raise InputError(f"{self.name}: has no mirrored ground truth: use the direct ground truth.")
        return self.truth

    def true_overlap(self, mesh_x: Mesh, mesh_y: Mesh) -> None:
        """Return None, because both shapes are full."""


AnyPair = DataPair | MeshPair
"""A pair that a benchmark measures."""


@dataclass(frozen=True)
class DataSet:
    """A data set: the shapes and pairs in a directory, as `open_data_set` returns them.

    **Attributes:**

    - `directory`: the path of the directory that contains the files.
    - `layout`: the name of the recognised layout, a key of `jaxsmw.benchmark.datasets.LAYOUTS`, such as
      `"SHREC'16 partial"`.
    - `pairs`: the pairs to match, each a `DataPair`, in the order of the data set's list of pairs.
    - `others`: all other pairs with ground truth. In a remeshed set, they include all pairs of shapes of
      different classes, although only some remeshed sets have ground truth for them.
    """

    directory: Path
    layout: str
    pairs: tuple[DataPair, ...]
    others: tuple[DataPair, ...] = ()

    @property
    def name(self) -> str:
        """The name of the directory."""
        return self.directory.resolve().name

    @property
    def shapes(self) -> dict[str, Path]:
        """The mesh files of all shapes that occur in a pair, by the names of the shapes."""
        pairs = self.known_pairs.values()
        return {name: file for pair in pairs for name, file in zip(pair.names, pair.meshes, strict=True)}

    @property
    def known_pairs(self) -> dict[tuple[str, str], DataPair]:
        """All pairs with ground truth, by the names of their source and target."""
        return {pair.names: pair for pair in (*self.pairs, *self.others)}

    @property
    def papers(self) -> str:
        """The papers that published data sets of this layout, and papers that use them."""
        return LAYOUTS[self.layout].papers

    def split(self, part: Split) -> tuple[DataPair, ...]:
        """Return all pairs with ground truth between two training shapes, or between two test shapes.

        The published split comes from the first of these sources that exists:

        - a file `train_cat.txt`, `test_cat.txt`, `train.txt` or `test.txt`, which lists the shapes;
        - the numbers of the shapes of FAUST (tests from `tr_reg_080`) and SCAPE (tests from `mesh052`);
        - the name of the directory, if both parts circulate in their own directories: a word of the name is
          `train` or `test`. This concerns SHREC'16 partial, PARTIALSMAL and CP2P24;
        - SHREC'16 topology, SHREC'19 humans and SHREC'20 contain test shapes only.

        **Arguments:** `part`: `"train"` or `"test"`.

        **Returns:** The pairs, in the order of `known_pairs`. `jaxsmw.benchmark.protocol_pairs` returns the
        test pairs of a certain published protocol.

        **Raises:** `InputError` for another part, or if the data set has no published split, lacks a listed
        shape, or has no pair of this part.
        """
        check_choice(part, Split, "a part of a data set")
        shapes = _shapes_of_part(self, part)
        if missing := [name for name in shapes if name not in self.shapes]:
            raise InputError(
                f"{self.directory}: lacks the listed shapes {first_three(missing)}: complete the data set, "
                "or correct the list."
            )
        pairs = tuple(pair for pair in self.known_pairs.values() if set(shapes).issuperset(pair.names))
        if not pairs:
            raise InputError(
                f"{self.directory}: contains no pair of {part} shapes: complete the data set, or choose the "
                "other part."
            )
        return pairs


# The first test shape among the numbered shapes of FAUST and SCAPE.
_FIRST_TESTS = {"tr_reg_": 80, "mesh": 52}


def _shapes_of_part(data_set: DataSet, part: Split) -> list[str]:
    """Return the names of the training shapes or the test shapes; see `DataSet.split`."""
    directory, shapes = data_set.directory, data_set.shapes
    for name in (f"{part}_cat.txt", f"{part}.txt"):
        if (path := directory / name).is_file():
            return read_shapes(path)
    if data_set.layout in ("SHREC'16 topology", "SHREC'19 humans", "SHREC'20"):
        return list(shapes) if part == "test" else []
    if data_set.layout in ("SHREC'16 partial", "PARTIALSMAL", "CP2P24"):
        if part in re.split("[^a-z]+", data_set.name.lower()):
            return list(shapes)
        raise InputError(
            f"{directory}: its name does not say that it is the {part} half of {data_set.layout}: open the "
            f"directory of this half, whose name must contain the word {part}, or use the attribute pairs."
        )
    numbers = {name: re.fullmatch(r"(tr_reg_|mesh)(\d{3})", name) for name in shapes}
    if not all(numbers.values()):
        raise InputError(
            f"{directory}: has no published split: write the names of the {part} shapes into {part}.txt in "
            "this directory, or use the attribute pairs."
        )
    is_test = {name: int(match[2]) >= _FIRST_TESTS[match[1]] for name, match in numbers.items() if match}
    return [name for name in shapes if is_test[name] == (part == "test")]


# The lists `pairs` and `others` of a `DataSet`.
_Pairs = tuple[list[DataPair], list[DataPair]]


def open_data_set(directory: str | os.PathLike[str]) -> DataSet:
    """Open a data set, and recognise its layout from its files.

    The function recognises the following layouts. NAME, I, J, NN and NNN denote parts of file names.

    - **Remeshed sets** (FAUST, TOSCA, SCAPE and others; Ren et al. 2018): one folder (`off/`, `shapes/`, …)
      contains the meshes. For each mesh, `corres/` contains a file `NAME.vts`, and optionally a file
      `NAME.sym.vts` for the mirrored ground truth.
    - **SHREC'19 humans** (Melzi et al. 2019): the meshes are `1.obj`, `2.obj`, …, and a folder `FARMgt_txt`
      contains a file `I_J.txt` for each pair. In the remeshed version of this data set, a folder `corres`
      contains a file `I_J.map` for each pair.
    - **SHREC'16 partial** (Cosmo et al. 2016): `null/` contains the full shapes, and `cuts/` or `holes/`
      contain the partial shapes. In each pair a partial shape is the source, and its full shape is the
      target.
    - **PARTIALSMAL** (Ehm et al. 2024): `shapes/` contains parts of animals, and `maps/` contains a file
      `A_B.vts` for each pair of two parts. Line i contains the vertex of B that corresponds to the i-th
      vertex of A, counted from 0, or -1 if B lacks this point.
    - **CP2P24** (Xie et al. 2025): `off/` contains cuts of SHREC'16 partial, and `maps/` contains a file
      `A_B.map` for each pair of two cuts. Its first lines are those of PARTIALSMAL. Then a line for each
      vertex of B is 1 if the vertex has a counterpart on A, and otherwise 0.
    - **SHREC'16 topology** (Lähner et al. 2016): the mesh `kid00` is the target of all pairs. The sources are
      the other meshes `kidNN`, each with a file `kidNN_ref.txt`.
    - In the **copies of Cao et al. (2023)** of both SHREC'16 sets, the meshes are in folders `off/`, and the
      ground truth is in folders `corres/`, in files `PART.vts` and `kidNN_ref.vts`. Line i contains the
      vertex of the target that corresponds to the i-th vertex of the source, counted from 1.
    - **SHREC'20** (non-isometric animals; Dyke et al. 2020): `models/` contains the meshes, and `test-sets/`
      contains five lists of pairs. A second directory, beside the first and with `_gts` at the end of its
      name, contains a file `NAME.mat` for each mesh, with about 50 landmarks.
    - **DeformingThings4D** (remeshed characters, DT4D-H; Magnet et al. 2022): one folder (`off/`, …) contains
      a folder of meshes for each class, and `corres/CLASS/` contains a file `NAME.vts` for each mesh. A file
      `A_B.vts` in `corres/cross_category_corres/` lists the line in the `.vts` files of class B that
      corresponds to each line in the `.vts` files of class A. The names of shapes have the form `CLASS/NAME`.
    - **FAUST registrations** (`tr_reg_NNN`), **SCAPE** (`meshNNN`) and **TOSCA** (`cat0`, …): the directory
      or one of its folders contains the meshes, and there is no ground-truth file. Vertex i of one shape
      corresponds to vertex i of every other shape. In TOSCA, vertices correspond only between shapes of the
      same class, such as `cat0` and `cat1`.

    PARTIALSMAL and CP2P24 circulate in two halves, for training and for tests, each in its own directory.

    A data set can contain a list of pairs: a file `test_pairs.txt` or `PAIRS_list_….txt` with two names per
    line. The attribute `pairs` of the result then contains the listed pairs. Without a list, `pairs` contains
    all ordered pairs of different shapes with ground truth. In remeshed sets and in TOSCA, only shapes of the
    same class form pairs. The class of a shape is its name without the number at the end, for example `cat`
    for `cat0`. In DeformingThings4D, the class is the folder of the shape.

    **Returns:** A `DataSet`.

    **Raises:** `InputError` if the directory does not exist, has no known layout, lacks a file, cannot be
    read, or contains several data sets.
    """
    # Unlike `Path.is_dir`, `os.path.isdir` raises no error if a name is too long for the file system.
    if not os.path.isdir(directory):
        raise InputError(f"{directory}: is not a directory: give the directory of an unpacked data set.")
    directory = Path(directory)
    try:
        folders = (folder for folder in sorted(directory.iterdir()) if folder.is_dir())
        inner = [folder for folder in folders if _is_a_set(folder)]
        recognised = _recognise(directory) if len(inner) < 2 else None
    except OSError as error:
        raise InputError(
            f"{error.filename or directory}: cannot be read ({error.strerror}): check its permissions."
        ) from error
    if len(inner) > 1:
        raise InputError(
            f"{directory}: contains several data sets ({', '.join(folder.name for folder in inner)}): give "
            "the directory of one data set."
        )
    if recognised is None:
        expected = "; ".join(f"{name}: {layout.files}" for name, layout in LAYOUTS.items())
        raise InputError(
            f"{directory}: is not laid out like a known data set ({expected}): give the "
            "directory of an unpacked data set."
        )
    layout, (pairs, others) = recognised
    if not pairs:
        raise InputError(
            f"{directory}: has the layout of {layout}, but no two of its shapes form a pair: add the missing "
            "shapes."
        )
    return DataSet(directory, layout, tuple(pairs), tuple(others))


def _recognise(directory: Path) -> tuple[str, _Pairs] | None:
    for name, layout in LAYOUTS.items():
        if (pairs := layout.open(directory)) is not None:
            return name, pairs
    return None


def _is_a_set(directory: Path) -> bool:
    try:
        return _recognise(directory) is not None
    except InputError:
        return False


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that puts cat2 before cat10."""
    return [(int(word), "") if word.isdigit() else (-1, word) for word in re.split(r"(\d+)", name)]


def _meshes(directory: Path) -> dict[str, Path]:
    """Return the mesh files in a directory by name, sorted by `_natural`."""
    from jaxsmw.io.meshes import MESH_SUFFIXES

    if not directory.is_dir():
        return {}
    files = [file for file in directory.iterdir() if file.suffix.lower() in MESH_SUFFIXES and file.is_file()]
    # If a shape has files in several formats, the first suffix in MESH_SUFFIXES takes precedence.
    files.sort(key=lambda file: MESH_SUFFIXES.index(file.suffix.lower()), reverse=True)
    by_name = {file.stem: file for file in files}
    return {name: by_name[name] for name in sorted(by_name, key=_natural)}


def _mesh_folder(directory: Path, names: re.Pattern[str]) -> dict[str, Path]:
    """Return the meshes whose names match a pattern, in the first folder that contains such a mesh."""
    folders = [directory, *sorted(folder for folder in directory.rglob("*") if folder.is_dir())]
    for folder in folders:
        if meshes := {name: file for name, file in _meshes(folder).items() if names.fullmatch(name)}:
            return meshes
    return {}


def _listed_pairs(directory: Path, shapes: Mapping[str, Path]) -> list[tuple[str, str]] | None:
    """Read the list of pairs in a data set; return None if there is no list."""
    lists = sorted([*directory.glob("test_pairs.txt"), *directory.rglob("PAIRS_list*.txt")])
    return read_pairs(lists[0], shapes) if lists else None


def read_pairs(path: str | os.PathLike[str], shapes: Iterable[str]) -> list[tuple[str, str]]:
    """Read the names of the sources and targets of pairs from a text file.

    Each line names two of the `shapes`, separated by spaces, a comma or a semicolon. Text after `#` is a
    comment.

    **Raises:** `InputError` if the file cannot be read, a line is not as described, or there is no pair.
    """
    path, possible, pairs = Path(path), set(shapes), []
    for number, line in _lines(path, "pairs").items():
        names = re.split(r"[,;\s]+", line)
        wrong = [name for name in names if name not in possible]
        if len(names) != 2 or wrong:
            fault = f"{wrong[0][:60]!a} is not one of the shapes" if wrong else "does not name two shapes"
            raise InputError(f"{path}, line {number}: {fault}: correct the line, or complete the data set.")
        pairs.append((names[0], names[1]))
    if not pairs:
        raise InputError(f"{path}: names no pair: write two names of shapes on each line.")
    return pairs


def read_shapes(path: str | os.PathLike[str]) -> list[str]:
    """Read a list of shapes, one name per line. Text after `#` is a comment."""
    return list(_lines(Path(path), "shapes").values())


def _lines(path: Path, what: str) -> dict[int, str]:
    """Return the lines of a text file without comments and empty lines, as a dictionary from line numbers."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}): give a list of {what}.") from error
    stripped = {number: line.partition("#")[0].strip() for number, line in enumerate(lines, start=1)}
    return {number: line for number, line in stripped.items() if line}


def choose_pairs(data_set: DataSet, wanted: str | None, seed: int) -> list[DataPair]:
    """Choose pairs of a data set.

    **Arguments:**

    - `wanted`: a number of pairs as text, which are drawn at random without replacement; or the path of a
      list of pairs (see `read_pairs`), which are chosen once each; or None for all pairs.
    - `seed`: the seed of the random draw.

    **Returns:** The pairs, in the order of the list or of the data set.

    **Raises:** `InputError` if the number is not positive, if the list cannot be read, or if a listed pair
    has no ground truth.
    """
    import numpy as np

    pairs = list(data_set.pairs)
    if wanted is None:
        return pairs
    if re.fullmatch(r"[+-]?\d+", wanted):
        count = int(wanted)
        if count < 1:
            raise InputError(f"{count} pairs cannot be measured: give at least 1.")
        rows = np.random.default_rng(seed).permutation(len(pairs))[:count]
        return [pairs[row] for row in np.sort(rows)]
    by_names = data_set.known_pairs
    listed = read_pairs(wanted, data_set.shapes)
    if unknown := [names for names in listed if names not in by_names]:
        raise InputError(
            f"{wanted}: {data_set.directory} has no ground truth for {' to '.join(unknown[0])}: remove the "
            "pair from the list."
        )
    return [by_names[names] for names in dict.fromkeys(listed)]


def first_three(names: Sequence[str]) -> str:
    """Return a text with the first three names and the number of further names."""
    more = len(names) - 3
    return ", ".join(names[:3]) + (f" and {more} more" if more > 0 else "")


def class_of(name: str) -> str:
    """Return the class of a shape: its folder, or its name without the number at the end."""
    folder, _, _ = name.rpartition("/")
    return folder or re.sub(r"[_-]?\d+$", "", name)


def _within_classes(names: Iterable[str]) -> list[tuple[str, str]]:
    return [(x, y) for x, y in permutations(names, 2) if class_of(x) == class_of(y)]


def _listed_first(
    pair: Callable[[str, str], DataPair],
    listed: Iterable[tuple[str, str]] | None,
    with_truth: Iterable[tuple[str, str]],
) -> _Pairs:
    """Return the listed pairs (all pairs if there is no list), and the other pairs with ground truth."""
    wanted = dict.fromkeys(with_truth if listed is None else listed)
    others = (names for names in with_truth if names not in wanted)
    return [pair(*names) for names in wanted], [pair(*names) for names in others]


def _remeshed(directory: Path) -> _Pairs | None:
    truths = directory / "corres"
    files = {file.name.removesuffix(".vts"): file for file in truths.glob("*.vts")}
    plain = {name: file for name, file in files.items() if not name.endswith(".sym")}
    if not plain:
        return None
    if (directory.resolve().parent / "null").is_dir():
        raise InputError(f"{directory}: is only a part of a data set: give {directory.resolve().parent}.")
    folders = (folder for folder in sorted(directory.iterdir()) if folder.is_dir() and folder != truths)
    shapes = next((meshes for meshes in map(_meshes, folders) if meshes.keys() & plain.keys()), {})
    if not shapes:
        raise InputError(
            f"{directory}: has {len(plain)} .vts files in corres/, but no folder with their meshes: put the "
            "meshes into off/ next to corres/."
        )
    _check_complete(directory, shapes, plain)

    def pair(x: str, y: str) -> DataPair:
        mirrored = (files[f"{x}.sym"], plain[y]) if f"{x}.sym" in files else None
        return DataPair(x, y, shapes[x], shapes[y], (plain[x], plain[y]), mirrored)

    pairs, others = _listed_first(pair, _listed_pairs(directory, shapes), _within_classes(shapes))
    # In some sets, such as SMAL, the .vts files also match shapes of different classes. The files do not tell
    # whether a set is of this kind, so all pairs are allowed.
    present = {present.names for present in (*pairs, *others)}
    return pairs, others + [pair(*names) for names in permutations(shapes, 2) if names not in present]


def _check_complete(directory: Path, shapes: Mapping[str, Path], truths: Mapping[str, Path]) -> None:
    """Raise `InputError` if a mesh has no `.vts` file in `corres/`, or a `.vts` file has no mesh."""
    if missing := [name for name in shapes if name not in truths]:
        raise InputError(
            f"{directory / 'corres' / missing[0]}.vts: the ground truth of {shapes[missing[0]]} is missing: "
            "add this file, or remove the mesh."
        )
    if missing := [name for name in truths if name not in shapes]:
        raise InputError(
            f"{directory}: has no mesh for {truths[missing[0]]}: add the mesh, or remove the .vts file."
        )


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
            raise InputError(
                f"{directory}: the ground truth {x}_{y} of a listed pair is missing: add the file, or remove "
                "the pair from the list."
            )
        return DataPair(x, y, shapes[x], shapes[y], (truths[x, y],), index_base=1)

    with_truth = [names for names in truths if shapes.keys() >= set(names)]
    return _listed_first(pair, _listed_pairs(directory, shapes), with_truth)


_PARTIAL_FOLDERS = ("null", "cuts", "holes")


def _partial(directory: Path) -> _Pairs | None:
    full, cuts, holes = (
        _meshes(directory / folder) or _meshes(directory / folder / "off") for folder in _PARTIAL_FOLDERS
    )
    partial = cuts | holes
    if not full and not partial:
        return None
    if not full or not partial:
        folders = "cuts/ or holes/ but no null/" if partial else "null/ but no cuts/ or holes/"
        raise InputError(f"{directory}: has {folders}: add the missing folder.")
    pairs = []
    for name, file in partial.items():
        match = re.fullmatch(r"(?:cuts|holes)_(.+)_shape_\d+", name)
        if match is None or match[1] not in full:
            raise InputError(
                f"{file}: the full shape of this partial shape is not in {directory / 'null'}: add the full "
                "shape, or rename the partial shape to cuts_FULL_shape_N or holes_FULL_shape_N, where FULL "
                "is the name of its full shape and N is a number."
            )
        truth, mirrored = (file.with_suffix(suffix) for suffix in (".baryc_gt", ".baryc_gt_sym"))
        if not truth.is_file() and file.parent.name == "off":
            truth = file.parents[1] / "corres" / f"{name}.vts"
        if not truth.is_file():
            raise InputError(f"{truth}: the ground truth of {file} is missing: add this file.")
        target, sides = match[1], (mirrored,) if mirrored.is_file() else None
        pairs.append(DataPair(name, target, file, full[target], (truth,), sides, index_base=1, partial=True))
    return pairs, []


def _two_parts(folder: str, suffix: str) -> Callable[[Path], _Pairs | None]:
    """Return a function that opens a data set of pairs of two parts, with ground truth in `maps/`."""

    def open_layout(directory: Path) -> _Pairs | None:
        files = sorted((directory / "maps").glob(f"*_*{suffix}"), key=lambda file: _natural(file.stem))
        shapes = _meshes(directory / folder)
        if not files or not shapes:
            return None
        truths = {_two_names(file, shapes, directory / folder): file for file in files}

        def pair(x: str, y: str) -> DataPair:
            if (x, y) not in truths:
                raise InputError(
                    f"{directory / 'maps' / f'{x}_{y}{suffix}'}: the ground truth of a listed pair is "
                    "missing: add the file, or remove the pair from the list."
                )
            return DataPair(
                x,
                y,
                shapes[x],
                shapes[y],
                (truths[x, y],),
                index_base=0,
                partial=True,
                both_partial=True,
                reverse_truth=truths.get((y, x)),
            )

        return _listed_first(pair, _listed_pairs(directory, shapes), truths)

    return open_layout


def _two_names(file: Path, shapes: Mapping[str, Path], folder: Path) -> tuple[str, str]:
    """Return the names of the two shapes in the name of a file A_B. The names may contain underscores."""
    words = file.stem.split("_")
    for split in range(1, len(words)):
        x, y = "_".join(words[:split]), "_".join(words[split:])
        if x in shapes and y in shapes:
            return x, y
    raise InputError(
        f"{file}: is not named after two meshes in {folder}: add the missing mesh, or remove the file."
    )


def _topology(directory: Path) -> _Pairs | None:
    shapes = _mesh_folder(directory, re.compile(r"kid\d+"))
    if not shapes:
        return None
    if "kid00" not in shapes:
        raise InputError(f"{directory}: has no kid00, the target of all pairs: add this mesh.")
    full = shapes.pop("kid00")
    pairs = []
    for name, file in shapes.items():
        truth = file.with_name(f"{name}_ref.txt")
        if not truth.is_file() and file.parent.name == "off":
            truth = file.parents[1] / "corres" / f"{name}_ref.vts"
        if not truth.is_file():
            raise InputError(f"{truth}: the ground truth of {file} is missing: add this file.")
        pairs.append(DataPair(name, "kid00", file, full, (truth,), index_base=1))
    return pairs, []


def _landmarks(directory: Path) -> _Pairs | None:
    shapes = _meshes(directory / "models")
    lists = sorted((directory / "test-sets").glob("test-set*.txt"))
    if not shapes or not lists:
        return None
    # The ground truth is in an archive of its own, which may be unpacked beside or inside the data set.
    name = f"{directory.resolve().name}_gts"
    folders = (directory.resolve().with_name(name), directory / name)
    truths = {file.stem: file for folder in folders for file in folder.rglob("*.mat")}

    def pair(x: str, y: str, partial: bool) -> DataPair:
        if missing := [shape for shape in (x, y) if shape not in truths]:
            raise InputError(
                f"{folders[0] / missing[0]}.mat: the ground truth of {shapes[missing[0]]} is missing: unpack "
                f"{name} beside the data set, or remove the shape from the lists of pairs."
            )
        files = (truths[x], truths[y])
        return DataPair(x, y, shapes[x], shapes[y], files, index_base=1, partial=partial)

    # The list test-set0 contains the pairs of a partial scan and a full scan.
    listed = {
        names: file.stem.endswith("0") for file in lists for names in dict.fromkeys(read_pairs(file, shapes))
    }
    parts = {x for (x, _), partial in listed.items() if partial}
    whole = [shape for shape in shapes if shape in truths and shape not in parts]
    others = [pair(x, y, False) for x, y in permutations(whole, 2) if (x, y) not in listed]
    return [pair(*names, partial) for names, partial in listed.items()], others


# This folder of DeformingThings4D contains the correspondences between classes.
_BETWEEN_CLASSES = "cross_category_corres"


def _characters(directory: Path) -> _Pairs | None:
    truths = {
        f"{file.parent.name}/{file.stem}": file
        for file in (directory / "corres").glob("*/*.vts")
        if file.parent.name != _BETWEEN_CLASSES
    }
    if not truths:
        return None
    shapes: dict[str, Path] = {}
    for folder in sorted(directory.iterdir()):
        if folder.is_dir() and folder.name != "corres" and not shapes:
            classes = (inner for inner in sorted(folder.iterdir()) if inner.is_dir())
            shapes = {f"{c.name}/{name}": file for c in classes for name, file in _meshes(c).items()}
    _check_complete(directory, shapes, truths)

    def pair(x: str, y: str, *between: Path) -> DataPair:
        return DataPair(x, y, shapes[x], shapes[y], (truths[x], truths[y], *between))

    others = []
    for file in sorted((directory / "corres" / _BETWEEN_CLASSES).glob("*_*.vts")):
        class_x, _, class_y = file.stem.partition("_")
        of_x, of_y = ([name for name in shapes if class_of(name) == c] for c in (class_x, class_y))
        others += [pair(x, y, file) for x in of_x for y in of_y]
    return [pair(*names) for names in _within_classes(shapes)], others


def _identical(names: str) -> Callable[[Path], _Pairs | None]:
    """Return a function that opens a data set in which vertex i corresponds to vertex i of all shapes."""
    pattern = re.compile(names)

    def open_layout(directory: Path) -> _Pairs | None:
        shapes = _mesh_folder(directory, pattern)
        if not shapes:
            return None
        above = directory.resolve().parent
        if any((above / "corres").glob("*.vts")):
            raise InputError(f"{directory}: is only the mesh folder of a remeshed set: give {above}.")

        def pair(x: str, y: str) -> DataPair:
            return DataPair(x, y, shapes[x], shapes[y])

        return _listed_first(pair, _listed_pairs(directory, shapes), _within_classes(shapes))

    return open_layout


class Layout(NamedTuple):
    """A layout of data sets: the files by which it is recognised, as text for messages, and its reader.

    The reader returns the lists `pairs` and `others` of a `DataSet`, or None if it has another layout.
    `papers` names the papers that published such data sets, and papers that use them.
    """

    files: str
    open: Callable[[Path], _Pairs | None]
    papers: str


_TOSCA = r"(cat|centaur|david|dog|gorilla|horse|lioness|michael|seahorse|victoria|wolf)\d+"
LAYOUTS = {
    "SHREC'16 partial": Layout(
        "null/ with cuts/ or holes/",
        _partial,
        "Cosmo 2016; Rodolà 2017 (PFM), Attaiki 2021 (DPFM), Cao 2023 (ULRSSM)",
    ),
    "SHREC'16 topology": Layout(
        "kid00.off with kidNN_ref.txt",
        _topology,
        "Lähner 2016; Eisenberger 2020 (smooth shells), Cao 2023 (ULRSSM)",
    ),
    "SHREC'20": Layout(
        "models/NAME.obj with test-sets/test-set0.txt and NAME.mat in DIRECTORY_gts/ beside it",
        _landmarks,
        "Dyke 2020; Eisenberger 2021 (NeuroMorph), Cao 2023 (ULRSSM)",
    ),
    "a remeshed set": Layout(
        "off/NAME.off with corres/NAME.vts",
        _remeshed,
        "Ren 2018; Donati 2020, Hu 2021 (MWP), Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM), Bastian 2024",
    ),
    "SHREC'19 humans": Layout(
        "NAME.obj with FARMgt_txt/NAME_NAME.txt",
        _shrec19,
        "Melzi 2019; Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM)",
    ),
    "PARTIALSMAL": Layout(
        "shapes/NAME.off with maps/NAME_NAME.vts",
        _two_parts("shapes", ".vts"),
        "Ehm 2024; Xie 2025 (EchoMatch)",
    ),
    "CP2P24": Layout(
        "off/NAME.off with maps/NAME_NAME.map", _two_parts("off", ".map"), "Xie 2025 (EchoMatch)"
    ),
    "DeformingThings4D": Layout(
        "off/CLASS/NAME.off with corres/CLASS/NAME.vts",
        _characters,
        "Li 2021, Magnet 2022; Li 2022 (AttentiveFMaps), Cao 2023 (ULRSSM)",
    ),
    "FAUST registrations": Layout(
        "tr_reg_NNN.ply",
        _identical(r"tr_reg_\d{3}"),
        "Bogo 2014; Litany 2017 (deep functional maps)",
    ),
    "SCAPE": Layout("meshNNN.ply", _identical(r"mesh\d{3}"), "Anguelov 2005; Kim 2011, Ovsjanikov 2012"),
    "TOSCA": Layout(
        "cat0.mat or cat0.off",
        _identical(_TOSCA),
        "Bronstein 2008; Kim 2011, Ovsjanikov 2012, Hu 2021 (MWP)",
    ),
}
"""A dictionary from the names of the layouts to the layouts, in the order in which they are tried."""
