"""Settings of datasets: pairs, splits, graphs and ground truth."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from nss_ros.config.ground_truth import AlignmentConfig, RefinementConfig
from nss_ros.config.section import Fraction, Positive, Section


class SelectionConfig(Section):
    """How pairs are chosen so that easy and hard ones are equally many."""

    share: Fraction = Field(
        0.5, description="Share of the eligible same-stage and of the different-stage pairs chosen"
    )
    same_stage_pairs: int = Field(
        0, ge=0, description="Number of same-stage pairs to choose; 0: by share"
    )
    different_stage_pairs: int = Field(
        0, ge=0, description="Number of different-stage pairs to choose; 0: by share"
    )
    overlap_bins: int = Field(
        9, ge=1, le=100, description="Bins of the overlap ratio, from min_overlap to 1"
    )
    change_bins: int = Field(
        10, ge=1, le=100, description="Bins of the temporal change ratio, from 0 to 1"
    )
    complexity_bins: int = Field(
        1, ge=1, le=100, description="Bins of the pair's complexity; 1: complexity is not balanced"
    )
    complexity_limit: Positive = Field(
        0.12, description="Complexity at which the last of its bins ends"
    )


class PairConfig(Section):
    """Which pairs are measured and chosen (NSS paper, pairwise dataset)."""

    overlap_distance: Positive = Field(
        0.2, description="Distance at which points count as overlapping (tau), metres"
    )
    curvature_radius: Positive = Field(
        0.5, description="Neighbourhood of the surface variation, metres"
    )
    least_overlap: Fraction = Field(
        0.01,
        description="Pairs that overlap less than this in both directions are left out of the table",
    )
    min_overlap: Fraction = Field(0.1, description="Least overlap ratio of a chosen pair")
    selection: SelectionConfig = SelectionConfig()


class SplitConfig(Section):
    """Which pairs train, validate and test."""

    train_share: Fraction = Field(
        0.7, description="Share of the pairs (or fragments) that train in the split 'original'"
    )
    validation_share: Fraction = Field(
        0.1,
        description="Share that validates: of all in 'original', of the training pairs in the other splits",
    )
    original_by: Literal["pairs", "fragments"] = Field(
        "pairs",
        description="What 'original' draws; by fragments, no fragment is in two sets, and pairs between sets are dropped",
    )
    train_areas: tuple[str, ...] = Field(
        ("1", "2", "6", "A", "B", "F"), description="Areas that train in 'cross_area'"
    )
    validation_areas: tuple[str, ...] = Field(
        (),
        description="Areas that validate in 'cross_area' (the challenge: 3); none: a share of the training pairs",
    )
    test_areas: tuple[str, ...] = Field(
        ("3", "4", "5", "C", "D", "E"),
        description="Areas that test in 'cross_area' (the challenge: 4 and 5)",
    )

    @model_validator(mode="after")
    def _disjoint(self) -> Self:
        if self.train_share + self.validation_share > 1:
            raise ValueError("train_share and validation_share must not be more than 1 together")
        named = [*self.train_areas, *self.validation_areas, *self.test_areas]
        for area in named:
            if named.count(area) > 1:
                raise ValueError(
                    f"area '{area}' is named twice in train, validation and test areas"
                )
        return self


class GraphConfig(Section):
    """Pose graphs: one per area as in the NSS paper, and many small ones as in its challenge."""

    min_overlap: Fraction = Field(0.1, description="Least overlap ratio of an edge")
    min_component: int = Field(
        50, ge=2, description="Fewest nodes of a graph of a whole area (multi-way)"
    )
    sizes: tuple[int, ...] = Field(
        (20, 40, 80, 160), min_length=1, description="Numbers of nodes of challenge graphs"
    )
    graphs_per_area: int = Field(
        20, ge=0, le=10_000, description="Number of challenge graphs of each area"
    )
    outlier_share: float = Field(
        0.1, ge=0, le=0.5, description="Largest share of nodes that overlap with no other node"
    )
    other_areas: bool = Field(
        True, description="Take outliers from other areas where the own one has too few"
    )
    min_degree: int = Field(2, ge=1, le=10, description="Fewest edges of a node, outliers apart")
    min_mean_overlap: Fraction = Field(
        0.3, description="The mean overlap ratio of a challenge graph's edges is above this"
    )
    attempts: int = Field(
        20, ge=1, le=1000, description="Attempts to grow a challenge graph before it is given up"
    )

    @model_validator(mode="after")
    def _large_enough(self) -> Self:
        if min(self.sizes) <= self.min_degree:
            raise ValueError("every size must be more than min_degree")
        return self


class DatasetConfig(Section):
    """How a dataset is made of fragments and their true poses."""

    pairs: PairConfig = PairConfig()
    splits: SplitConfig = SplitConfig()
    graphs: GraphConfig = GraphConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    refinement: RefinementConfig = RefinementConfig()
