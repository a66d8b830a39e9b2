"""The file of a page contains the right data, is small, and is not written for bad input."""

import hashlib
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refused
from report_helpers import TALL, decode, ellipsoid, embedded, renumbered
from synthetic import random_spectrum

from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report import colors, page_data
from jaxsmw.report.figures import draw_correspondence
from jaxsmw.report.page import ShownMap, write_page
from jaxsmw.report.page_data import eigenvectors_on_page
from jaxsmw.report.standing import stand_pair
from jaxsmw.report.summary import write_comparison

ROOT = Path(__file__).resolve().parents[1]


def _page(mesh_x: Mesh, mesh_y: Mesh, pointwise_map: Any, *, errors: Any = None, **options: Any) -> None:
    shown = ShownMap(pointwise_map, errors or {})
    write_page(os.devnull, mesh_x, mesh_y, {"map": shown}, title="", **options)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("show", [draw_correspondence, _page])
def test_invalid_maps_and_errors_are_refused(show: Callable[..., Any]) -> None:
    n = len(TALL.vertices)
    good = np.arange(n)
    for bad, fault in (
        (good[1:], f"has {n - 1} entries, but ellipsoid has {n} vertices"),
        (good.astype(float), "must be a list of integers"),
        (good[None], "must be a list of integers"),
        (good + 1, f"between 0 and {n - 1}, but entry {n - 1} is {n}: .* count from 1"),
        (good - 1, f"between 0 and {n - 1}, but entry 0 is -1"),
    ):
        with pytest.raises(InputError, match=fault):
            show(TALL, TALL, bad)
    for errors in (np.zeros(n - 1), np.full(n, -0.1)):
        with pytest.raises(InputError, match="non-negative"):
            show(TALL, TALL, good, errors={"Error": errors})
    for limit in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match="positive"):
            show(TALL, TALL, good, errors={"Error": np.zeros(n)}, error_limit=limit)


def test_bodies_from_files_of_one_name_have_different_captions(tmp_path: Path) -> None:
    first, second = (replace(TALL, name=f"/home/{directory}/scan.off") for directory in ("before", "after"))
    page_file = tmp_path / "page.html"
    write_comparison(page_file, first, second, {"map": np.arange(len(TALL.vertices))})
    page = page_file.read_text("utf-8")
    assert "<span>before/scan.off · 642 vertices</span>" in page
    assert "<span>after/scan.off · 642 vertices</span>" in page
    assert "<h1>before/scan.off to after/scan.off</h1>" in page and "home" not in page
    assert [embedded(page)[side]["name"] for side in "xy"] == ["before/scan.off", "after/scan.off"]


