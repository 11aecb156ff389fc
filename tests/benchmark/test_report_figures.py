from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from nss_ros.benchmark.bootstrap import Bootstrap
from nss_ros.benchmark.chart import Axis, Chart, Mark, Panel, Series, distribution
from nss_ros.benchmark.chart_drawing import draw
from nss_ros.benchmark.chart_plotly import plotly_figure
from nss_ros.benchmark.figures import (
    error_distributions,
    missing_charts,
    precision_recall,
    recall_by_bin,
    rmse_by_graph_size,
    rmse_change,
    run_charts,
)
from nss_ros.benchmark.map_figures import (
    before_after_figure,
    graph_chart,
    ink_picture,
    map_figure,
    stage_figure,
)
from nss_ros.benchmark.map_model import map_model
from nss_ros.benchmark.map_view import (
    chained_view,
    map_view,
    map_views,
    most_important,
    thinned,
)
from nss_ros.benchmark.run import measured_run
from nss_ros.benchmark.run_timing import RunTiming
from nss_ros.benchmark.timing_chart import timing_chart
from nss_ros.colors import stage_color, stage_hex
from nss_ros.fragment import voxelize
from nss_ros.geometry import exponential, from_yaw
from nss_ros.multiway.pose_graph import EdgeStatus, PoseGraph


def timing_of(log, latency=0.5):
    count = len(log.relative_transforms)
    return RunTiming(
        fragments=np.arange(len(log.fragments), dtype=np.float64),
        requests=np.arange(count, dtype=np.float64),
        pairs=tuple(log.relative_transforms),
        answers=np.arange(count) + latency,
        latency=np.full(count, latency),
        compute_time=np.full(count, latency / 2),
    )


@pytest.fixture
def measured(make_run):
    def make(**changes):
        log = make_run(**changes)
        return measured_run(log, timing_of(log), Bootstrap(0))

    return make


def named(chart, name, panel=0):
    (series,) = [each for each in chart.panels[panel].series if each.name.startswith(name)]
    return series


def test_recall_by_bin_has_the_scores_values(measured):
    run = measured(wrong=(0, 1, 7))
    chart = recall_by_bin(run.score, "overlap")
    bins = [each for each in run.score.overlap_bins if each.edges["same_stage"]]
    series = named(chart, "pairwise, same stage")
    assert series.y.tolist() == [each.pairwise["same_stage"] for each in bins]
    assert series.x == pytest.approx([(each.low + each.high) / 2 for each in bins])
    assert series.mark is Mark.DASHED_POINTS
    assert named(chart, "map, same stage").y.tolist() == [100.0] * len(bins)
    counts = sum(series.y.sum() for series in chart.panels[1].series)
    assert counts == 15


def test_error_distributions_end_at_the_answered_share_and_pass_the_recall(measured):
    run = measured(wrong=(0, 1, 7))
    chart = error_distributions(run.evaluation)
    for kind, name in (("same_stage", "same stage"), ("different_stage", "different stages")):
        series = named(chart, f"pairwise, {name}", panel=1)
        within = series.y[series.x <= 0.2].max()
        assert within == pytest.approx(getattr(run.score.overall.pairwise, kind).recall)
        assert series.y[-1] == pytest.approx(100)


def test_a_distribution_counts_what_never_comes_up():
    x, y = distribution(np.array([3.0, 1.0]), total=4)
    assert x.tolist() == [1, 3]
    assert y.tolist() == [25, 50]


def test_the_change_of_rmse_is_negative_where_the_map_mends_a_pair(measured):
    run = measured(wrong=(0, 1, 7))
    chart = rmse_change(run.evaluation)
    lines = [series for series in chart.panels[0].series if series.name]
    everything = np.concatenate([series.y for series in lines])
    assert len(everything) == 15
    assert (everything < -1).sum() == 3
    assert all((np.diff(series.y) >= 0).all() for series in lines)
    assert rmse_change(measured(pose_graph=None).evaluation) is None


def test_the_precision_recall_curve_is_that_of_the_score(measured):
    run = measured()
    chart = precision_recall(run.score)
    curve = np.array(run.score.overlap.all.curve)
    assert np.column_stack((chart.panels[0].series[0].y, chart.panels[0].series[0].x)) == (
        pytest.approx(curve[:, 1:])
    )


