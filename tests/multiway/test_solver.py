"""Maps solved in a process of their own."""

import signal
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from nss_ros.config import MultiwayConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId, FragmentPair
from nss_ros.multiway.pose_graph import Edge, EdgeKind, EdgeStatus, NodeStatus
from nss_ros.multiway.solver import Problem, Solver, prepared_by, solve
from nss_ros.registration.gravity.weights import load_weights, save_weights

CONFIG = MultiwayConfig()
CHOI = MultiwayConfig(synchronizer="choi")


@pytest.fixture(scope="module")
def ids(building):
    return [*building.spots(1, 1, 2), *building.spots(2, 5, 6)]


@pytest.fixture(scope="module")
def fragments(building, ids):
    return {id_: building.fragments[id_] for id_ in ids}


@pytest.fixture(scope="module")
def problem(building, ids):
    """A chain: what closes its loops is found by the points."""
    chain = [FragmentPair(*pair) for pair in pairwise(ids)]
    return Problem(CONFIG, ids, [building.right(pair) for pair in chain])


@pytest.fixture(scope="module")
def expected(problem, fragments):
    """Made in this process."""
    return solve(problem, prepared_by(CONFIG, fragments.values()))


@pytest.fixture(scope="module")
def solver():
    """One for all tests: a process takes seconds to start."""
    solver = Solver()
    yield solver
    solver.close()


def poses(graph):
    return [(node.id, node.status, node.T_map_fragment.tobytes()) for node in graph.nodes]


def edges(graph):
    return [(edge.pair, edge.kind, edge.status, edge.weight) for edge in graph.edges]


def submap_edges(graph):
    return [edge for edge in graph.edges if edge.kind is EdgeKind.SUBMAP]


def test_a_process_solves_as_this_one_does_and_remembers_fragments(
    solver, problem, fragments, expected
):
    with_points = solver.solve_with_points(problem, fragments).result()
    assert poses(with_points) == poses(expected)
    assert edges(with_points) == edges(expected)
    assert submap_edges(with_points)
    # Given once, they need not come again.
    again = solver.solve_with_points(problem, {}).result()
    assert edges(again) == edges(expected)
    # A problem without points in between changes nothing.
    without = solver.solve(problem).result()
    assert poses(without) == poses(solve(problem))
    assert not submap_edges(without)
    assert edges(solver.solve_with_points(problem, {}).result()) == edges(expected)


def test_what_is_known_is_for_solutions_without_points(solver, problem, fragments, expected):
    """The last word does not depend on what was found on the way."""
    nonsense = replace(
        expected,
        nodes=tuple(replace(node, T_map_fragment=np.eye(4)) for node in expected.nodes),
        edges=tuple(replace(edge, status=EdgeStatus.REJECTED) for edge in expected.edges),
    )
    misled = solver.solve_with_points(replace(problem, known=nonsense), fragments).result()
    assert poses(misled) == poses(expected)
    assert edges(misled) == edges(expected)
    again = solver.solve(replace(problem, known=expected)).result()
    assert [(e.pair, e.kind, e.status) for e in again.edges] == [
        (e.pair, e.kind, e.status) for e in expected.edges
    ]
    assert submap_edges(again)
    plain = replace(problem, config=CHOI, known=expected)
    assert poses(solve(plain)) == poses(solve(replace(plain, known=None)))


def test_another_configuration_prepares_anew(solver, problem, fragments, expected, tmp_path):
    path = tmp_path / "weights.safetensors"
    save_weights(path, load_weights())
    assert submap_edges(solver.solve_with_points(problem, fragments).result())
    same_weights = Problem(CONFIG.model_copy(update={"submap_weights": str(path)}), *_rest(problem))
    # What was prepared by other weights is not used.
    assert not submap_edges(solver.solve_with_points(same_weights, {}).result())
    prepared_anew = solver.solve_with_points(same_weights, fragments).result()
    assert edges(prepared_anew) == edges(expected)


