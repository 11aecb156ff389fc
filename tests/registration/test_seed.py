import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.errors import InputError
from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.registration.seed import pair_seed, shard_of

ids = st.builds(FragmentId, st.sampled_from("ABC"), st.integers(0, 5), st.integers(0, 99))
pairs = st.builds(FragmentPair, ids, ids)
PAIR = FragmentPair(FragmentId("1", 1, 2), FragmentId("1", 2, 3))


def test_a_seed_is_the_same_in_every_process():
    code = (
        "from nss_ros.fragment import *; from nss_ros.registration.seed import *;"
        "p = FragmentPair(FragmentId('1', 1, 2), FragmentId('1', 2, 3));"
        "print(pair_seed(p, 7), shard_of(p, 5))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONHASHSEED": "123", "PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert printed.stdout.split() == [str(pair_seed(PAIR, 7)), str(shard_of(PAIR, 5))]


def test_seeds_depend_on_direction_and_on_the_configured_seed():
    back = FragmentPair(PAIR.target, PAIR.source)
    assert len({pair_seed(PAIR), pair_seed(back), pair_seed(PAIR, 1)}) == 3


@given(pairs, st.integers(1, 20))
def test_every_pair_has_one_shard(pair, count):
    assert 0 <= shard_of(pair, count) < count


def test_shards_are_about_equal():
    spots = [FragmentId("1", 1, spot) for spot in range(40)]
    shards = [shard_of(FragmentPair(a, b), 4) for a in spots for b in spots if a != b]
    assert min(shards.count(i) for i in range(4)) > len(shards) / 4 * 0.8


def test_no_shards_is_an_error():
    with pytest.raises(InputError, match="one or more"):
        shard_of(PAIR, 0)