def test_global_rmse_against_the_size_takes_several_graphs(measured):
    one, other = measured(name="a"), measured(name="b", noise=0.02, seed=1)
    assert rmse_by_graph_size([one.score]) is None
    chart = rmse_by_graph_size([one.score, other.score])
    assert [series.name for series in chart.panels[0].series] == ["a", "b"]
    assert named(chart, "b").y[0] == pytest.approx(other.score.overall.map.global_rmse)
    assert named(chart, "b").x.tolist() == [6]


def test_timing_tells_of_requests_that_were_not_heard_in_time(make_run):
    log = make_run()
    times = timing_of(log)
    times.latency[:3] = np.nan
    chart = timing_chart(times)
    assert "Of 3 answers" in chart.caption
    assert len(named(chart, "request to answer", panel=2).x) == 12
    throughput = chart.panels[1].series[0]
    assert (throughput.y * throughput.width / 0.92).sum() == pytest.approx(15)


def test_every_chart_can_be_drawn_by_both(measured):
    charts = run_charts(measured(wrong=(3,)))
    assert set(charts) == {
        "recall_by_overlap", "recall_by_change", "error_distributions", "rmse_change",
        "precision_recall", "reliability", "timing",
    }  # fmt: skip
    for chart in charts.values():
        figure = draw(chart)
        assert len(figure.axes) == len(chart.panels)
        for axes, panel in zip(figure.axes, chart.panels, strict=True):
            assert axes.get_xlabel() == panel.x.label
            plot = plotly_figure(panel)
            assert len(plot["data"]) == len(panel.series)
            assert plot["layout"]["xaxis"]["title"]["text"] == panel.x.label


def test_numbers_for_plotly_are_finite_or_none():
    series = Series("a", np.array([1.0, np.nan, 1 / 3]), np.array([1.0, 2.0, np.inf]), "#000000")
    panel = Panel(Axis("x", 0.01, 100, log=True), Axis("y"), (series,))
    plot = plotly_figure(panel)
    assert plot["data"][0]["x"] == [1.0, None, 0.33333]
    assert plot["data"][0]["y"] == [1.0, 2.0, None]
    assert plot["layout"]["xaxis"]["range"] == [-2, 2]


def test_a_legend_has_each_name_once():
    points = np.zeros(1)
    series = [Series(name, points, points, "#000000") for name in ("a", "b", "")]
    panel = Panel(Axis("x"), Axis("y"), tuple(series))
    assert [each.name for each in Chart("t", (panel, panel)).legend()] == ["a", "b"]


def test_what_is_missing_is_said(measured, make_run):
    assert missing_charts(measured()) == []
    truth = make_run().ground_truth[0]
    bare = replace(
        truth,
        edges=tuple(replace(e, overlap_ratio=np.nan, temporal_change=np.nan) for e in truth.edges),
    )
    told = " ".join(missing_charts(measured(ground_truth=(bare,), fragments={})))
    assert "no overlap ratios" in told
    assert "takes a map and point clouds" in told


def test_a_view_lies_in_the_frame_of_the_truth_with_walls_along_the_axes(make_run):
    log = make_run(noise=0.0)
    moved = from_yaw(0.7, (5, -3, 1))
    nodes = tuple(replace(n, T_map_fragment=moved @ n.T_map_fragment) for n in log.pose_graph.nodes)
    graph = replace(log.pose_graph, nodes=nodes)
    for truth in (log.ground_truth, ()):
        (view,) = map_views(replace(log, pose_graph=graph, ground_truth=truth))
        assert list(view.points) == view.stages == [1, 2]
        points = np.concatenate(list(view.points.values()))
        low, high = np.percentile(points, (1, 99), axis=0)
        extent = high - low
        assert sorted(extent[:2]) == pytest.approx([5, 6], abs=0.25)
        assert extent[2] == pytest.approx(2.8, abs=0.2)
        assert len(view.gaps) == (6 if truth else 0)
        assert (view.gaps < 1e-6).all()
    assert view.floor() == pytest.approx(low[2], abs=0.15)


