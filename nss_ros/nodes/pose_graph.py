"""Node `pose_graph`: accumulates fragments and relative transforms of all stages into one map.

It never sees ground truth: it subscribes to fragments, pairs and relative transforms only.
"""

from __future__ import annotations

import sys
import threading
import time
from concurrent.futures import Future as SolutionFuture
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from nss_msgs.msg import Fragment as FragmentMessage
from nss_msgs.msg import FragmentPair as PairMessage
from nss_msgs.msg import FragmentPoses
from nss_msgs.msg import PoseGraph as PoseGraphMessage
from nss_msgs.msg import RelativeTransform as RelativeTransformMessage
from nss_msgs.srv import AddConstraint, MapFile, RemoveConstraint
from nss_ros import topics
from nss_ros.config import MultiwayConfig, PoseGraphConfig, RegistrationConfig
from nss_ros.errors import BagError, FormatError, InputError, NssError, RunError
from nss_ros.fragment import Fragment
from nss_ros.geometry import to_quaternion
from nss_ros.messages import (
    GraphProgress,
    fragment_from,
    fragment_poses_message,
    pair_from,
    pose_from,
    pose_graph_message,
    relative_transform_from,
    rosidl_family,
)
from nss_ros.multiway.map_file import load_map, save_map
from nss_ros.multiway.multi_stage_map import MultiStageMap
from nss_ros.multiway.pose_graph import NodeStatus, PoseGraph, doubtful_sentence
from nss_ros.multiway.solver import Problem, Solver
from nss_ros.multiway.synchronizer import PointSynchronizer, load_synchronizer
from nss_ros.nodes.diagnostics import Health, publish_diagnostics
from nss_ros.nodes.intake import converted
from nss_ros.nodes.map_publisher import MapPublisher
from nss_ros.nodes.parameters import declare_parameters, follow_parameters
from nss_ros.nodes.qos import publisher_qos, subscription_qos
from nss_ros.nodes.spin import Background, run_node

_POLL = 0.05
_TF_PERIOD = 1.0
_MOST_DEATHS = 2


