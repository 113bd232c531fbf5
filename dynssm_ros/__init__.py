"""Vehicle dynamics for autonomous racing: learned from rosbags, deployed on ROS 2, explained in physical terms.

    from dynssm_ros import Recording, load_vehicle, load_model, extract, calibrate, train, evaluate, diagnose, race

The functions are those of the ``dynssm`` command; see :mod:`dynssm_ros.api`. Importing this package loads none of the heavy
libraries: they come in with the function that needs them.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.4.0"

# ONNX Runtime reports to its maker, over the network, unless it finds this as it is loaded
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from dynssm_ros.api.calibrate import calibrate
    from dynssm_ros.api.diagnose import diagnose
    from dynssm_ros.api.evaluate import evaluate
    from dynssm_ros.api.export import export
    from dynssm_ros.api.extract import extract
    from dynssm_ros.api.inputs import load_model
    from dynssm_ros.api.inspect import inspect
    from dynssm_ros.api.learn import learn
    from dynssm_ros.api.new_vehicle import new_vehicle
    from dynssm_ros.api.race import race
    from dynssm_ros.api.replay import replay
    from dynssm_ros.api.residuals import residuals
    from dynssm_ros.api.season import extract_season, review_season
    from dynssm_ros.api.simulate import recorded, simulate
    from dynssm_ros.api.sweep import sweep
    from dynssm_ros.api.train import train
    from dynssm_ros.learning.models.registry import register_model
    from dynssm_ros.signals.recording import Recording
    from dynssm_ros.signals.season import Season
    from dynssm_ros.simulation.plant import register_plant
    from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle
    from dynssm_ros.vehicle.effects import register_effect

_HOMES = {
    "Recording": "signals.recording",
    "Season": "signals.season",
    **dict.fromkeys(("Vehicle", "load_vehicle", "save_vehicle"), "vehicle"),
    "register_effect": "vehicle.effects",
    "register_model": "learning.models.registry",
    "register_plant": "simulation.plant",
}
__all__ = [
    "Recording",
    "Season",
    "Vehicle",
    "calibrate",
    "diagnose",
    "evaluate",
    "export",
    "extract",
    "extract_season",
    "inspect",
    "learn",
    "load_model",
    "load_vehicle",
    "new_vehicle",
    "race",
    "recorded",
    "register_effect",
    "register_model",
    "register_plant",
    "replay",
    "residuals",
    "review_season",
    "save_vehicle",
    "simulate",
    "sweep",
    "train",
]


def __getattr__(name: str) -> Any:
    """The public names, from where they are defined, when they are first asked for."""
    if name in __all__:
        return getattr(import_module(f"{__name__}.{_HOMES.get(name, 'api')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
