"""Running the graph as processes without ROS tools: start, watch, stop."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from nss_ros.errors import NodeError
from nss_ros.nodes.spin import LAUNCHER_VARIABLE

_STOP_TIMEOUT = 20.0
# How nodes print what they log, whatever the user has set, and what of it is a warning.
_CONSOLE = {
    "RCUTILS_CONSOLE_OUTPUT_FORMAT": "[{severity}] [{time}] [{name}]: {message}",
    "RCUTILS_COLORIZED_OUTPUT": "0",
}
_WARNING = re.compile(r"^\[WARN\] \[[\d.]+\] \[[^\]]*\]: (.+)$", re.MULTILINE)


@dataclass(slots=True)
class NodeProcess:
    """One node as a process.

    Attributes:
        name: node name, for messages.
        process: the process.
        log: file with its output.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def last_words(self) -> str:
        """The last line that it printed."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("error: ") if lines else "it printed nothing"

    def warnings(self) -> list[str]:
        """What it warned of."""
        return _WARNING.findall(self.log.read_text(errors="replace"))


class Launcher:
    """Starts nodes as processes and notices when one dies.

    Args:
        namespace: of all nodes.
        directory: for parameter files and output.

    Attributes:
        nodes: started so far, in order.
    """

    def __init__(self, namespace: str, directory: Path) -> None:
        self._namespace = namespace
        self._directory = directory
        self.nodes: list[NodeProcess] = []

    def start(self, executable: str, parameters: Mapping[str, Any], name: str = "") -> None:
        """Start `nss_ros.nodes.<executable>`, under another node name if given."""
        name = name or executable
        file = self._directory / f"{name}.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}))
        log = self._directory / f"{name}.log"
        command = [sys.executable, "-m", f"nss_ros.nodes.{executable}", "--ros-args"]
        command += ["--params-file", str(file), "-r", f"__node:={name}"]
        if self._namespace.strip("/"):
            command += ["-r", f"__ns:=/{self._namespace.strip('/')}"]
        with log.open("wb") as output:
            # A session of its own: Ctrl-C reaches us alone, and we stop the nodes in order.
            process = subprocess.Popen(
                command,
                stdout=output,
                stderr=output,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={
                    **os.environ,
                    **_CONSOLE,
                    "PYTHONUNBUFFERED": "1",
                    LAUNCHER_VARIABLE: str(os.getpid()),
                },
            )
        self.nodes.append(NodeProcess(name, process, log))

    def check(self) -> None:
        """Look after the nodes.

        Raises:
            NodeError: one has ended; the message names it and quotes its last words.
        """
        for node in self.nodes:
            status = node.process.poll()
            if status is None:
                continue
            how = (
                f"was killed by {signal.Signals(-status).name}"
                if status < 0
                else (f"ended with status {status}")
            )
            raise NodeError(f"Node {node.name} {how}: {node.last_words()} (all of it: {node.log})")

    def warnings(self) -> list[str]:
        """What the nodes warned of, each sentence once."""
        return list(dict.fromkeys(each for node in self.nodes for each in node.warnings()))

    def stop(self) -> list[str]:
        """Interrupt the nodes in order of their start reversed, the first (recorder) last.

        Returns:
            Names of the nodes that had to be killed or ended with an error.
        """
        unclean = []
        for group in (self.nodes[:0:-1], self.nodes[:1]):
            for node in group:
                _interrupt(node)
            unclean += [node.name for node in group if not _stopped_cleanly(node)]
        return unclean


def _interrupt(node: NodeProcess) -> None:
    if node.process.poll() is None:
        node.process.send_signal(signal.SIGINT)


def _stopped_cleanly(node: NodeProcess) -> bool:
    try:
        return node.process.wait(_STOP_TIMEOUT) == 0
    except subprocess.TimeoutExpired:
        os.killpg(node.process.pid, signal.SIGKILL)
        node.process.wait()
        return False
