"""The Python API: one function for each command, from data to data. The command line calls these and prints.

Inputs come by position, settings as keywords, or all of them as ``settings=``, an object of the function's own class:
``calibrate(laps, "orca", horizon=0.5)``. Vehicles, models, signal maps and tracks are given by shipped name, by path, or as
the object itself. Nothing is printed; ``on_progress`` is called with what is done and what there is to do. What is wrong with
the input raises a :class:`~dynssm_ros.errors.UserError` whose message is one line; data that look wrong a
:class:`~dynssm_ros.errors.DataWarning`.
"""

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

__all__ = [
    "calibrate",
    "diagnose",
    "evaluate",
    "export",
    "extract",
    "extract_season",
    "inspect",
    "learn",
    "load_model",
    "new_vehicle",
    "race",
    "recorded",
    "replay",
    "residuals",
    "review_season",
    "simulate",
    "sweep",
    "train",
]
