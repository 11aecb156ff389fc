from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nss_ros.bag import Log
from nss_ros.benchmark.challenge import score_challenge
from nss_ros.benchmark.clouds import Clouds
from nss_ros.benchmark.score import score_log
from nss_ros.dataset.challenge import ChallengeGraph
from nss_ros.dataset.submission import submission, template_of
from nss_ros.errors import InputError
from nss_ros.fragment import FragmentPair
from nss_ros.geometry import exponential, inverse
from nss_ros.multiway.pose_graph import EdgeStatus, Node, NodeStatus, PoseGraph
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed

SHIFT = exponential([0.15, 0, 0, 0, 0, 0])  # within 0.2 m, not within 0.1 m


def perfect_log(room, **changes) -> Log:
    """The log of a run that estimates the truth, in a map frame of its own."""
    motion = exponential([3, 2, 1, 0.1, 0.2, 2.0])
    answers = {
        edge.pair: RelativeTransform(edge.pair, "truth", edge.T_target_source)
        for edge in room.ground_truth.edges
    }
    nodes = tuple(
        replace(node, T_map_fragment=motion @ node.T_map_fragment)
        for node in room.ground_truth.nodes
    )
    log = Log(
        path=Path("log"),
        fragments={f.id: replace(f, points=f.points[::20]) for f in room.fragments},
        pairs=tuple(room.pairs),
        relative_transforms=answers,
        ground_truth=(room.ground_truth,),
        pose_graph=PoseGraph(nodes, room.ground_truth.edges, "map", "truth"),
    )
    return replace(log, **changes)


def answers_with(log, **changes):
    """The log's answers, those of the given pair numbers replaced or (None) taken away."""
    answers = dict(log.relative_transforms)
    for name, value in changes.items():
        pair = log.pairs[int(name.removeprefix("pair"))]
        if value is None:
            del answers[pair]
        elif isinstance(value, Reason):
            answers[pair] = failed(pair, "truth", value, "")
        else:
            answers[pair] = replace(answers[pair], T_target_source=value)
    return answers


def drop_fragment(log, index):
    """The map without a fragment: no accepted edge reaches it."""
    gone = log.pose_graph.nodes[index].id
    nodes = tuple(Node(n.id) if n.id == gone else n for n in log.pose_graph.nodes)
    edges = tuple(
        replace(e, status=EdgeStatus.REJECTED) if gone in (e.pair.source, e.pair.target) else e
        for e in log.pose_graph.edges
    )
    return replace(log, pose_graph=PoseGraph(nodes, edges, "map", "truth"))


def test_the_truth_scores_perfectly(room):
    score = score_log(perfect_log(room))
    assert not score.partial
    assert (score.pairs, score.answered, score.failed) == (15, 15, 0)
    overall = score.overall
    for subsets in (overall.pairwise, overall.multiway):
        assert (subsets.all.edges, subsets.same_stage.edges, subsets.different_stage.edges) == (
            15, 6, 9
        )  # fmt: skip
        for edge in (subsets.all, subsets.same_stage, subsets.different_stage):
            assert edge.recall == edge.recall_challenge == 100.0
            assert edge.rte < 1e-9
            assert edge.rre < 1e-5
            assert edge.rmse < 0.1
    assert overall.map.placed == overall.map.fragments == 6
    assert overall.map.components == 1
    assert overall.map.outlier_f1 == overall.map.coverage == 100.0
    assert overall.map.global_rmse < 1e-9
    assert overall.map.official_global_rmse < 1e-9


def test_failed_missing_and_wrong_answers(room):
    log = perfect_log(room)
    right = log.relative_transforms[log.pairs[2]].T_target_source
    answers = answers_with(
        log, pair0=None, pair1=Reason.TOO_FEW_INLIERS, pair2=SHIFT @ right, pair3=np.eye(4)
    )
    score = score_log(replace(log, relative_transforms=answers))
    assert score.partial
    assert not score.truncated
    assert (score.pairs, score.answered, score.failed) == (15, 14, 1)
    edges = score.overall.pairwise.all
    assert (edges.edges, edges.answered) == (15, 13)
    assert edges.recall == pytest.approx(12 / 15 * 100)
    assert edges.recall_challenge == pytest.approx(11 / 15 * 100)
    assert edges.rte == pytest.approx(0.15 / 12)
    wrong = np.linalg.norm(log.ground_truth[0].edges[3].T_target_source[:3, 3])
    assert edges.rte_answered == pytest.approx((0.15 + wrong) / 13)
    assert score.overall.multiway.all.recall == 100.0


def test_an_edge_that_was_registered_in_the_other_direction(room):
    log = perfect_log(room)
    pair = log.pairs[0]
    answers = dict(log.relative_transforms)
    turned = FragmentPair(pair.target, pair.source)
    T = inverse(SHIFT @ answers.pop(pair).T_target_source)
    answers[turned] = RelativeTransform(turned, "truth", T)
    score = score_log(replace(log, relative_transforms=answers, pairs=(turned, *log.pairs[1:])))
    assert not score.partial
    edges = score.overall.pairwise.all
    assert edges.answered == 15
    assert edges.rte_answered == pytest.approx(0.15 / 15)


