"""Variants of methods: the answers of 'nss benchmark', with settings and perturbations."""

import math
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import read_log
from nss_ros.batch.ceiling import recall_from_truth
from nss_ros.batch.pair_sample import PairSample, sample_apart
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import Choice, registration_config, run_benchmark
from nss_ros.batch.source import BatchSplit, DatasetSource, PairChoice
from nss_ros.batch.variant import Variant, recall_among, run_variant, run_variants
from nss_ros.batch.variant_table import variant_table, variant_tables
from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.score import score_log
from nss_ros.benchmark.table import bin_table
from nss_ros.config import load_config
from nss_ros.dataset.folder import PAIRS_NAME, DatasetFolder
from nss_ros.dataset.pairs import read_pairs
from nss_ros.dataset.perturbation import Perturbation
from nss_ros.errors import ConfigError, MethodError
from nss_ros.geometry import from_yaw
from nss_ros.multiway.pose_graph import Edge, EdgeKind, PoseGraph
from nss_ros.registration.method import load_method
from nss_ros.registration.relative_transform import (
    Hypothesis,
    Reason,
    RelativeTransform,
    failed,
)

QUICK = (
    "registration.fpfh.max_keypoints=300",
    "registration.fpfh.ransac_iterations=2000",
    "registration.fpfh.hypotheses=8",
    "registration.icp.max_points=1000",
)
FEW = Bootstrap(resamplings=50)


@pytest.fixture(scope="module")
def sample(dataset_path):
    table = read_pairs(dataset_path / PAIRS_NAME)
    return PairSample(table.take(np.flatnonzero(table.selected & (table.overlap_ratio >= 0.1))))


def ran(dataset, sample, *overrides, **options):
    variant = Variant("fpfh_ransac", overrides, common=QUICK, **options)
    return run_variant(dataset.path, sample, variant, FEW, workers=1)


@pytest.fixture(scope="module")
def plain(dataset_path, sample):
    return ran(DatasetFolder(dataset_path), sample)


def test_answers_are_those_of_nss_benchmark(dataset, sample, plain, tmp_path):
    result = plain
    choice = Choice(("fpfh_ransac",), (BatchSplit.ALL,), (), PairChoice.SELECTED)
    made = run_benchmark(
        DatasetSource(dataset), tmp_path / "out", choice, load_config(None, QUICK), Workforce(1)
    )
    expected = score_log(read_log(made.logs[0].path), FEW)
    assert result.score.overall.pairwise.all.edges == len(sample.overlapping) > 5
    for kind in ("same_stage", "different_stage"):
        ours, theirs = (getattr(each.overall.pairwise, kind) for each in (result.score, expected))
        assert (ours.recall, ours.answered) == (theirs.recall, theirs.answered)
        for name in ("rte_answered", "rre_answered"):
            assert getattr(ours, name) == pytest.approx(getattr(theirs, name), nan_ok=True)
    for by in ("overlap", "change"):
        assert bin_table([result.score], by).to_csv() == bin_table([expected], by).to_csv()
    assert result.score.overall.pairwise.all.recall > 0
    for kind, among in result.among.items():
        own = getattr(result.score.overall.pairwise, kind)
        assert math.isnan(among) if own.edges == 0 else own.recall <= among <= 100
    assert result.timing.pairs == len(sample.overlapping)
    assert result.timing.alone > result.timing.register > 0
    assert 50 < result.memory < 20_000


def test_overrides_reach_the_method_and_its_name(dataset, sample):
    result = ran(dataset, sample, "registration.min_inlier_ratio=1.0")
    assert result.name == "fpfh_ransac, min_inlier_ratio=1.0"
    assert result.timing.failed == len(sample.overlapping)
    assert result.score.overall.pairwise.all.recall == 0


def test_tilted_fragments_are_what_the_method_is_given(dataset, sample, plain):
    as_they_are = "registration.find_standpoints=false"
    tilted = ran(dataset, sample, as_they_are, perturbation=Perturbation(tilt=10.0))
    assert tilted.name == "fpfh_ransac, find_standpoints=false, tilt 10 deg"
    # Levelled fragments that tilt against each other by more than 3 degrees are refused.
    assert tilted.timing.failed > plain.timing.failed
    assert tilted.score.overall.pairwise.all.recall < plain.score.overall.pairwise.all.recall
    # Where the tilt is expected it does little harm, so ground truth went with the fragments.
    free = ("registration.max_tilt=45.0", "registration.fpfh.use_gravity=false", as_they_are)
    free_tilted = ran(dataset, sample, *free, perturbation=Perturbation(tilt=10.0))
    assert free_tilted.score.overall.pairwise.all.recall > 0


