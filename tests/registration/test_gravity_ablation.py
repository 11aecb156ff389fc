"""Networks with a part taken away: what is gone is gone, and nothing else is."""

import numpy as np
import pytest
import torch

from nss_ros.registration.gravity.ablation import (
    ABLATIONS,
    without_free_space,
    without_learning,
    without_second_look,
    without_verifier,
)
from nss_ros.registration.gravity.method import feature_maps
from nss_ros.registration.gravity.network import CHANNELS, DESCRIPTORS, VECTORS
from nss_ros.registration.gravity.raster import LAYERS, SIZE, SLICE_COUNT
from nss_ros.registration.gravity.refinement import SIGNS
from nss_ros.registration.gravity.verifier import judge
from nss_ros.registration.gravity.weights import load_weights, save_weights


@pytest.fixture(scope="module")
def trained():
    return load_weights()


@pytest.fixture(scope="module")
def raster():
    rng = np.random.default_rng(3)
    return rng.random((SLICE_COUNT, LAYERS, SIZE, SIZE)).astype(np.float16)


def signs(**values):
    listed = np.zeros(len(SIGNS))
    for name, value in values.items():
        listed[SIGNS.index(name)] = value
    return listed


def test_without_free_space_the_rest_is_as_it_was(trained, raster):
    whole, less = (
        feature_maps(each.network, raster) for each in (trained, without_free_space(trained))
    )
    np.testing.assert_array_equal(less[:, : VECTORS.stop], whole[:, : VECTORS.stop])
    assert np.abs(whole[:, VECTORS.stop :]).max() > 0
    assert np.abs(less[:, VECTORS.stop :]).max() == 0


def test_weights_by_hand_have_no_descriptors_and_treat_all_cells_alike(trained, raster):
    by_hand = without_learning(trained)
    maps = feature_maps(by_hand.network, raster)
    assert maps.shape[1] == CHANNELS
    assert np.abs(maps[:, :DESCRIPTORS]).max() == 0
    # The features of half of the maps' heights of occupancy are half as large everywhere.
    half = feature_maps(by_hand.network, raster / 2)
    np.testing.assert_allclose(half, maps / 2, atol=2e-3)
    assert np.abs(maps[:, VECTORS.stop :]).max() > 0


def test_the_second_look_tells_nothing_apart(trained):
    comparison = without_second_look(trained).comparison
    generator = torch.Generator().manual_seed(1)
    moved = torch.rand((3, CHANNELS, 48, 48), generator=generator)
    still = torch.rand((CHANNELS, 48, 48), generator=generator)
    with torch.inference_mode():
        assert len(set(comparison(moved, still).tolist())) == 1
        assert len(set(trained.comparison(moved, still).tolist())) == 3


def test_without_a_verifier_only_the_score_ranks_and_all_are_kept(trained):
    verifier = without_verifier(trained).verifier
    hypotheses = [signs(margin_aligned=-3.0, inlier_ratio=0.9), signs(margin_aligned=2.0), signs()]
    many = [*hypotheses, *(signs(margin_aligned=-5.0 - n) for n in range(21))]
    probabilities = judge(verifier, many, same_stage=False).probabilities
    assert np.argsort(-probabilities)[:3].tolist() == [1, 2, 0]
    assert probabilities.min() > 0.01
    np.testing.assert_array_equal(
        probabilities, judge(verifier, many, same_stage=True).probabilities
    )


def test_the_trained_networks_stay_as_they_are_and_each_can_be_loaded(trained, tmp_path):
    before = [value.clone() for each in trained for value in each.state_dict().values()]
    for number, take_away in enumerate(ABLATIONS.values()):
        path = tmp_path / f"{number}.safetensors"
        save_weights(path, take_away(trained))
        loaded = load_weights(str(path))
        after = [value for each in loaded for value in each.state_dict().values()]
        assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    now = [value for each in trained for value in each.state_dict().values()]
    assert all(torch.equal(a, b) for a, b in zip(before, now, strict=True))
