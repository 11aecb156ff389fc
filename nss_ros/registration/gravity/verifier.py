"""How probable each aligned hypothesis is, and that the fragments overlap at all.

A small network scores each hypothesis by its signs; the scores of all hypotheses of a pair and of
"none of them" are made into probabilities together, so that two that look equally good get half
of it each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from nss_ros.registration.gravity.refinement import SIGNS

_HIDDEN = 24


class Verifier(nn.Module):
    """Probabilities from signs; one set of weights for each kind of pair."""

    def __init__(self) -> None:
        super().__init__()
        self.mean: Tensor
        self.deviation: Tensor
        self.register_buffer("mean", torch.zeros(len(SIGNS)))
        self.register_buffer("deviation", torch.ones(len(SIGNS)))
        # One more input: whether the fragments are of one stage.
        self.score = nn.Sequential(
            nn.Linear(len(SIGNS) + 1, _HIDDEN), nn.Tanh(), nn.Linear(_HIDDEN, 1)
        )
        self.overlap = nn.Sequential(
            nn.Linear(len(SIGNS) + 2, _HIDDEN), nn.Tanh(), nn.Linear(_HIDDEN, 1)
        )

    def forward(self, signs: Tensor, same_stage: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probabilities of hypotheses and of none, and the logit of an overlap.

        Args:
            signs: (b, k, len(SIGNS)); NaN in hypotheses that there are not.
            same_stage: (b,) 0 or 1.

        Returns:
            (b, k + 1), the last for none of them; and (b,).
        """
        missing = signs[..., 0].isnan()
        inputs = ((signs - self.mean) / self.deviation).nan_to_num(0.0).clamp(-6, 6)
        kind = same_stage[:, None, None].expand(*inputs.shape[:2], 1)
        scores = self.score(torch.cat((inputs, kind), dim=-1))[..., 0]
        scores = scores.masked_fill(missing, -30.0)
        logits = torch.cat((scores, torch.zeros_like(scores[:, :1])), dim=1)
        best = scores.argmax(dim=1)
        rows = torch.arange(len(best))
        chosen = torch.cat(
            (inputs[rows, best], scores[rows, best, None], same_stage[:, None]), dim=-1
        )
        return logits.log_softmax(dim=1), self.overlap(chosen)[:, 0]


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is known about the hypotheses of a pair.

    Attributes:
        probabilities: (k,) float64, that each is right; the rest to 1 is that none is.
        overlap: probability that the fragments overlap.
    """

    probabilities: NDArray[np.float64]
    overlap: float


def judge(verifier: Verifier, signs: Sequence[NDArray[np.float64]], same_stage: bool) -> Judgement:
    """Judges the hypotheses of one pair by their signs, each (len(SIGNS),)."""
    with torch.inference_mode():
        inputs = torch.from_numpy(np.stack(signs)).float()[None]
        logs, overlap = verifier(inputs, torch.tensor([float(same_stage)]))
        probabilities = logs[0, :-1].exp().double().numpy()
        return Judgement(probabilities, float(overlap.sigmoid()[0]))
