import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.benchmark.calibration import calibrate, expected_calibration_error

samples = st.lists(st.tuples(st.booleans(), st.floats(0, 1)), min_size=1, max_size=40)


def test_a_confidence_that_means_what_it_says():
    success = np.array(([True] * 3 + [False]) * 25)
    result = calibrate(success, np.full(100, 0.75))
    assert result.expected_error == pytest.approx(0)
    assert result.brier == pytest.approx(0.75 * 0.25)
    assert result.accuracy == result.confidence == 0.75
    assert result.curve[7].count == 100
    assert result.curve[7].accuracy == 0.75
    assert np.isnan(result.curve[0].accuracy)
    assert [each.low for each in result.curve] == [i / 10 for i in range(10)]


def test_a_confidence_that_brags():
    result = calibrate(np.array([True, False]), np.array([1.0, 1.0]))
    assert result.expected_error == 0.5
    assert result.auroc == 0.5


@given(samples)
def test_the_error_lies_between_that_of_one_bin_and_one(rows):
    success, confidence = (np.array(column) for column in zip(*rows, strict=True))
    result = calibrate(success, confidence)
    assert sum(each.count for each in result.curve) == result.count == len(rows)
    least = abs(result.accuracy - result.confidence)
    assert least - 1e-9 <= result.expected_error <= 1 + 1e-9


@given(samples, st.randoms())
def test_weights_count_samples(rows, random):
    success, confidence = (np.array(column) for column in zip(*rows, strict=True))
    times = np.array([random.randint(0, 3) for _ in rows])
    value = expected_calibration_error(success, confidence, times[None].astype(float))
    repeated = calibrate(np.repeat(success, times), np.repeat(confidence, times))
    if repeated is None:
        assert np.isnan(value[0])
    else:
        assert value[0] == pytest.approx(repeated.expected_error, abs=1e-9)


def test_what_is_no_probability():
    result = calibrate(np.array([True, False, True]), np.array([1.7, -3.0, np.nan]))
    assert (result.count, result.expected_error, result.auroc) == (2, 0, 1)
    assert calibrate(np.array([True]), np.array([np.nan])) is None
    assert np.isnan(calibrate(np.array([True]), np.array([0.5])).auroc)
