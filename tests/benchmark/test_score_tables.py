from dataclasses import replace

import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.evaluation import SPLIT_KEY, TRAINING_KEY
from nss_ros.benchmark.published import PublishedTraining, published
from nss_ros.benchmark.score import score_log
from nss_ros.benchmark.table import (
    log_tables,
    multiway_table,
    notes,
    pairwise_table,
    run_names,
    run_tables,
    training_table,
)
from nss_ros.multiway.pose_graph import doubtful_sentence

NONE = Bootstrap(0)


@pytest.fixture
def make_score(make_run):
    def make(name="run", split="", training="", **changes):
        metadata = {SPLIT_KEY: split, TRAINING_KEY: training}
        return score_log(make_run(name, metadata=metadata, **changes), NONE)

    return make


def column(table, heading):
    names = [each.name for each in table.columns]
    return [row[names.index(heading)] for row in table.rows]


def test_published_figures_are_those_whose_source_is_known():
    figures = {(p.method, p.split): (p.same_stage, p.different_stage) for p in published().pairwise}
    assert figures == {
        ("best of five", "cross_area"): (80.5, 11.6),
        ("FPFH", "cross_area"): (32.9, 1.1),
    }
    assert "2311.09346" in published().source


def test_the_pairwise_table_has_splits_methods_and_the_paper(make_score):
    scores = [make_score("a", "cross_stage"), make_score("b", "cross_area", wrong=(0, 1, 2))]
    table = pairwise_table(scores)
    assert column(table, "split") == ["cross_area", "cross_area", "cross_area", "cross_stage"]
    assert column(table, "method") == ["test", "best of five *", "FPFH *", "test"]
    assert column(table, "recall, all")[0] == pytest.approx(80)
    assert column(table, "recall, different")[1:3] == [11.6, 1.1]
    assert "on other data" in table.caption


def test_the_multiway_table_has_the_transforms_once_and_then_each_synchronizer(make_score):
    first = make_score()
    scores = [first, replace(first, synchronizer="other")]
    table = multiway_table(scores)
    assert column(table, "multi-way") == ["-", "truth", "other"]
    assert column(table, "RMSE^G")[0] is None
    assert column(table, "RMSE^G")[1] == first.overall.map.global_rmse
    assert column(table, "RMSE^P")[0] == first.overall.pairwise.all.rmse
    without = make_score(pose_graph=None)
    assert column(multiway_table([without]), "multi-way") == ["-"]


def test_the_training_table_puts_same_stage_training_beside_the_other(make_score):
    scores = [
        make_score("a", "cross_area", "same_stage"),
        make_score("b", "cross_area", "all"),
        make_score("c"),
    ]
    table = training_table(scores)
    assert column(table, "trained on") == ["all", "same stage"]
    assert column(table, "method") == ["test", "test"]
    assert column(table, "RTE, same")[1] == scores[0].overall.pairwise.same_stage.rte
    assert "training" in run_tables(scores)
    assert "training" not in run_tables(scores[2:] * 2)
    assert "training" not in log_tables(scores[2])
    (row,) = log_tables(scores[0])["training"].rows
    assert row[:3] == ("cross_area", "test", "same stage")
    # A run of the same split and method that tells nothing is shown, too.
    silent = training_table([scores[0], make_score("d", "cross_area")])
    assert column(silent, "trained on") == ["not told", "same stage"]


def test_the_training_table_says_that_the_papers_figures_are_not_at_hand(make_score, monkeypatch):
    scores = [make_score("a", "cross_area", "same_stage")]
    assert "not at hand" in training_table(scores).caption
    values = {"split": "cross_area", "method": "X", "same_stage": 70, "different_stage": 3}
    entry = PublishedTraining.model_validate(values | {"training": "same_stage"})
    with_entry = published().model_copy(update={"training": (entry,)})
    monkeypatch.setattr("nss_ros.benchmark.table.published", lambda: with_entry)
    table = training_table(scores)
    assert column(table, "method") == ["test", "X *"]
    assert column(table, "recall, different")[1] == 3
    assert "on other data" in table.caption


def test_training_tells_runs_of_one_method_apart(make_score):
    scores = [make_score("a", "x", "same_stage"), make_score("b", "x", "all")]
    names = ["test, trained on same stage", "test, trained on all"]
    assert run_names(scores) == names
    assert column(pairwise_table(scores), "method")[-2:] == names


def test_a_map_in_parts_is_told_everywhere(make_run, cut):
    score = score_log(cut(make_run(), 4, 6), NONE)
    (sentence,) = notes(score)
    assert "2 components" in sentence
    assert "main component: 4 of 6 fragments; in the others: 2; in none: 0" in sentence
    assert "(46.7 %; in the main component alone 40.0 %)" in sentence
    tables = log_tables(score)
    assert column(tables["map"], "in main component") == [4]
    assert column(tables["map"], "in others") == [2]
    assert column(tables["multiway"], "recall 0.2 m")[0] == pytest.approx(100 * 7 / 15)
    table = multiway_table([score])
    assert column(table, "components") == [None, 2]
    assert column(table, "recall, main") == [None, pytest.approx(40)]


def test_runs_are_named_by_method_as_long_as_that_tells_them_apart(make_score):
    assert run_names([make_score("logs/a", "x"), make_score("b", "y")]) == ["test", "test"]
    assert run_names([make_score("logs/a"), make_score("b")]) == ["a", "b"]


def test_tables_of_all_kinds_of_logs_render(make_score):
    scores = [
        make_score("whole", wrong=(3,)),
        make_score("no_map", pose_graph=None, partial=True),
        make_score("no_points", fragments={}),
        make_score("no_answers", relative_transforms={}),
    ]
    for tables in (*(log_tables(score) for score in scores), run_tables(scores)):
        for table in tables.values():
            assert table.rows
            headings = [each.heading for each in table.columns]
            assert len(set(headings)) == len(headings)
            for text in (table.to_markdown(), table.to_csv(), table.to_latex()):
                assert "nan" not in text
    assert set(log_tables(scores[1])) == {
        "pairwise", "overlap_bins", "change_bins", "overlap", "calibration", "paper",
        "reliability", "intervals",
    }  # fmt: skip


def test_doubtful_places_are_told(make_run):
    log = make_run()
    nodes = tuple(replace(n, doubtful=i in (1, 4)) for i, n in enumerate(log.pose_graph.nodes))
    score = score_log(replace(log, pose_graph=replace(log.pose_graph, nodes=nodes)), NONE)
    ids = [str(nodes[i].id) for i in (1, 4)]
    assert list(score.doubtful) == ids
    assert notes(score) == [
        f"Placed by little that was seen, so perhaps wrongly: {', '.join(ids)}."
    ]
    assert doubtful_sentence([f"f{n}" for n in range(14)]).endswith("f10, f11 and 2 more.")


def test_what_is_missing_is_told(make_score, make_run):
    whole = make_score()
    assert notes(whole) == []
    log = make_run(pose_graph=None, partial=True, fragments={})
    answers = dict(list(log.relative_transforms.items())[:9])
    remarks = " ".join(notes(score_log(replace(log, relative_transforms=answers), NONE)))
    for words in ("truncated", "6 of 15 pairs have no answer", "no point clouds", "no map"):
        assert words in remarks
