"""Installation by pip (`pip install .`) and by colcon (ament_python); `package.xml` is the ROS side of it."""

import hashlib
from collections import defaultdict
from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "dynssm_ros"


def shared(*folders):
    """Lists every file under ``folders`` as ``(destination in share/, files)``, the form of ``data_files``."""
    entries = defaultdict(list)
    for folder in folders:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                entries[f"share/{NAME}/{path.parent.as_posix()}"].append(path.as_posix())
    return sorted(entries.items())


def compiled():
    """The compiled loops of the predictor. Where no C compiler is, the package goes without: numpy computes the same."""
    file = f"{NAME}/compiled.c"
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return Extension(
        f"{NAME}._compiled",
        [file],
        define_macros=[("SOURCE", f'"{digest}"')],
        libraries=["m"],
        # roundings as numpy's; the tape's short loops take half as long again where they cross lines of the cache
        extra_compile_args=["-O3", "-fno-math-errno", "-ffp-contract=off", "-falign-loops=64"],
        optional=True,
    )


EXTRAS = {
    # training, calibration and diagnosis
    "train": ["torch>=2.13", "onnx>=1.17", "onnxscript>=0.5", "scipy>=1.12"],
    # tracks, simulated cars and the controller: derivatives of the vehicle equations, and the DAQP solver
    "race": ["casadi>=3.8", "scipy>=1.12"],
    # figures and pages
    "report": ["matplotlib>=3.9", "plotly>=6.0", "jinja2>=3.1", "scipy>=1.12"],
    # logs in MATLAB files; all of the above read them too
    "matlab": ["scipy>=1.12"],
    # what a diagnosis leaves, as a formula
    "formula": ["scikit-learn>=1.4"],
    # what boosted trees can still learn of the errors of a model, and the tests of its other patterns
    "residuals": ["scikit-learn>=1.4", "scipy>=1.12", "threadpoolctl>=3.1"],
    # seasons of logs on several processes
    "scale": ["joblib>=1.4"],
    # settings of models that are searched for
    "sweep": ["optuna>=4.0"],
    # several processes on clusters
    "ray": ["joblib>=1.4", "ray>=2.40"],
    "dask": ["joblib>=1.4", "dask>=2024.12", "distributed>=2024.12"],
    # ROS 2 Jazzy as wheels, for machines without it; a sourced ROS installation provides the same modules
    "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
}

setup(
    name=NAME,
    version="0.4.0",
    description="Vehicle dynamics for autonomous racing: learned from rosbags, deployed on ROS 2, explained.",
    maintainer="dynssm_ros developers",
    maintainer_email="maintainers@dynssm-ros.invalid",
    license="Apache-2.0",
    python_requires=">=3.10,<3.13",  # 3.10 to 3.12 are the Pythons of the ROS 2 distributions that Jazzy users run
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "compiled.c", "reporting/templates/*"]},
    ext_modules=[compiled()],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("config", "launch"),
    ],
    zip_safe=False,
    # The floors are the oldest that pass the tests together; `constraints.txt` has the versions of `make demo`. The core is
    # what a car needs to extract, replay and predict; dynssm_ros/extras.py says which library belongs to which extra.
    install_requires=[
        "setuptools>=61",  # the console scripts that colcon writes
        "numpy>=1.26",
        "onnxruntime>=1.19",  # the deployed predictor
        "safetensors>=0.4",  # weights without pickle
        "pyarrow>=15,<26",  # recordings; 26 refuses the numpy 1.26 of Ubuntu 24.04
        "pydantic>=2.7",  # configuration
        "typing-extensions>=4.8",
        "pyyaml>=6.0.1",
        "rosbags>=0.11.6",  # bags without a ROS installation
        "mcap>=1.1.1",  # what a cut MCAP file still holds
        "typer>=0.20",
        "rich>=14.3",
    ],
    extras_require=EXTRAS
    | {
        "all": sorted({each for extra in EXTRAS.values() for each in extra}),
        "docs": ["sphinx", "myst-parser", "furo"],
        "test": [
            "commonroad-vehicle-models",  # a car that somebody else wrote, for the benchmark of hidden causes
            "doit",  # the benchmarks' workflow
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
