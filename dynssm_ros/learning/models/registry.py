"""Which class a model file's ``kind`` is."""

from __future__ import annotations

from collections.abc import Callable

from torch import nn

from dynssm_ros.learning.configuration import ModelConfig
from dynssm_ros.learning.models.ddm import DDM
from dynssm_ros.learning.models.dynssm.network import DynSSM
from dynssm_ros.learning.models.ridge import Ridge
from dynssm_ros.runtime.artifact import ModelKind, Normalisation
from dynssm_ros.vehicle import Vehicle

_CLASSES: dict[ModelKind, Callable[[ModelConfig, Vehicle, Normalisation], nn.Module]] = {
    "dynssm": DynSSM,
    "ridge": lambda config, _, normalisation: Ridge(config.H, normalisation),
    "ddm": DDM,
    "fthd": DDM,  # the same network, trained on
}


def build_model(config: ModelConfig, vehicle: Vehicle, normalisation: Normalisation) -> nn.Module:
    """An untrained model, which maps raw windows ``(B, H, 7)`` to an :class:`~dynssm_ros.learning.models.dynssm.network.Output`."""
    return _CLASSES[config.kind](config, vehicle, normalisation)


def modelled_vehicle(config: ModelConfig, vehicle: Vehicle) -> Vehicle:
    """The car as the model's physics has it, which is the one that the model's coefficients are for."""
    if config.physics is None or config.physics.load_transfer:
        return vehicle
    return vehicle.model_copy(update={"constants": vehicle.constants.model_copy(update={"load_transfer": False})})
