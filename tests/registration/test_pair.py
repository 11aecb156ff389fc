import numpy as np
import pytest

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.registration.fpfh import FpfhRansac
from nss_ros.registration.method import load_method, method_names
from nss_ros.registration.pair import register_pair
from nss_ros.registration.relative_transform import Reason, RelativeTransform
from nss_ros.registration.seed import pair_seed

PAIR = FragmentPair(FragmentId("1", 1, 0), FragmentId("1", 1, 1))
CONFIG = RegistrationConfig(seed=7)


class Plugin:
    """A researcher's method: it notes its seed, or raises what it is told to."""

    name = "plugin"

    def __init__(self, error=None):
        self.error = error
        self.seed = None

    def prepare(self, fragment):
        return fragment

    def register(self, source, target, seed):  # noqa: ARG002
        self.seed = seed
        if self.error is not None:
            raise self.error
        return RelativeTransform(PAIR, self.name, confidence=0.5)


def test_the_seed_is_that_of_the_pair_and_the_time_is_noted():
    plugin = Plugin()
    result = register_pair(plugin, "source", "target", PAIR, CONFIG)
    assert result.ok
    assert result.compute_time > 0
    assert plugin.seed == pair_seed(PAIR, 7)


@pytest.mark.parametrize(
    "error", [ValueError("bad"), MethodError("No weights."), MemoryError(), np.linalg.LinAlgError()]
)
def test_an_error_of_the_method_becomes_an_answer(error):
    result = register_pair(Plugin(error), "source", "target", PAIR, CONFIG)
    assert result.reason is Reason.METHOD_ERROR
    assert result.pair == PAIR
    assert str(error) in result.message
    assert result.message


@pytest.mark.parametrize(
    ("source", "target", "named"),
    [(None, "t", "Spot0"), ("s", None, "Spot1"), (None, None, "Spot0 and Bldg1_Stage1_Spot1")],
)
def test_unknown_fragments_are_named(source, target, named):
    result = register_pair(Plugin(), source, target, PAIR, CONFIG)
    assert result.reason is Reason.UNKNOWN_FRAGMENT
    assert named in result.message


def test_features_of_another_method_are_an_error_of_the_method(scans):
    method = FpfhRansac(CONFIG)
    result = register_pair(method, "not features", method.prepare(scans[0]), PAIR, CONFIG)
    assert result.reason is Reason.METHOD_ERROR
    assert "AttributeError" in result.message


def test_methods_are_found_by_name():
    assert {"fpfh_fgr", "fpfh_ransac"} <= set(method_names())
    for name in ("fpfh_fgr", "fpfh_ransac"):
        assert load_method(RegistrationConfig(method=name)).name == name
    with pytest.raises(MethodError, match="no registration method 'nothing'"):
        load_method(RegistrationConfig(method="nothing"))
