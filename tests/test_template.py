"""Two partial shapes are matched through a full shape."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxsmw import Registration, Stage, creature_pair, make_mesh, match
from jaxsmw.creature import creature
from jaxsmw.errors import InputError
from jaxsmw.matching.advice import advice
from jaxsmw.matching.correspondence import Correspondence
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.stages import Preset
from jaxsmw.matching.template import _composed

# Without a search, the maps of parts to the template are often wrong.
QUICK = Preset(repeated=(Stage(Registration((30, 60))),))
rough = pytest.mark.filterwarnings("ignore:.*wrong as a whole")


def cut(mesh, kept):
    """The part of a mesh with the kept vertices, without the others."""
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    return make_mesh(mesh.vertices[used], np.searchsorted(used, faces), name="part"), used


@pytest.fixture(scope="module")
def parts():
    """The front of a creature, its rear in another pose, and for each front vertex the true rear vertex.

    The true vertex is -1 for front vertices that the rear lacks.
    """
    pair = creature_pair(vertices=1500)
    truth = pair.truth.positions(pair.target)
    length = pair.source.vertices[:, 2]
    x, used_x = cut(pair.source, length > np.quantile(length, 0.3))
    # The rear is cut at the same place of the body, by the lengths of the nearest true points.
    nearest = KDTree(truth).query(pair.target.vertices)[1]
    y, _ = cut(pair.target, length[nearest] < np.quantile(length, 0.7))
    far, true = KDTree(y.vertices).query(truth[used_x])
    return x, y, np.where(far < 0.03 * pair.target.area**0.5, true, -1)


@pytest.fixture(scope="module")
def joined(parts):
    x, y, _ = parts
    template = creature("quadruped", vertices=1200, seed=0)
    return match(x, y, template=template)


def test_parts_are_matched_in_the_region_that_they_share(parts, joined):
    _, y, true = parts
    shared = true >= 0
    assert 0.2 < shared.mean() < 0.8
    errors = np.linalg.norm(y.vertices[joined.pointwise_map] - y.vertices[true], axis=1)[shared]
    assert np.median(errors) < 0.05 * y.area**0.5 and joined.probability > 0.5
    mask_x, mask_y = joined.overlap()
    assert (mask_x & shared).sum() > 0.7 * (mask_x | shared).sum()
    assert len(mask_y) == len(y.vertices) and 0.1 < mask_y.mean() < 0.9


def test_the_result_is_a_partial_correspondence_of_the_given_meshes(parts, joined):
    x = parts[0]
    assert isinstance(joined, Correspondence) and joined.pair.partial and joined.origin == "template"
    assert joined.mesh_x.vertices is x.vertices and len(joined.pointwise_map) == len(x.vertices)
    assert set(joined.seconds) == {
        "scale of the template",
        "source to template",
        "target to template",
        "source to target",
    }
    probabilities = joined.overlap_probabilities()
    assert probabilities.of_x.min() >= 0 and probabilities.of_x.max() <= 1
    # A vertex must lie in the region of the template that both shapes cover.
    assert (probabilities.of_x <= joined.shared.of_x).all()
    assert np.isfinite(joined.expected_error()).all()


def test_a_template_is_recommended_for_uncertain_parts(joined):
    uncertain = replace(joined, probability=0.1)
    for match_of_parts, recommended in ((uncertain, False), (replace(uncertain, shared=None), True)):
        (warning,) = advice(match_of_parts, partial=True)
        assert ("template=mesh" in str(warning)) == ('template="mammal"' in str(warning)) == recommended


def test_uncertain_maps_of_two_parts_cause_one_warning(parts):
    x, y, _ = parts
    with pytest.warns(UserWarning, match="wrong as a whole") as caught:
        found = match(x, y, template=creature("quadruped", vertices=800, seed=0), preset=QUICK)
    (warning,) = [str(one.message) for one in caught if "wrong as a whole" in str(one.message)]
    assert found.pair.name in warning and found.probability < 0.5


def test_points_are_matched_where_they_meet_on_the_template():
    template = creature("quadruped", vertices=600, seed=0)
    rng = np.random.default_rng(0)
    to_template = rng.permutation(len(template.vertices))
    np.testing.assert_array_equal(
        to_template[_composed(template, np.arange(len(to_template)), to_template)],
        np.arange(len(to_template)),
    )


@pytest.mark.slow
def test_parts_that_share_nothing_are_said_to_share_nothing(parts):
    """The head and the tail have no common region, so the map is not refined there."""
    whole = creature("quadruped", vertices=1200, seed=0)
    length = whole.vertices[:, 2]
    head, _ = cut(whole, length > np.quantile(length, 0.55))
    tail, _ = cut(whole, length < np.quantile(length, 0.4))
    with pytest.warns(UserWarning, match="share too small a region"):
        found = match(head, tail, template=whole)
    assert found.overlap()[0].mean() < 0.05


def test_maps_of_a_pair_cannot_be_used_with_a_template(parts):
    x, y, _ = parts
    with pytest.raises(InputError, match="cannot be used with a template"):
        match(x, y, template=x, init=np.zeros(len(x.vertices), int))


@rough
def test_scales_to_the_template_are_divided(parts, monkeypatch):
    """Lengths on X are doubled, so the scale of X to Y and to the template is one half."""
    seen = []
    make = Pair.make.__func__

    def record(cls, *meshes, **options):
        seen.append(options["scale"])
        return make(cls, *meshes, **options)

    x, y, _ = parts
    monkeypatch.setattr(Pair, "make", classmethod(record))
    double = replace(x, vertices=2 * x.vertices)
    found = match(double, y, template=creature("quadruped", vertices=800, seed=0), scale=0.5, preset=QUICK)
    assert seen == [0.5, 1.0] and found.pair.scale == 0.5