def test_a_tilted_map_of_fragments_that_are_not_levelled_is_stood_up(make_run):
    log = make_run(noise=0.0)
    tilt = exponential([0, 0, 0, 0.6, 0.3, 0.2])
    nodes = tuple(replace(n, T_map_fragment=tilt @ n.T_map_fragment) for n in log.pose_graph.nodes)
    fragments = {id_: replace(f, gravity_aligned=False) for id_, f in log.fragments.items()}
    (view,) = map_views(
        replace(
            log,
            pose_graph=replace(log.pose_graph, nodes=nodes),
            ground_truth=(),
            fragments=fragments,
        )
    )
    points = np.concatenate(list(view.points.values()))
    assert np.ptp(np.percentile(points[:, 2], (1, 99))) == pytest.approx(2.8, abs=0.3)
    assert not view.level


def test_the_chained_view_is_worse_where_answers_are(make_run):
    log = make_run(wrong=(0, 1, 2, 3, 4))
    (view,) = map_views(log)
    before = chained_view(log, view)
    assert before.spots.keys() == view.spots.keys()
    assert view.gaps.max() < 0.1
    assert before.gaps[0] > 1  # all its answers are wrong
    assert before.gaps[1:].max() < 0.1
    answers = {
        pair: answer
        for pair, answer in log.relative_transforms.items()
        if log.pairs[0].target not in (pair.source, pair.target)
    }
    assert chained_view(replace(log, relative_transforms=answers), view) is None


def test_the_section_passes_spots_but_never_misses_the_points(make_run):
    (view,) = map_views(make_run())
    y = [spot[1] for spot in view.spots.values()]
    assert min(y) <= view.middle() <= max(y)
    outside = {id_: spot + np.array((0, 100, 0)) for id_, spot in view.spots.items()}
    points = np.concatenate(list(view.points.values()))
    assert replace(view, spots=outside).middle() == pytest.approx(np.median(points[:, 1]), abs=0.2)


def test_a_torn_map_is_shown_with_its_largest_part_in_place(make_run):
    log = make_run(noise=0.0)
    nodes = tuple(
        replace(n, T_map_fragment=exponential([4, 1, 0, 0, 0, 1]) @ n.T_map_fragment)
        if i < 2
        else n
        for i, n in enumerate(log.pose_graph.nodes)
    )
    (view,) = map_views(replace(log, pose_graph=replace(log.pose_graph, nodes=nodes)))
    assert (view.gaps[:2] > 1).all()
    assert (view.gaps[2:] < 1e-6).all()


def test_a_view_without_points_still_has_spots(make_run):
    (view,) = map_views(make_run(fragments={}))
    assert view.points == {}
    assert len(view.spots) == 6
    assert map_views(make_run(pose_graph=None)) == []


def test_views_are_one_for_each_area(make_run):
    log = make_run()
    nodes = log.pose_graph.nodes
    other = tuple(replace(n, id=replace(n.id, area="2"), component=1) for n in nodes)
    graph = PoseGraph((*nodes, *other), log.pose_graph.edges)
    assert [view.area for view in map_views(replace(log, pose_graph=graph))] == ["1", "2"]


def test_views_are_one_for_each_component(make_run, cut):
    log = cut(make_run(noise=0.0), 2, 6)
    views = map_views(log)
    assert [(view.part, view.parts, len(view.spots)) for view in views] == [(1, 2, 4), (2, 2, 2)]
    assert [view.title for view in views] == [
        "Area 1, component 1 of 2 (4 fragments)", "Area 1, component 2 of 2 (2 fragments)",
    ]  # fmt: skip
    assert [view.key for view in views] == ["1_component1", "1_component2"]
    # Each lies in the true frame by itself, though the map has them 50 m apart.
    assert all((view.gaps < 1e-6).all() for view in views)
    chart = graph_chart(log.pose_graph, views[1], {})
    assert chart.title.endswith("area 1, component 2 of 2, in plan")
    assert [each.name for each in chart.legend()] == ["edge accepted (1)", "stage 1 (2)"]


