import json
import re
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.headline_cards import cards
from nss_ros.benchmark.map_model import map_model
from nss_ros.benchmark.map_view import map_views
from nss_ros.benchmark.pair_list import pair_chart, pair_table
from nss_ros.benchmark.pair_records import Outcome, pair_records
from nss_ros.benchmark.report import report
from nss_ros.benchmark.run import measured_run
from nss_ros.benchmark.run_facts import facts
from nss_ros.benchmark.run_timing import RunTiming
from nss_ros.benchmark.worst_pairs import pair_figure, worst_pairs
from nss_ros.multiway.pose_graph import NodeStatus, PoseGraph
from nss_ros.registration.relative_transform import Reason, failed

NO_TIMES = RunTiming(*[np.zeros(0)] * 2, (), *[np.zeros(0)] * 3)


@pytest.fixture
def measured(make_run):
    def make(**changes):
        return measured_run(make_run(**changes), NO_TIMES, Bootstrap(20))

    return make


class Page(HTMLParser):
    """Ids, links and texts of a page; scripts and styles apart."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.links, self.sources, self.text, self._skip = [], [], [], "", False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self._skip = tag in ("script", "style")
        if "id" in values:
            self.ids.append(values["id"])
        if tag == "a":
            self.links.append(values["href"])
        self.sources += [values[name] for name in ("src", "href") if name in values]

    def handle_endtag(self, tag):
        self._skip = self._skip and tag not in ("script", "style")

    def handle_data(self, data):
        if not self._skip:
            self.text += data


def data_of(text):
    found = re.search(r'<script type="application/json" id="report-data">(.*?)</script>', text)
    return json.loads(found[1])


def test_the_page_has_all_sections_and_needs_no_other_file(measured):
    text = report([measured(wrong=(0, 5))], worst=1, most_points=5000)
    page = Page(text)
    for name in ("summary", "map", "graph", "accuracy", "worst", "pairs", "run"):
        assert f"r0-{name}" in page.ids
    assert all(source.startswith(("#", "data:")) for source in page.sources)
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))
    assert "Pairwise recall" in page.text
    assert "86.7 %" in page.text
    data = data_of(text)
    assert len(data["maps"]["r0-map0"]["stages"]) == 2
    assert all(f'data-plot="{key}"' in text for key in data["plots"])


def test_names_of_logs_cannot_break_the_page(measured):
    name = '</script><b onclick="x">&'
    run = measured(name=name.replace("/", "|"), metadata={"key": "</script><i>"})
    text = report([run], worst=0, most_points=100)
    assert "<b onclick" not in text
    assert "</script><i>" not in text
    assert '<|script><b onclick="x">&' in Page(text).text


@pytest.mark.parametrize(
    ("changes", "sentence", "sections"),
    [
        ({"ground_truth": ()}, "holds no ground truth", {"map", "graph", "pairs"}),
        ({"fragments": {}}, "no point clouds", {"graph", "accuracy", "pairs"}),
        ({"pose_graph": None}, "holds no map", {"accuracy", "pairs"}),
        ({"relative_transforms": {}}, "15 of 15 pairs have no answer", {"map", "accuracy"}),
        (
            {"relative_transforms": {}, "pose_graph": None},
            "holds no answers",
            {"pairs"},
        ),
        (
            {"ground_truth": (), "relative_transforms": {}, "pose_graph": None, "fragments": {}},
            "holds no ground truth",
            {"pairs"},
        ),
        ({"pose_graph": PoseGraph()}, "The map is empty", {"accuracy", "pairs"}),
    ],
)
def test_what_a_log_lacks_is_said_and_the_rest_is_there(measured, changes, sentence, sections):
    page = Page(report([measured(**changes)], worst=1, most_points=1000))
    assert sentence in page.text
    there = {id_.removeprefix("r0-") for id_ in page.ids}
    assert sections <= there
    everything = {"map", "graph", "accuracy", "pairs"}
    if "fragments" in changes or "pose_graph" in changes:
        assert "map" in everything - there


def test_a_ground_truth_without_edges(measured, make_run):
    truth = replace(make_run().ground_truth[0], edges=())
    page = Page(report([measured(ground_truth=(truth,))], worst=1, most_points=1000))
    assert "no edges" in page.text
    assert "r0-map" in page.ids


def test_a_map_in_components_is_drawn_whole(make_run, cut, monkeypatch):
    log = cut(make_run(), 4, 6)
    graph = log.pose_graph
    lost = replace(graph.nodes[5], status=NodeStatus.UNPLACED)
    graph = replace(graph, nodes=(*graph.nodes[:5], lost))
    run = measured_run(replace(log, pose_graph=graph), NO_TIMES, Bootstrap(20))
    text = report([run], worst=1, most_points=2000)
    page = Page(text)
    names = [model["name"] for model in data_of(text)["maps"].values()]
    assert names == [
        "Area 1, component 1 of 2 (4 fragments)", "Area 1, component 2 of 2 (1 fragment)",
    ]  # fmt: skip
    assert f"{names[0]}: all stages" in page.text
    assert names[1] in page.text
    assert "components that nothing links (area 1 in 2)" in page.text
    assert "1 of 6 fragments are in no component" in page.text

    monkeypatch.setattr("nss_ros.benchmark.report.MOST_VIEWS", 1)
    text = report([run], worst=1, most_points=2000)
    assert len(data_of(text)["maps"]) == 1
    assert "left out: area 1, component 2 of 2 (1 fragment)." in Page(text).text


def test_several_logs_stand_side_by_side(measured):
    runs = [measured(name="one"), measured(name="two", wrong=(1, 2))]
    page = Page(report(runs, worst=1, most_points=2000))
    assert {"together", "r0", "r1", "r0-map", "r1-map"} <= set(page.ids)
    assert "Global RMSE against the size of the graph" in page.text
    assert len(page.ids) == len(set(page.ids))


def test_pairs_are_listed_worst_first(measured, make_run):
    log = make_run(wrong=(4, 9))
    answers = dict(log.relative_transforms)
    answers[log.pairs[2]] = failed(log.pairs[2], "test", Reason.TOO_FEW_INLIERS, "too flat")
    del answers[log.pairs[3]]
    run = measured(wrong=(4, 9), relative_transforms=answers)
    records = pair_records(run.log, run.evaluation)
    assert len(records) == 15
    assert [record.outcome for record in records[:5]] == [
        Outcome.WRONG, Outcome.WRONG, Outcome.FAILED, Outcome.UNANSWERED, Outcome.RIGHT,
    ]  # fmt: skip
    assert records[0].error >= records[1].error > 1
    assert records[2].reason == "too flat"
    assert {record.pair for record in records[:2]} == {log.pairs[4], log.pairs[9]}
    table = pair_table(records[:6], len(records), scored=True)
    assert "The first 6 of 15 pairs" in table.caption
    assert table.rows[0][0] == str(records[0].pair.source)
    assert records[0].confidence == 0.2


def test_the_chart_of_pairs_leads_to_their_rows(measured):
    run = measured(wrong=(4, 9))
    records = pair_records(run.log, run.evaluation)
    chart = pair_chart(records, {records[0].pair: "r0-p1"})
    right, wrong = chart.panels[0].series
    assert (right.name, wrong.name) == ("right (13)", "wrong (2)")
    assert wrong.links[0] == "r0-p1"
    assert str(records[0].pair.target) in wrong.hover[0]
    assert wrong.x[0] == records[0].overlap_ratio
    assert pair_chart(pair_records(run.log, None), {}) is None


def test_pairs_without_ground_truth_are_listed_too(measured):
    run = measured(ground_truth=())
    records = pair_records(run.log, None)
    assert {record.outcome for record in records} == {Outcome.UNKNOWN}
    names = [column.name for column in pair_table(records, 15, scored=False).columns]
    assert "RTE" not in names


def test_worst_pairs_are_wrong_and_each_shown_once(measured):
    run = measured(wrong=(0, 1, 2, 3))
    records = pair_records(run.log, run.evaluation)
    for count in (0, 1, 2, 3, 4, 9):
        worst = worst_pairs(run.log, records, count)
        assert len(worst) == min(count, 4)
        assert len({each.record.pair for each in worst}) == len(worst)
        assert all(each.record.outcome is Outcome.WRONG for each in worst)
    assert worst_pairs(replace(run.log, fragments={}), records, 3) == []
    figure = pair_figure(run.log, run.evaluation, records[0])
    assert [axes.get_title() for axes in figure.axes[:2]] == [
        "Source at the estimate", "Source in truth",
    ]  # fmt: skip
    with pytest.raises(ValueError, match="no edge of the ground truth"):
        pair_figure(run.log, run.evaluation, replace(records[0], edge=None))


def test_the_3d_model_unpacks_to_the_points(make_run):
    (view,) = map_views(make_run())
    model = map_model(view, 4000)
    json.dumps(model)
    total = 0
    for stage in model["stages"]:
        for part in ("below", "above"):
            numbers = np.frombuffer(b64decode(stage[part]), "<u2").reshape(-1, 3)
            points = np.array(model["origin"]) + model["step"] * numbers
            total += len(points)
            if len(points):
                near = np.abs(view.points[stage["stage"]][:, None] - points[:20]).max(axis=2)
                assert near.min(axis=0).max() < 0.3  # a mean of a voxel
                assert ((points[:, 2] > view.slice()[1]) == (part == "above")).mean() > 0.9
        assert len(stage["spots"]) == 3
    assert 500 < total <= 4000


def test_cards_have_what_there_is(measured):
    run = measured(wrong=(0,))
    titles = {card.title: card for card in cards(run.score.headline)}
    first = titles["Pairwise recall"].rows[0]
    assert first.value == "93.3 %"
    assert first.bar[1] <= first.bar[0] <= first.bar[2] <= 100
    assert "Recall of the map" not in {
        card.title for card in cards(measured(pose_graph=None).score.headline)
    }


def test_facts_name_the_run(measured):
    run = measured(metadata={"bag_0": "/data/bag", "bag_0_sha256": "ab", "nss_ros": "1.2"})
    values = dict(facts(run))
    assert values["Log"] == "run"
    assert values["Bag"] == "/data/bag"
    assert values["Fragments"] == "6 in 2 stages"
    assert "15 asked for, 15 answered, 0 failed" in values["Pairs"]


def test_the_page_is_packaged():
    setup = (Path(__file__).parents[2] / "setup.py").read_text()
    assert "benchmark/report_page/*" in setup
