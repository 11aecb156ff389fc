"""The network against formulas written out, and what must not change its answers."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nss_ros.geometry import exponential, inverse, is_transform
from nss_ros.multiway.posegraphnet import rigid
from nss_ros.multiway.posegraphnet.network import (
    GRAPH_FEATURES,
    NODE_FEATURES,
    GraphTensors,
    SynchronizationNetwork,
)
from nss_ros.multiway.posegraphnet.rigid import Rigid

WIDTH = 8


def transforms(rng, count, size=3.0):
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    result[:, :3, 3] = rng.uniform(-size, size, (count, 3))
    return result


def tensors(matrices):
    return Rigid.of(torch.from_numpy(np.asarray(matrices)))


def network(seed=0, width=WIDTH):
    torch.manual_seed(seed)
    return SynchronizationNetwork(width).double().requires_grad_(False)


class Drawn:
    """A graph of some nodes, one of which has no edge, and poses to start from."""

    def __init__(self, seed, count=7, edges=12):
        self.rng = np.random.default_rng(seed)
        pairs = [(i, j) for i in range(count - 1) for j in range(count - 1) if i != j]
        chosen = self.rng.choice(len(pairs), edges, replace=False)
        self.ends = np.array(pairs)[chosen]
        self.measured = transforms(self.rng, edges)
        self.start = transforms(self.rng, count)

    def graph(self, order=None, names=None):
        order = np.arange(len(self.ends)) if order is None else order
        names = np.arange(len(self.start)) if names is None else names
        source, target = names[self.ends[order]].T
        return GraphTensors(
            torch.from_numpy(source),
            torch.from_numpy(target),
            tensors(self.measured[order]),
            torch.zeros(len(self.start), dtype=torch.int64),
        )


def plain(layers, values):
    """A stack of linear layers with ReLU between them, in numpy."""
    linear = [each for each in layers if isinstance(each, torch.nn.Linear)]
    for each in linear[:-1]:
        values = np.maximum(each.weight.numpy() @ values + each.bias.numpy(), 0)
    values = linear[-1].weight.numpy() @ values + linear[-1].bias.numpy()
    return np.maximum(values, 0) if isinstance(layers[-1], torch.nn.ReLU) else values


def written_out(model, drawn, steps):
    """The paper's equations, node by node and message by message."""
    node, whole = model.meta_op.node_model, model.meta_op.global_model
    poses, count = drawn.start.copy(), len(drawn.start)
    features, shared = np.zeros((count, NODE_FEATURES)), np.zeros(GRAPH_FEATURES)
    for _ in range(steps):
        shared = plain(whole.global_mlp, np.concatenate((shared, features.mean(axis=0))))
        moved, changed = poses.copy(), features.copy()
        for receiver in range(count):
            told, opinions = [], []
            for (source, target), measured in zip(drawn.ends, drawn.measured, strict=True):
                for sender, end, there in (
                    (source, target, measured),
                    (target, source, inverse(measured)),
                ):
                    if end != receiver:
                        continue
                    missed = poses[receiver] @ inverse(poses[sender]) @ inverse(there)
                    message = np.concatenate(
                        (features[sender], features[receiver], missed[:3].T.ravel())
                    )
                    told.append(plain(node.node_mlp_1, message))
                    opinions.append(plain(node.weights_mlp_1, message))
            summed = np.zeros(WIDTH)
            for message, opinion in zip(told, opinions, strict=True):
                both = np.concatenate((opinion, np.max(opinions, axis=0)))
                summed += message / (1 + math.exp(-plain(node.weights_mlp_2, both)[0]))
            summed /= np.linalg.norm(summed) + 1e-4
            out = plain(node.node_mlp_2, np.concatenate((summed, features[receiver], shared)))
            turn, length = out[-3:], np.linalg.norm(out[-3:])
            twist = np.concatenate(
                (out[-6:-3], math.pi * length**2 / (1 + length**2) * turn / length)
            )
            moved[receiver] = exponential(twist) @ poses[receiver]
            changed[receiver] += out[:NODE_FEATURES]
        poses, features = moved, changed
    return poses, features


def test_a_step_is_what_the_paper_says():
    drawn, model = Drawn(0), network()
    expected, features = written_out(model, drawn, 3)
    state = model(drawn.graph(), tensors(drawn.start), 3)[-1]
    assert np.allclose(state.poses.matrices().numpy(), expected, atol=1e-9)
    assert np.allclose(state.nodes.numpy(), features, atol=1e-9)
    assert not np.allclose(expected, drawn.start, atol=1e-2)


