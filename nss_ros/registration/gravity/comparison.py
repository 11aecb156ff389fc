"""A second look at aligned hypotheses: what both fragments saw, side by side.

The search adds up products of features, cell by cell, so that all poses can be scored at once.
Of the few poses that are left, a small network sees the features of both fragments on one grid,
and thereby also what stands beside what: a row of studs that ends where the other has none, a wall
that is in free space as a whole.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nss_ros.registration.gravity.correlation import rotated
from nss_ros.registration.gravity.network import CHANNELS, as_target

_WIDTH = 32
# Features are scaled to about 1; single cells far beyond that say no more.
_MOST = 8.0
# Sums over the cells of a usual map are about this large.
_CELLS = 40.0
# More poses at a time would not stay in the cache.
_BATCH = 12


class Comparison(nn.Module):
    """Log-odds that poses are right, by the features of both fragments."""

    def __init__(self) -> None:
        super().__init__()
        self.feature_scale: Tensor
        self.product_scale: Tensor
        self.register_buffer("feature_scale", torch.ones(CHANNELS, 1, 1))
        self.register_buffer("product_scale", torch.ones(CHANNELS, 1, 1))
        self.enter = nn.Conv2d(3 * CHANNELS, _WIDTH, 1)
        self.fine = nn.Conv2d(_WIDTH, _WIDTH, 3, 1, 1)
        self.down = nn.Conv2d(_WIDTH, 48, 3, 2, 1)
        self.middle = nn.Conv2d(48, 48, 3, 1, 1)
        self.further = nn.Conv2d(48, 64, 3, 2, 1)
        self.deep = nn.Conv2d(64, 64, 3, 1, 1)
        self.leave = nn.Sequential(nn.Linear(128, 32), nn.ReLU(), nn.Linear(32, 1))

    def forward(self, moved: Tensor, still: Tensor) -> Tensor:
        """Log-odds (k,), up to a constant.

        Args:
            moved: (k, CHANNELS, n, n), features of the source, as a source, on the target's grid.
            still: (CHANNELS, n, n), features of the target, as a target.
        """
        inputs = torch.cat(
            (
                moved / self.feature_scale,
                (still / self.feature_scale).expand_as(moved),
                moved * still / self.product_scale,
            ),
            dim=1,
        ).clamp(-_MOST, _MOST)
        fine = torch.relu(self.enter(inputs))
        fine = torch.relu(fine + self.fine(fine))
        half = torch.relu(self.down(fine))
        half = torch.relu(half + self.middle(half))
        quarter = torch.relu(self.further(half))
        quarter = torch.relu(quarter + self.deep(quarter))
        summary = torch.cat((quarter.sum(dim=(2, 3)) / _CELLS, quarter.amax(dim=(2, 3))), dim=1)
        odds: Tensor = self.leave(summary)[:, 0]
        return odds


def compared(
    comparison: Comparison, source: Tensor, target: Tensor, yaws: Tensor, shifts: Tensor
) -> Tensor:
    """Log-odds of poses (k,), the mean of both fragments in the place of the source.

    Args:
        comparison: the network.
        source: (CHANNELS, n, n), as a source.
        target: (CHANNELS, n, n), as a source, too.
        yaws: (k,) of `T_target_source`, radians.
        shifts: (k, 2), x and y of it, metres.
    """
    with torch.inference_mode():
        parts = zip(torch.split(yaws, _BATCH), torch.split(shifts, _BATCH), strict=True)
        looks = [_compared(comparison, source, target, one, other) for one, other in parts]
        return torch.cat(looks)


def swapped(yaws: Tensor, shifts: Tensor) -> tuple[Tensor, Tensor]:
    """Yaws (k,) and shifts (k, 2) of the inverse transforms."""
    cosines, sines = yaws.cos(), yaws.sin()
    x, y = shifts.unbind(dim=1)
    return -yaws, torch.stack((-cosines * x - sines * y, sines * x - cosines * y), dim=1)


def _compared(
    comparison: Comparison, source: Tensor, target: Tensor, yaws: Tensor, shifts: Tensor
) -> Tensor:
    forth = comparison(rotated(source, yaws, shifts), as_target(target))
    back = comparison(rotated(target, *swapped(yaws, shifts)), as_target(source))
    mean: Tensor = (forth + back) / 2
    return mean
