import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from nss_ros.config import PairConfig, SplitConfig
from nss_ros.dataset.pairs import read_pairs
from nss_ros.dataset.selection import select_pairs
from nss_ros.dataset.splits import Split, split_pairs, write_split
from nss_ros.errors import FormatError, InputError

CONFIG = SplitConfig()
CHALLENGE = SplitConfig(validation_areas=("3",), test_areas=("4", "5"))


def names(sets):
    return {name: {str(pair) for pair in pairs.pairs} for name, pairs in sets.items()}


def areas(pairs):
    return {id_.area for id_ in (*pairs.source, *pairs.target)}


def stages(pairs):
    return {(id_.area, id_.stage) for id_ in (*pairs.source, *pairs.target)}


@pytest.mark.parametrize("split", Split)
def test_no_pair_is_in_two_sets_and_none_is_invented(building, split):
    found = names(split_pairs(building.pairs, split, CONFIG, 0))
    assert list(found) == ["train", "val", "test"]
    assert all(found.values())
    assert sum(map(len, found.values())) == len(set.union(*found.values()))
    everything = {str(pair) for pair in building.pairs.pairs}
    assert set.union(*found.values()) <= everything
    if split is not Split.CROSS_STAGE:
        assert set.union(*found.values()) == everything


@settings(max_examples=10)
@given(st.integers(0, 1000), st.sampled_from(Split))
def test_neither_the_order_nor_other_pairs_matter(building, seed, split):
    whole = names(split_pairs(building.pairs, split, CONFIG, seed))
    rng = np.random.default_rng(seed)
    some = rng.permutation(len(building.pairs))[: len(building.pairs) // 2]
    part = building.pairs.take(some)
    kept = {str(pair) for pair in part.pairs}
    for name, found in names(split_pairs(part, split, CONFIG, seed)).items():
        assert found == whole[name] & kept


def test_original_draws_by_its_shares(building):
    sets = split_pairs(building.pairs, Split.ORIGINAL, CONFIG, 3)
    shares = [len(pairs) / len(building.pairs) for pairs in sets.values()]
    np.testing.assert_allclose(shares, (0.7, 0.1, 0.2), atol=0.03)
    assert names(sets) != names(split_pairs(building.pairs, Split.ORIGINAL, CONFIG, 4))


def test_original_by_fragments_shares_no_fragment(building):
    sets = split_pairs(building.pairs, Split.ORIGINAL, SplitConfig(original_by="fragments"), 0)
    members = [{*pairs.source, *pairs.target} for pairs in sets.values()]
    assert sum(map(len, members)) == len(set.union(*members))


def test_cross_area_is_the_papers_with_validation_from_training_areas(make_building):
    pairs = make_building(areas="123456", stages=1, spots=8).pairs
    sets = split_pairs(pairs, Split.CROSS_AREA, CONFIG, 0)
    assert areas(sets["train"]) == {"1", "2", "6"}
    assert areas(sets["val"]) <= {"1", "2", "6"}
    assert areas(sets["test"]) == {"3", "4", "5"}
    sets = split_pairs(pairs, Split.CROSS_AREA, CHALLENGE, 0)
    assert [areas(found) for found in sets.values()] == [{"1", "2", "6"}, {"3"}, {"4", "5"}]


@pytest.mark.parametrize(
    ("there", "train", "test"),
    [
        ("ABCDEF", "ABF", "CDE"),
        (("1", "3", "7"), "17", "3"),  # not named: trains
        (("2", "10", "11"), ("2",), ("10", "11")),  # none tests: halves in natural order
        (("3", "4"), "3", "4"),  # none trains
        (("lobby", "attic"), ("attic",), ("lobby",)),
    ],
)
def test_areas_that_are_not_named(make_building, there, train, test):
    pairs = make_building(areas=tuple(there), stages=1, spots=8).pairs
    sets = split_pairs(pairs, Split.CROSS_AREA, CONFIG, 0)
    assert areas(sets["train"]) | areas(sets["val"]) == set(train)
    assert areas(sets["test"]) == set(test)


@pytest.mark.parametrize(("count", "trains"), [(2, 1), (3, 1), (4, 2), (5, 2)])
def test_cross_stage_trains_on_the_first_half(make_building, count, trains):
    pairs = make_building(areas=("1",), stages=count, spots=8, size=6).pairs
    sets = split_pairs(pairs, Split.CROSS_STAGE, CONFIG, 0)
    assert stages(sets["train"]) == {("1", stage) for stage in range(1, trains + 1)}
    assert stages(sets["val"]) <= stages(sets["train"])
    assert stages(sets["test"]) == {("1", stage) for stage in range(trains + 1, count + 1)}


def test_what_cannot_be_divided_is_said(make_building):
    pairs = make_building(areas=("1",), stages=1, spots=8).pairs
    with pytest.raises(InputError, match="cross_area needs two areas"):
        split_pairs(pairs, Split.CROSS_AREA, CONFIG, 0)
    with pytest.raises(InputError, match="cross_stage needs an area with two stages"):
        split_pairs(pairs, Split.CROSS_STAGE, CONFIG, 0)


def test_an_area_of_one_stage_trains(make_building):
    pairs = make_building(areas=("1", "2"), stages=2, spots=8, size=6).pairs
    first = np.array([not (i.area == "2" and 2 in {i.stage, j.stage})
                      for i, j in zip(pairs.source, pairs.target, strict=True)])  # fmt: skip
    sets = split_pairs(pairs.take(first), Split.CROSS_STAGE, CONFIG, 0)
    assert ("2", 1) in stages(sets["train"])
    assert stages(sets["test"]) == {("1", 2)}


def test_the_settings_must_be_possible():
    with pytest.raises(ValidationError, match="area '3' is named twice"):
        SplitConfig(train_areas=("3",))
    with pytest.raises(ValidationError, match="must not be more than 1 together"):
        SplitConfig(train_share=0.95)


def test_selected_pairs_are_written(building, tmp_path):
    pairs = select_pairs(building.pairs, PairConfig(), 0)
    sets = split_pairs(pairs, Split.CROSS_AREA, CONFIG, 0)
    write_split(tmp_path / "splits" / "cross_area", sets)
    for name, found in sets.items():
        read = read_pairs(tmp_path / "splits" / "cross_area" / f"{name}.csv")
        assert read.selected.all()
        assert read.pairs == found.take(found.selected).pairs
    (tmp_path / "file").touch()
    with pytest.raises(FormatError, match="Cannot make the folder"):
        write_split(tmp_path / "file" / "cross_area", sets)
