import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.multiway.measurement import information, measurement
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed

PAIR = FragmentPair(FragmentId("1", 1, 0), FragmentId("1", 2, 1))


@given(st.integers(0, 10_000), st.floats(0.01, 10))
def test_information_is_the_inverse_covariance(seed, scale):
    root = np.random.default_rng(seed).normal(size=(6, 6)) * scale
    covariance = root @ root.T + np.eye(6) * scale**2
    # No estimate counts as better than a centimetre and a tenth of a degree.
    floor = np.diag([0.01**2] * 3 + [np.deg2rad(0.1) ** 2] * 3)
    assert np.allclose(information(covariance) @ (covariance + floor), np.eye(6), atol=1e-6)


@pytest.mark.parametrize(
    "covariance",
    [np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6), np.diag([1, 1, 1, 1, 1, 0.0])],
    ids=["zero", "nan", "negative", "singular"],
)
def test_an_invalid_covariance_is_replaced(covariance):
    eigenvalues = np.linalg.eigvalsh(information(covariance))
    assert np.isfinite(eigenvalues).all()
    assert eigenvalues[0] > 0


def test_what_the_answer_says_is_kept():
    result = RelativeTransform(
        PAIR, "m", np.eye(4), np.eye(6), confidence=0.7, inliers=12, inlier_ratio=0.4
    )
    taken = measurement(result, level=True)
    assert (taken.pair, taken.confidence, taken.inliers) == (PAIR, 0.7, 12)
    assert taken.level
    assert not taken.manual


def test_a_failure_is_no_measurement():
    with pytest.raises(InputError, match="has no estimate: too few"):
        measurement(failed(PAIR, "m", Reason.TOO_FEW_POINTS, "too few"), level=False)
