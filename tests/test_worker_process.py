import os
import signal
import threading
import time

import pytest

from nss_ros.worker_process import stop_now, worker_pool


def test_ctrl_c_of_the_terminal_does_not_reach_workers():
    pool = worker_pool(1)
    try:
        worker = pool.submit(os.getpid).result()
        os.kill(worker, signal.SIGINT)
        assert pool.submit(os.getpid).result() == worker
    finally:
        stop_now(pool)


@pytest.mark.parametrize("delay", [0.0, 0.3])
def test_a_pool_ends_though_a_large_call_was_on_its_way(delay):
    """Larger than the pipe, which nobody reads any more."""
    pool = worker_pool(1)
    future = pool.submit(len, bytes(30_000_000))
    time.sleep(delay)
    ending = threading.Thread(target=stop_now, args=(pool,), daemon=True)
    ending.start()
    ending.join(60)
    assert not ending.is_alive()
    assert future.done()


def test_a_pool_that_was_never_used_ends():
    stop_now(worker_pool(2))
