import os
import signal

import numpy as np
import pytest

from nss_ros.config import PairConfig
from nss_ros.dataset.pairs import measure_pairs
from nss_ros.errors import InputError, WorkerDiedError
from nss_ros.parallel import Engine, run, stream


def square(number):
    return number * number


def process(_):
    return os.getpid()


def die(_):
    os.kill(os.getpid(), signal.SIGKILL)


def fail(number):
    if number == 3:
        raise InputError("Item 3 is not usable.")
    return number


@pytest.mark.parametrize("workers", [0, 1, 2, 5])
def test_results_come_in_the_order_of_the_items(workers):
    assert list(run(square, range(30), workers)) == [number**2 for number in range(30)]
    assert list(run(square, [], workers)) == []


def test_one_worker_is_this_process_and_two_are_others():
    assert set(run(process, range(4), workers=1)) == {os.getpid()}
    assert os.getpid() not in run(process, range(4), workers=2)


def test_items_are_taken_as_they_are_needed():
    taken = []
    items = (taken.append(i) or i for i in range(1000))
    results = run(square, items, workers=1)
    next(results)
    assert len(taken) < 1000


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_a_call_comes_through(workers):
    with pytest.raises(InputError, match="Item 3 is not usable"):
        list(run(fail, range(6), workers))


@pytest.mark.parametrize("workers", [1, 2])
def test_the_environment_is_as_before(workers, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    list(run(square, range(3), workers))
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_ray_gives_the_same_as_this_process(room, monkeypatch):
    """A real Ray on this machine, with two processes."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    # One of its own: another test may have one on this machine.
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        assert list(run(abs, range(-4, 3), engine=Engine.RAY)) == [4, 3, 2, 1, 0, 1, 2]
        poses = {node.id: node.T_map_fragment for node in room.ground_truth.nodes}
        tables = [
            measure_pairs(room.fragments, poses, PairConfig(), workers, engine)
            for workers, engine in ((1, Engine.LOCAL), (2, Engine.RAY))
        ]
    finally:
        ray.shutdown()
    assert tables[0].pairs == tables[1].pairs
    for name in ("overlap_ratio", "temporal_change", "source_complexity"):
        np.testing.assert_array_equal(getattr(tables[0], name), getattr(tables[1], name))


def test_a_ray_cluster_that_is_not_there_is_named(monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(InputError, match=r"RAY_ADDRESS=127\.0\.0\.1:1"):
        list(run(square, [1], engine=Engine.RAY))


def test_streamed_results_come_as_they_are_there():
    assert sorted(stream(square, range(7), workers=2)) == [n**2 for n in range(7)]
    assert list(stream(square, [], workers=1)) == []
    for workers in (1, 2):
        assert os.getpid() not in stream(process, range(3), workers)
        with pytest.raises(InputError, match="Item 3 is not usable"):
            list(stream(fail, range(6), workers))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_worker_that_dies_is_an_error_of_its_own(workers):
    with pytest.raises(WorkerDiedError, match="killed or crashed"):
        list(stream(die, range(3), workers))
