import pytest
from hypothesis import given
from hypothesis import strategies as st

from nss_ros.benchmark.gate import COUNTS, parse_gate
from nss_ros.benchmark.headline import FIGURES
from nss_ros.errors import InputError

NAMES = (*FIGURES, *COUNTS, "delta_recall_all")


def fails(text, **values):
    return parse_gate(text, NAMES).fails(values, "run")


@given(st.floats(0, 9), st.floats(0, 9))
def test_all_operators(value, limit):
    expected = {
        "<": value < limit, "<=": value <= limit, ">": value > limit, ">=": value >= limit,
        "==": value == limit, "!=": value != limit,
    }  # fmt: skip
    for operator, result in expected.items():
        assert fails(f"global_rmse {operator} {limit!r}", global_rmse=value) is result


def test_shares_as_fractions_or_percent():
    for text in ("recall_different_stage < 0.9", "recall_different_stage<90%",
                 " recall_different_stage < 9e-1 "):  # fmt: skip
        assert fails(text, recall_different_stage=89.9)
        assert not fails(text, recall_different_stage=90.0)
    assert fails("overlap_auroc < 80 %", overlap_auroc=0.79)
    assert fails("delta_recall_all < -.02", delta_recall_all=-2.5)


def test_units_and_counts():
    assert fails("global_rmse >= 1.5", global_rmse=1.5)
    assert not fails("failed > 10", failed=10)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("recall_all < 90", "a share of 0 to 1, with 90: write 0.9 or 90 %"),
        ("global_rmse > 5 %", "is no share"),
        ("recall < 0.9", "names no figure .* recall_all, "),
        ("recall_all 0.9", "is not a gate"),
        ("recall_all < 0.9 or 1", "is not a gate"),
        ("recall_all < __import__('os')", "is not a gate"),
        ("", "is not a gate"),
        ("recall_all = 0.9", "is not a gate"),
        ("recall_all < nan", "is not a gate"),
    ],
)
def test_what_is_no_gate_says_so(text, problem):
    with pytest.raises(InputError, match=problem):
        parse_gate(text, NAMES)


def test_a_figure_that_a_run_lacks_is_no_success():
    for values in ({}, {"recall_all": float("nan")}):
        with pytest.raises(InputError, match="run has no recall_all"):
            fails("recall_all < 0.9", **values)
