"""Settings of datasets: pairs, splits, graphs and the refinement of ground truth."""

from __future__ import annotations

from pydantic import Field

from nss_ros.config.section import Fraction, Positive, Section


class PairConfig(Section):
    """Which pairs are measured and chosen (NSS paper, pairwise dataset)."""

    overlap_distance: Positive = Field(
        0.2, description="Distance at which points count as overlapping (tau), metres"
    )
    curvature_radius: Positive = Field(
        0.5, description="Neighbourhood of the surface variation, metres"
    )
    min_overlap: Fraction = Field(0.1, description="Least overlap ratio of a chosen pair")


class DatasetConfig(Section):
    """How a dataset is made of fragments and their true poses."""

    pairs: PairConfig = PairConfig()
