"""Maps, correlation and search of the gravity method, without trained weights."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nss_ros.config import RegistrationConfig
from nss_ros.fragment import Fragment
from nss_ros.geometry import from_yaw, transform_points
from nss_ros.registration.gravity.coarse import (
    COARSE_YAWS,
    coarse_scores,
    fast_size,
    shift_of_middles,
)
from nss_ros.registration.gravity.correlation import (
    STEP,
    correlate,
    correlate_turned,
    rotated,
    spectrum,
    turned_spectra,
    yaw_angles,
)
from nss_ros.registration.gravity.network import CHANNELS, GravityNetwork, as_target
from nss_ros.registration.gravity.raster import (
    CELL,
    FREE,
    NORMAL_X,
    OCCUPIED,
    SIZE,
    SLICE_COUNT,
    find_floor,
)
from nss_ros.registration.gravity.scan import scan_of
from nss_ros.registration.gravity.search import search
from nss_ros.registration.gravity.training import (
    Planar,
    augmented,
    target_distribution,
)
from nss_ros.registration.gravity.training_data import Example, Item

CONFIG = RegistrationConfig()


def scan(fragment, transform=None):
    points = fragment.points
    if transform is not None:
        points = transform_points(transform, points).astype(np.float32)
    return scan_of(Fragment(fragment.id, points, True), CONFIG)


def features(network, maps):
    """The hand-set first version of the network: normals and free space only."""
    with torch.inference_mode():
        batch = torch.from_numpy(maps).float()[None]
        return network.features(batch, network(batch), True)[0]


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    torch.set_num_threads(1)
    return GravityNetwork().eval()


def test_the_floor_of_a_room_is_found(scans):
    found = scan(scans[0]).floor
    assert found.height == pytest.approx(-1.2, abs=0.02)
    assert found.share > 0.05


def test_a_cloud_without_a_floor_has_none():
    wall = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    wall[:, 0] = 2.0
    assert find_floor(wall, np.tile((-1.0, 0.0, 0.0), (500, 1))).share == 0


def test_a_wall_and_the_air_before_it_are_where_they_are(scans):
    maps = scan(scans[0]).maps
    row = SIZE // 2
    wall = SIZE // 2 + math.floor(-2.5 / CELL)
    assert maps.shape == (SLICE_COUNT, 5, SIZE, SIZE)
    assert maps[2, OCCUPIED, row, wall - 1 : wall + 2].max() > 0.3
    assert maps[2, NORMAL_X, row, wall - 1 : wall + 2].max() > 0.3
    assert maps[2, FREE, SIZE // 2 - 3, SIZE // 2 - 3] == 1
    assert maps[2, FREE, row, : wall - 4].max() == 0


@settings(max_examples=15, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-2, 2), st.floats(-2, 2))
def test_a_moved_copy_is_found_where_it_was_moved(scans, network, yaw, x, y):
    # The scanner stays the origin of the copy, so that free space is not what it saw: only
    # normals and occupied cells help.
    source = scan(scans[0])
    turned = scan(scans[0], from_yaw(yaw, (0, 0, 0)))
    still = as_target(features(network, turned.maps)).roll(
        (round(y / 0.2), round(x / 0.2)), (-2, -1)
    )
    best = search(turned_spectra(features(network, source.maps)), still, 3).peaks[0]
    assert abs((best.yaw - yaw + math.pi) % (2 * math.pi) - math.pi) < math.radians(4)
    assert best.x == pytest.approx(round(x / 0.2) * 0.2, abs=0.21)
    assert best.y == pytest.approx(round(y / 0.2) * 0.2, abs=0.21)


def test_half_a_turn_tells_the_scores_of_all_of_it(scans, network):
    source, target = (features(network, scan(each).maps) for each in scans[:2])
    still = as_target(target)
    direct = correlate(spectrum(rotated(source, yaw_angles())), spectrum(still))
    scores = correlate_turned(turned_spectra(source), still, still.shape[-1])
    assert scores.shape == direct.shape
    assert torch.allclose(scores, direct, atol=1e-4 * float(direct.abs().max()))


@pytest.mark.parametrize("sizes", [(10, 17), (9, 9), (14, 6)])
def test_half_a_turn_tells_the_coarse_scores_of_grids_of_any_size(sizes):
    moving, still = (
        torch.randn(CHANNELS, n, n, generator=torch.Generator().manual_seed(n)) for n in sizes
    )
    size = fast_size(sum(sizes))
    yaws = torch.arange(COARSE_YAWS) * (2 * math.pi / COARSE_YAWS)
    turned = spectrum(rotated(moving, yaws), size)
    direct = correlate(turned, spectrum(as_target(still), size), size)
    scores = coarse_scores(moving, still)
    assert scores.shape == direct.shape
    assert torch.allclose(scores, direct, atol=1e-4 * float(direct.abs().max()))


def test_peaks_differ_and_their_probability_is_at_most_one(scans, network):
    maps = features(network, scan(scans[0]).maps)
    found = search(turned_spectra(maps), as_target(maps), 10)
    assert len(found.peaks) == 10
    assert sum(math.exp(peak.mass) for peak in found.peaks) <= 1 + 1e-4
    assert [peak.score for peak in found.peaks] == sorted(
        (peak.score for peak in found.peaks), reverse=True
    )


@pytest.mark.parametrize("seed", range(6))
def test_augmentation_moves_truth_and_maps_alike(scans, network, seed):
    truth = from_yaw(0.7, (0.6, -0.4, 0))
    items = [
        Item(0, scan(scans[0]), truth),
        Item(0, scan(scans[0], truth), np.eye(4)),
    ]
    trial = augmented(
        items, Example(0, 1, True, 1.0), Planar.of(truth), np.random.default_rng(seed)
    )
    best = search(
        turned_spectra(features(network, trial.source.numpy())),
        as_target(features(network, trial.target.numpy())),
        1,
    ).peaks[0]
    assert abs((best.yaw - trial.truth.yaw + math.pi) % (2 * math.pi) - math.pi) < math.radians(4)
    assert best.x == pytest.approx(trial.truth.x, abs=0.25)
    assert best.y == pytest.approx(trial.truth.y, abs=0.25)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0, 2 * math.pi),
    st.floats(-9, 9),
    st.floats(-9, 9),
    st.sampled_from([(48, 48), (48, 120), (120, 48), (120, 120)]),
)
def test_the_target_of_training_is_a_distribution_about_the_truth(yaw, x, y, cells):
    middle = round(yaw / (2 * math.pi / 120))
    near = [(middle + k) % 120 for k in (-1, 0, 1)]
    wanted = target_distribution(Planar(yaw, x, y), near, *cells).numpy()
    assert wanted.sum() == pytest.approx(1, abs=1e-4)
    assert wanted.max() > 0.05
    best = np.unravel_index(wanted.argmax(), wanted.shape)
    assert best[0] == 1
    shift = shift_of_middles(np.array(best[1:]), *cells, wanted.shape[-1]) * STEP
    assert shift == pytest.approx([y, x], abs=STEP / 2 + 1e-6)
