from pathlib import Path

from setuptools import find_packages, setup

package_name = "nss_ros"


def files(folder: str, pattern: str) -> list[str]:
    return sorted(str(path) for path in Path(folder).glob(pattern) if path.is_file())


setup(
    name=package_name,
    version="0.1.0",
    description="One map of a building that changes: multi-stage point cloud registration.",
    author="nss_ros maintainers",
    author_email="maintainers@nss-ros.dev",
    maintainer="nss_ros maintainers",
    maintainer_email="maintainers@nss-ros.dev",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=["nss_ros", "nss_ros.*"]),
    package_data={
        "nss_ros": [
            "py.typed",
            "interfaces/*.msg",
            "multiway/posegraphnet/*.safetensors",
            "registration/gravity/*.safetensors",
            "simulation/sites/*.yaml",
            "benchmark/paper.yaml",
            "benchmark/report_page/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/launch", files("launch", "*.launch.py")),
        (f"share/{package_name}/config", files("config", "*")),
    ],
    install_requires=[
        "setuptools",
        "jinja2",
        "joblib",
        "kiss-matcher",
        "markupsafe",
        "matplotlib",
        "mcap",
        "numpy",
        "open3d",
        "pillow",
        "plotly",
        "pydantic>=2",
        "pyyaml",
        "rich",
        "rosbags",
        "safetensors",
        "scikit-learn",
        "scipy",
        "shapely",
        "small-gicp",
        "threadpoolctl",
        "torch",
        "trimesh",
        "typer>=0.12.4",
        "zstandard",
    ],
    extras_require={
        "ifc": ["ifcopenshell", "mapbox_earcut"],
        "ray": ["ray"],
        "rerun": ["rerun-sdk"],
        "test": ["hypothesis", "pytest"],  # makes colcon test run pytest
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "nss = nss_ros.cli:main",
            "fragment_player = nss_ros.nodes.start:fragment_player",
            "registration = nss_ros.nodes.start:registration",
            "pose_graph = nss_ros.nodes.start:pose_graph",
            "recorder = nss_ros.nodes.start:recorder",
        ],
        "nss_ros.registration_methods": [
            "fpfh_ransac = nss_ros.registration.fpfh:FpfhRansac",
            "gravity = nss_ros.registration.gravity.method:Gravity",
            "fpfh_fgr = nss_ros.registration.fpfh:FpfhFgr",
            "kiss_matcher = nss_ros.registration.kiss_matcher:KissMatcher",
            "fcgf = nss_ros.registration.learned.fcgf:Fcgf",
            "d3feat = nss_ros.registration.learned.d3feat:D3Feat",
            "predator = nss_ros.registration.learned.predator:Predator",
            "geotransformer = nss_ros.registration.learned.geotransformer:GeoTransformer",
        ],
        "nss_ros.synchronizers": [
            "choi = nss_ros.multiway.choi:Choi",
            "submaps = nss_ros.multiway.submaps:Submaps",
            "posegraphnet = nss_ros.multiway.posegraphnet.method:PoseGraphNet",
        ],
    },
)
