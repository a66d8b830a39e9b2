"""Tests of the relative scale of a partial shape and a full shape."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import SMALL, assert_refused
from sampled_cases import first_always
from scipy.spatial.transform import Rotation
from synthetic import bumpy_mesh

from jaxsmw import InputError, make_mesh, match, read_mesh, write_mesh
from jaxsmw.benchmark.datasets import choose_pairs, open_data_set
from jaxsmw.creature import creature_pair
from jaxsmw.geometry import estimate_scale
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.matching.judge import distortion
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.preparation import paired_spectra

PRESET = "paper"


def upper_part(mesh: Mesh, share: float) -> Mesh:
    """The upper part of a mesh, with the vertices of the whole."""
    kept = mesh.vertices[:, 2] > np.quantile(mesh.vertices[:, 2], 1 - share)
    return make_mesh(mesh.vertices, mesh.faces[kept[mesh.faces].all(axis=1)], name="part")


def moved(mesh: Mesh, scale: float) -> Mesh:
    rotation = Rotation.random(random_state=5).as_matrix()
    return replace(mesh, vertices=scale * mesh.vertices @ rotation.T + [5, -3, 100])


@pytest.fixture(scope="module")
def body():
    """A body in two poses."""
    return creature_pair(vertices=1500, seed=3)


@pytest.fixture(scope="module")
def part(body):
    """The upper part of the first pose, and the second pose."""
    return upper_part(body.source, 0.6), body.target


@pytest.mark.parametrize("scale", [1e-3, 25.0])
def test_the_scale_of_a_part_is_found(part, scale):
    part, full = part
    found = estimate_scale(moved(part, scale), full)
    assert found.scale * scale == pytest.approx(1, rel=0.05)
    assert not found.uncertain


def test_the_order_of_the_meshes_inverts_the_scale(part):
    part, full = part
    forward, backward = estimate_scale(part, full), estimate_scale(full, part)
    assert forward.scale * backward.scale == pytest.approx(1, rel=1e-9)
    assert forward.support == backward.support


def test_an_estimate_for_unlike_shapes_is_uncertain(part):
    assert estimate_scale(upper_part(bumpy_mesh(4), 0.6), part[1]).uncertain


def test_closed_meshes_are_refused(body):
    with pytest.raises(InputError, match=r"both meshes are closed.*give the scale as a number"):
        estimate_scale(body.source, body.target)


def test_meshes_that_are_too_coarse_are_refused(part):
    coarse = bumpy_mesh(1)
    with pytest.raises(InputError, match=r"coarse|too few similar points"):
        estimate_scale(upper_part(coarse, 0.5), coarse)


def test_a_pair_of_known_scale_has_comparable_units(part):
    part, full = part
    pair, scaled = Pair(part, full, True), Pair(moved(part, 8.0), full, True, 1 / 8)
    np.testing.assert_allclose(scaled.areas, pair.areas, rtol=1e-9)
    np.testing.assert_allclose(scaled.units_of_length, np.multiply(pair.units_of_length, [8, 1]), rtol=1e-9)
    for now, usual in zip(paired_spectra(scaled, 30), paired_spectra(pair, 30), strict=True):
        np.testing.assert_allclose(now.eigenvalues, usual.eigenvalues, rtol=1e-6, atol=1e-6)
    found = np.random.default_rng(0).integers(len(full.vertices), size=len(part.vertices))
    scores = [distortion(one, found, paired_spectra(one, 30)[0]) for one in (pair, scaled)]
    assert scores[0] == pytest.approx(scores[1], rel=1e-6)
    reverse = scaled.reversed()
    assert reverse.units_of_length == pytest.approx(scaled.units_of_length[::-1], rel=1e-12)
    assert scaled.mirrored().scale == scaled.scale


@pytest.mark.slow
def test_a_part_in_another_unit_is_matched_as_in_the_same_unit(part, body):
    part, full = part
    options = {"preset": PRESET, "partial": True, "init": body.true_map}
    usual = match(part, full, **options)
    scaled = replace(part, vertices=100 * part.vertices)
    known = match(scaled, full, **options, scale=0.01)
    assert (known.pointwise_map == usual.pointwise_map).mean() > 0.99
    unknown = match(scaled, full, **options, scale="unknown")
    assert unknown.pair.scale == pytest.approx(0.01, rel=0.05)
    used = part.referenced_vertices
    errors = [
        np.linalg.norm(full.vertices[one.pointwise_map] - full.vertices[body.true_map], axis=1)[used].mean()
        for one in (usual, unknown)
    ]
    assert errors[1] < 1.5 * errors[0]
    registered = known.registered_mesh()
    np.testing.assert_allclose(
        registered.vertices, usual.registered_mesh().vertices, atol=0.05 * full.area**0.5
    )
    assert np.median(registered.similarities.scales[used]) == pytest.approx(0.01, rel=0.1)


def test_an_uncertain_scale_is_announced(part, monkeypatch):
    monkeypatch.setattr(
        "jaxsmw.matching.pair.estimate_scale", lambda *_: estimate_scale(*part)._replace(uncertain=True)
    )
    with pytest.warns(UserWarning, match=r"the estimated scale 0\.99\d is uncertain"):
        Pair.make(*part, partial=True, scale="unknown")


@pytest.mark.parametrize("scale", [0, -1.0, np.nan, np.inf, "big", None, True])
@pytest.mark.usefixtures("unchecked")
def test_bad_scales_are_refused(part, scale):
    with pytest.raises(InputError, match="scale"):
        Pair.make(*part, partial=True, scale=scale)


@pytest.mark.parametrize("exchanged", first_always([True, False]))
def test_a_part_that_is_larger_than_a_closed_shape_is_refused(part, exchanged):
    part, full = part
    meshes = [replace(part, vertices=10 * part.vertices), full][:: -1 if exchanged else 1]
    with pytest.raises(
        InputError, match=r"part is open and .* is closed.* 5\d\.\d times the area: check the units"
    ):
        match(*meshes, partial=True)
    for scale in (0.1, "unknown"):
        assert Pair.make(part, full, partial=True).areas == pytest.approx(
            Pair.make(meshes[exchanged], full, partial=True, scale=scale).areas, rel=0.1
        )


@pytest.mark.parametrize("scale", [2.0, "unknown"])
def test_full_shapes_have_no_scale(part, scale):
    with pytest.raises(InputError, match=r"full shapes are scaled to the same area.*partial=True"):
        match(*part, scale=scale)


def test_the_command_estimates_the_scale(part, body, tmp_path, run):
    files = [tmp_path / "part.off", tmp_path / "full.off"]
    write_mesh(files[0], moved(part[0], 0.2))
    write_mesh(files[1], body.source)
    arguments = ["match", *files, *SMALL, "--output", tmp_path / "map.txt"]
    done = run(*arguments, "--partial", "--scale", "unknown")
    assert done.code == 0, done.errors
    line = next(line for line in done.output.splitlines() if line.startswith("scale:"))
    assert float(line.split()[1]) == pytest.approx(5, rel=0.05)
    for wrong, message in (
        (["--scale", "2"], "--scale: has no effect without --partial"),
        (["--partial", "--scale", "0"], "'0' is no scale: give a positive number or unknown"),
        (["--partial", "--scale", "known"], "'known' is no scale"),
    ):
        assert_refused(run(*arguments, *wrong), naming=message)


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["cuts_horse_shape_2", "holes_david_shape_1", "cuts_michael_shape_3"])
def test_the_scale_of_real_parts_is_found(shared, name):
    pairs = choose_pairs(open_data_set(shared / "data" / "shrec16_partial"), None, 0)
    (pair,) = (pair for pair in pairs if name in pair.name)
    part, full = map(read_mesh, pair.meshes)
    found = estimate_scale(replace(part, vertices=0.37 * part.vertices), full)
    assert found.scale == pytest.approx(1 / 0.37, rel=0.05)
