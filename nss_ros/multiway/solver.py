"""Solves the maps of a growing set of fragments in a process of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

from nss_ros.config import MultiwayConfig
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.multiway.pose_graph import Edge, Measurement, PoseGraph
from nss_ros.multiway.synchronizer import PointSynchronizer, load_synchronizer
from nss_ros.worker_process import stop_now, worker_pool


@dataclass(frozen=True, slots=True)
class Problem:
    """A map to be solved.

    Attributes:
        config: which synchronizer, and its settings.
        fragments: all ids.
        measurements: `MultiStageMap.measurements`.
        unused: `MultiStageMap.unused_edges`, carried over into the graph.
        known: the last solution with points, which one without points goes on from.
    """

    config: MultiwayConfig
    fragments: Sequence[FragmentId]
    measurements: Sequence[Measurement]
    unused: Sequence[Edge] = ()
    known: PoseGraph | None = None


def solve(problem: Problem, prepared: Mapping[FragmentId, Any] | None = None) -> PoseGraph:
    """The pose graph of a problem, nodes and edges in canonical order.

    Args:
        problem: to be solved.
        prepared: what a `PointSynchronizer` made of the fragments; None: without points.
    """
    synchronizer = load_synchronizer(problem.config)
    fragments, measurements = problem.fragments, problem.measurements
    if not isinstance(synchronizer, PointSynchronizer):
        graph = synchronizer.synchronize(fragments, measurements)
    elif prepared is None:
        graph = synchronizer.synchronize(fragments, measurements, problem.known)
    else:
        graph = synchronizer.synchronize_points(fragments, measurements, prepared)
    edges = sorted((*graph.edges, *problem.unused), key=lambda edge: (edge.pair, edge.kind))
    return replace(graph, edges=tuple(edges))


def prepared_by(config: MultiwayConfig, fragments: Iterable[Fragment]) -> dict[FragmentId, Any]:
    """What a synchronizer needs of those fragments that it can use; empty if it takes no points."""
    synchronizer = load_synchronizer(config)
    if not isinstance(synchronizer, PointSynchronizer):
        return {}
    made = ((each.id, synchronizer.prepare(each)) for each in fragments)
    return {id_: each for id_, each in made if each is not None}


class Solver:
    """One worker process that keeps what it prepared: the optimiser holds the interpreter lock."""

    def __init__(self) -> None:
        self._pool = worker_pool(1)
        self._known: set[FragmentId] = set()
        self._prepared_with: MultiwayConfig | None = None
        self._last: Future[PoseGraph] | None = None

    def solve(self, problem: Problem) -> Future[PoseGraph]:
        """Begin to solve a problem without points."""
        return self._pool.submit(solve, problem)

    def solve_with_points(
        self, problem: Problem, fragments: Mapping[FragmentId, Fragment]
    ) -> Future[PoseGraph]:
        """Begin to solve a problem; fragments that were given before need not travel again."""
        again = problem.config == self._prepared_with and not _failed(self._last)
        if not again:
            self._known.clear()
        new = [each for id_, each in sorted(fragments.items()) if id_ not in self._known]
        self._known |= fragments.keys()
        self._prepared_with = problem.config
        self._last = self._pool.submit(_solve_with_points, problem, new, again)
        return self._last

    def restart(self) -> None:
        """Another process, which knows no fragments: the old one died, or the map was reset."""
        self.close()
        self._pool = worker_pool(1)
        self._known.clear()

    def close(self) -> None:
        """End the process, whatever it does."""
        stop_now(self._pool)


def _failed(future: Future[PoseGraph] | None) -> bool:
    """Whether it is not known what was prepared."""
    if future is None or not future.done():
        return False
    return future.cancelled() or future.exception() is not None


# Of the worker process.
_prepared: dict[FragmentId, Any] = {}


def _solve_with_points(problem: Problem, new: Sequence[Fragment], again: bool) -> PoseGraph:
    if not again:
        _prepared.clear()
    _prepared.update(prepared_by(problem.config, new))
    known = set(problem.fragments)
    return solve(problem, {id_: each for id_, each in _prepared.items() if id_ in known})
