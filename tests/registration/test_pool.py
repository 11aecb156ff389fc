"""Worker processes, driven through a method that a package of the user's own would add."""

import os
import sys

import pytest

from nss_ros.config import load_config
from nss_ros.errors import MethodError
from nss_ros.fragment import FragmentPair
from nss_ros.registration.method import load_method, method_names
from nss_ros.registration.pool import RegistrationPool
from nss_ros.registration.relative_transform import Reason

_METHOD = '''
import os, signal
from nss_ros.fragment import FragmentPair
from nss_ros.registration.relative_transform import RelativeTransform

class Lethal:
    """Kills the process that registers a source of spot 2."""

    name = "lethal"

    def __init__(self, config):
        pass

    def prepare(self, fragment):
        return fragment.id

    def register(self, source, target, seed):
        if source.spot == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return RelativeTransform(FragmentPair(source, target), self.name, confidence=0.5)
'''


@pytest.fixture
def lethal(tmp_path, monkeypatch):
    """An installed package with an entry point, as README tells users to write one."""
    (tmp_path / "lethal_method.py").write_text(_METHOD)
    metadata = tmp_path / "lethal_method-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lethal-method\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[nss_ros.registration_methods]\nlethal = lethal_method:Lethal\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    yield load_config(None, ["registration.method=lethal"]).registration
    sys.modules.pop("lethal_method", None)


def test_a_package_of_the_users_adds_a_method(lethal):
    assert "lethal" in method_names()
    assert load_method(lethal).name == "lethal"


def test_an_unknown_method_names_the_known_ones():
    config = load_config(None, ["registration.method=magic"]).registration
    with pytest.raises(MethodError, match=r"'magic'.*fpfh_ransac"):
        load_method(config)


def test_a_pair_that_kills_its_workers_is_given_up_and_the_others_are_answered(lethal, room):
    pool = RegistrationPool(lethal, workers=2)
    try:
        for fragment in room.fragments:
            pool.add_fragment(fragment)
        for pair in room.pairs:
            pool.submit(pair)
        answers = {}
        while len(answers) < len(room.pairs):
            for answer in pool.poll(0.1):
                assert answer.pair not in answers
                answers[answer.pair] = answer
    finally:
        pool.close()

    def expected(pair: FragmentPair) -> Reason:
        return Reason.WORKER_DIED if pair.source.spot == 2 else Reason.NONE

    assert {pair: a.reason for pair, a in answers.items()} == {p: expected(p) for p in room.pairs}


def test_pairs_of_one_source_follow_each_other(lethal, room):
    """Whatever their order, since a method may keep what it made of the last source."""
    one, other, *rest = [each for each in room.fragments if each.id.spot != 2]
    pairs = [FragmentPair(source.id, each.id) for each in rest for source in (one, other)]
    assert len(pairs) == 4
    pool = RegistrationPool(lethal, workers=1)
    try:
        for fragment in room.fragments:
            pool.add_fragment(fragment)
        for pair in pairs:
            pool.submit(pair)
        answers = []
        while len(answers) < len(pairs):
            answers.extend(pool.poll(0.1))
    finally:
        pool.close()
    assert [each.pair for each in answers] == [*pairs[0::2], *pairs[1::2]]


def test_what_was_prepared_is_told_once(lethal, room):
    pool = RegistrationPool(lethal, workers=1)
    try:
        for fragment in room.fragments:
            pool.add_fragment(fragment)
        prepared = []
        while len(prepared) < len(room.fragments):
            assert pool.poll(0.1) == []
            prepared += pool.take_prepared()
        assert pool.take_prepared() == []
    finally:
        pool.close()
    assert {each.fragment for each in prepared} == {each.id for each in room.fragments}
    assert not any(each.warning for each in prepared)
