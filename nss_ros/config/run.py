"""Settings of the nodes, and of the registration and multi-way methods that they run."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from nss_ros.config.section import Fraction, Positive, Section


class PlayerConfig(Section):
    """How bags are replayed."""

    bags: list[str] = Field([], description="Bag directories, played one after the other")
    rate: float = Field(
        1.0, ge=0, description="Speed against recorded time; 0: as fast as possible"
    )
    start_offset: float = Field(
        0.0, ge=0, description="Seconds of bag time to skip (latched data is still published)"
    )
    loop: bool = Field(False, description="Start again at the end")
    start_paused: bool = Field(False, description="Wait for the resume service before playing")
    publish_clock: bool = Field(True, description="Publish bag time on /clock")
    pair_across_bags: bool = Field(
        True,
        description="With several bags that ask for pairs: also ask for every pair of one area between different bags",
    )
    max_pending_pairs: int = Field(
        64, ge=0, description="Hold back when this many pairs await an answer; 0: never"
    )
    wait_for_subscribers: float = Field(
        10.0, ge=0, description="Longest wait for a first subscriber of fragments, seconds"
    )


class FpfhConfig(Section):
    """FPFH features (Rusu et al. 2009) and feature matching."""

    voxel_size: Positive = Field(
        0.1, description="Voxel size of the points that are described, metres"
    )
    normal_radius: Positive = Field(0.25, description="Neighbourhood of normals, metres")
    feature_radius: Positive = Field(0.6, description="Neighbourhood of the descriptor, metres")
    max_keypoints: int = Field(
        5000, gt=0, description="Described points kept for matching, those of the least flat places"
    )
    inlier_distance: Positive = Field(
        0.15, description="Correspondences closer than this agree, metres"
    )
    use_gravity: bool = Field(
        True,
        description="RANSAC of two levelled fragments looks for yaw and translation only",
    )
    hypotheses: int = Field(
        200, gt=0, description="RANSAC hypotheses that are compared before the best are refined"
    )
    ransac_iterations: int = Field(500_000, gt=0, description="Most RANSAC samples per pair")
    ransac_confidence: Fraction = Field(
        0.999, description="RANSAC stops at this probability of success"
    )
    fgr_iterations: int = Field(64, gt=0, description="Iterations of fast global registration")


class GravityConfig(Section):
    """Exhaustive search of levelled fragments."""

    weights: str = Field(
        "", description="File of trained weights; empty: those that come with the package"
    )
    hypotheses: int = Field(
        24, gt=0, le=200, description="Poses that are aligned and judged; more are slower"
    )


class KissMatcherConfig(Section):
    """KISS-Matcher (Lim et al. 2025)."""

    voxel_size: float = Field(
        0.2,
        ge=0.005,
        description="Voxel size of the points that are described, metres; radii of descriptors and tolerances grow with it",
    )
    yaw_only: bool = Field(
        True, description="Between two levelled fragments, solve for yaw and translation only"
    )
    max_matches: int = Field(
        5000, gt=0, description="Matches kept for pruning, the most distinctive"
    )
    min_inliers: int = Field(
        0, ge=0, description="Fewest matches that must agree with a transform before it is refined"
    )


class LearnedConfig(Section):
    """A learned baseline; it does not run without trained weights."""

    weights: str = Field(
        "", description="File of trained weights: the checkpoint of the method's authors, or yours"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="Where the network runs; auto: on a GPU if there is one"
    )
    voxel_size: Positive = Field(
        0.05, description="Voxel size by which the weights were trained, metres"
    )
    inlier_distance: Positive = Field(
        0.15, description="Correspondences closer than this agree, metres"
    )


class DescriptorConfig(LearnedConfig):
    """A learned baseline whose descriptors are matched."""

    max_keypoints: int = Field(5000, gt=0, description="Described points kept for matching")


class FcgfConfig(DescriptorConfig):
    """FCGF (Choy et al. 2019)."""


class D3FeatConfig(DescriptorConfig):
    """D3Feat (Bai et al. 2020)."""

    voxel_size: Positive = Field(
        0.03, description="First voxel size by which the weights were trained, metres"
    )


class PredatorConfig(DescriptorConfig):
    """Predator (Huang et al. 2021)."""

    voxel_size: Positive = Field(
        0.025, description="First voxel size by which the weights were trained, metres"
    )


class GeoTransformerConfig(LearnedConfig):
    """GeoTransformer (Qin et al. 2022)."""

    voxel_size: Positive = Field(
        0.025, description="First voxel size by which the weights were trained, metres"
    )


class IcpConfig(Section):
    """Point-to-plane refinement."""

    max_distance: Positive = Field(
        0.1, description="Longest correspondence of the last level, metres; twice that at first"
    )
    iterations: int = Field(40, gt=0, description="Most iterations per level")
    max_points: int = Field(4000, gt=0, description="Source points used, evenly taken")


class RegistrationConfig(Section):
    """How pairs are registered."""

    method: str = Field("gravity", description="Registered name of the method; see 'nss methods'")
    seed: int = Field(0, ge=0, description="Mixed with the hash of the pair into each pair's seed")
    voxel_size: Positive = Field(
        0.05, description="Fragments are voxelised to this size on arrival, metres"
    )
    min_points: int = Field(100, ge=3, description="Fewest voxelised points that a fragment needs")
    find_standpoints: bool = Field(
        True,
        description="Look for the scanner's place where the origin of a levelled fragment cannot be it, and set tilted ones upright; false: frames are taken as they are",
    )
    min_inlier_ratio: Fraction = Field(
        0.05, description="Least inlier ratio of an estimate; gravity gives a confidence instead"
    )
    max_tilt: Positive = Field(
        3.0,
        description="Most tilt between two levelled fragments, degrees; gravity gives a confidence instead",
    )
    overlap_distance: Positive = Field(
        0.2, description="Distance at which points count as overlapping (tau), metres"
    )
    gravity: GravityConfig = GravityConfig()
    fpfh: FpfhConfig = FpfhConfig()
    kiss_matcher: KissMatcherConfig = KissMatcherConfig()
    fcgf: FcgfConfig = FcgfConfig()
    d3feat: D3FeatConfig = D3FeatConfig()
    predator: PredatorConfig = PredatorConfig()
    geotransformer: GeoTransformerConfig = GeoTransformerConfig()
    icp: IcpConfig = IcpConfig()


class ProposalConfig(Section):
    """Pairs that the registration node asks for itself, by a quick look at all."""

    when: Literal["auto", "always", "never"] = Field(
        "auto", description="auto: if nobody else asks for any pair"
    )
    within: int = Field(6, ge=0, description="Pairs of each fragment with others of its stage")
    across: int = Field(6, ge=0, description="Pairs of each fragment with others of other stages")
    quiet_time: Positive = Field(
        3.0, description="Seconds without a new fragment or pair before it looks"
    )


class RegistrationNodeConfig(RegistrationConfig):
    """Registration as a node: what is registered, by how many."""

    proposals: ProposalConfig = ProposalConfig()
    workers: int = Field(0, ge=0, le=256, description="Worker processes; 0: one per processor core")
    fragment_timeout: Positive = Field(
        15.0,
        description="A pair is answered 'unknown fragment' when no fragment has come for this long, seconds",
    )
    shard_index: int = Field(
        0, ge=0, description="This node's place among the nodes that share the pairs"
    )
    shard_count: int = Field(
        1, ge=1, description="Number of registration nodes that share the pairs"
    )
    memory_limit: int = Field(
        1024,
        gt=0,
        description="MiB of fragments and features kept in memory by each process; the rest waits on disk",
    )


class MultiwayConfig(Section):
    """How relative transforms become poses (Choi et al. 2015)."""

    synchronizer: str = Field(
        "submaps", description="Registered name of the multi-way method; see 'nss methods'"
    )
    start: Literal["evidence", "triangles", "confidence"] = Field(
        "evidence",
        description="Initial poses: by the evidence of all hypotheses, or of a spanning tree by triangle support, or by confidence as in the paper's set-up",
    )
    submap_weights: str = Field(
        "",
        description="File of trained weights of gravity by which submaps are registered; empty: those that come with the package",
    )
    posegraphnet_weights: str = Field(
        "",
        description="File of trained weights of posegraphnet, ours or its authors'; empty: those that come with the package",
    )
    find_standpoints: bool = Field(
        True,
        description="Submaps: look for the scanner's place where the origin of a levelled fragment cannot be it, and set tilted ones upright; false: frames are taken as they are",
    )
    max_distance: Positive = Field(
        0.2, description="Correspondence distance that scales the line process, metres"
    )
    prune_threshold: Fraction = Field(
        0.25, description="Edges whose line process falls below this are rejected"
    )
    preference: Positive = Field(1.0, description="Preference for keeping edges; larger keeps more")
    min_confidence: Fraction = Field(
        0.0, description="Relative transforms below this confidence are rejected at once"
    )
    max_tilt: Positive = Field(
        10.0,
        description="Levelled edges tilted by more than this are rejected at once, degrees; each of two scanners may be tilted by some",
    )
    loop_translation: Positive = Field(
        0.4, description="A loop of edges closes if it misses by no more than this, metres"
    )
    loop_rotation: Positive = Field(6.0, description="... and by no more than this, degrees")
    bridge_confidence: Fraction = Field(
        0.5,
        description="An edge that no loop confirms needs this confidence to link two parts of the map",
    )


class PoseGraphConfig(MultiwayConfig):
    """The pose-graph node: map, frames and rates."""

    map_frame: str = Field(
        "map",
        min_length=1,
        description="Name of the map frame; component n > 0 gets <map_frame>_<n>",
    )
    map_voxel_size: Positive = Field(0.1, description="Voxel size of the published maps, metres")
    map_rate: Positive = Field(
        0.2,
        description="Most that the clouds of the map take while it changes, MB/s on average, so that large ones come seldom; of a settled map all come",
    )
    update_period: Positive = Field(
        2.0,
        description="Least time between optimisations, seconds; after a long one seven times its own time",
    )
    settle_time: Positive = Field(
        1.0, description="Quiet time after which the graph counts as settled, seconds"
    )


class RecorderConfig(Section):
    """What is logged, and how."""

    output: str = Field("", description="Directory of the log to write; must not exist")
    metadata_file: str = Field(
        "", description="JSON object of strings to store in the log as run metadata"
    )
    flush_period: Positive = Field(
        0.5, description="Longest time that data waits before it is on disk, seconds"
    )
    record_fragments: bool = Field(
        True,
        description="Log point clouds too, so that the log alone can be scored with point metrics",
    )
    record_maps: bool = Field(True, description="Log the maps and markers too")
