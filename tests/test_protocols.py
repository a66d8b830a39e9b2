"""Published protocols choose the right pairs, and name the files that a data set lacks."""

from pathlib import Path

import pytest
from test_datasets import A, C, animals, column, partial, put, shrec19, topology, tosca, two_cuts, two_parts

from jaxsmw import InputError, read_mesh
from jaxsmw.benchmark import open_data_set, protocol_pairs
from jaxsmw.benchmark.datasets import LAYOUTS
from jaxsmw.benchmark.protocols import PROTOCOLS

HERE = Path(__file__).parent


def remeshed(directory: Path, names, *, listed=()) -> None:
    for name in names:
        put(directory / "off" / f"{name}.off")
        put(directory / "corres" / f"{name}.vts", column(range(1, 11)))
    if listed:
        put(directory / "test_cat.txt", "\n".join(listed))


def characters(directory: Path) -> None:
    """Write two poses of each of three classes. Line i of crypto corresponds to line 11 - i of ortiz."""
    names = [
        f"{folder}/Walk{number:03}" for folder in ("crypto", "ortiz", "pumpkinhulk") for number in (1, 2)
    ]
    for name in names:
        put(directory / "off" / f"{name}.off")
        put(directory / "corres" / f"{name}.vts", column(range(2, 12)))
    for between in ("crypto_ortiz", "crypto_pumpkinhulk"):
        put(directory / "corres" / "cross_category_corres" / f"{between}.vts", column(range(10, 0, -1)))
    put(directory / "test.txt", "\n".join(name for name in names if name != "ortiz/Walk002"))


def all_humans(directory: Path) -> None:
    for number in range(1, 45):
        put(directory / "off" / f"{number}.off")
        put(directory / "corres" / f"{number}_{number % 44 + 1}.map", column(range(1, 21)))


FAUST = [f"tr_reg_{number:03}" for number in (3, *range(80, 100))]
SCAPE = [f"mesh{number:03}" for number in range(50, 72)]
ANIMALS = ["cougar", "hippo5", "hippo6", "dog2"]
CASES = {
    "faust-r": (lambda d: remeshed(d, FAUST), 380, ("tr_reg_080", "tr_reg_081"), "tr_reg_003"),
    "scape-r": (lambda d: remeshed(d, SCAPE), 380, ("mesh052", "mesh053"), "mesh051"),
    "shrec19-r": (all_humans, 42, ("1", "2"), "40"),
    "smal-r": (lambda d: remeshed(d, ANIMALS, listed=ANIMALS[:3]), 6, ("cougar", "hippo5"), "dog2"),
    "topkids": (topology, 2, ("kid01", "kid00"), "kid03"),
    "shrec16-cuts": (partial, 1, ("cuts_cat_shape_1", "cat"), "holes_cat_shape_1"),
    "shrec16-holes": (partial, 1, ("holes_cat_shape_1", "cat"), "cuts_cat_shape_1"),
    "partial-smal": (two_parts, 3, (A, C), "cat"),
    "cp2p24": (two_cuts, 1, ("cat-01", "cat-02"), "cat"),
    "shrec20": (animals, 1, ("cow", "bison"), "dog"),
    "shrec20-partial": (animals, 1, ("dog", "cow"), "bison"),
    "tosca": (tosca, 4, ("cat0", "cat1"), "cat2"),
    "dt4d-intra": (characters, 2, ("crypto/Walk001", "crypto/Walk002"), "pumpkinhulk/Walk001"),
    "dt4d-inter": (characters, 2, ("crypto/Walk001", "ortiz/Walk001"), "pumpkinhulk/Walk001"),
}


def test_each_protocol_is_tested():
    assert list(CASES) == list(PROTOCOLS)


def test_protocols_name_known_layouts():
    assert {name for protocol in PROTOCOLS.values() for name in protocol.layouts} <= set(LAYOUTS)


def test_an_unknown_protocol_is_refused(tmp_path):
    topology(tmp_path)
    with pytest.raises(InputError, match=r"'kids' is not a protocol.*topkids"):
        protocol_pairs("kids", open_data_set(tmp_path))


@pytest.mark.parametrize("name", CASES)
def test_protocols_choose_the_published_pairs(tmp_path, name):
    build, count, first, absent = CASES[name]
    build(tmp_path)
    data_set = open_data_set(tmp_path)
    pairs = protocol_pairs(name, data_set)
    assert (len(pairs), pairs[0].names) == (count, first)
    assert len({pair.names for pair in pairs}) == count
    assert all(absent not in pair.names for pair in pairs)
    assert all(pair in (*data_set.pairs, *data_set.others) for pair in pairs)


