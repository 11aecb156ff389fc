"""What a run looks like in Rerun: entities, colours, timelines and the layout of the viewer.

    map/stage_<n>               points of the map, coloured by stage
    fragments/stage_<n>/<id>    a fragment at its pose
    graph/stage_<n>             where the fragments stood, with their ids
    graph/path/stage_<n>        the way from spot to spot
    graph/doubtful              around those that are perhaps in a wrong place
    graph/accepted, rejected    edges of the pose graph
    graph/confidence            all answered pairs between placed fragments, by confidence
    answers/<figure>            confidence, seconds, RMSE and inlier ratio of each answer
    run, rejected               texts: metadata, why edges were rejected

This is the largest component; the map, the fragments and the graph of the others lie below
component_1, component_2, …, numbered as their ROS topics are, each in a map frame and in views of
its own, since nothing links them.
Fragments that are in no component are not drawn. Lengths are metres. The timeline `answer`
counts the answers to pairs; what is drawn of a graph that still changes lies on it, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nss_ros.colors import ACCEPTED, REJECTED, Color, stage_color
from nss_ros.fragment import Fragment, FragmentId, FragmentPair, Points, voxelize
from nss_ros.multiway.multi_stage_map import map_points
from nss_ros.multiway.pose_graph import EdgeStatus, Node, PoseGraph
from nss_ros.registration.relative_transform import RelativeTransform
from nss_ros.viewing.sink import rerun

ANSWERS = "answer"
"""Timeline: the number of the answer."""
FIGURES = {
    "confidence": "confidence of each answer",
    "seconds": "seconds of each answer",
    "rmse": "RMSE of its inliers (m)",
    "inlier_ratio": "inlier ratio",
}
"""Of answers, with the titles of their plots."""
_MOST_VIEWS = 12  # of components

_NODE_RADIUS, _EDGE_RADIUS = 0.12, 0.015
_LOW, _HIGH = np.array((0.27, 0.0, 0.33)), np.array((0.99, 0.91, 0.14))  # ends of viridis


class Scene:
    """Draws a run into a Rerun recording; everything may be drawn again when it changes.

    Args:
        recording: a `rerun.RecordingStream`.
        voxel_size: of maps and fragments, metres.
        changing: the graph is drawn again and again, so that the viewer can go back in time.
    """

    def __init__(self, recording: Any, voxel_size: float = 0.1, changing: bool = False) -> None:
        self._rerun = rerun()
        self._recording = recording
        self._voxel_size = voxel_size
        self._changing = changing
        self._maps: dict[str, int] = {}
        self._spots: set[tuple[str, int]] = set()
        self._drawn: dict[FragmentId, str] = {}
        self._answers = 0
        self._components = 1
        recording.send_blueprint(_layout(1))
        recording.log("/", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for figure, title in FIGURES.items():
            line = self._rerun.SeriesPoints(names=title, marker_sizes=2.0)
            recording.log(f"answers/{figure}", line, static=True)

    def describe(self, metadata: Mapping[str, str]) -> None:
        """Show the metadata of the run."""
        lines = [f"| {name} | {value} |" for name, value in sorted(metadata.items())]
        text = "\n".join(["| | |", "|---|---|", *lines])
        self._text("run", text)

    def draw_map(self, graph: PoseGraph, fragments: Mapping[FragmentId, Fragment]) -> None:
        """Draw the map and its fragments."""
        clouds: dict[str, tuple[int, Points]] = {}
        paths: dict[FragmentId, str] = {}
        nodes: dict[FragmentId, Node] = {}
        for root, part in _parts(graph):
            points, stages = map_points(dict(fragments), part, self._voxel_size)
            for stage in sorted({int(value) for value in set(stages.tolist())}):
                clouds[f"{root}map/stage_{stage}"] = stage, points[stages == stage]
            here = {node.id: node for node in part.nodes if node.id in fragments}
            paths |= {id_: f"{root}{_fragment_path(id_)}" for id_ in here}
            nodes |= here
        nothing = np.zeros((0, 3), np.float32)
        gone = {path: (stage, nothing) for path, stage in self._maps.items() if path not in clouds}
        for path, (stage, points) in (clouds | gone).items():
            self._draw_cloud(path, stage, points)
        self._maps |= {path: stage for path, (stage, _) in clouds.items()}
        for id_, path in list(self._drawn.items()):
            if paths.get(id_) != path:
                self._log(path, self._rerun.Clear(recursive=True))
                del self._drawn[id_]
        for id_, path in paths.items():
            self._draw_fragment(path, fragments[id_], nodes[id_])

    def draw_graph(
        self, graph: PoseGraph, answers: Mapping[FragmentPair, RelativeTransform]
    ) -> None:
        """Draw the nodes and edges of a pose graph, and the confidence of answers along it."""
        parts = _parts(graph)
        spots = {(root, node.id.stage) for root, part in parts for node in part.nodes}
        for root, stage in sorted(self._spots - spots):
            for path in _spot_paths(root, stage):
                self._log(path, self._rerun.Clear(recursive=False))
        self._spots = spots
        for root, part in parts:
            self._draw_part(root, part, answers)
        for number in range(len(parts), self._components):
            self._log(f"{_root(number)}graph", self._rerun.Clear(recursive=True))
        if len(parts) > self._components:
            self._components = len(parts)
            self._recording.send_blueprint(_layout(min(self._components, _MOST_VIEWS)))
        rejected = [edge for edge in graph.edges if edge.status is not EdgeStatus.ACCEPTED]
        # A list, whose lines are broken: the end of a wide table is out of sight.
        lines = [f"- {e.pair}: {e.status.name.lower()}, {e.reason}" for e in rejected]
        self._text("rejected", "\n".join(lines) or "Every edge was accepted.")

    def add_answers(self, answers: Sequence[RelativeTransform]) -> None:
        """Plot figures of further answers; those of failures have no value but seconds."""
        module = self._rerun
        numbers = range(self._answers, self._answers + len(answers))
        self._answers += len(answers)
        columns = {
            "seconds": [(n, a.compute_time) for n, a in zip(numbers, answers, strict=True)],
            "confidence": [
                (n, a.confidence) for n, a in zip(numbers, answers, strict=True) if a.ok
            ],
            "rmse": [(n, a.rmse) for n, a in zip(numbers, answers, strict=True) if a.ok],
            "inlier_ratio": [
                (n, a.inlier_ratio) for n, a in zip(numbers, answers, strict=True) if a.ok
            ],
        }
        for figure, values in columns.items():
            if values:
                self._recording.send_columns(
                    f"answers/{figure}",
                    [module.TimeColumn(ANSWERS, sequence=[number for number, _ in values])],
                    module.Scalars.columns(scalars=[value for _, value in values]),
                )

    def _draw_part(
        self, root: str, part: PoseGraph, answers: Mapping[FragmentPair, RelativeTransform]
    ) -> None:
        """Draw the graph of one component."""
        placed = part.poses()
        by_stage: dict[int, list[Node]] = {}
        for id_ in sorted(placed):
            by_stage.setdefault(id_.stage, []).append(placed[id_])
        for stage, nodes in by_stage.items():
            self._draw_nodes(root, stage, nodes)
        self._draw_doubtful(f"{root}graph/doubtful", [n for n in placed.values() if n.doubtful])
        for name, status, color in (
            ("accepted", EdgeStatus.ACCEPTED, ACCEPTED),
            ("rejected", EdgeStatus.REJECTED, REJECTED),
        ):
            pairs = [edge.pair for edge in part.edges if edge.status is status]
            self._draw_lines(f"{root}graph/{name}", pairs, placed, _octets(color))
        answered = [pair for pair, answer in answers.items() if answer.ok]
        known = [pair for pair in answered if pair.source in placed and pair.target in placed]
        shares = np.array([answers[pair].confidence for pair in known])
        self._draw_lines(f"{root}graph/confidence", known, placed, _shades(shares))

    def _draw_cloud(self, path: str, stage: int, points: Points) -> None:
        cloud = self._rerun.Points3D(points, colors=_octets(stage_color(stage)), radii=0.02)
        self._log(path, cloud)

    def _draw_fragment(self, path: str, fragment: Fragment, node: Node) -> None:
        pose = node.T_map_fragment
        self._log(path, self._rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if fragment.id not in self._drawn:
            self._drawn[fragment.id] = path
            points = voxelize(fragment.points, self._voxel_size)
            self._draw_cloud(path, fragment.id.stage, points)

    def _draw_nodes(self, root: str, stage: int, nodes: Sequence[Node]) -> None:
        positions = np.array([node.T_map_fragment[:3, 3] for node in nodes])
        color = _octets(stage_color(stage))
        spots, way = _spot_paths(root, stage)
        self._log(
            spots,
            self._rerun.Points3D(
                positions,
                colors=color,
                radii=_NODE_RADIUS,
                labels=[str(node.id) for node in nodes],
                show_labels=False,
            ),
        )
        path = self._rerun.LineStrips3D([positions], colors=color, radii=_EDGE_RADIUS)
        self._log(way, path)

    def _draw_doubtful(self, path: str, nodes: Sequence[Node]) -> None:
        positions = np.array([node.T_map_fragment[:3, 3] for node in nodes]).reshape(-1, 3)
        around = self._rerun.Points3D(
            positions,
            colors=_octets(REJECTED),
            radii=2 * _NODE_RADIUS,
            labels=[f"{node.id}: doubtful" for node in nodes],
            show_labels=False,
        )
        self._log(path, around)

    def _draw_lines(
        self,
        path: str,
        pairs: Sequence[FragmentPair],
        placed: Mapping[FragmentId, Node],
        colors: NDArray[np.uint8],
    ) -> None:
        strips = np.array(
            [
                [placed[id_].T_map_fragment[:3, 3] for id_ in (pair.source, pair.target)]
                for pair in pairs
            ]
        ).reshape(-1, 2, 3)
        lines = self._rerun.LineStrips3D(
            strips,
            colors=colors,
            radii=_EDGE_RADIUS,
            labels=[str(pair) for pair in pairs],
            show_labels=False,
        )
        self._log(path, lines)

    def _log(self, path: str, content: Any) -> None:
        if self._changing:
            self._recording.set_time(ANSWERS, sequence=self._answers)
        self._recording.log(path, content, static=not self._changing)

    def _text(self, path: str, text: str) -> None:
        markdown = self._rerun.MediaType.MARKDOWN
        self._log(path, self._rerun.TextDocument(text, media_type=markdown))


def _layout(components: int) -> Any:
    """The views: of each component one, and what is told of answers and edges."""
    views = rerun().blueprint

    def of_each(name: str, *contents: str) -> Any:
        """A view of each component; `%` in what it contains is the root of the component."""
        shown = [
            views.Spatial3DView(
                name=name if components == 1 else f"Component {number}" if number else "Largest",
                contents=[each.replace("%", f"/{_root(number)}") for each in contents],
            )
            for number in range(components)
        ]
        return shown[0] if components == 1 else views.Tabs(*shown, name=name, active_tab=0)

    return views.Blueprint(
        views.Horizontal(
            views.Tabs(
                of_each("Map by stage", "+ %map/**", "+ %graph/**", "- %graph/confidence"),
                of_each("Confidence", "+ %graph/confidence", "+ %map/**"),
                of_each("Fragments", "+ %fragments/**"),
                active_tab=0,
            ),
            views.Vertical(
                *(
                    views.TimeSeriesView(
                        name=title,
                        contents=[f"+ /answers/{name}"],
                        # The title says it, and a legend would hide points.
                        plot_legend=views.PlotLegend(visible=False),
                    )
                    for name, title in FIGURES.items()
                ),
                views.Tabs(
                    views.TextDocumentView(name="Rejected edges", origin="/rejected"),
                    views.TextDocumentView(name="Run", origin="/run"),
                    active_tab=0,
                ),
                row_shares=[*(1 for _ in FIGURES), 2],
            ),
            column_shares=[2, 1],
        ),
        collapse_panels=True,
    )


def _root(number: int) -> str:
    """Below which the component of a number is drawn."""
    return "" if number == 0 else f"component_{number}/"


def _spot_paths(root: str, stage: int) -> tuple[str, str]:
    """Of the spots of a stage, and of the way through them."""
    return f"{root}graph/stage_{stage}", f"{root}graph/path/stage_{stage}"


def _parts(graph: PoseGraph) -> list[tuple[str, PoseGraph]]:
    """Each component as a graph of its own, the largest first, with the path of its root."""
    members: dict[int, list[Node]] = {}
    for node in graph.poses().values():
        members.setdefault(node.component, []).append(replace(node, component=0))
    parts = []
    for number, component in enumerate(sorted(members)):
        here = {node.id for node in members[component]}
        edges = tuple(e for e in graph.edges if {e.pair.source, e.pair.target} <= here)
        parts.append((_root(number), PoseGraph(tuple(members[component]), edges)))
    return parts or [("", PoseGraph())]


def _fragment_path(id_: FragmentId) -> str:
    return f"fragments/stage_{id_.stage}/{rerun().escape_entity_path_part(str(id_))}"


def _octets(color: Color) -> NDArray[np.uint8]:
    return np.asarray(np.round(np.array([color]) * 255), dtype=np.uint8)


def _shades(shares: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3) of values 0..1, dark to light."""
    mixed = _LOW + np.clip(shares, 0, 1)[:, None] * (_HIGH - _LOW)
    return np.asarray(np.round(mixed * 255), dtype=np.uint8)
