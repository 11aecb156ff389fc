import os
import signal

from nss_ros.worker_process import stop_now, worker_pool


def test_ctrl_c_of_the_terminal_does_not_reach_workers():
    pool = worker_pool(1)
    try:
        worker = pool.submit(os.getpid).result()
        os.kill(worker, signal.SIGINT)
        assert pool.submit(os.getpid).result() == worker
    finally:
        stop_now(pool)
