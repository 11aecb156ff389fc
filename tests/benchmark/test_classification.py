import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score, roc_auc_score

from nss_ros.benchmark.classification import (
    auroc,
    average_precision,
    classify,
    ranking,
    swapped,
    threshold_counts,
)

# Few values, so that there are ties.
samples = st.lists(
    st.tuples(st.booleans(), st.sampled_from([0.0, 0.1, 0.5, 0.6, 1.0]), st.integers(0, 3)),
    min_size=2,
    max_size=30,
)


@given(samples)
def test_weighted_figures_are_those_of_scikit_learn(rows):
    truth, score, times = (np.array(column) for column in zip(*rows, strict=True))
    both = times[truth].sum() > 0 and times[~truth].sum() > 0
    counts = threshold_counts(truth, ranking(score), np.stack((times, times)).astype(float))
    for value, other, expected in (
        (auroc(counts), truth, roc_auc_score),
        (average_precision(counts), truth, average_precision_score),
        (average_precision(swapped(counts)), ~truth, average_precision_score),
    ):
        assert value.shape == (2,)
        if not both:
            assert np.isnan(value).all()
            continue
        by = score if other is truth else 1 - score
        assert value == pytest.approx(expected(other, by, sample_weight=times), abs=1e-9)


def test_known_figures():
    truth = np.array([True, True, False, True, False])
    result = classify(truth, np.array([0.9, 0.8, 0.7, 0.3, np.nan]))
    assert (result.pairs, result.overlapping) == (4, 3)
    assert result.accuracy == 0.5
    assert result.precision == pytest.approx(2 / 3)
    assert result.recall == pytest.approx(2 / 3)
    assert result.f1 == pytest.approx(2 / 3)
    assert result.auroc == pytest.approx(2 / 3)
    assert result.average_precision == pytest.approx((1 + 1 + 3 / 4) / 3)
    assert result.mean_average_precision == pytest.approx((result.average_precision + 1 / 2) / 2)
    assert result.curve[0] == pytest.approx((0.3, 0.75, 1.0))
    assert result.curve[-1] == pytest.approx((0.9, 1.0, 1 / 3))


def test_one_class_ranks_nothing():
    result = classify(np.ones(3, dtype=bool), np.array([0.9, 0.1, 0.6]))
    assert result.accuracy == result.recall == pytest.approx(2 / 3)
    assert np.isnan([result.auroc, result.average_precision]).all()
    assert result.curve == ()
    result = classify(np.zeros(2, dtype=bool), np.array([0.1, 0.2]))
    assert np.isnan([result.precision, result.recall]).all()
    assert result.accuracy == 1


def test_no_probability_no_figures():
    assert classify(np.array([True]), np.array([np.nan])) is None
    assert classify(np.zeros(0, dtype=bool), np.zeros(0)) is None


def test_long_curves_are_thinned():
    rng = np.random.default_rng(0)
    result = classify(rng.random(5000) < 0.5, rng.random(5000))
    assert len(result.curve) == 200
    thresholds = [point[0] for point in result.curve]
    assert thresholds == sorted(thresholds)
