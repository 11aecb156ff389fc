import numpy as np
import pytest

from nss_ros.config import RigConfig
from nss_ros.simulation.element import Material
from nss_ros.simulation.noise import draw_noise, measured_depth, returned

CONFIG = RigConfig(dropout=0)
COUNT = 20_000


def share(material, distance=1.2, incidence=0.0, config=CONFIG):
    """Of many rays, the share that gives a return."""
    chance = draw_noise(COUNT, np.random.default_rng(0)).chance
    cosine = np.full(COUNT, np.cos(np.radians(incidence)), np.float32)
    materials = np.full(COUNT, material, np.uint8)
    return returned(np.full(COUNT, distance, np.float32), cosine, materials, chance, config).mean()


def test_draws_are_normal_uniform_and_independent():
    draws = draw_noise(100_000, np.random.default_rng(0))
    everything = np.stack((*draws.lateral, draws.axial, draws.chance))
    np.testing.assert_allclose(everything.mean(axis=1), [0, 0, 0, 0.5], atol=0.015)
    np.testing.assert_allclose(everything.std(axis=1), [1, 1, 1, 12**-0.5], rtol=0.02)
    assert np.abs(np.corrcoef(everything) - np.eye(4)).max() < 0.02
    assert draws.chance.min() > 0
    assert draws.chance.max() < 1
    assert np.isfinite(everything).all()


def test_matt_surfaces_return_up_to_grazing_incidence():
    assert share(Material.MATT, incidence=CONFIG.grazing_start - 1) == 1
    assert 0.2 < share(Material.MATT, incidence=78) < 0.8
    assert share(Material.MATT, incidence=CONFIG.grazing_end + 1) == 0


def test_metal_loses_returns_at_less_grazing_incidence():
    assert share(Material.METAL, incidence=CONFIG.metal_grazing_start - 1) == 1
    assert share(Material.METAL, incidence=60) < share(Material.MATT, incidence=60)
    assert share(Material.METAL, incidence=CONFIG.metal_grazing_end + 1) == 0


def test_dark_surfaces_return_from_near_only():
    assert share(Material.DARK, distance=CONFIG.dark_range_start - 0.1) == 1
    assert share(Material.DARK, distance=2.5) == pytest.approx(0.5, abs=0.02)
    assert share(Material.DARK, distance=CONFIG.dark_range_end + 0.1) == 0
    assert share(Material.MATT, distance=CONFIG.dark_range_end + 0.1) == 1


def test_glass_gives_next_to_no_return():
    assert share(Material.GLASS) == pytest.approx(CONFIG.glass_return, abs=0.005)


def test_some_returns_are_lost_anywhere():
    config = RigConfig(dropout=0.25)
    assert share(Material.MATT, config=config) == pytest.approx(0.75, abs=0.01)


def test_too_near_is_no_return():
    assert share(Material.MATT, distance=CONFIG.min_range - 0.01) == 0
    assert share(Material.MATT, distance=np.inf) == 0


def test_depth_without_noise_is_rounded_to_the_nearest_step():
    depth = np.linspace(0.5, 9.0, 1000, dtype=np.float32)
    config = RigConfig(axial_noise=0)
    measured = measured_depth(depth, np.zeros_like(depth), config)
    # Half a step of disparity is half of step * depth^2.
    assert (np.abs(measured - depth) <= 0.51 * config.disparity_step * measured * depth).all()
    exact = measured_depth(depth, np.zeros_like(depth), RigConfig(axial_noise=0, disparity_step=0))
    np.testing.assert_array_equal(exact, depth)
