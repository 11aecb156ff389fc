"""All settings, typed, with their defaults, limits and meaning.

This is the single definition: configuration files, `--set` options and ROS parameters are all
read into these models, so a name, a unit and a limit stand in one place. A ROS parameter has
the dotted name of the field inside its node's section, for example `icp.max_distance` on the
registration node is `registration.icp.max_distance` in a file.
"""

from nss_ros.config.dataset import (
    DatasetConfig,
    GraphConfig,
    PairConfig,
    SelectionConfig,
    SplitConfig,
)
from nss_ros.config.ground_truth import AlignmentConfig, RefinementConfig
from nss_ros.config.loading import NssConfig, load_config, validated, write_config
from nss_ros.config.run import (
    D3FeatConfig,
    FcgfConfig,
    FpfhConfig,
    GeoTransformerConfig,
    GravityConfig,
    IcpConfig,
    KissMatcherConfig,
    LearnedConfig,
    MultiwayConfig,
    PlayerConfig,
    PoseGraphConfig,
    PredatorConfig,
    ProposalConfig,
    RecorderConfig,
    RegistrationConfig,
    RegistrationNodeConfig,
)
from nss_ros.config.section import Section
from nss_ros.config.simulation import RigConfig, SimulationConfig, ViewpointConfig
from nss_ros.config.site import SiteConfig, WingConfig
from nss_ros.config.training import TrainingConfig

__all__ = [
    "AlignmentConfig",
    "D3FeatConfig",
    "DatasetConfig",
    "FcgfConfig",
    "FpfhConfig",
    "GeoTransformerConfig",
    "GraphConfig",
    "GravityConfig",
    "IcpConfig",
    "KissMatcherConfig",
    "LearnedConfig",
    "MultiwayConfig",
    "NssConfig",
    "PairConfig",
    "PlayerConfig",
    "PoseGraphConfig",
    "PredatorConfig",
    "ProposalConfig",
    "RecorderConfig",
    "RefinementConfig",
    "RegistrationConfig",
    "RegistrationNodeConfig",
    "RigConfig",
    "Section",
    "SelectionConfig",
    "SimulationConfig",
    "SiteConfig",
    "SplitConfig",
    "TrainingConfig",
    "ViewpointConfig",
    "WingConfig",
    "load_config",
    "validated",
    "write_config",
]