def test_an_unplaced_fragment_costs_recall_and_coverage(room):
    log = drop_fragment(perfect_log(room), 2)
    score = score_log(log)
    edges = score.overall.multiway.all
    assert (edges.edges, edges.answered) == (15, 10)
    assert edges.recall == pytest.approx(10 / 15 * 100)
    figures = score.overall.map
    assert (figures.placed, figures.fragments) == (5, 6)
    points = [len(fragment.points) for fragment in log.fragments.values()]
    assert figures.coverage == pytest.approx((1 - points[2] / sum(points)) * 100)
    assert figures.global_rmse < 1e-9
    assert figures.official_global_rmse > 0.1


def test_edges_within_any_component_count_and_those_between_are_misses(room, cut):
    score = score_log(cut(perfect_log(room), 4, 6)).overall
    # Of 15 edges 6 are in the component of four fragments, and 1 in that of two.
    assert (score.multiway.all.edges, score.multiway.all.answered) == (15, 7)
    assert score.multiway.all.recall == pytest.approx(7 / 15 * 100)
    assert score.multiway.all.rte < 1e-9
    assert score.multiway.all.rmse < 0.1
    figures = score.map
    assert (figures.placed, figures.placed_elsewhere, figures.fragments) == (4, 2, 6)
    assert (figures.components, figures.component_sizes) == (2, (4, 2))
    assert figures.recall_main == pytest.approx(6 / 15 * 100)
    assert figures.global_rmse < 1e-9
    assert figures.coverage < 100


def test_two_right_halves_are_right_though_nothing_links_them(room, cut):
    """Without ground-truth edges between the halves there is nothing that the map lacks."""
    log = cut(perfect_log(room), 3, 6)
    truth = log.ground_truth[0]
    inside = tuple(edge for edge in truth.edges if edge.pair.same_stage)
    score = score_log(replace(log, ground_truth=(replace(truth, edges=inside),)))
    overall = score.overall
    assert overall.multiway.all.recall == score.headline["multiway_recall_all"].value == 100.0
    assert overall.map.recall_main == score.headline["multiway_recall_main"].value == 50.0
    assert (overall.map.placed, overall.map.placed_elsewhere) == (3, 3)
    assert overall.multiway.all.answered == 6
    assert [b.multiway for b in score.overlap_bins] == []


def test_a_fragment_whose_edges_are_all_rejected_is_in_no_component(room, cut):
    log = cut(perfect_log(room), 5, 6)
    score = score_log(log).overall
    assert (score.map.components, score.map.placed, score.map.placed_elsewhere) == (1, 5, 0)
    assert score.multiway.all.answered == 10
    assert score.map.recall_main == score.multiway.all.recall


def test_a_graph_whose_fragments_hang_together_by_others(room):
    """The map knows their relative pose, though the challenge would not see the link."""
    log = perfect_log(room)
    a, b, c = (node.id for node in log.pose_graph.nodes[:3])
    linked = {frozenset((a, b)), frozenset((b, c))}
    edges = tuple(
        edge
        if frozenset((edge.pair.source, edge.pair.target)) in linked
        else replace(edge, status=EdgeStatus.REJECTED)
        for edge in log.pose_graph.edges
    )
    truth = log.ground_truth[0]
    ends = PoseGraph(
        tuple(n for n in truth.nodes if n.id in (a, c)),
        tuple(e for e in truth.edges if {e.pair.source, e.pair.target} == {a, c}),
        "ends",
    )
    log = replace(log, pose_graph=replace(log.pose_graph, edges=edges), ground_truth=(ends,))
    score = score_log(log).overall
    assert score.multiway.all.recall == 100.0
    assert (score.map.placed, score.map.recall_main) == (0, 0.0)


def test_outliers_of_the_ground_truth(room):
    log = drop_fragment(perfect_log(room), 2)
    truth = log.ground_truth[0]
    gone = truth.nodes[2].id
    nodes = tuple(
        Node(node.id, status=NodeStatus.OUTLIER) if node.id == gone else node
        for node in truth.nodes
    )
    edges = tuple(e for e in truth.edges if gone not in (e.pair.source, e.pair.target))
    score = score_log(replace(log, ground_truth=(PoseGraph(nodes, edges, truth.name),))).overall
    assert score.map.outlier_f1 == 100.0
    assert score.map.coverage == 100.0
    assert score.map.official_global_rmse < 1e-9
    assert score.multiway.all.recall == 100.0