def test_page_holds_its_data_and_loads_nothing(tmp_path: Path) -> None:
    other, number = renumbered(ellipsoid(0.5, 1.1, 0.4, name="/home/someone/other.off"))
    errors = np.linspace(0, 0.1, len(number))
    named = {"Error": errors, "Expected <error>": errors / 2}
    matrix = np.arange(6.0).reshape(2, 3)
    maps = {"A <b>": ShownMap(number, named, matrix, "pushforward"), "B": ShownMap(number[::-1])}
    meanings = {"Error": "How far & wide."}
    page_file = tmp_path / "page.html"
    write_page(page_file, TALL, other, maps, title="One", error_meanings=meanings, error_limit=0.05)
    page = (tmp_path / "page.html").read_text("utf-8")
    data = embedded(page)
    for side, standing in zip("xy", stand_pair(TALL, other), strict=True):
        assert np.allclose(decode(data[side]["vertices"], "<f4").reshape(-1, 3), standing.vertices, atol=1e-6)
        assert np.array_equal(decode(data[side]["faces"], "<u4").reshape(-1, 3), standing.faces)
    first, second = data["maps"]
    assert (first["name"], second["name"]) == ("A <b>", "B")
    assert np.array_equal(decode(first["map"], "<u4"), number)
    assert np.array_equal(decode(second["map"], "<u4"), number[::-1])
    assert list(first["errors"]) == data["error_names"] == list(named) and second["errors"] == {}
    for name, values in named.items():
        assert np.allclose(decode(first["errors"][name], "<f4"), values)
    assert np.array_equal(decode(first["functional"]["values"], "<f4").reshape(2, 3), matrix)
    assert first["functional"]["pushforward"] and second["functional"] is None
    scale = decode(data["scales"]["error"], "u1").reshape(-1, 3)
    assert np.array_equal(scale, np.round(255 * colors.error_colors(np.linspace(0, 0.05, 256), 0.05)))
    assert data["limit"] == 0.05
    assert 'value="error-1"><span>Expected &lt;error&gt;<' in page and "<span>A &lt;b&gt;<" in page
    assert 'value="wavelets"' not in page
    assert "someone" not in page and "other.off · 642 vertices" in page
    assert "0.05 and above (fraction of √area)" in page
    assert '<p data-for="error-0">How far &amp; wide. ' in page
    assert '<p data-for="error-1">Expected &lt;error&gt; of every match. ' in page
    assert "{{" not in page.split("<script>")[0]
    # Browsers fetch neither the name of an XML namespace nor the name of a schema of landmark files.
    addresses = set(re.findall(r"https?://[^\s\"'`<]+", page))
    assert {address.partition("#")[0].rpartition("/")[2] for address in addresses} == {
        "svg",
        "xhtml",
        "markups-schema-v1.0.3.json",
    }
    assert not re.search(r"<(link|iframe|object)|@import|\burl\(", page.split("<script>")[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html"]


def test_page_marks_points_without_a_counterpart(tmp_path: Path) -> None:
    n, path, shown = (
        len(TALL.vertices),
        tmp_path / "page.html",
        {"map": ShownMap(np.arange(len(TALL.vertices)))},
    )
    masks = np.arange(n) < n // 2, np.arange(n) > n // 3
    write_page(path, TALL, TALL, shown, title="", overlap=masks)
    page = path.read_text("utf-8")
    for side, mask in zip("xy", masks, strict=True):
        assert np.array_equal(decode(embedded(page)["alone"][side], "u1"), ~mask)
    explanation = "Grey points probably have no counterpart"
    assert explanation in page
    write_page(path, TALL, TALL, shown, title="")
    page = path.read_text("utf-8")
    assert "alone" not in embedded(page) and explanation not in page


def test_page_holds_the_placements_and_the_registered_source(tmp_path: Path) -> None:
    other, number = renumbered(ellipsoid(0.5, 1.1, 0.4, name="/home/someone/other.off"))
    other = replace(other, vertices=70 * other.vertices + [4000, 0, -3])
    path = tmp_path / "page.html"
    shown = {"map": ShownMap(number)}
    write_page(path, TALL, other, shown, title="", registered=other.vertices[number])
    data = embedded(path.read_text("utf-8"))
    for side, mesh in (("x", TALL), ("y", other)):
        placement = data[side]["placement"]
        displayed = decode(data[side]["vertices"], "<f4").reshape(-1, 3).astype(float)
        found = displayed @ np.array(placement["matrix"]) + placement["offset"]
        # The docstring of `encode_shape` states this error.
        diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
        assert np.linalg.norm(found - mesh.vertices, axis=1).max() < 1e-7 * diagonal
        assert data[side]["name"] == Path(mesh.name).name
    registered = decode(data["registered"], "<f4").reshape(-1, 3)
    assert np.allclose(registered, decode(data["y"]["vertices"], "<f4").reshape(-1, 3)[number], atol=1e-6)
    assert data["expected"] == "Expected error"
    write_page(path, TALL, other, shown, title="")
    assert "registered" not in embedded(path.read_text("utf-8"))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("registered", [TALL.vertices[1:], TALL.vertices * np.nan, TALL.vertices[:, :2]])
def test_registered_positions_that_do_not_fit_are_refused(registered: np.ndarray) -> None:
    with refused("three finite numbers", "642 vertices", "ellipsoid"):
        _page(TALL, TALL, np.arange(len(TALL.vertices)), registered=registered)


@pytest.mark.parametrize("errors", [(0.7, 0.02), (0.001,), ()])
def test_the_scale_of_errors_is_the_same_for_all_maps(tmp_path: Path, errors: tuple[float, ...]) -> None:
    n = len(TALL.vertices)
    maps = {str(error): ShownMap(np.arange(n), {"Error": np.full(n, error)}) for error in errors}
    write_page(tmp_path / "page.html", TALL, TALL, maps | {"none": ShownMap(np.arange(n))}, title="t")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert embedded(page)["limit"] == 0.1 and "0.1 and above (fraction of √area)" in page


@pytest.mark.usefixtures("unchecked")
def test_incomplete_pages_are_refused() -> None:
    n = len(TALL.vertices)
    with pytest.raises(InputError, match="no map"):
        write_page(os.devnull, TALL, TALL, {}, title="")
    shown = {"map": ShownMap(np.arange(n))}
    with pytest.raises(InputError, match=r"the spectrum has 7 vertices, but the mesh has 642"):
        write_page(
            os.devnull, TALL, TALL, shown, title="", spectra=(random_spectrum(n, 5), random_spectrum(7, 5))
        )
    shown = {"map": ShownMap(np.arange(n), functional_map=np.array([[np.nan]]))}
    with pytest.raises(InputError, match="functional map"):
        write_page(os.devnull, TALL, TALL, shown, title="")


def test_page_of_a_usual_mesh_is_small(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    n = 7000
    mesh = Mesh(generator.normal(size=(n, 3)), generator.integers(0, n, (2 * n, 3)))
    shown = ShownMap(np.arange(n), {"Error": generator.random(n)}, np.eye(100))
    for spectra, limit in ((None, 1.6e6), ((random_spectrum(n, 120), random_spectrum(n, 120)), 3.5e6)):
        write_page(tmp_path / "page.html", mesh, mesh, {"map": shown}, title="t", spectra=spectra)
        assert (tmp_path / "page.html").stat().st_size < limit


def test_large_meshes_get_fewer_eigenvectors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n = len(TALL.vertices)
    spectra = random_spectrum(n, 60), random_spectrum(n, 60)
    for room, eigenvectors in ((10**6, 60), (50 * n, 25), (39 * n, 0)):
        monkeypatch.setattr(page_data, "_VALUES", room)
        write_page(tmp_path / "p", TALL, TALL, {"map": ShownMap(np.arange(n))}, title="", spectra=spectra)
        page = (tmp_path / "p").read_text("utf-8")
        shown = embedded(page)["x"].get("eigenvectors", {"codes": "", "units": ""})
        assert len(decode(shown["units"], "<f4")) == eigenvectors
        assert len(decode(shown["codes"], "i1")) == eigenvectors * n <= room / 2
        assert ('value="wavelets"' in page) == (eigenvectors > 0)
        assert min(eigenvectors_on_page(TALL, TALL), 60) == eigenvectors


def test_the_same_input_gives_the_same_page(tmp_path: Path) -> None:
    n = len(TALL.vertices)
    spectra = random_spectrum(n, 30), random_spectrum(n, 30)
    for name in ("a", "b"):
        write_page(tmp_path / name, TALL, TALL, {"map": ShownMap(np.arange(n))}, title="t", spectra=spectra)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_bundle_is_current_licensed_and_safe_to_embed() -> None:
    assets = ROOT / "jaxsmw" / "report" / "assets"
    viewer, license = (assets / "viewer.js").read_text("utf-8"), (assets / "THREE-LICENSE").read_text("utf-8")
    assert license.strip() in viewer and "MIT" in license
    # The script must not end the script element early, and must not open a comment that hides the end tag.
    assert "</script" not in viewer.lower() and "<!--" not in viewer
    # The bundle was built from the current sources.
    sources = sorted((ROOT / "scripts" / "build_viewer").glob("*.js"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    assert f"Built from the viewer's sources with SHA-256 {digest}." in viewer
    lock = json.loads((ROOT / "scripts" / "build_viewer" / "package-lock.json").read_text("utf-8"))
    assert all("resolved" not in package for package in lock["packages"].values())
