"""The file of a collection's page contains the right data, is small, and is not written for bad input."""

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collection_samples import HOSTILE, collection, edge
from report_helpers import decode, embedded
from scipy.spatial.distance import pdist

from jaxsmw.collection.shape_models import shape_model
from jaxsmw.creature import creature
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report import collection_page
from jaxsmw.report.collection_page import layout, simplify, write_collection_page
from jaxsmw.report.colors import position_colors
from jaxsmw.report.page_data import encode_positions
from jaxsmw.report.standing import placement, stand


def positions(encoded: dict[str, Any]) -> np.ndarray:
    return np.array(encoded["low"]) + np.array(encoded["step"]) * decode(encoded["codes"], "<u2").reshape(
        -1, 3
    )


def written(path: Path, **changes: Any) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Write a page, and return the HTML, the data and the arguments."""
    arguments = collection() | changes
    write_collection_page(path, **arguments)
    page = path.read_text("utf-8")
    return page, embedded(page), arguments


def test_page_holds_the_aligned_shapes_and_the_model(tmp_path: Path) -> None:
    _, data, arguments = written(tmp_path / "page.html", up="y")
    model = arguments["model"]
    first = Mesh(model.aligned[0], arguments["faces"])
    standing = stand(first, "y")
    matrix, offset = placement(first, standing)
    to_page = np.linalg.inv(matrix)
    for shown, shape in zip(data["shapes"], model.aligned, strict=True):
        np.testing.assert_allclose(positions(shown), (shape - offset) @ to_page, atol=2e-5)
    np.testing.assert_allclose(positions(data["shapes"][0]), standing.vertices, atol=2e-5)
    np.testing.assert_array_equal(decode(data["faces"], "<u4").reshape(-1, 3), standing.faces)
    np.testing.assert_array_equal(
        decode(data["colors"], "u1").reshape(-1, 3), np.round(255 * position_colors(standing))
    )
    assert data["names"] == arguments["names"] and data["template"] == 0 and data["vertices"] is None
    # The mean plus the modes times the scores are the shapes.
    of_model = data["model"]
    modes = np.array([positions(mode) for mode in of_model["modes"]])
    np.testing.assert_allclose(np.sum(of_model["shares"]), 1, atol=1e-2)
    for shown, scores in zip(data["shapes"], of_model["scores"], strict=True):
        rebuilt = positions(of_model["mean"]) + np.tensordot(scores, modes, axes=1)
        np.testing.assert_allclose(rebuilt, positions(shown), atol=2e-2)
    for shown, one in zip(data["edges"], arguments["edges"], strict=True):
        assert (shown["source"], shown["target"], shown["doubtful"]) == (one.source, one.target, one.doubtful)
        assert shown["error"] == (1e3 * one.expected_error if np.isfinite(one.expected_error) else None)
        assert shown["note"] == one.sentence(arguments["names"])
    assert any(shown["error"] is None for shown in data["edges"])


@pytest.mark.parametrize("up", ["y", None])
@pytest.mark.filterwarnings("error")
def test_a_shape_on_which_the_template_collapses_is_shown(tmp_path: Path, up: Any) -> None:
    """A tiny or very different mesh can give such a shape. All vertices lie at the ends of one segment."""
    arguments = collection()
    ends = np.where(arguments["registered"][0][:, :1] > 0, 1.0, 0.0) * [1, 2, 3]
    registered = [*arguments["registered"][:2], ends]
    changes = {"names": ["rest", "stand", "segment"], "registered": registered, "edges": [], "up": up}
    _, data, _ = written(tmp_path / "page.html", **changes, model=shape_model(registered))
    assert len(data["shapes"]) == 3 and np.isfinite(data["azimuth"])


def test_page_loads_nothing_and_escapes_texts(tmp_path: Path) -> None:
    names = [HOSTILE, *collection()["names"][1:]]
    edges = [edge(0, 1, 3.0, doubtful=True)]
    page, data, _ = written(
        tmp_path / "page.html",
        names=names,
        edges=edges,
        title=HOSTILE,
        notes=[HOSTILE],
        left_out={HOSTILE: HOSTILE},
    )
    assert data["names"][0] == HOSTILE and HOSTILE in data["edges"][0]["note"]
    assert "<img src=x" not in page
    before = page.split('<script type="application/json"')[0]
    assert "{{" not in before.replace("{{script}}", "")
    assert not re.search(r"<(link|iframe|object)|@import|\burl\(", before)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html"]


def test_names_with_undecodable_bytes_are_shown(tmp_path: Path) -> None:
    names = ["a\udcff", *collection()["names"][1:]]
    _, data, _ = written(tmp_path / "page.html", names=names)
    assert data["names"][0] == "a?"


def test_the_list_of_pairs_starts_with_doubtful_pairs_and_large_errors(tmp_path: Path) -> None:
    edges = [edge(0, 1, 9.0), edge(1, 2, 20.0), edge(2, 3, 1.0, doubtful=True), edge(3, 0, np.inf)]
    page, _, _ = written(tmp_path / "page.html", edges=edges)
    assert re.findall(r'data-edge="(\d)"', page) == ["2", "3", "1", "0"]
    assert "<dt>Doubtful pairs</dt><dd>1</dd>" in page


def test_pages_of_equal_collections_are_equal(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_collection_page(tmp_path / name, **collection())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_page_without_a_model_has_aligned_shapes(tmp_path: Path) -> None:
    _, with_model, _ = written(tmp_path / "a.html")
    _, without, _ = written(tmp_path / "b.html", model=None)
    assert without["model"] is None
    assert without["shapes"] == with_model["shapes"] and without["layout"] == with_model["layout"]


def test_one_shape_is_shown_without_modes(tmp_path: Path) -> None:
    arguments = collection()
    shapes = arguments["registered"][:1]
    page, data, _ = written(
        tmp_path / "page.html", names=["only"], registered=shapes, edges=[], model=shape_model(shapes)
    )
    assert data["model"]["modes"] == [] and data["layout"] == [[0, 0]]
    assert "Matched pairs</dt>" not in page


@pytest.mark.slow
def test_a_hundred_shapes_fit_in_8_megabytes(tmp_path: Path) -> None:
    mesh = creature("biped", vertices=5000)
    shapes = mesh.vertices + 0.002 * np.random.default_rng(0).normal(size=(100, 5000, 3))
    edges = [edge(i, i + 1, 1.0) for i in range(99)]
    written(
        tmp_path / "page.html",
        names=[f"shape {i}" for i in range(100)],
        faces=mesh.faces,
        registered=list(shapes),
        edges=edges,
        model=shape_model(shapes, number_of_modes=10),
    )
    assert (tmp_path / "page.html").stat().st_size < 8e6


def test_large_triangulations_are_simplified_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, whole, _ = written(tmp_path / "a.html")
    monkeypatch.setattr(collection_page, "MOST_VERTICES", 250)
    page, data, _ = written(tmp_path / "b.html")
    chosen = decode(data["vertices"], "<u4")
    faces = decode(data["faces"], "<u4").reshape(-1, 3)
    assert 200 < len(chosen) <= 250 and faces.max() == len(chosen) - 1
    for small, large in zip(data["shapes"], whole["shapes"], strict=True):
        np.testing.assert_allclose(positions(small), positions(large)[chosen], atol=1e-4)
    np.testing.assert_array_equal(
        decode(data["colors"], "u1").reshape(-1, 3), decode(whole["colors"], "u1").reshape(-1, 3)[chosen]
    )
    assert f"This page shows {len(chosen)} of the vertices." in page


def test_simplified_meshes_keep_their_surface() -> None:
    mesh = creature("quadruped", vertices=3000)
    numbered = replace(mesh, vertices=np.vstack([[[9.0, 9, 9]], mesh.vertices]), faces=mesh.faces + 1)
    chosen, faces = simplify(numbered, 1000)
    assert len(chosen) == len(np.unique(chosen)) == len(np.unique(faces)) == 1000 and chosen.min() == 1
    assert Mesh(numbered.vertices[chosen], faces).area == pytest.approx(mesh.area, rel=0.05)
    # A mesh that is not manifold only loses unreferenced vertices.
    bad = replace(numbered, faces=np.vstack([numbered.faces, numbered.faces[:1]]))
    chosen, faces = simplify(bad, 1000)
    np.testing.assert_array_equal(chosen, np.arange(1, 3001))
    np.testing.assert_array_equal(chosen[faces], bad.faces)


def test_layout_keeps_distances_of_shapes_in_a_plane() -> None:
    generator = np.random.default_rng(0)
    fields = generator.normal(size=(2, 40, 3))
    shapes = np.tensordot(generator.normal(size=(9, 2)), fields, axes=1)
    weights = generator.uniform(size=40)
    weights /= weights.sum()
    places = layout(shapes, weights)
    flat = (shapes * np.sqrt(weights)[:, None]).reshape(9, -1)
    np.testing.assert_allclose(pdist(places), pdist(flat), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(places.mean(axis=0), 0, atol=1e-9)


def test_layout_of_equal_shapes_is_finite() -> None:
    for count in (1, 2, 5):
        places = layout(np.repeat(np.eye(3)[None], count, axis=0), np.full(3, 1 / 3))
        np.testing.assert_allclose(places, np.zeros((count, 2)), atol=1e-12)


def test_positions_are_rounded_to_16_bits() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * [1, 100, 0]
    error = np.abs(positions(encode_positions(points)) - points)
    assert (error <= np.ptp(points, axis=0) / 131070 * 1.001).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"registered": [], "names": []}, "there is no shape to show"),
        ({"names": ["a"]}, "there are 1 names, but 5 shapes"),
        ({"template": 5}, "the template is shape 5, but the shapes are 0 to 4"),
        ({"faces": np.array([[0, 1, 9999]])}, "the faces do not fit the 600 vertices"),
        ({"faces": np.zeros((0, 3), dtype=int)}, "the faces do not fit"),
        ({"edges": [edge(0, 5, 1.0)]}, "an edge joins the shapes 0 and 5"),
        ({"model": slice(3)}, "the model has 3 shapes with 600 vertices"),
        ({"registered": np.eye(3)}, "blend: there are 3 positions, but the template has 600"),
        ({"registered": np.full((600, 3), np.nan)}, "blend: some coordinates are not finite"),
    ],
)
def test_invalid_collections_are_refused(changes: dict[str, Any], message: str) -> None:
    """An array stands for the positions of the last shape, and a slice for the shapes of the model."""
    arguments = collection()
    registered = arguments["registered"]
    for name, value in changes.items():
        if isinstance(value, np.ndarray) and name == "registered":
            value = [*registered[:-1], value]
        arguments[name] = shape_model(registered[value]) if isinstance(value, slice) else value
    with pytest.raises(InputError, match=re.escape(message)):
        write_collection_page(os.devnull, **arguments)