def test_graphs_that_share_fragments_are_micro_averaged(room):
    log = perfect_log(room)
    truth = log.ground_truth[0]
    ids = [node.id for node in truth.nodes[:3]]
    part = PoseGraph(
        truth.nodes[:3],
        tuple(e for e in truth.edges if e.pair.source in ids and e.pair.target in ids),
        "part",
    )
    answers = answers_with(log, pair14=np.eye(4))  # of the last two fragments, not in the part
    score = score_log(replace(log, ground_truth=(truth, part), relative_transforms=answers))
    assert [graph.name for graph in score.graphs] == ["room", "part"]
    assert score.graphs[0].pairwise.all.recall == pytest.approx(14 / 15 * 100)
    assert score.graphs[1].pairwise.all.recall == 100.0
    assert score.overall.pairwise.all.recall == pytest.approx(17 / 18 * 100)
    assert score.overall.map.fragments == 9


def test_without_points_all_but_rmse(room):
    score = score_log(perfect_log(room, fragments={}))
    assert not score.has_points
    assert np.isnan(score.overall.pairwise.all.rmse)
    assert np.isnan(score.overall.map.global_rmse)
    assert np.isnan(score.overall.map.official_global_rmse)
    assert score.overall.map.coverage == 100.0
    assert score.overall.multiway.all.recall == 100.0


def test_a_log_cut_before_its_map(room):
    score = score_log(perfect_log(room, pose_graph=None, partial=True))
    assert score.partial
    assert score.truncated
    assert score.overall.multiway is None
    assert score.overall.map is None
    assert score.overall.pairwise.all.recall == 100.0


def test_a_map_without_placed_fragments(room):
    log = perfect_log(room)
    nodes = tuple(Node(node.id) for node in log.pose_graph.nodes)
    score = score_log(replace(log, pose_graph=PoseGraph(nodes, (), "map", "truth"))).overall
    assert (score.map.placed, score.map.coverage) == (0, 0.0)
    assert np.isnan(score.map.global_rmse)
    assert score.multiway.all.recall == 0.0


def test_what_cannot_be_scored_says_so(room):
    hidden = PoseGraph(tuple(Node(node.id) for node in room.ground_truth.nodes), (), "hidden")
    for truth in ((), (hidden,)):
        with pytest.raises(InputError, match="holds no ground truth"):
            score_log(perfect_log(room, ground_truth=truth))
    with pytest.raises(InputError, match="holds no answers"):
        score_log(perfect_log(room, relative_transforms={}, pose_graph=None))


def test_the_exported_map_has_the_same_official_figures(room):
    """What the log's score says of the map is what the challenge says of its submission."""
    log = drop_fragment(shaken(perfect_log(room)), 0)
    official, ours = official_overall(log), score_log(log).overall
    for subset, edges in (
        ("All", ours.multiway.all),
        ("Same-Stage", ours.multiway.same_stage),
        ("Cross-Stage", ours.multiway.different_stage),
    ):
        assert edges.recall == pytest.approx(official[subset].recall)
        assert edges.rte == pytest.approx(official[subset].translation_error)
        assert edges.rre == pytest.approx(official[subset].rotation_error)
    assert ours.map.recall_main == pytest.approx(official["All"].recall)
    assert ours.map.official_global_rmse == pytest.approx(official["All"].global_rmse)
    assert ours.map.official_global_rmse > ours.map.global_rmse


def test_of_a_map_in_parts_the_challenge_sees_the_main_component(room, cut):
    log = cut(shaken(perfect_log(room)), 4, 6)
    official, ours = official_overall(log)["All"], score_log(log).overall
    assert ours.map.recall_main == pytest.approx(official.recall, abs=1e-6)
    assert ours.map.official_global_rmse == pytest.approx(official.global_rmse, abs=1e-6)
    assert ours.map.outlier_f1 == official.outlier_f1
    assert ours.multiway.all.recall > official.recall


def shaken(log):
    """The log with poses that are off by some centimetres."""
    rng = np.random.default_rng(3)
    nodes = tuple(
        replace(n, T_map_fragment=n.T_map_fragment @ exponential(rng.normal(scale=0.05, size=6)))
        for n in log.pose_graph.nodes
    )
    return replace(log, pose_graph=replace(log.pose_graph, nodes=nodes))


def official_overall(log):
    """The challenge's score of the log's submission, at 0.2 m."""
    truth = log.ground_truth[0]
    template = template_of(truth)
    target = ChallengeGraph(
        template.name,
        tuple(
            replace(node, transform=core.T_map_fragment)
            for node, core in zip(template.nodes, truth.nodes, strict=True)
        ),
        tuple(
            replace(edge, transform=core.T_target_source)
            for edge, core in zip(template.edges, truth.edges, strict=True)
        ),
    )
    clouds = {f"{id_}.ply": fragment.points for id_, fragment in log.fragments.items()}
    return score_challenge(
        [target],
        submission(log),
        Clouds(lambda name: clouds[name].astype(np.float64)),
        max_rte=0.2,
    ).overall
