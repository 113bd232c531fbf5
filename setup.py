"""Installation by pip (`pip install .`) and by colcon (ament_python); `package.xml` is the ROS side of it."""

from collections import defaultdict
from pathlib import Path

from setuptools import find_packages, setup

NAME = "dynssm_ros"


def shared(*folders):
    """Lists every file under ``folders`` as ``(destination in share/, files)``, the form of ``data_files``."""
    entries = defaultdict(list)
    for folder in folders:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                entries[f"share/{NAME}/{path.parent.as_posix()}"].append(path.as_posix())
    return sorted(entries.items())


setup(
    name=NAME,
    version="0.1.0",
    description="Vehicle dynamics for autonomous racing: learned from rosbags, deployed on ROS 2, explained.",
    maintainer="dynssm_ros developers",
    maintainer_email="maintainers@dynssm-ros.invalid",
    license="Apache-2.0",
    python_requires=">=3.10,<3.13",  # 3.10 to 3.12 are the Pythons of the ROS 2 distributions that Jazzy users run
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "evaluation/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("config", "launch"),
    ],
    zip_safe=False,
    # The floors are the oldest that pass the tests together; `constraints.txt` has the versions of `make demo`.
    install_requires=[
        "setuptools",  # the console scripts that colcon writes
        "numpy>=1.26",
        "scipy>=1.11",
        "torch>=2.13",  # training
        "onnx>=1.17",  # the exported graph ...
        "onnxscript>=0.5",  # ... and what torch exports it by
        "onnxruntime>=1.19",  # the deployed predictor
        "safetensors>=0.4",  # weights without pickle
        "pyarrow>=15",  # recordings
        "pydantic>=2.7",  # configuration
        "pyyaml>=6.0.1",
        "rosbags>=0.11.6",  # bags without a ROS installation
        "mcap>=1.1.1",  # what a cut MCAP file still holds
        "casadi>=3.7",  # the controller of `dynssm race`: derivatives of the vehicle equations, and the DAQP solver
        "joblib>=1.4",  # steps of `dynssm paper` side by side
        "typer>=0.20",
        "rich>=14.3",
        "matplotlib>=3.9",  # the figures and ...
        "jinja2>=3.1",  # ... the page of the reports
    ],
    extras_require={
        # ROS 2 Jazzy as wheels, for machines without it; a sourced ROS installation provides the same modules
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        "test": [
            "hypothesis",
            "mypy",
            "pytest",
            "pytest-timeout",
            "pytest-xdist",
            "ruff",
            "scipy-stubs",
            "types-PyYAML",
        ],
    },
    entry_points={
        "console_scripts": [
            "dynssm = dynssm_ros.cli.main:main",
            "predictor = dynssm_ros.nodes.predictor:main",
            "player = dynssm_ros.nodes.player:main",
            "controller = dynssm_ros.nodes.controller:main",
            "simulator = dynssm_ros.nodes.simulator:main",
        ],
    },
)