def test_correspondences_between_classes_lead_through_the_lines_of_a_file(tmp_path):
    characters(tmp_path)
    (pair, _) = protocol_pairs("dt4d-inter", open_data_set(tmp_path))
    truth = pair.ground_truth(*map(read_mesh, pair.meshes))
    assert truth.source_vertices.tolist() == list(range(1, 11))
    assert truth.targets.tolist() == list(range(10, 0, -1))


def test_the_test_shapes_of_characters_are_listed(tmp_path):
    characters(tmp_path)
    pairs = {pair.names for pair in open_data_set(tmp_path).split("test")}
    for name in ("dt4d-intra", "dt4d-inter"):
        assert {pair.names for pair in protocol_pairs(name, open_data_set(tmp_path))} < pairs
    assert ("pumpkinhulk/Walk001", "pumpkinhulk/Walk002") in pairs
    assert not any("ortiz/Walk002" in names for names in pairs)


def lines_are_wrong(directory: Path, contents: str) -> None:
    characters(directory)
    put(directory / "corres" / "cross_category_corres" / "crypto_ortiz.vts", contents)


@pytest.mark.parametrize(
    ("contents", "message"),
    [(column(range(1, 10)), "has 9 lines and .*Walk001.vts has 10"), (column(range(2, 12)), "line 10: .*11")],
)
def test_wrong_lines_between_classes_are_refused(tmp_path, contents, message):
    lines_are_wrong(tmp_path, contents)
    (pair, _) = protocol_pairs("dt4d-inter", open_data_set(tmp_path))
    with pytest.raises(InputError, match=message):
        pair.ground_truth(*map(read_mesh, pair.meshes))


LACKS = {
    "another layout": (
        "faust-r",
        topology,
        "has the layout of SHREC'16 topology, but .* needs a remeshed set",
    ),
    "shapes": (
        "faust-r",
        lambda d: remeshed(d, FAUST[:-5]),
        "lacks the shapes tr_reg_095, tr_reg_096, tr_reg_097 and 2 more",
    ),
    "a list": ("smal-r", lambda d: remeshed(d, ANIMALS), "lacks test_cat.txt, the list of its test shapes"),
    "a listed shape": (
        "smal-r",
        lambda d: remeshed(d, ["cow1", "cow2"], listed=["cow1", "cat"]),
        "lacks the shapes cat,",
    ),
    "humans": ("shrec19-r", shrec19, "lacks 40 of the shapes 1 to 44, such as 3"),
    "animals": ("tosca", lambda d: remeshed(d, FAUST[:2]), "lacks the shapes of TOSCA, such as cat0"),
    "holes": (
        "shrec16-holes",
        lambda d: (partial(d), [file.unlink() for file in (d / "holes").iterdir()]),
        "lacks the folder holes/",
    ),
    "files between classes": (
        "dt4d-inter",
        lambda d: (characters(d), [f.unlink() for f in (d / "corres" / "cross_category_corres").iterdir()]),
        "lacks the folder corres/cross_category_corres",
    ),
}


@pytest.mark.parametrize("case", LACKS)
def test_what_a_data_set_lacks_is_named(tmp_path, case):
    name, build, message = LACKS[case]
    build(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        protocol_pairs(name, open_data_set(tmp_path))
    assert str(tmp_path) in str(caught.value) and PROTOCOLS[name].source in str(caught.value)


def test_the_documentation_lists_all_protocols():
    text = (HERE.parent / "docs" / "datasets.md").read_text("utf-8")
    for name, protocol in PROTOCOLS.items():
        row = f"| `{name}` | {protocol.files} ([source]({protocol.source})) | {protocol.pairs} | {protocol.papers} |"
        assert row in text


def test_real_data_sets_have_the_layouts_of_their_protocols(shared):
    topkids = open_data_set(shared / "data" / "shrec16_topology")
    assert len(protocol_pairs("topkids", topkids)) == 15
    parts = open_data_set(shared / "data" / "shrec16_partial")
    assert len(protocol_pairs("shrec16-cuts", parts)) == 32
    assert len(protocol_pairs("shrec16-holes", parts)) == 24
    assert len(protocol_pairs("partial-smal", open_data_set(shared / "data" / "partial_smal"))) == 60
    with pytest.raises(InputError, match="tr_reg_080"):
        protocol_pairs("faust-r", open_data_set(shared / "data" / "faust_r"))
