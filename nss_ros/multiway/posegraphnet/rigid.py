"""Stacks of rigid transforms as tensors through which gradients flow."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Below this angle, rad, the series of the exponential are exact to the last digit of a float64.
_SMALL = 1e-4


class Rigid(NamedTuple):
    """Rigid transforms.

    Attributes:
        rotation: (n, 3, 3).
        translation: (n, 3).
    """

    rotation: Tensor
    translation: Tensor

    @classmethod
    def of(cls, matrices: Tensor) -> Rigid:
        """Transforms of matrices (n, 4, 4)."""
        return cls(matrices[:, :3, :3], matrices[:, :3, 3])

    @classmethod
    def identity(cls, count: int, like: Tensor) -> Rigid:
        """Transforms that change nothing, of the type of a tensor."""
        return cls(torch.eye(3).to(like).expand(count, 3, 3), like.new_zeros(count, 3))

    def matrices(self) -> Tensor:
        """(n, 4, 4)."""
        upper = torch.cat((self.rotation, self.translation[:, :, None]), dim=2)
        lower = upper.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(upper), 1, 4)
        return torch.cat((upper, lower), dim=1)

    def __matmul__(self, other: Rigid) -> Rigid:
        return Rigid(
            self.rotation @ other.rotation,
            torch.einsum("nij,nj->ni", self.rotation, other.translation) + self.translation,
        )

    def inverse(self) -> Rigid:
        """The inverses."""
        rotation = self.rotation.transpose(1, 2)
        return Rigid(rotation, -torch.einsum("nij,nj->ni", rotation, self.translation))

    def take(self, index: Tensor) -> Rigid:
        """Those of an index (k,)."""
        return Rigid(self.rotation.index_select(0, index), self.translation.index_select(0, index))

    def scaled(self, factor: float) -> Rigid:
        """The same in another unit of length."""
        return Rigid(self.rotation, self.translation * factor)

    def detached(self) -> Rigid:
        """The same without gradients."""
        return Rigid(self.rotation.detach(), self.translation.detach())

    def vectors(self) -> Tensor:
        """The columns of the rotation, then the translation, (n, 12)."""
        return torch.cat((self.rotation.transpose(1, 2).flatten(1), self.translation), dim=1)


def exponential(twists: Tensor) -> Rigid:
    """SE(3) exponential of twists (n, 6), order x y z rx ry rz."""
    rho, phi = twists[:, :3], twists[:, 3:]
    square = (phi * phi).sum(dim=1)[:, None, None]
    small = square < _SMALL**2
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    # sin(a) / a, (1 - cos(a)) / a^2 and (a - sin(a)) / a^3.
    first = torch.where(small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / safe)
    third = torch.where(small, 1 / 6 - square / 120, (angle - angle.sin()) / (safe * angle))
    cross = _cross(phi)
    twice = cross @ cross
    unit = torch.eye(3).to(twists)
    jacobian = unit + second * cross + third * twice
    return Rigid(unit + first * cross + second * twice, torch.einsum("nij,nj->ni", jacobian, rho))


def _cross(vectors: Tensor) -> Tensor:
    x, y, z = vectors.unbind(dim=1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=1).reshape(-1, 3, 3)