def test_of_many_views_each_areas_largest_are_kept_first(make_run):
    (view,) = map_views(make_run())
    spots = list(view.spots.items())
    sizes = {("1", 1): 6, ("1", 2): 5, ("1", 3): 2, ("2", 1): 3, ("2", 2): 2}
    views = [
        replace(view, area=area, part=part, parts=3, spots=dict(spots[:size]))
        for (area, part), size in sizes.items()
    ]
    kept = most_important(views, 3)
    assert [(each.area, each.part) for each in kept] == [("1", 1), ("1", 2), ("2", 1)]
    assert most_important(views, 9) == views


def test_the_graph_chart_rings_doubtful_places(make_run):
    log = make_run()
    first, *others = log.pose_graph.nodes
    graph = replace(log.pose_graph, nodes=(replace(first, doubtful=True), *others))
    (view,) = map_views(replace(log, pose_graph=graph))
    (ring,) = (s for s in graph_chart(graph, view, {}).panels[0].series if s.hollow)
    assert ring.name == "place doubtful (1)"
    assert (ring.x[0], ring.y[0]) == tuple(view.spots[first.id][:2])


def test_the_graph_chart_has_stages_and_edges_that_lead_to_their_pairs(make_run):
    log = make_run()
    edges = list(log.pose_graph.edges)
    edges[0] = replace(edges[0], status=EdgeStatus.REJECTED, reason="contradicts the others")
    graph = replace(log.pose_graph, edges=tuple(edges))
    (view,) = map_views(replace(log, pose_graph=graph))
    chart = graph_chart(graph, view, {edges[0].pair: "r0-p1"})
    names = [series.name for series in chart.legend()]
    assert names == ["edge rejected (1)", "edge accepted (14)", "stage 1 (3)", "stage 2 (3)"]
    (rejected,) = [s for s in chart.panels[0].series if s.links and "rejected" in s.hover[0]]
    assert rejected.links == ("r0-p1",)
    assert "contradicts" in rejected.hover[0]
    assert str(edges[0].pair.source) in rejected.hover[0]


def test_pictures_of_the_map_have_axes_in_metres(make_run):
    log = make_run()
    (view,) = map_views(log)
    before = map_view(log, {n.id: n.T_map_fragment for n in log.pose_graph.nodes}, view)
    for figure, axes in (
        (map_figure(view), 2),
        (stage_figure(view), 4),
        (before_after_figure(before, view), 4),
    ):
        assert len(figure.axes) == axes
        labels = {each.get_xlabel() for each in figure.axes} | {
            each.get_ylabel() for each in figure.axes
        }
        assert {"x (m)", "y (m)", "z (m)"} <= labels


def test_stages_have_the_colours_that_viewers_give_them(make_run):
    log = make_run()
    (view,) = map_views(log)
    series = {each.name: each for each in graph_chart(log.pose_graph, view, {}).panels[0].series}
    for stage, model in zip((1, 2), map_model(view, 1000)["stages"], strict=True):
        assert model["colour"] == series[f"stage {stage} (3)"].colour == stage_hex(stage)
        assert to_rgb(stage_hex(stage)) == pytest.approx(stage_color(stage))


def test_inks_mix_and_hide_nothing():
    point = np.array([[0.5, 0.5]])
    extent = (0.0, 1.0, 0.0, 1.0)
    both = ink_picture({"#ff0000": point, "#0000ff": point}, extent, 10)
    turned = ink_picture({"#0000ff": point, "#ff0000": point}, extent, 10)
    assert both == pytest.approx(turned)
    one = ink_picture({"#ff0000": point}, extent, 10)
    assert both[5, 5].sum() < one[5, 5].sum() < 3
    assert (one[0] == 1).all()


def test_thinning_keeps_the_limit_and_all_stages():
    rng = np.random.default_rng(0)
    points = {s: rng.uniform(0, 3, (20_000, 3)).astype(np.float32) for s in (1, 2)}
    few = thinned(points, 5000)
    assert list(few) == [1, 2]
    assert 1000 < sum(map(len, few.values())) <= 5000
    assert thinned(points, 50_000)[1] is points[1]
    assert len(voxelize(points[1], 0.03)) > len(few[1])
