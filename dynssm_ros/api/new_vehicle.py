"""A first vehicle file from what a scale and a ruler tell."""

from __future__ import annotations

from dataclasses import dataclass

from dynssm_ros.api.inputs import PathLike, vehicle_of
from dynssm_ros.api.settings import VerbSettings, keywords, setting
from dynssm_ros.errors import SettingError
from dynssm_ros.files import replacing, require_replaceable
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.draft import TYRES, MeasuredCar, Tyre, as_commented_file, drafted
from dynssm_ros.vehicle.single_track import SetPoint

NEEDED = ("mass", "front_mass", "wheelbase")
_LEAST_SHARE = 0.1
"""Of the mass on an axle."""


class NewVehicleSettings(VerbSettings):
    """Settings of :func:`new_vehicle`."""

    like: str = setting(
        "sedan", "Car to begin from: sedan, formula_student, indy, f1tenth, another shipped one or a file."
    )
    mass: float | None = setting(None, "Mass, ready to drive (kg).", otherwise="asked for", gt=0.0)
    front_mass: float | None = setting(None, "Of that on the front axle (kg).", otherwise="asked for", gt=0.0)
    wheelbase: float | None = setting(None, "Distance of the axles (m).", otherwise="asked for", gt=0.0)
    tyre: Tyre | None = setting(
        None,
        f"Kind of the tyres: {'; '.join(f'{name}: {kind.words}' for name, kind in TYRES.items())}.",
        otherwise="those of the car to begin from",
    )
    height: float | None = setting(
        None, "Height of the centre of gravity (m).", otherwise="in wheelbases that of the car to begin from", ge=0.0
    )
    acceleration: float | None = setting(
        None, "Acceleration that full throttle stands for (m/s^2).", otherwise="that of the car to begin from", gt=0.0
    )
    steering: float | None = setting(
        None, "Largest angle of the road wheels (rad).", otherwise="that of the car to begin from", gt=0.0, le=1.57
    )
    set_point: SetPoint | None = setting(
        None, "What the first input is: throttle, or speed (m/s).", otherwise="that of the car to begin from"
    )
    rate: float | None = setting(
        None, "Of the rows (Hz).", otherwise="that of the car to begin from", ge=1.0, le=1000.0
    )


@dataclass(frozen=True)
class VehicleDraft:
    """A vehicle that nobody has calibrated yet."""

    vehicle: Vehicle
    text: str  # its file, with comments

    def save(self, path: PathLike) -> None:
        """Writes the file.

        Raises:
            UserError: there is one already, which somebody may have edited.
        """
        require_replaceable(path, False, "new")
        with replacing(path) as aside:
            aside.write_text(self.text, encoding="utf-8")


@keywords(NewVehicleSettings)
def new_vehicle(name: str, *, settings: NewVehicleSettings) -> VehicleDraft:
    """Drafts a vehicle file: a car of the same kind, scaled to mass, axle loads and wheelbase.

    Standard deviations say that it is a guess: a quarter to a half of most values. ``calibrate`` replaces them.

    Args:
        name: of the car.
        settings: all keywords as one object.

    Example:
        >>> draft = new_vehicle("mine", like="f1tenth", mass=3.2, front_mass=1.7, wheelbase=0.32, tyre="rubber")
        >>> draft.vehicle.constants.l_f, draft.vehicle.inputs.set_point
        (0.15, 'speed')
    """
    s = settings
    if s.mass is None or s.front_mass is None or s.wheelbase is None:
        lacking = next(each for each in NEEDED if getattr(s, each) is None)
        raise SettingError(f"{lacking} is missing; expected what a scale or a ruler tells", lacking)
    if not _LEAST_SHARE * s.mass <= s.front_mass <= (1 - _LEAST_SHARE) * s.mass:
        share = next(
            (each for each in (s.front_mass, s.front_mass / 100) if _LEAST_SHARE <= each <= 1 - _LEAST_SHARE), None
        )
        hint = f"; {100 * share:g} % of it are {share * s.mass:g} kg" if share else ""
        raise SettingError(
            f"front_mass {s.front_mass:g}: expected {_LEAST_SHARE * s.mass:g} to {(1 - _LEAST_SHARE) * s.mass:g} kg, of the "
            f"{s.mass:g} kg of the car{hint}", "front_mass",
        )  # fmt: skip
    like = vehicle_of(s.like)
    T_s = None if s.rate is None else 1 / s.rate
    measured = MeasuredCar(s.mass, s.front_mass, s.wheelbase, s.height, s.acceleration, s.steering, T_s)
    vehicle = drafted(like, name, measured, tyre=s.tyre, set_point=s.set_point)
    tyres = f"those of {like.name}" if s.tyre is None else TYRES[s.tyre].words
    head = (
        f"A guess: {like.name}, scaled to {s.mass:g} kg, {s.front_mass:g} kg of them in front, and a wheelbase of "
        f"{s.wheelbase:g} m.",
        f"Measured: mass, axle loads, wheelbase. Tyres: {tyres}.",
        "All else is guessed, and the standard deviations say how well: a quarter to a half of most values.",
        "Put in what you know better, with its standard deviation; then `dynssm calibrate` replaces them by what a log says.",
    )
    return VehicleDraft(vehicle, as_commented_file(vehicle, head))
