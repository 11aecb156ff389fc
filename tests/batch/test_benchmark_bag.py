"""A benchmark over a bag instead of a dataset."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from nss_ros.bag import read_log, with_source_points, write_bag
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import Choice, run_benchmark
from nss_ros.batch.source import BagSource, BatchSplit, DatasetSource, PairChoice, open_source
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.score import score_log
from nss_ros.config import NssConfig, load_config
from nss_ros.dataset.annotate import pair_sets
from nss_ros.dataset.bag_export import export_bag
from nss_ros.errors import FormatError, InputError
from nss_ros.registration.pool import RegistrationPool

pytestmark = pytest.mark.usefixtures("plugins")

ALL = (BatchSplit.ALL,)


def go(source, output, synchronizers=("choi",), config=None, method="guess", **options):
    choice = Choice((method,), options.pop("splits", ALL), synchronizers, **options)
    return run_benchmark(source, output, choice, config or NssConfig(), Workforce(1)).logs


def transforms(log):
    return {
        pair: (each.T_target_source.tobytes(), each.confidence)
        for pair, each in log.relative_transforms.items()
    }


@pytest.fixture
def bag(dataset, tmp_path):
    """All overlapping pairs of the dataset."""
    export_bag(tmp_path / "bag", dataset, pair_sets(dataset, None)["all"], 0.0)
    return tmp_path / "bag"


def test_a_bag_gives_what_its_dataset_gives(dataset, bag, tmp_path):
    overlapping = {"pairs": PairChoice.OVERLAPPING}
    (one,) = go(DatasetSource(dataset), tmp_path / "one", **overlapping)
    (two,) = go(open_source(bag), tmp_path / "two", **overlapping)
    first, second = read_log(one.path), read_log(two.path)
    assert set(first.pairs) == set(second.pairs)
    assert transforms(first) == transforms(second)
    scores = [score_log(with_source_points(log), Bootstrap(0)) for log in (first, second)]
    for score in scores:
        assert score.has_points
    one, two = (asdict(score.overall.pairwise) for score in scores)
    for kind, figures in one.items():
        # Means of edges in another order.
        assert figures == pytest.approx(two[kind], rel=1e-12, nan_ok=True)
    assert [graph.name for graph in scores[1].graphs] == ["Bldg1_Graph1", "Bldg2_Graph1"]
    assert second.metadata["generator"] == "nss simulate"


def test_one_mcap_file_with_pairs_in_its_order_is_answered_as_in_the_graph(bag, tmp_path):
    config = load_config(None, ["registration.method=guess", "registration.seed=2"])
    (file,) = bag.glob("*.mcap")
    (log,) = go(open_source(file), tmp_path / "out", config=config)
    made, source = read_log(log.path), read_log(bag)
    assert made.pairs == source.pairs
    pool = RegistrationPool(config.registration, workers=1)
    try:
        for fragment in source.fragments.values():
            pool.add_fragment(fragment)
        for pair in source.pairs:
            pool.submit(pair)
        expected = {}
        while len(expected) < len(source.pairs):
            expected |= {each.pair: each for each in pool.poll(0.1)}
    finally:
        pool.close()
    for pair, each in made.relative_transforms.items():
        assert each.T_target_source == pytest.approx(expected[pair].T_target_source, abs=1e-12)
    # All fragments are in the map, those without a pair too, as in the node's.
    assert {node.id for node in made.pose_graph.nodes} == source.fragments.keys()


def test_a_log_can_be_registered_anew(dataset, bag, tmp_path):
    (first,) = go(open_source(bag), tmp_path / "first")
    (again,) = go(open_source(first.path), tmp_path / "again", synchronizers=("tree",))
    assert transforms(read_log(first.path)) == transforms(read_log(again.path))
    moved = with_source_points(read_log(again.path))
    assert moved.fragments.keys() == set(dataset.fragment_ids())
    assert moved.metadata["benchmark.synchronizer"] == "tree"


def test_bags_that_lack_something_say_so(bag, tmp_path, room):
    fragments = [replace(f, points=f.points[::40]) for f in room.fragments]
    hidden = replace(room.ground_truth, edges=())
    for name, clouds, pairs, truth, words in (
        ("blind", fragments, room.pairs, (), "no ground-truth edges"),
        ("hidden", fragments, room.pairs, [hidden], "no ground-truth edges"),
        ("empty", [], [], [room.ground_truth], "no point clouds"),
    ):
        write_bag(tmp_path / name, clouds, pairs, truth)
        with pytest.raises(InputError, match=words):
            open_source(tmp_path / name)
    with pytest.raises(FormatError, match="neither a dataset"):
        open_source(tmp_path)
    with pytest.raises(InputError, match="has no split 'cross_area'"):
        go(BagSource(bag), tmp_path / "out", splits=(BatchSplit.CROSS_AREA,))
    write_bag(tmp_path / "plain", fragments, (), [room.ground_truth])
    plain = open_source(tmp_path / "plain")
    # Without pairs those of the ground truth; of whose overlap nothing is known.
    assert plain.table(BatchSplit.ALL, PairChoice.SELECTED, 0.1).pairs == room.pairs
    assert np.isnan(plain.table(BatchSplit.ALL, PairChoice.SELECTED, 0.1).overlap_ratio).all()
    with pytest.raises(InputError, match="tells no overlap ratios"):
        go(plain, tmp_path / "out", pairs=PairChoice.OVERLAPPING)
