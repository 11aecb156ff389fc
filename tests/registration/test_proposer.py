"""Pairs for fragments that nobody asks for, by real workers on a part of the bundled bag."""

import pickle
import threading
import time
from pathlib import Path

import pytest

from nss_ros.bag import read_log
from nss_ros.config import ProposalConfig, RegistrationConfig
from nss_ros.errors import RunError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.registration.gravity.evidence import pair_evidence, sketch
from nss_ros.registration.gravity.proposals import proposed_pairs
from nss_ros.registration.proposer import Proposer

CONFIG = RegistrationConfig()
BAG = Path(__file__).parents[2] / "bags" / "three_stages"
QUIET = 100.0


@pytest.fixture(scope="module")
def fragments():
    return [each for each in read_log(BAG).fragments.values() if each.id.spot <= 3][:6]


@pytest.fixture
def proposer():
    made = Proposer(ProposalConfig(within=1, across=1), CONFIG, workers=1)
    yield made
    made.close()


@pytest.fixture
def add(proposer, tmp_path):
    def add_fragment(fragment):
        file = tmp_path / f"{fragment.id}.fragment"
        file.write_bytes(pickle.dumps(fragment))
        proposer.add_fragment(fragment.id, file)

    return add_fragment


def one_round(proposer):
    deadline = time.monotonic() + 120
    while proposer.undecided:
        assert time.monotonic() < deadline
        pairs = proposer.poll(QUIET)
        if pairs:
            return pairs
        time.sleep(0.05)
    return []


def test_a_round_gives_the_pairs_with_the_most_evidence(proposer, add, fragments):
    for each in fragments:
        add(each)
    assert proposer.undecided == len(fragments)
    found = one_round(proposer)
    sketches = sorted((sketch(each, CONFIG) for each in fragments), key=lambda each: each.id)
    every = [(a, b) for n, a in enumerate(sketches) for b in sketches[n + 1 :]]
    assert found == proposed_pairs(pair_evidence(every), 1, 1)
    assert proposer.proposed == len(found)
    assert proposer.undecided == 0


def test_a_fragment_counts_as_decided_only_when_its_pairs_are_counted(proposer, add, fragments):
    """Who watches a run takes it for done otherwise."""
    seen = set()
    ended = threading.Event()

    def watch():
        while not ended.is_set():
            undecided = proposer.undecided
            seen.add((undecided, proposer.proposed))

    for each in fragments:
        add(each)
    watcher = threading.Thread(target=watch)
    watcher.start()
    pairs = one_round(proposer)
    ended.set()
    watcher.join()
    assert (len(fragments), 0) in seen
    assert {proposed for undecided, proposed in seen if undecided == 0} <= {len(pairs)}


def test_a_later_fragment_gets_pairs_of_its_own_and_no_others(proposer, add, fragments):
    *earlier, late = fragments
    for each in earlier:
        add(each)
    first = one_round(proposer)
    for pair in first:
        proposer.add_pair(pair)  # as the node hears what it asked for
    add(late)
    second = one_round(proposer)
    assert 1 <= len(second) <= 2
    assert all(late.id in (pair.source, pair.target) for pair in second)
    assert not set(first) & set(second)


def test_nothing_is_proposed_before_it_is_quiet(proposer, add, fragments):
    for each in fragments[:2]:
        add(each)
    for _ in range(3):
        assert proposer.poll(quiet=1.0) == []
    assert proposer.undecided == 2


def test_pairs_of_others_end_it(proposer, add, fragments):
    for each in fragments[:2]:
        add(each)
    proposer.poll(QUIET)
    proposer.add_pair(FragmentPair(fragments[0].id, fragments[1].id))
    assert proposer.undecided == 0
    assert proposer.poll(QUIET) == []


def test_announced_pairs_end_it_too(proposer, add, fragments):
    add(fragments[0])
    proposer.expect_pairs()
    assert proposer.undecided == 0


def test_always_means_beside_the_pairs_of_others(proposer, add, fragments):
    always = ProposalConfig(when="always", within=1, across=0)
    proposer.reconfigure(always, CONFIG, workers=1)
    same = [each for each in fragments if each.id.stage == fragments[0].id.stage]
    for each in same[:2]:
        add(each)
    given = FragmentPair(same[1].id, same[0].id)
    proposer.add_pair(given)
    assert one_round(proposer) == []  # the only pair there is was given, the other way round
    add(same[2])
    assert len(one_round(proposer)) == 1


def test_what_cannot_be_looked_at_is_paired_with_all_of_its_area(proposer, add, fragments):
    hand_held = Fragment(fragments[0].id, fragments[0].points, gravity_aligned=False)
    elsewhere = Fragment(FragmentId("other", 1, 1), fragments[1].points, gravity_aligned=True)
    for each in (hand_held, *fragments[1:4], elsewhere):
        add(each)
    found = one_round(proposer)
    with_it = [pair for pair in found if hand_held.id in (pair.source, pair.target)]
    assert len(with_it) == 3
    assert all(pair.source.area == pair.target.area for pair in found)


def test_a_fragment_alone_is_decided_without_a_pair(proposer, add, fragments):
    add(fragments[0])
    assert one_round(proposer) == []
    assert proposer.undecided == 0


def test_a_dead_process_is_told(proposer, add, fragments):
    for each in fragments[:3]:
        add(each)
    proposer.poll(QUIET)
    for process in list(proposer._pool._processes.values()):
        process.kill()
    with pytest.raises(RunError, match="memory"):
        one_round(proposer)
