"""Stages, presets and the settings of the search."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from synthetic import body_with_arms

from jaxsmw.core.refiners.feature_regression import FeatureRegression
from jaxsmw.core.refiners.wavelet_preservation import WaveletPreservation
from jaxsmw.errors import InputError
from jaxsmw.geometry.mesh import Mesh, make_mesh
from jaxsmw.matching.judge import detours, overlap_probability
from jaxsmw.matching.pair import Pair
from jaxsmw.matching.settings import SearchSettings
from jaxsmw.matching.stages import PRESETS, Preset, Stage

LEVELS = (20, 20, 40, 40)
STAGE = Stage(FeatureRegression(LEVELS))
SEARCH = SearchSettings()
SAMPLED = replace(STAGE, number_of_samples=90)
ENDING = replace(SAMPLED, ends_on_samples=True)


def test_default_settings_of_the_search_are_those_of_the_preset_and_documented():
    settings = SearchSettings()
    assert settings == PRESETS["accurate"].search == PRESETS["accurate"].large.search
    for field in fields(settings):
        assert f"`{field.name}`" in SearchSettings.__doc__


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: Preset(()), "at least one stage"),
        (lambda: Preset((STAGE,), search=SEARCH), "the search has no stage to repeat"),
        (lambda: Preset((STAGE,), final=(STAGE,), search=SEARCH), "the search has no stage to repeat"),
        (lambda: Preset(final=(STAGE,)), "no map to judge"),
        (
            lambda: Preset(repeated=(ENDING,), final=(replace(SAMPLED, starts_on_samples=True),)),
            "before the final stages ends on samples, but its map is judged",
        ),
        (lambda: Preset(repeated=(Stage(),), search=SEARCH), "WaveletPreservation, which has no levels"),
        (lambda: Preset((STAGE,), large=(STAGE,)), "large is .*: give a Preset or None"),
        (lambda: Preset((SAMPLED, ENDING)), "the last stage ends on samples"),
        (lambda: Preset((ENDING,), (SAMPLED,)), "stage 0 matches only 90 samples: let stage 1"),
        (
            lambda: Preset((ENDING, replace(SAMPLED, number_of_samples=91, starts_on_samples=True))),
            "at most as",
        ),
        (lambda: Stage(FeatureRegression(LEVELS), ends_on_samples=True), "there are no samples"),
        (lambda: Stage(number_of_samples=500, starts_on_samples=True), "WaveletPreservation matches samples"),
        (lambda: Stage(FeatureRegression(LEVELS), number_of_eigenvectors=60), "require 40: leave .* out"),
        (lambda: Stage(FeatureRegression(LEVELS), iterations=3), "require 4: leave iterations out"),
        (lambda: Stage(WaveletPreservation()).with_levels((3,)), "has no levels"),
        (lambda: SearchSettings(passes=-1), "passes is -1: give a whole number of at least 0"),
        (lambda: SearchSettings(finalists=0), "finalists is 0: give a whole number of at least 1"),
        (lambda: SearchSettings(certain=3.0), "certain is 3.0: give a number from 0 to 1"),
        (lambda: SearchSettings(likely=float("nan")), "likely is nan"),
    ],
)
def test_invalid_presets_and_settings_are_refused(make, fault):
    with pytest.raises(InputError, match=fault):
        make()


def test_sizes_follow_from_levels():
    assert (STAGE.number_of_eigenvectors, STAGE.iterations) == (40, 4)
    assert (Stage().number_of_eigenvectors, Stage().iterations) == (100, 3)
    other = STAGE.with_levels((5, 50))
    assert (other.number_of_eigenvectors, other.iterations) == (50, 2)
    assert replace(STAGE, number_of_samples=300).number_of_samples == 300
    small = STAGE.fitted(60)
    assert small.refiner.levels == (20, 20, 30, 30) and small.number_of_eigenvectors == 30
    with pytest.raises(TypeError, match="positional"):
        Stage(FeatureRegression(LEVELS), 40)


def test_the_overlap_of_two_partial_shapes():
    """Two overlapping halves of a body, with the true maps in both directions."""
    mesh = body_with_arms(3)
    height = mesh.vertices[:, 1]
    keep_x, keep_y = height < np.quantile(height, 0.7), height > np.quantile(height, 0.3)
    x, y = (make_mesh(mesh.vertices, mesh.faces[k[mesh.faces].all(axis=1)]) for k in (keep_x, keep_y))

    def nearest(to: Mesh) -> np.ndarray:
        used = np.flatnonzero(to.referenced_vertices)
        return used[KDTree(mesh.vertices[used]).query(mesh.vertices)[1]]

    pair = Pair.make(x, y, partial=True)
    found = overlap_probability(pair, nearest(y), nearest(x)) >= 0.5
    used = x.referenced_vertices
    assert (found == keep_y)[used].mean() > 0.9
    inside = used & y.referenced_vertices
    assert detours(pair, nearest(y), nearest(x))[inside].max() == 0