def test_names_are_those_of_the_published_checkpoints():
    shapes = {name: tuple(t.shape) for name, t in SynchronizationNetwork().state_dict().items()}
    assert len(shapes) == 20
    assert shapes["meta_op.node_model.node_mlp_1.0.weight"] == (256, 44)
    assert shapes["meta_op.node_model.node_mlp_2.0.weight"] == (256, 276)
    assert shapes["meta_op.node_model.node_mlp_2.2.bias"] == (22,)
    assert shapes["meta_op.node_model.weights_mlp_1.2.weight"] == (128, 256)
    assert shapes["meta_op.node_model.weights_mlp_2.2.weight"] == (1, 256)
    assert shapes["meta_op.global_model.global_mlp.2.weight"] == (4, 256)


def test_another_map_frame_changes_nothing():
    drawn, model = Drawn(1), network(1)
    change = transforms(drawn.rng, 1)[0]
    here = model(drawn.graph(), tensors(drawn.start), 5)[-1]
    there = model(drawn.graph(), tensors(drawn.start @ change), 5)[-1]
    assert np.allclose(
        there.poses.matrices().numpy(), here.poses.matrices().numpy() @ change, atol=1e-9
    )
    assert np.allclose(there.logits.numpy(), here.logits.numpy(), atol=1e-9)


def test_other_numbers_and_another_order_change_nothing():
    drawn, model = Drawn(2), network(2)
    order, names = drawn.rng.permutation(len(drawn.ends)), drawn.rng.permutation(len(drawn.start))
    start = np.empty_like(drawn.start)
    start[names] = drawn.start
    one = model(drawn.graph(), tensors(drawn.start), 5)[-1].poses.matrices().numpy()
    other = model(drawn.graph(order, names), tensors(start), 5)[-1].poses.matrices().numpy()
    assert np.allclose(other[names], one, atol=1e-9)


def test_an_edge_may_be_written_the_other_way_round():
    drawn, model = Drawn(3), network(3)
    graph = drawn.graph()
    turned = graph._replace(
        source=graph.target, target=graph.source, measured=graph.measured.inverse()
    )
    one = model(graph, tensors(drawn.start), 5)[-1]
    other = model(turned, tensors(drawn.start), 5)[-1]
    assert np.allclose(one.poses.matrices().numpy(), other.poses.matrices().numpy(), atol=1e-9)
    there, back = one.logits.chunk(2)
    assert np.allclose(torch.cat((back, there)).numpy(), other.logits.numpy(), atol=1e-9)


def test_graphs_of_a_batch_do_not_see_each_other():
    drawn, others, model = Drawn(4), Drawn(5, count=5, edges=6), network(4)
    one, two = drawn.graph(), others.graph()
    both = GraphTensors(
        torch.cat((one.source, two.source + 7)),
        torch.cat((one.target, two.target + 7)),
        tensors(np.concatenate((drawn.measured, others.measured))),
        torch.cat((one.graph, two.graph + 1)),
    )
    start = np.concatenate((drawn.start, others.start))
    joined = model(both, tensors(start), 5)[-1].poses.matrices().numpy()
    for part, graph, own in ((joined[:7], one, drawn), (joined[7:], two, others)):
        alone = model(graph, tensors(own.start), 5)[-1].poses.matrices().numpy()
        assert np.allclose(part, alone, atol=1e-9)


def test_poses_stay_rigid():
    drawn, model = Drawn(6), network(6)
    for each in model(drawn.graph(), tensors(drawn.start), 30)[-1].poses.matrices().numpy():
        assert is_transform(each, 1e-9)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-6, 1e-3, 1.0, 3.1])
def test_the_exponential_and_its_gradient(scale):
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(5, 6)) * [1, 1, 1, 0, 0, 0] + 0.0
    turns = rng.normal(size=(5, 3))
    twists[:, 3:] = scale * turns / np.linalg.norm(turns, axis=1, keepdims=True)
    tensor = torch.from_numpy(twists).requires_grad_()
    found = rigid.exponential(tensor).matrices()
    assert np.allclose(found.detach().numpy(), [exponential(each) for each in twists], atol=1e-7)
    found.sum().backward()
    step = 1e-6
    for i in range(6):
        shift = torch.zeros(6, dtype=torch.float64)
        shift[i] = step
        high = rigid.exponential(tensor.detach() + shift).matrices().sum(dim=(1, 2))
        low = rigid.exponential(tensor.detach() - shift).matrices().sum(dim=(1, 2))
        expected = ((high - low) / (2 * step)).numpy()
        assert np.allclose(tensor.grad[:, i].numpy(), expected, atol=1e-5)
