"""A benchmark on a real Ray cluster of two nodes, on this machine."""

import pytest

from nss_ros.bag import read_log
from nss_ros.batch.registering import Workforce
from nss_ros.batch.run import Choice, run_benchmark
from nss_ros.batch.source import BatchSplit, DatasetSource
from nss_ros.config import NssConfig
from nss_ros.errors import InputError
from nss_ros.parallel import Engine, run, stream
from nss_ros.registration.relative_transform import Reason


@pytest.fixture
def cluster(plugins, monkeypatch):  # noqa: ARG001 - its nodes start with the package
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    nodes = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    nodes.add_node(**node)
    monkeypatch.setenv("RAY_ADDRESS", nodes.address)
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def test_the_cluster_gives_what_this_machine_gives(dataset, tmp_path, cluster):  # noqa: ARG001
    # Ray's workers can import what the package has, but not this file.
    from guess_methods import fail, where

    # As they come, from both nodes.
    begin = [0.0] * 4 + [1.5]
    found = list(stream(where, [3.0, *begin], engine=Engine.RAY))
    assert sorted(seconds for seconds, _ in found) == sorted([3.0, *begin])
    assert found[-1][0] == 3.0
    assert len({node for _, node in found}) == 2
    assert [seconds for seconds, _ in run(where, [0.5, 0.0, 0.1], engine=Engine.RAY)] == [
        0.5,
        0.0,
        0.1,
    ]
    with pytest.raises(InputError, match=r"^Item 7 is not usable\.$"):
        list(run(fail, [7], engine=Engine.RAY))

    splits = [BatchSplit.CROSS_STAGE]
    logs = {}
    for name, force in (
        ("here", Workforce(1)),
        ("there", Workforce(engine=Engine.RAY)),
    ):
        choice = Choice(["guess", "lethal"], splits, ["choi"])
        made = run_benchmark(DatasetSource(dataset), tmp_path / name, choice, NssConfig(), force)
        logs[name] = [read_log(log.path) for log in made.logs]
    for here, there in zip(logs["here"], logs["there"], strict=True):
        assert here.pairs == there.pairs
        for pair in here.pairs:
            one, other = here.relative_transforms[pair], there.relative_transforms[pair]
            assert one.T_target_source.tobytes() == other.T_target_source.tobytes()
            assert (one.reason, one.message) == (other.reason, other.message)
    reasons = {each.reason for each in logs["there"][1].relative_transforms.values()}
    assert reasons == {Reason.NONE, Reason.WORKER_DIED}
