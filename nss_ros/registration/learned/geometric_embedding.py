"""Where superpoints lie relative to each other (Qin et al., CVPR 2022, section 3.2).

The embedding of a pair of superpoints is of their distance and of the angles that their line makes
with the lines to the nearest neighbours of the first; it does not change when all move rigidly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

#: Neighbours of a superpoint that angles are measured from.
NEIGHBOURS = 3

_ANGLE = math.radians(15)

# With steps this small, linear interpolation is as exact as float32: its error is below the second
# derivative / (8 * 512**2).
_STEPS = 512
_MOST_STEPS = 2**17


class SinusoidalEmbedding(nn.Module):
    """Sines and cosines of a number, in turns, of ever lower frequencies."""

    div_term: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        powers = torch.arange(0, channels, 2) / channels
        self.register_buffer("div_term", torch.exp(-math.log(10000.0) * powers))

    def forward(self, numbers: Tensor) -> Tensor:
        """(..., channels) of numbers (...)."""
        phases = numbers[..., None] * self.div_term
        return torch.stack((phases.sin(), phases.cos()), dim=-1).flatten(-2)


@dataclass(frozen=True, slots=True)
class Curve:
    """A projected sinusoidal embedding of a number, looked up in a table where that is quicker.

    Attributes:
        embedding: of numbers.
        projection: of the embedding.
        table: (k, channels), projected embeddings of 0, 1/512, 2/512, ...; None if there is none.
    """

    embedding: SinusoidalEmbedding
    projection: nn.Linear
    table: Tensor | None

    @classmethod
    def of(
        cls, embedding: SinusoidalEmbedding, projection: nn.Linear, highest: float, count: int
    ) -> Curve:
        """A curve for `count` numbers from 0 to `highest`."""
        steps = highest * _STEPS + 2
        if steps > min(count, _MOST_STEPS):
            return cls(embedding, projection, None)
        numbers = torch.arange(int(steps) + 1, device=projection.weight.device) / _STEPS
        return cls(embedding, projection, projection(embedding(numbers)))

    def __call__(self, numbers: Tensor) -> Tensor:
        """(..., channels) of numbers (...)."""
        if self.table is None:
            embedded: Tensor = self.projection(self.embedding(numbers))
            return embedded
        positions = numbers.flatten() * _STEPS
        below = positions.floor()
        share = positions - below
        found = nn.functional.embedding_bag(
            torch.stack((below, below + 1), dim=1).int(),
            self.table,
            per_sample_weights=torch.stack((1 - share, share), dim=1),
            mode="sum",
        )
        return found.view(*numbers.shape, -1)


@dataclass(frozen=True, slots=True)
class Structure:
    """The embeddings of all pairs of n superpoints, made a few rows at a time.

    All of them at once would need gigabytes: a room has thousands of superpoints.

    Attributes:
        points: (n, 3), metres.
        distances: (n, n), of pairs, in units of the curve.
        nearest: (n, NEIGHBOURS, 3), from each superpoint to its neighbours, metres.
        of_distance: curve of distances.
        of_angle: curve of angles.
    """

    points: Tensor
    distances: Tensor
    nearest: Tensor
    of_distance: Curve
    of_angle: Curve

    def __len__(self) -> int:
        return len(self.points)

    def rows(self, rows: slice) -> Tensor:
        """Embeddings (r, n, channels) of some superpoints as the first of a pair."""
        lines = self.points - self.points[rows, None]
        embedded = self.of_angle(self._angles(lines, self.nearest[rows, 0]))
        # Where there are gradients, they need what a further angle would write over.
        place = None if torch.is_grad_enabled() else embedded
        for neighbour in range(1, NEIGHBOURS):
            angles = self._angles(lines, self.nearest[rows, neighbour])
            embedded = torch.maximum(embedded, self.of_angle(angles), out=place)
        return embedded.add_(self.of_distance(self.distances[rows]))

    @staticmethod
    def _angles(lines: Tensor, nearest: Tensor) -> Tensor:
        """Between lines (r, n, 3) and one of each row (r, 3), (r, n), in units of the curve."""
        across = torch.linalg.cross(nearest[:, None], lines, dim=-1).norm(dim=-1)
        along = (lines @ nearest[:, :, None])[..., 0]
        return torch.atan2(across, along) / _ANGLE


class GeometricEmbedding(nn.Module):
    """Embeddings of pairs of superpoints.

    Attributes:
        sigma: distance that counts as one, metres.
    """

    def __init__(self, channels: int, sigma: float) -> None:
        super().__init__()
        self.sigma = sigma
        self.embedding = SinusoidalEmbedding(channels)
        self.proj_d = nn.Linear(channels, channels)
        self.proj_a = nn.Linear(channels, channels)

    def forward(self, points: Tensor) -> Structure:
        """Of superpoints (n, 3), metres, distinct and more than NEIGHBOURS."""
        # Not by a matrix product, which is centimetres off.
        metres = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = metres.topk(NEIGHBOURS + 1, largest=False).indices[:, 1:]
        distances = metres / self.sigma
        count = distances.numel()
        return Structure(
            points,
            distances,
            points[nearest] - points[:, None],
            Curve.of(self.embedding, self.proj_d, float(distances.max()), count),
            Curve.of(self.embedding, self.proj_a, math.pi / _ANGLE, count * NEIGHBOURS),
        )
