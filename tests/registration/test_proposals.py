"""Which pairs are worth registering, by the evidence of all."""

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from nss_ros.fragment import FragmentId, FragmentPair
from nss_ros.registration.gravity.proposals import proposed_pairs

IDS = [FragmentId("1", stage, spot) for stage in (1, 2) for spot in range(6)]
PAIRS = [FragmentPair(a, b) for a, b in combinations(IDS, 2)]


@given(
    st.lists(st.floats(-50, 50), min_size=len(PAIRS), max_size=len(PAIRS)),
    st.integers(0, 3),
    st.integers(0, 3),
)
def test_each_fragment_gets_its_best_pairs_and_the_number_grows_with_the_fragments(
    values, within, across
):
    evidence = dict(zip(PAIRS, values, strict=True))
    chosen = proposed_pairs(evidence, within, across)
    assert chosen == sorted(set(chosen))
    assert len(chosen) <= len(IDS) * (within + across)
    for id_ in IDS:
        for same, most in ((True, within), (False, across)):
            own = [p for p in PAIRS if id_ in (p.source, p.target) and p.same_stage == same]
            best = sorted(own, key=lambda p: (-evidence[p], p))[:most]
            assert set(best) <= set(chosen)


def test_only_those_that_ask_get_pairs():
    evidence = {pair: float(number % 7) for number, pair in enumerate(PAIRS)}
    chosen = proposed_pairs(evidence, 2, 2, {IDS[0]})
    assert len(chosen) == 4
    assert all(IDS[0] in (pair.source, pair.target) for pair in chosen)


def test_the_order_of_the_evidence_does_not_matter():
    evidence = {pair: float(number % 7) for number, pair in enumerate(PAIRS)}
    backward = dict(reversed(evidence.items()))
    assert proposed_pairs(evidence, 2, 1) == proposed_pairs(backward, 2, 1)