def test_pairs_that_do_not_overlap_are_judged_by_the_probability_alone(dataset):
    touching = read_pairs(dataset.path / PAIRS_NAME)
    few = touching.take(touching.overlap_ratio >= 0.5)
    # This site is so small that pairs that overlap less stand for those apart.
    apart = sample_apart(dataset.fragment_ids(), few, 4, seed=0)
    both = PairSample(few, apart)
    lenient = ("registration.min_inlier_ratio=0.0", "registration.max_tilt=180.0")
    result = ran(dataset, both, *lenient)
    assert result.score.pairs == len(few) + 4
    assert result.score.overall.pairwise.all.edges == len(few)
    overlap = result.score.overlap
    assert overlap.unknown == 0
    assert overlap.all is not None
    assert overlap.all.overlapping <= len(few)
    without = ran(dataset, PairSample(few), *lenient)
    assert math.isnan(without.score.overlap.all.auroc)


def test_variants_run_in_processes_of_their_own_and_in_order(dataset, sample):
    few = PairSample(sample.overlapping.take(np.arange(3)))
    variants = [Variant("fpfh_fgr", common=QUICK), Variant("fpfh_ransac", common=QUICK)]
    seen = []
    results = list(run_variants(dataset.path, few, variants, FEW, report=seen.append))
    assert [result.name for result in results] == ["fpfh_fgr", "fpfh_ransac"]
    assert seen == [1, 2]
    table = variant_table(results)
    assert [row[0] for row in table.rows] == ["fpfh_fgr", "fpfh_ransac"]
    cells = dict(zip((column.name for column in table.columns), table.rows[0], strict=True))
    assert cells["failed"] == results[0].timing.failed
    assert cells["memory"] == results[0].memory
    assert cells["recall, same"] == pytest.approx(
        results[0].score.overall.pairwise.same_stage.recall, nan_ok=True
    )
    titles = [each.title for each in variant_tables(results)]
    assert titles[1:] == ["Recall by overlap ratio", "Recall by temporal change ratio"]
    assert "fpfh_ransac" in variant_tables(results)[1].to_markdown()


def test_a_right_hypothesis_counts_whichever_it_is(sample):
    (pair, other), there = sample.overlapping.pairs[:2], from_yaw(0.3, (1.0, 2.0, 0.0))
    kind = EdgeKind.SAME_STAGE if pair.same_stage else EdgeKind.DIFFERENT_STAGE
    name, unknown = ("same_stage", "different_stage")[:: 1 if pair.same_stage else -1]
    truth = (PoseGraph((), (Edge(pair, there, kind), Edge(other, there, kind))),)
    near = there @ from_yaw(0.05, (0.1, 0.0, 0.0))
    wrong = RelativeTransform(pair, "m", np.eye(4), confidence=0.9)
    among = replace(wrong, alternatives=(Hypothesis(near, 0.1, np.eye(6)),))
    for answers, expected in (({}, 0), ({pair: wrong}, 0), ({pair: among}, 50)):
        found = recall_among(answers, truth)
        assert found[name] == expected
        assert math.isnan(found[unknown])
    # What has failed has the identity for a transform, which means nothing.
    same_place = (PoseGraph((), (Edge(pair, np.eye(4), kind),)),)
    none = failed(pair, "m", Reason.TOO_FEW_POINTS, "")
    assert recall_among({pair: none}, same_place)[name] == 0
    assert recall_among({pair: wrong}, same_place)[name] == 100


def test_icp_that_begins_at_the_truth_is_a_ceiling(dataset, sample, plain):
    config = load_config(None, QUICK).registration
    ceiling = recall_from_truth(dataset, sample.overlapping, config)
    for kind, least in plain.among.items():
        assert ceiling[kind] >= least
    assert ceiling["same_stage"] > 50
    nothing = sample.overlapping.take(np.arange(0))
    assert all(math.isnan(each) for each in recall_from_truth(dataset, nothing, config).values())


@pytest.mark.parametrize(
    ("variant", "error"),
    [
        (Variant("no_such_method"), MethodError),
        (Variant("fpfh_fgr", ("registration.fpfh.no_such_setting=1",)), ConfigError),
    ],
)
def test_what_cannot_run_is_refused_before_anything_runs(variant, error, dataset, sample):
    first = Variant("fpfh_ransac", common=QUICK)
    with pytest.raises(error):
        next(run_variants(dataset.path, sample, [first, variant], FEW))


def test_the_ablations_of_the_benchmark_vary_settings_that_exist():
    script = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "registration.py"))
    methods = {each.split(":")[0] for each in script["ABLATIONS"]}
    assert "gravity" in methods
    for method in methods:
        overrides = list(script["overrides_of"](method, script["ABLATIONS"]))
        assert overrides
        for override in overrides:
            Variant(method, (override,)).config()


def test_parts_of_gravity_are_taken_away_by_weights_that_it_takes(tmp_path):
    script = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "registration.py"))
    variants = list(script["parts_taken_away"](tmp_path))
    assert [str(each) for each in variants][:2] == [
        "gravity, without second look",
        "gravity, without verifier",
    ]
    for each in variants:
        load_method(registration_config(each.config(), each.method))