def test_what_failed_is_tried_again(solver, problem, fragments, expected, tmp_path):
    path = tmp_path / "weights.safetensors"
    missing = Problem(CONFIG.model_copy(update={"submap_weights": str(path)}), *_rest(problem))
    with pytest.raises(MethodError, match="weights"):
        solver.solve_with_points(missing, fragments).result()
    save_weights(path, load_weights())
    assert edges(solver.solve_with_points(missing, fragments).result()) == edges(expected)


def _rest(problem):
    return problem.fragments, problem.measurements, problem.unused


def test_a_fragment_that_cannot_be_used_does_no_harm(solver, problem, fragments, expected):
    clouds = [np.zeros((0, 3)), np.ones((1, 3)), np.full((50, 3), np.nan)]
    bad = [
        Fragment(FragmentId("1", 1, 90 + number), cloud.astype(np.float32), True)
        for number, cloud in enumerate(clouds)
    ]
    all_ = fragments | {fragment.id: fragment for fragment in bad}
    assert prepared_by(CONFIG, bad) == {}
    larger = Problem(CONFIG, sorted(all_), problem.measurements)
    graph = solver.solve_with_points(larger, all_).result()
    assert edges(graph) == edges(expected)
    status = {node.id: node.status for node in graph.nodes}
    assert {status[fragment.id] for fragment in bad} == {NodeStatus.UNPLACED}
    assert {status[id_] for id_ in fragments} == {NodeStatus.PLACED}


def test_fragments_come_one_after_the_other(solver, problem, fragments, ids, expected):
    config = CONFIG.model_copy(update={"bridge_confidence": 0.4})  # so that none is known
    for count in range(1, len(ids) + 1):
        new = {ids[count - 1]: fragments[ids[count - 1]]}
        growing = Problem(config, ids[:count], problem.measurements[: count - 1])
        graph = solver.solve_with_points(growing, new).result()
        assert [node.id for node in graph.nodes] == ids[:count]
    assert edges(graph) == edges(expected)
    # Those that are no longer in the map are not used, though they are remembered.
    graph = solver.solve_with_points(Problem(config, ids[:2], []), {}).result()
    assert [node.id for node in graph.nodes] == ids[:2]
    assert graph.edges == ()


def test_a_synchronizer_without_points_needs_none(solver, problem, fragments):
    plain = Problem(CHOI, *_rest(problem))
    assert prepared_by(CHOI, fragments.values()) == {}
    graph = solver.solve_with_points(plain, fragments).result()
    assert graph.synchronizer == "choi"
    assert poses(graph) == poses(solver.solve(plain).result()) == poses(solve(plain))
    assert poses(solve(plain, {})) == poses(graph)


def test_unused_edges_are_carried_over_in_order(problem, ids):
    pair = FragmentPair(ids[0], ids[2])
    lost = Edge(pair, np.eye(4), EdgeKind.SAME_STAGE, EdgeStatus.FAILED, "nothing fits")
    graph = solve(Problem(CONFIG, ids, problem.measurements, [lost]))
    order = [(edge.pair, edge.kind) for edge in graph.edges]
    assert order == sorted(order)
    assert len(order) == len(problem.measurements) + 1
    assert [edge.reason for edge in graph.edges if edge.pair == pair] == ["nothing fits"]


def test_a_restart_helps_when_the_process_died_and_forgets(solver, problem, fragments, expected):
    assert submap_edges(solver.solve_with_points(problem, fragments).result())
    with pytest.raises(BrokenProcessPool):
        solver._pool.submit(signal.raise_signal, signal.SIGKILL).result()
    solver.restart()
    assert not submap_edges(solver.solve_with_points(problem, {}).result())
    assert edges(solver.solve_with_points(problem, fragments).result()) == edges(expected)


def test_closing_ends_the_process_at_work(problem, fragments):
    solver = Solver()
    future = solver.solve_with_points(problem, fragments)
    solver.close()
    assert future.cancelled() or isinstance(future.exception(), BrokenProcessPool)
