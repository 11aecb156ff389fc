import numpy as np

from nss_ros.batch.pair_sample import PairSample, sample_apart, sample_overlapping
from nss_ros.dataset.folder import PAIRS_NAME
from nss_ros.dataset.pairs import read_pairs


def test_a_sample_has_so_many_pairs_of_each_kind(dataset):
    table = read_pairs(dataset.path / PAIRS_NAME)
    kinds = np.count_nonzero(table.same_stage), np.count_nonzero(~table.same_stage)
    assert min(kinds) > 4
    some = sample_overlapping(table, 4, seed=0)
    assert np.count_nonzero(some.same_stage) == np.count_nonzero(~some.same_stage) == 4
    assert set(some.pairs) <= set(table.pairs)
    assert sample_overlapping(table, 4, seed=0).pairs == some.pairs
    assert sample_overlapping(table, 4, seed=1).pairs != some.pairs
    assert sample_overlapping(table, 10_000, seed=0).pairs == table.pairs


def test_pairs_apart_are_of_one_area_and_overlap_nowhere(dataset):
    ids = dataset.fragment_ids()
    touching = read_pairs(dataset.path / PAIRS_NAME)
    none = touching.take(np.zeros(len(touching), dtype=bool))
    everything = sample_apart(ids, none, 10_000, seed=0)
    areas = [sum(id_.area == area for id_ in ids) for area in dataset.areas()]
    assert len(everything) == sum(count * (count - 1) // 2 for count in areas)
    assert all(pair.source.area == pair.target.area for pair in everything)
    few = touching.take(np.arange(5))
    rest = sample_apart(ids, few, 10_000, seed=0)
    assert len(rest) == len(everything) - 5
    assert not set(rest) & set(few.pairs)
    assert len(sample_apart(ids, few, 3, seed=0)) == 3


def test_all_pairs_are_registered_once(dataset):
    table = read_pairs(dataset.path / PAIRS_NAME)
    apart = sample_apart(dataset.fragment_ids(), table, 5, seed=0)
    sample = PairSample(table, apart)
    assert sorted(sample.pairs) == sorted([*table.pairs, *apart])
