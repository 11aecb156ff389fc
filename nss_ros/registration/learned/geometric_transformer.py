"""Features of superpoints that know of their own cloud and of the other (Qin et al., CVPR 2022).

Self-attention tells superpoints where the others of their cloud lie (`geometric_embedding`),
cross-attention what the other cloud looks like (section 3.2).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from nss_ros.registration.learned.geometric_embedding import GeometricEmbedding, Structure

_HEADS = 4
_BLOCKS = 3
# Pairs of superpoints whose embeddings are made at a time: what fits into a cache, or a GPU.
_PAIRS = {"cpu": 2**13, "cuda": 2**20}


class RelativeAttention(nn.Module):
    """Attention of the superpoints of a cloud to each other, by features and by structure."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.proj_q = nn.Linear(channels, channels)
        self.proj_k = nn.Linear(channels, channels)
        self.proj_v = nn.Linear(channels, channels)
        self.proj_p = nn.Linear(channels, channels)

    def forward(self, features: Tensor, structure: Structure) -> Tensor:
        """What superpoints with features (n, c) gather, (n, c).

        Queries are taken to the embeddings, rather than the embeddings of all pairs to the
        queries; the bias of their projection adds the same to a whole row, which softmax ignores.
        """
        query = _heads(self.proj_q(features)) / math.sqrt(features.shape[1] // _HEADS)
        key, value = _heads(self.proj_k(features)), _heads(self.proj_v(features))
        weight = self.proj_p.weight.view(_HEADS, -1, features.shape[1])
        structural = (query @ weight).transpose(0, 1)
        step = max(1, _PAIRS[features.device.type] // len(structure))

        def gathered(rows: slice) -> Tensor:
            scores = (structural[rows] @ structure.rows(rows).mT).transpose(0, 1)
            found: Tensor = (scores + query[:, rows] @ key.mT).softmax(dim=-1) @ value
            return found

        parts = [slice(start, start + step) for start in range(0, len(structure), step)]
        if torch.is_grad_enabled():  # embeddings are made again, rather than kept, for gradients
            return _joined(
                torch.cat([checkpoint(gathered, rows, use_reentrant=False) for rows in parts], 1)
            )
        return _joined(torch.cat([gathered(rows) for rows in parts], dim=1))


class CrossAttention(nn.Module):
    """Attention of the superpoints of a cloud to those of the other."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.proj_q = nn.Linear(channels, channels)
        self.proj_k = nn.Linear(channels, channels)
        self.proj_v = nn.Linear(channels, channels)

    def forward(self, features: Tensor, others: Tensor) -> Tensor:
        """What superpoints with features (n, c) gather from others (m, c), (n, c)."""
        return _joined(
            nn.functional.scaled_dot_product_attention(
                _heads(self.proj_q(features))[None],
                _heads(self.proj_k(others))[None],
                _heads(self.proj_v(others))[None],
            )[0]
        )


class AttentionBlock(nn.Module):
    """Attention beside a shortcut."""

    def __init__(self, attention: RelativeAttention | CrossAttention, channels: int) -> None:
        super().__init__()
        self.attention = attention
        self.linear = nn.Linear(channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, features: Tensor, memory: Any) -> Tensor:
        """Features (n, c) of features (n, c) and what the attention is to."""
        normed: Tensor = self.norm(self.linear(self.attention(features, memory)) + features)
        return normed


class FeedForward(nn.Module):
    """Two linear layers beside a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.expand = nn.Linear(channels, 2 * channels)
        self.squeeze = nn.Linear(2 * channels, channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, features: Tensor) -> Tensor:
        """Features (n, c) of features (n, c)."""
        hidden = self.squeeze(self.expand(features).relu())
        normed: Tensor = self.norm(features + hidden)
        return normed


class TransformerLayer(nn.Module):
    """Attention, then a feed-forward network."""

    def __init__(self, attention: RelativeAttention | CrossAttention, channels: int) -> None:
        super().__init__()
        self.attention = AttentionBlock(attention, channels)
        self.output = FeedForward(channels)

    def forward(self, features: Tensor, memory: Any) -> Tensor:
        """Features (n, c) of features (n, c) and what the attention is to."""
        attended: Tensor = self.output(self.attention(features, memory))
        return attended


class ConditionalTransformer(nn.Module):
    """Self-attention and cross-attention in turns."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            TransformerLayer(kind(channels), channels)
            for _ in range(_BLOCKS)
            for kind in (RelativeAttention, CrossAttention)
        )

    def forward(
        self, target: Tensor, source: Tensor, structures: tuple[Structure, Structure]
    ) -> tuple[Tensor, Tensor]:
        """Features of target (n, c) and source (m, c), of features of the same shapes."""
        for within, across in zip(self.layers[::2], self.layers[1::2], strict=True):
            target, source = within(target, structures[0]), within(source, structures[1])
            target = across(target, source)
            source = across(source, target)  # to what the target has just become
        return target, source


class GeometricTransformer(nn.Module):
    """The transformer of superpoints, with its projections.

    Args:
        inside: channels of the features that come in.
        channels: of those within and of those that come out.
        sigma: distance that counts as one, metres.
    """

    def __init__(self, inside: int, channels: int, sigma: float) -> None:
        super().__init__()
        self.embedding = GeometricEmbedding(channels, sigma)
        self.in_proj = nn.Linear(inside, channels)
        self.transformer = ConditionalTransformer(channels)
        self.out_proj = nn.Linear(channels, channels)

    def forward(
        self, target_points: Tensor, source_points: Tensor, target: Tensor, source: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Features (n, channels) and (m, channels) of the superpoints of target and source.

        Args:
            target_points: (n, 3), metres.
            source_points: (m, 3), metres.
            target: (n, inside), features.
            source: (m, inside), features.
        """
        structures = self.embedding(target_points), self.embedding(source_points)
        target, source = self.transformer(self.in_proj(target), self.in_proj(source), structures)
        return self.out_proj(target), self.out_proj(source)


def _heads(features: Tensor) -> Tensor:
    """(n, c) by heads, (_HEADS, n, c / _HEADS)."""
    return features.view(len(features), _HEADS, -1).transpose(0, 1)


def _joined(heads: Tensor) -> Tensor:
    """The inverse of `_heads`."""
    return heads.transpose(0, 1).flatten(1)
