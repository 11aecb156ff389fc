"""A log in the real Rerun viewer, in a real browser without a graphics card."""

import io
import shutil
import socket
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from nss_ros.bag import write_bag
from nss_ros.cli.main import app
from nss_ros.colors import stage_color

playwright = pytest.importorskip("playwright.sync_api")
rerun_cli = pytest.importorskip("rerun_cli")

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium here")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
_PATIENCE = 120.0


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(condition):
    end = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.5)


def answers(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def served(room, record, tmp_path):
    """The page of a viewer that shows a log."""
    fragments = [replace(f, points=f.points[::4]) for f in room.fragments]
    write_bag(tmp_path / "bag", fragments, room.pairs, [room.ground_truth])
    file = tmp_path / "run.rrd"
    result = CliRunner().invoke(app, ["view", str(record(tmp_path / "bag")), "--save", str(file)])
    assert result.exit_code == 0, result.output
    viewer = Path(rerun_cli.__file__).parent / "rerun"
    data, web = free_port(), free_port()
    command = [viewer, file, "--serve-web", "--bind", "127.0.0.1", "--port", data]
    command += ["--web-viewer-port", web]
    process = subprocess.Popen(
        [str(each) for each in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until(lambda: answers(web) and answers(data))
        yield (
            f"http://127.0.0.1:{web}/?renderer=webgl"
            f"&url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data}%2Fproxy"
        )
    finally:
        process.kill()
        process.wait()


def test_the_map_is_seen_in_the_colours_of_its_stages(served):
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1300, "height": 800})
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(served)

        def shown():
            image = Image.open(io.BytesIO(page.screenshot(timeout=1000 * _PATIENCE)))
            # Left of the plots.
            pixels = np.asarray(image.convert("RGB"), dtype=float)[60:760, :850] / 255
            return all(
                (np.abs(pixels - stage_color(stage)).max(axis=2) < 0.1).sum() > 200
                for stage in (1, 2)
            )

        until(shown)
        assert errors == []
        browser.close()
