"""What a run looks like in Rerun: entities, colours, timelines and the layout of the viewer.

    map/stage_<n>               points of the map, coloured by stage
    fragments/stage_<n>/<id>    a fragment at its pose
    graph/stage_<n>             where the fragments stood, with their ids
    graph/path/stage_<n>        the way from spot to spot
    graph/accepted, rejected    edges of the pose graph
    graph/confidence            all answered pairs between placed fragments, by confidence
    answers/<figure>            confidence, seconds, RMSE and inlier ratio of each answer
    run, rejected               texts: metadata, why edges were rejected

Lengths are metres, poses those of the largest component in its map frame. The timeline `answer`
counts the answers to pairs; what is drawn of a graph that still changes lies on it, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
FIGURES = ("confidence", "seconds", "rmse", "inlier_ratio")

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
        self._stages: set[int] = set()
        self._drawn: set[FragmentId] = set()
        self._answers = 0
        recording.send_blueprint(_layout())
        recording.log("/", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for figure in FIGURES:
            line = self._rerun.SeriesPoints(names=figure.replace("_", " "), marker_sizes=2.0)
            recording.log(f"answers/{figure}", line, static=True)

    def describe(self, metadata: Mapping[str, str]) -> None:
        """Show the metadata of the run."""
        lines = [f"| {name} | {value} |" for name, value in sorted(metadata.items())]
        text = "\n".join(["| | |", "|---|---|", *lines])
        self._text("run", text)

    def draw_map(self, graph: PoseGraph, fragments: Mapping[FragmentId, Fragment]) -> None:
        """Draw the map and its fragments."""
        points, stages = map_points(dict(fragments), graph, self._voxel_size)
        for stage in sorted({int(value) for value in set(stages.tolist())} | self._stages):
            self.draw_stage(stage, points[stages == stage])
        placed = _placed(graph)
        for id_ in sorted(self._drawn - placed.keys()):
            self._log(_fragment_path(id_), self._rerun.Clear(recursive=True))
        self._drawn &= placed.keys()
        for id_, node in placed.items():
            if id_ in fragments:
                self._draw_fragment(fragments[id_], node)

    def draw_stage(self, stage: int, points: Points) -> None:
        """Draw the map of one stage, points (n, 3) in the map frame."""
        self._stages.add(stage)
        cloud = self._rerun.Points3D(points, colors=_octets(stage_color(stage)), radii=0.02)
        self._log(f"map/stage_{stage}", cloud)

    def draw_graph(
        self, graph: PoseGraph, answers: Mapping[FragmentPair, RelativeTransform]
    ) -> None:
        """Draw the nodes and edges of a pose graph, and the confidence of answers along it."""
        placed = _placed(graph)
        by_stage: dict[int, list[Node]] = {}
        for id_ in sorted(placed):
            by_stage.setdefault(id_.stage, []).append(placed[id_])
        for stage, nodes in by_stage.items():
            self._draw_nodes(stage, nodes)
        for name, status, color in (
            ("accepted", EdgeStatus.ACCEPTED, ACCEPTED),
            ("rejected", EdgeStatus.REJECTED, REJECTED),
        ):
            pairs = [edge.pair for edge in graph.edges if edge.status is status]
            self._draw_lines(f"graph/{name}", _inside(pairs, placed), placed, _octets(color))
        known = _inside([pair for pair, answer in answers.items() if answer.ok], placed)
        shares = np.array([answers[pair].confidence for pair in known])
        self._draw_lines("graph/confidence", known, placed, _shades(shares))
        rejected = [edge for edge in graph.edges if edge.status is not EdgeStatus.ACCEPTED]
        lines = [f"| {e.pair} | {e.status.name.lower()} | {e.reason} |" for e in rejected]
        self._text("rejected", "\n".join(["| pair | status | reason |", "|---|---|---|", *lines]))

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

    def _draw_fragment(self, fragment: Fragment, node: Node) -> None:
        path = _fragment_path(fragment.id)
        pose = node.T_map_fragment
        self._log(path, self._rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if fragment.id not in self._drawn:
            self._drawn.add(fragment.id)
            points = voxelize(fragment.points, self._voxel_size)
            color = _octets(stage_color(fragment.id.stage))
            self._log(path, self._rerun.Points3D(points, colors=color, radii=0.02))

    def _draw_nodes(self, stage: int, nodes: Sequence[Node]) -> None:
        positions = np.array([node.T_map_fragment[:3, 3] for node in nodes])
        color = _octets(stage_color(stage))
        self._log(
            f"graph/stage_{stage}",
            self._rerun.Points3D(
                positions,
                colors=color,
                radii=_NODE_RADIUS,
                labels=[str(node.id) for node in nodes],
                show_labels=False,
            ),
        )
        path = self._rerun.LineStrips3D([positions], colors=color, radii=_EDGE_RADIUS)
        self._log(f"graph/path/stage_{stage}", path)

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


def _layout() -> Any:
    views = rerun().blueprint
    return views.Blueprint(
        views.Horizontal(
            views.Tabs(
                views.Spatial3DView(
                    name="Map by stage",
                    contents=["+ /map/**", "+ /graph/**", "- /graph/confidence"],
                ),
                views.Spatial3DView(
                    name="Confidence", contents=["+ /graph/confidence", "+ /map/**"]
                ),
                views.Spatial3DView(name="Fragments", contents=["+ /fragments/**"]),
            ),
            views.Vertical(
                *(
                    views.TimeSeriesView(name=name, contents=[f"+ /answers/{name}"])
                    for name in FIGURES
                ),
                views.Tabs(
                    views.TextDocumentView(name="Rejected edges", origin="/rejected"),
                    views.TextDocumentView(name="Run", origin="/run"),
                ),
            ),
            column_shares=[2, 1],
        ),
        collapse_panels=True,
    )


def _placed(graph: PoseGraph) -> dict[FragmentId, Node]:
    return {id_: node for id_, node in graph.poses().items() if node.component == 0}


def _inside(pairs: Iterable[FragmentPair], placed: Mapping[FragmentId, Node]) -> list[FragmentPair]:
    return [pair for pair in pairs if pair.source in placed and pair.target in placed]


def _fragment_path(id_: FragmentId) -> str:
    return f"fragments/stage_{id_.stage}/{rerun().escape_entity_path_part(str(id_))}"


def _octets(color: Color) -> NDArray[np.uint8]:
    return np.asarray(np.round(np.array([color]) * 255), dtype=np.uint8)


def _shades(shares: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (n, 3) of values 0..1, dark to light."""
    mixed = _LOW + np.clip(shares, 0, 1)[:, None] * (_HIGH - _LOW)
    return np.asarray(np.round(mixed * 255), dtype=np.uint8)
