"""The models of a race by name: the plant's own, a vehicle file, a trained model, a baseline."""

from __future__ import annotations

import os
from pathlib import Path

from dynssm_ros.control.prediction_model import Adaptive, Fixed, PredictionModel
from dynssm_ros.errors import ArtifactError, ConfigurationError
from dynssm_ros.runtime.artifact import model_folder
from dynssm_ros.runtime.baselines import SingleTrack
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.registry import UNTRAINED, load_model
from dynssm_ros.simulation.plant import PlantKind, plant_type
from dynssm_ros.vehicle import CarModel, Vehicle, load_vehicle

TRUE = "true"
SHARED = ("m", "l_f", "l_r")  # what makes it the same car


def true_model(vehicle: Vehicle, plant: PlantKind) -> Fixed:
    """The plant's own model: its coefficients, effects and wheels. Steps of 1 ms become two of Runge and Kutta."""
    of = plant_type(plant)
    return Fixed(
        TRUE, CarModel.at_any_speed(vehicle, of.integrator, of.substeps, first=of.first(vehicle)), vehicle.nominal
    )


def load_prediction_model(
    name_or_path: str,
    known: Vehicle,
    driven: Vehicle,
    plant: PlantKind,
    *,
    along_horizon: bool = False,
    as_is: bool = False,
) -> PredictionModel:
    """What the controller is to know of the car.

    Args:
        name_or_path: ``true``, the plant's own model; a vehicle file (``.yaml``), the single-track car with its
            coefficients; else as :func:`~dynssm_ros.runtime.registry.load_model`.
        known: the vehicle as its file describes it.
        driven: the same with what the plant has beyond that.
        plant: how that is simulated.
        along_horizon: see :class:`Adaptive`.
        as_is: likewise.

    Raises:
        ArtifactError: the model is damaged, or of another car or sampling time.
        ConfigurationError: no such model, or a vehicle file of another car.
    """
    if name_or_path == TRUE:
        return true_model(driven, plant)
    if Path(name_or_path).suffix == ".yaml":
        model: WindowModel = SingleTrack(load_vehicle(name_or_path))
        model.name = Path(name_or_path).stem
    elif os.path.isdir(model_folder(name_or_path)) or name_or_path in UNTRAINED:
        model = load_model(name_or_path, known)
    else:
        raise ConfigurationError(
            f"model '{name_or_path}': neither a model folder nor one of {', '.join((TRUE, *UNTRAINED))} nor a vehicle file"
        )
    _check_car(name_or_path, model, known)
    return Adaptive(model, known, along_horizon, as_is)


def _check_car(given: str, model: WindowModel, vehicle: Vehicle) -> None:
    error = ConfigurationError if model.card is None else ArtifactError
    if model.T_s and abs(model.T_s - vehicle.sampling_time) > 1e-9:
        raise error(
            f"model {given}: sampling time {model.T_s:g} s; expected that of vehicle {vehicle.name}, "
            f"{vehicle.sampling_time:g} s"
        )
    for name in SHARED:
        own = getattr(vehicle.constants, name)
        its = own if model.vehicle is None else getattr(model.vehicle.constants, name)
        if abs(its - own) > 1e-6 * own:
            raise error(
                f"model {given}: of another vehicle ({name} = {its:g}); expected that of {vehicle.name} "
                f"({name} = {own:g})"
            )
