from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nss_ros.config import PairConfig, SelectionConfig
from nss_ros.dataset.selection import select_pairs, selection_flatness

CONFIG = PairConfig()


def chosen(pairs):
    return {str(pair) for pair in pairs.take(pairs.selected).pairs}


def test_the_joint_histogram_becomes_flatter(building):
    selected = select_pairs(building.pairs, CONFIG, seed=0)
    for kind, (before, after) in selection_flatness(selected, CONFIG).items():
        assert before + 0.03 < after <= 1, kind


def test_it_is_as_flat_as_the_pairs_allow(building):
    """No cell gives less than another while it has pairs left."""
    config = PairConfig(selection=SelectionConfig(overlap_bins=3, change_bins=2, share=0.4))
    pairs = select_pairs(building.pairs, config, seed=1)
    for side in (pairs.same_stage, ~pairs.same_stage):
        rows = pairs.take(side & (pairs.overlap_ratio >= 0.1))
        edges = (np.linspace(0.1, 1, 4), np.linspace(0, 1, 3))
        every = np.histogram2d(rows.overlap_ratio, rows.temporal_change, edges)[0]
        some = rows.take(rows.selected)
        taken = np.histogram2d(some.overlap_ratio, some.temporal_change, edges)[0]
        assert taken[taken < every].min() >= taken.max() - 1


def test_only_enough_overlap_and_the_number_asked_for(building):
    counts = SelectionConfig(same_stage_pairs=40, different_stage_pairs=70)
    config = PairConfig(min_overlap=0.25, selection=counts)
    pairs = select_pairs(building.pairs, config, seed=0)
    assert pairs.overlap_ratio[pairs.selected].min() >= 0.25
    assert (pairs.selected & pairs.same_stage).sum() == 40
    assert (pairs.selected & ~pairs.same_stage).sum() == 70
    everything = SelectionConfig(same_stage_pairs=10**6, share=1.0)
    pairs = select_pairs(building.pairs, PairConfig(selection=everything), seed=0)
    np.testing.assert_array_equal(pairs.selected, pairs.overlap_ratio >= 0.1)


@settings(max_examples=15)
@given(st.integers(0, 1000))
def test_the_order_of_the_rows_does_not_matter(building, seed):
    order = np.random.default_rng(seed).permutation(len(building.pairs))
    mixed = select_pairs(building.pairs.take(order), CONFIG, seed)
    assert chosen(mixed) == chosen(select_pairs(building.pairs, CONFIG, seed))


def test_another_seed_chooses_others(building):
    first, second = (select_pairs(building.pairs, CONFIG, seed) for seed in (0, 1))
    assert chosen(first) != chosen(second)
    assert first.selected.sum() == second.selected.sum()


def test_complexity_is_balanced_on_request(building):
    pairs = building.pairs
    rng = np.random.default_rng(0)
    complexity = np.where(rng.random(len(pairs)) < 0.9, 0.01, 0.11)
    pairs = replace(pairs, source_complexity=complexity, target_complexity=complexity)
    shares = []
    for bins in (1, 2):
        config = PairConfig(selection=SelectionConfig(share=0.1, complexity_bins=bins))
        taken = select_pairs(pairs, config, 0)
        shares.append((taken.complexity[taken.selected] > 0.05).mean())
    assert shares[0] == pytest.approx(0.1, abs=0.06)
    assert shares[1] > 0.25


def test_pairs_without_shared_points_have_a_cell_of_their_own(building):
    change = building.pairs.temporal_change.copy()
    change[::50] = np.nan
    pairs = select_pairs(replace(building.pairs, temporal_change=change), CONFIG, 0)
    assert np.isnan(pairs.temporal_change[pairs.selected]).any()


def test_nothing_to_choose_from(building):
    pairs = select_pairs(building.pairs.take(np.arange(0)), CONFIG, 0)
    assert len(pairs) == 0
    assert all(np.isnan(both).all() for both in selection_flatness(pairs, CONFIG).values())
