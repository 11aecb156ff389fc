import threading

import numpy as np
import pytest
import torch
from torch import nn

from nss_ros.config import TrainingConfig
from nss_ros.errors import RunError
from nss_ros.registration.learned.training.loop import Trainer, ahead, share_of_rate


class Numbers:
    """Examples that are numbers, of which every third has too little in common with another."""

    def drawn(self, number, attempt):
        return (number + attempt) % 7, np.random.default_rng((number, attempt))

    def at(self, place):
        return place, np.random.default_rng(place)


class Line:
    """Learns the slope of a line."""

    learning_rate = 0.05

    def __init__(self, slope=3.0):
        torch.manual_seed(0)
        self.network = nn.Linear(1, 1)
        self.slope = slope

    def prepare(self, example, random):
        return None if example % 3 == 2 else float(random.normal())

    def losses(self, prepared):
        told = self.network(torch.tensor([[prepared]]))
        return {"square": (told - self.slope * prepared).square().sum()}


def trainer(steps=200, slope=3.0, **settings):
    config = TrainingConfig(steps=steps, save_every=50, **settings)
    return Trainer(Line(slope), Numbers(), (Numbers(), 5), config)


def test_it_learns_and_tells_validation_where_state_is_saved():
    learner = trainer()
    reports = list(learner.steps())
    assert [report.step for report in reports] == list(range(1, 201))
    told = [report for report in reports if report.validation is not None]
    assert [report.step for report in told] == [50, 100, 150, 200]
    assert told[-1].validation < 0.05 * told[0].validation
    assert learner.state()["state_dict"]["weight"].item() == pytest.approx(3, abs=0.2)


@pytest.mark.parametrize("batch", [1, 3])
def test_a_run_that_goes_on_ends_like_one_that_was_not_cut(batch):
    whole = trainer(batch=batch)
    list(whole.steps())
    cut = trainer(batch=batch)
    for report in cut.steps():
        if report.step == 70:
            break
    following = trainer(batch=batch)
    following.load(cut.state())
    assert following.step == 70
    rest = list(following.steps())
    assert len(rest) == 130
    for name, tensor in whole.state()["state_dict"].items():
        assert torch.equal(tensor, following.state()["state_dict"][name])


def test_a_loss_that_is_no_number_ends_it():
    with pytest.raises(RunError, match=r"step 1 is not a number: lower training\.learning_rate"):
        next(trainer(slope=float("nan")).steps())


def test_pairs_without_anything_in_common_end_it():
    learner = trainer()
    learner._trainee.prepare = lambda *_: None
    with pytest.raises(RunError, match="none has enough points in common"):
        next(learner.steps())


def test_without_validation_pairs_no_loss_is_told():
    learner = Trainer(Line(), Numbers(), (Numbers(), 0), TrainingConfig(steps=1))
    (report,) = learner.steps()
    assert np.isnan(report.validation)


def test_the_rate_rises_then_falls():
    shares = [share_of_rate(step / 1000) for step in range(1001)]
    peak = int(np.argmax(shares))
    assert 0 < shares[0] < 0.05
    assert peak == 50
    assert np.all(np.diff(shares[:peak]) > 0)
    assert np.all(np.diff(shares[peak:]) < 0)
    assert max(shares) == pytest.approx(1)
    assert shares[-1] == pytest.approx(0)


def test_work_is_done_ahead_in_order_and_by_other_threads():
    started = threading.Event()
    threads = set()

    def work(number):
        threads.add(threading.get_ident())
        if number == 0:
            assert started.wait(10)  # until a later one has begun
        started.set() if number else None
        return number

    assert list(ahead(work, iter(range(20)), 3)) == list(range(20))
    assert threading.get_ident() not in threads


def test_what_goes_wrong_ahead_is_raised_in_its_turn():
    def work(number):
        if number == 2:
            raise RunError("two")
        return number

    found = ahead(work, iter(range(9)), 4)
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(RunError, match="two"):
        next(found)
