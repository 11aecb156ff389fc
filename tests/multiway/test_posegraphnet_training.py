"""Simulated graphs are what they say, and the network learns from them."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from nss_ros.geometry import inverse, relative, rotation_angle, tilt_angle
from nss_ros.multiway.posegraphnet import train as command
from nss_ros.multiway.posegraphnet.network import SynchronizationNetwork
from nss_ros.multiway.posegraphnet.rigid import Rigid
from nss_ros.multiway.posegraphnet.simulated_graph import GraphSettings, simulated_graph
from nss_ros.multiway.posegraphnet.training import (
    TrainingConfig,
    calm,
    compared_pairs,
    joined,
    lesson,
    sequence_loss,
    train,
    varied,
)
from nss_ros.multiway.posegraphnet.weights import Usage, load_weights
from nss_ros.multiway.spanning_tree import Closeness

CLOSE = Closeness(0.4, np.radians(6))
SMALL = GraphSettings(fragments=(12, 16), stages=(2, 3), degree=(4, 6))


def graph_of(seed, settings=SMALL):
    return simulated_graph(np.random.default_rng(seed), settings)


def misses(graph):
    """Metres and radians between the measurements and the truth."""
    shifts, turns = [], []
    for m in graph.measurements:
        truth = relative(graph.poses[m.pair.source], graph.poses[m.pair.target])
        shifts.append(np.linalg.norm((m.T_target_source - truth)[:3, 3]))
        turns.append(rotation_angle(relative(m.T_target_source, truth)))
    return np.array(shifts), np.array(turns)


@pytest.mark.parametrize("seed", range(5))
def test_graphs_are_those_of_level_tripods(seed):
    graph = graph_of(seed, GraphSettings())
    assert 20 <= len(graph.poses) <= 60
    assert graph.fragments == sorted(graph.fragments)
    assert 2 <= len({id_.stage for id_ in graph.fragments}) <= 6
    assert len({m.pair for m in graph.measurements}) == len(graph.measurements)
    for pose in graph.poses.values():
        assert tilt_angle(pose) < np.radians(3)
        assert abs(pose[2, 3]) < 0.5
    for m in graph.measurements:
        apart = relative(graph.poses[m.pair.source], graph.poses[m.pair.target])
        assert np.linalg.norm(apart[:2, 3]) < 7.5
    assert 2 * len(graph.measurements) <= 15 * len(graph.poses) + 2


def test_right_measurements_are_near_the_truth_and_others_are_not():
    settings = GraphSettings(noise_translation=(0.05, 0.05), noise_rotation=(1, 1))
    graphs = [graph_of(seed, settings) for seed in range(10)]
    right = np.concatenate([graph.right for graph in graphs])
    shifts, turns = np.concatenate([misses(graph) for graph in graphs], axis=1)
    off = (shifts > 0.2) | (turns > np.radians(5))
    assert np.mean(off[right]) < 0.01
    assert np.mean(off[~right]) > 0.98
    assert np.sqrt(np.mean(shifts[right] ** 2)) == pytest.approx(0.05, rel=0.1)
    assert np.sqrt(np.mean(turns[right] ** 2)) == pytest.approx(np.radians(1.5**0.5), rel=0.1)


def test_aliases_agree_with_each_other_and_random_ones_do_not():
    """The map frames in which a source would have to lie: of aliases, a few; else, all another."""
    quiet = {"noise_translation": (1e-6, 1e-6), "noise_rotation": (1e-6, 1e-6)}
    shares = []
    for aliased in (1.0, 0.0):
        graph = graph_of(3, replace(GraphSettings(aliased=(aliased, aliased), tilted=0), **quiet))
        moved = [
            graph.poses[m.pair.target] @ m.T_target_source @ inverse(graph.poses[m.pair.source])
            for m, right in zip(graph.measurements, graph.right, strict=True)
            if not right
        ]
        moved += [inverse(each) for each in moved]
        distinct = {tuple(np.round(each[:3], 3).ravel() + 0.0) for each in moved}
        shares.append(len(distinct) / len(moved))
    assert shares[0] < 0.6
    assert shares[1] == 1.0


def test_the_same_seed_draws_the_same_graph():
    one, other, different = graph_of(4), graph_of(4), graph_of(5)
    assert [m.T_target_source.tobytes() for m in one.measurements] == [
        m.T_target_source.tobytes() for m in other.measurements
    ]
    assert [m.pair for m in one.measurements] != [m.pair for m in different.measurements]


def test_variations_keep_what_is_right_and_what_is_wrong():
    one = lesson(graph_of(0), CLOSE)
    rng = np.random.default_rng(0)
    lengths = None
    for _ in range(6):
        other = varied(one, rng)
        poses = other.truth
        true = poses.take(other.graph.target) @ poses.take(other.graph.source).inverse()
        errors = (other.graph.measured.inverse() @ true).translation.norm(dim=1).numpy()
        lengths = errors if lengths is None else lengths
        assert np.allclose(errors, lengths, atol=1e-4)
        assert not torch.allclose(other.truth.rotation, one.truth.rotation)


def test_the_loss_is_zero_for_the_truth_and_does_not_see_the_map_frame():
    batch = joined([lesson(graph_of(n), CLOSE) for n in range(2)])
    pairs = compared_pairs(batch, np.random.default_rng(0))
    assert (batch.part[pairs[0]] == batch.part[pairs[1]]).all()
    sure = torch.cat((batch.right, batch.right)) * 200 - 100
    torch.manual_seed(0)
    state = SynchronizationNetwork(8)(batch.graph, batch.start, 1)[-1]
    true = state._replace(poses=batch.truth, logits=sure)
    assert float(sequence_loss([true], batch, pairs)) < 1e-4
    assert float(sequence_loss([true._replace(logits=-sure)], batch, pairs)) > 10
    away = Rigid(torch.eye(3)[[1, 2, 0]].expand(1, 3, 3), torch.tensor([[3.0, -2.0, 1.0]]))
    everywhere = away.take(torch.zeros(len(batch.part), dtype=torch.int64))
    other = state._replace(poses=state.poses @ everywhere)
    expected = float(sequence_loss([state], batch, pairs).detach())
    assert expected > 0.5
    assert float(sequence_loss([other], batch, pairs).detach()) == pytest.approx(expected, rel=1e-4)


def test_training_lowers_the_loss_on_a_fixed_graph_reproducibly():
    runs = []
    for _ in range(2):
        torch.manual_seed(0)
        network = SynchronizationNetwork(16)
        calm(network)
        config = TrainingConfig(steps=50, batch=1, network_steps=4, rounds=1, learning_rate=1e-2)
        runs.append(list(train(network, [lesson(graph_of(1), CLOSE)], config)))
    assert runs[0] == runs[1]
    assert np.mean(runs[0][-10:]) < 0.8 * np.mean(runs[0][:5])


def test_the_command_writes_weights_that_can_be_used(tmp_path, monkeypatch, capsys):
    path = tmp_path / "trained.safetensors"
    words = ["--graphs", "2", "--steps", "2", "--batch", "2", "--width", "8", "--rounds", "2"]
    monkeypatch.setattr(sys, "argv", ["train", "-o", str(path), *words])
    command.main()
    assert "loss" in capsys.readouterr().out
    network, usage = load_weights(str(path))
    assert usage == Usage("tree", 6, 2)
    assert sum(each.numel() for each in network.parameters()) > 0
    again = tmp_path / "again.safetensors"
    monkeypatch.setattr(sys, "argv", ["train", "-o", str(again), *words])
    command.main()
    assert again.read_bytes() == path.read_bytes()