class PoseGraphNode(Node):
    """Optimises in a worker process, publishes the corrected map; its executor only enqueues.

    Raises:
        ConfigError: a parameter is not valid.
        MethodError: the synchronizer is unknown.
    """

    def __init__(self) -> None:
        super().__init__("pose_graph")
        self._config = declare_parameters(self, PoseGraphConfig)
        self._takes_points = _takes_points(self._config)
        self._lock = threading.Lock()
        self._map = self._new_map()
        self._graph = PoseGraph(synchronizer=self._config.synchronizer)
        # The last solution with all that the synchronizer can use: quick ones go on from it.
        self._known: PoseGraph | None = None
        self._known_counts = True
        self._fragments_in: SimpleQueue[Fragment] = SimpleQueue()
        self._waiting_for_optimum: list[threading.Event] = []
        self._solved_version = 0
        self._forgotten = False
        self._settled = True
        self._last_change = self._last_solve = time.monotonic()
        self._solve_time = 0.0
        self._solver = Solver()
        self._solver_deaths = 0
        self._solution: SolutionFuture[PoseGraph] | None = None
        self._solving_version = 0
        # With all that the synchronizer can use; a quick solution goes without points.
        self._solving_thoroughly = self._solved_thoroughly = False
        self._solving_for: list[threading.Event] = []
        self._create_publishers()
        self._create_subscriptions()
        self._create_services()
        follow_parameters(self, PoseGraphConfig, self._apply, load_synchronizer)
        publish_diagnostics(self, self._health)
        self.background = Background("optimise", self._work)
        self.background.start()

    def close(self) -> None:
        """End the worker."""
        self.background.stop()
        self._solver.close()

    def _new_map(self) -> MultiStageMap:
        return MultiStageMap(min(self._config.map_voxel_size, RegistrationConfig().voxel_size))

    def _create_publishers(self) -> None:
        def publisher(message_type: type, topic: topics.Topic) -> Publisher:
            return self.create_publisher(message_type, topic.name, publisher_qos(topic))

        self._pose_graph = publisher(PoseGraphMessage, topics.POSE_GRAPH)
        self._poses = publisher(FragmentPoses, topics.FRAGMENT_POSES)
        self._map_publisher = MapPublisher(self)
        self._clouds_published = True
        self._tf = publisher(TFMessage, topics.TF)
        self.create_timer(_TF_PERIOD, self._publish_tf)

    def _create_subscriptions(self) -> None:
        for message_type, topic, callback in (
            (FragmentMessage, topics.FRAGMENTS, self._on_fragment),
            (PairMessage, topics.FRAGMENT_PAIRS, self._on_pair),
            (RelativeTransformMessage, topics.RELATIVE_TRANSFORMS, self._on_relative_transform),
        ):
            self.create_subscription(message_type, topic.name, callback, subscription_qos(topic))

    def _create_services(self) -> None:
        for service_type, name, callback in (
            (MapFile, "save_map", self._on_save_map),
            (MapFile, "load_map", self._on_load_map),
            (AddConstraint, "add_constraint", self._on_add_constraint),
            (RemoveConstraint, "remove_constraint", self._on_remove_constraint),
            (Trigger, "optimize", self._on_optimize),
            (Trigger, "reset", self._on_reset),
        ):
            self.create_service(service_type, f"~/{name}", callback)

    def _apply(self, config: PoseGraphConfig) -> None:
        with self._lock:
            if _multiway(config) != _multiway(self._config):
                self._forget_known()
            self._config = config
            self._takes_points = _takes_points(config)
            self._map.version += 1
            self._changed()

    def _forget_known(self) -> None:
        """Neither the last thorough solution counts any more, nor one that is being made."""
        self._known, self._known_counts = None, False

    def _changed(self) -> None:
        self._last_change = time.monotonic()
        self._settled = False

    def _on_fragment(self, message: FragmentMessage) -> None:
        fragment = converted(self, fragment_from, message)
        if fragment is not None:
            self._fragments_in.put(fragment)

    def _on_pair(self, message: PairMessage) -> None:
        pair = converted(self, pair_from, message)
        if pair is not None:
            with self._lock:
                self._map.add_pair(pair)
                self._changed()

    def _on_relative_transform(self, message: RelativeTransformMessage) -> None:
        result = converted(self, relative_transform_from, message)
        if result is not None:
            with self._lock:
                if self._map.add_result(result):
                    self._changed()

    def _on_save_map(self, request: MapFile.Request, response: MapFile.Response) -> object:
        with self._lock:
            graph, fragments, results = self._graph, dict(self._map.fragments), self._map.results
            results = dict(results)
        if not graph.poses():
            response.code = MapFile.Response.EMPTY_MAP
            response.message = "Nothing is placed yet, so there is nothing to save."
            return response
        try:
            save_map(Path(request.path), fragments, results, graph)
        except FormatError as error:
            unknown = not isinstance(error, BagError)
            kinds = MapFile.Response
            response.code = kinds.FORMAT_ERROR if unknown else kinds.FILE_ERROR
            response.message = str(error)
            return response
        response.message = f"Saved {len(graph.poses())} placed fragments to {request.path}."
        return response

    def _on_load_map(self, request: MapFile.Request, response: MapFile.Response) -> object:
        try:
            saved = load_map(Path(request.path))
        except NssError as error:
            exists = Path(request.path).exists()
            kinds = MapFile.Response
            response.code = kinds.FORMAT_ERROR if exists else kinds.FILE_ERROR
            response.message = str(error)
            return response
        with self._lock:
            for fragment in saved.fragments.values():
                self._map.add_fragment(fragment)
            for pair, result in saved.relative_transforms.items():
                self._map.add_pair(pair)
                self._map.add_result(result)
            for edge in saved.constraints:
                self._map.add_constraint(edge.pair, edge.T_target_source, edge.covariance)
            for pair in saved.excluded:
                self._map.remove_constraint(pair)
            self._changed()
        response.message = (
            f"Loaded {len(saved.fragments)} fragments and "
            f"{len(saved.relative_transforms)} relative transforms from {request.path}."
        )
        return response

    def _on_add_constraint(
        self, request: AddConstraint.Request, response: AddConstraint.Response
    ) -> object:
        try:
            pair = pair_from(request)
            transform, covariance = pose_from(request.pose)
        except InputError as error:
            response.code, response.message = AddConstraint.Response.INVALID_POSE, str(error)
            return response
        with self._lock:
            known = pair.source in self._map.fragments and pair.target in self._map.fragments
            try:
                self._map.add_constraint(pair, transform, covariance)
            except InputError as error:
                kinds = AddConstraint.Response
                response.code = kinds.INVALID_POSE if known else kinds.UNKNOWN_FRAGMENT
                response.message = str(error)
                return response
            self._changed()
        response.message = f"Added the constraint {pair}."
        return response

    def _on_remove_constraint(
        self, request: RemoveConstraint.Request, response: RemoveConstraint.Response
    ) -> object:
        try:
            pair = pair_from(request)
            with self._lock:
                removed = self._map.remove_constraint(pair)
                self._changed()
        except InputError as error:
            response.code, response.message = RemoveConstraint.Response.UNKNOWN_EDGE, str(error)
            return response
        if removed:
            response.message = f"Removed {pair}."
        else:
            response.code = RemoveConstraint.Response.UNKNOWN_EDGE
            response.message = f"No constraint and no relative transform links {pair}."
        return response

    def _on_optimize(self, _: Trigger.Request, response: Trigger.Response) -> object:
        """Answer when the optimum is there.

        Waiting holds the executor, but nothing is lost: DDS keeps what comes, and a coroutine
        that awaits here would make Jazzy's executor spin without pause.
        """
        done = threading.Event()
        with self._lock:
            self._map.version += 1
            self._waiting_for_optimum.append(done)
            self._changed()
        while not done.wait(_POLL):
            if self.background.error is not None or self.background.stopping.is_set():
                response.message = "The node is being stopped."
                return response
        graph = self._graph
        response.success = True
        response.message = (
            f"{len(graph.poses())} of {len(graph.nodes)} fragments placed, "
            f"RMS residual {graph.rms_residual():.3f} m."
        )
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> object:
        with self._lock:
            version = self._map.version
            self._map = self._new_map()
            self._map.version = version + 1
            self._forgotten = True
            self._forget_known()
            self._changed()
        response.success = True
        response.message = "Forgot all fragments, relative transforms and constraints."
        return response

    def _health(self) -> Health:
        graph = self._graph
        components = {node.component for node in graph.poses().values()}
        values = {
            "fragments": len(self._map.fragments),
            "placed": len(graph.poses()),
            "components": len(components),
            "pairs": f"{len(self._map.results)} / {len(self._map.pairs)}",
            "rms_residual": f"{graph.rms_residual():.3f} m",
            "solve_time": f"{self._solve_time:.2f} s",
        }
        well = len(components) <= 1
        sentence = "one component" if well else f"{len(components)} components are not linked"
        return well, sentence, values

    def _work(self) -> None:
        while not self.background.stopping.is_set():
            self._take_fragments()
            if self._solution is not None:
                if self._solution.done():
                    self._finish_solution()
            elif self._due():
                self._begin_solution()
            elif self._quiet() and not self._settled and not self._outdated():
                self._settled = True
                self._publish_map()
                self._publish_graph()
                self._log_progress()
            if not self._clouds_published:
                self._publish_map()
            self.background.stopping.wait(_POLL)

    def _log_progress(self) -> None:
        with self._lock:
            answered = sum(pair in self._map.results for pair in self._map.pairs)
            pairs = len(self._map.pairs)
        placed = sum(node.status is NodeStatus.PLACED for node in self._graph.nodes)
        doubtful = self._graph.doubtful()
        doubts = f" {doubtful_sentence(doubtful)}" if doubtful else ""
        self.get_logger().info(
            f"Settled: {placed} of {len(self._graph.nodes)} fragments placed, "
            f"{answered} of {pairs} pairs answered.{doubts}"
        )

    def _quiet(self) -> bool:
        unheard = time.monotonic() - self._last_change >= self._config.settle_time
        return unheard and self._fragments_in.empty()

    def _outdated(self) -> bool:
        if self._map.version != self._solved_version:
            return True
        return self._wants_points() and not self._solved_thoroughly

    def _wants_points(self) -> bool:
        """Whether it is time for the slow solution: nothing more is to be expected."""
        if not self._takes_points:
            return False
        return bool(self._waiting_for_optimum) or (self._quiet() and self._map.complete)

    def _due(self) -> bool:
        # Long optimisations get longer pauses, so that they take an eighth of the time at most:
        # what registers pairs on the same machine has better use for it.
        pause = max(self._config.update_period, 7 * self._solve_time)
        rested = time.monotonic() - self._last_solve >= pause
        return self._outdated() and (self._quiet() or rested or bool(self._waiting_for_optimum))

    def _take_fragments(self) -> None:
        while True:
            try:
                fragment = self._fragments_in.get_nowait()
            except Empty:
                return
            with self._lock:
                if self._map.add_fragment(fragment):
                    self._changed()
                else:
                    self.get_logger().debug(f"Fragment {fragment.id} came again: ignored.")

    def _begin_solution(self) -> None:
        with self._lock:
            thoroughly = self._wants_points()
            if self._forgotten:
                self._solver.restart()
                self._forgotten = False
            self._solving_version = self._map.version
            problem = Problem(
                self._config,
                sorted(self._map.fragments),
                self._map.measurements(),
                self._map.unused_edges(),
                self._known,
            )
            self._known_counts = True
            fragments = dict(self._map.fragments)
            self._solving_for, self._waiting_for_optimum = self._waiting_for_optimum, []
        self._solving_thoroughly = thoroughly
        self._last_solve = time.monotonic()
        if thoroughly:
            self._solution = self._solver.solve_with_points(problem, fragments)
        else:
            self._solution = self._solver.solve(problem)

    def _finish_solution(self) -> None:
        solution, self._solution = self._solution, None
        assert solution is not None
        try:
            graph = solution.result()
        except BrokenProcessPool as error:
            self._restart_solver(error)
            return
        self._solver_deaths = 0
        now = time.monotonic()
        if not self._solving_thoroughly:
            self._solve_time = now - self._last_solve
        self._last_solve = now
        with self._lock:
            self._graph, self._solved_version = graph, self._solving_version
            self._solved_thoroughly = self._solving_thoroughly
            if self._solving_thoroughly and self._known_counts:
                self._known = graph
        self._publish_graph()
        self._publish_map()
        for done in self._solving_for:
            done.set()

    def _restart_solver(self, error: BrokenProcessPool) -> None:
        if self.background.stopping.is_set():
            return
        self._solver_deaths += 1
        if self._solver_deaths >= _MOST_DEATHS:
            raise RunError("The optimiser's process died twice on the same graph.") from error
        self.get_logger().error("The optimiser's process died: starting another.")
        with self._lock:
            self._waiting_for_optimum += self._solving_for
        self._solver.restart()

    def _stamp(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _publish_graph(self) -> None:
        graph, family, frame = self._graph, rosidl_family(), self._config.map_frame
        with self._lock:
            answered = sum(pair in self._map.results for pair in self._map.pairs)
            progress = GraphProgress(len(self._map.pairs), answered, self._settled)
        stamp = self._stamp()
        self._pose_graph.publish(pose_graph_message(graph, frame, stamp, family, progress))
        self._poses.publish(fragment_poses_message(graph.nodes, frame, stamp, family))
        self._map_publisher.publish_markers(graph, self._config)
        self._publish_tf()

    def _publish_tf(self) -> None:
        stamp = self.get_clock().now().to_msg()
        transforms = []
        for node in self._graph.nodes:
            if node.status is not NodeStatus.PLACED:
                continue
            transform = TransformStamped(child_frame_id=str(node.id))
            transform.header.stamp = stamp
            transform.header.frame_id = topics.component_frame(
                self._config.map_frame, node.component
            )
            translation, rotation = transform.transform.translation, transform.transform.rotation
            translation.x, translation.y, translation.z = map(float, node.T_map_fragment[:3, 3])
            rotation.x, rotation.y, rotation.z, rotation.w = map(
                float, to_quaternion(node.T_map_fragment)
            )
            transforms.append(transform)
        if transforms:
            self._tf.publish(TFMessage(transforms=transforms))

    def _publish_map(self) -> None:
        with self._lock:
            fragments = dict(self._map.fragments)
            # Between slow answers the graph settles, too.
            final = self._settled and self._map.complete
        self._clouds_published = self._map_publisher.publish_clouds(
            fragments, self._graph, self._config, final
        )


def _multiway(config: PoseGraphConfig) -> dict[str, Any]:
    """The settings that decide what a solution is."""
    return config.model_dump(include=set(MultiwayConfig.model_fields))


def _takes_points(config: PoseGraphConfig) -> bool:
    """Whether the synchronizer looks at points.

    Raises:
        MethodError: there is no such synchronizer, or it lacks something.
    """
    return isinstance(load_synchronizer(config), PointSynchronizer)


def main(args: list[str] | None = None) -> None:
    """Entry point of the node."""
    sys.exit(run_node(PoseGraphNode, args))


if __name__ == "__main__":
    main()
