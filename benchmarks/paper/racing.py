"""The races of a plan as steps: laps in closed loop with trained models, their figures, and their numbers."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, get_args

from benchmarks.page import save_figure
from benchmarks.paper.plan import MID_RANGE, Race
from benchmarks.paper.steps import Step, in_data, named_track
from dynssm_ros.control.prediction_model import PredictionModel
from dynssm_ros.control.race import Course, Start
from dynssm_ros.control.race import race as drive
from dynssm_ros.control.race_models import load_prediction_model
from dynssm_ros.control.reference import load_reference
from dynssm_ros.control.settings import Settings
from dynssm_ros.files import digest, replacing, write_json
from dynssm_ros.reporting import race_figures
from dynssm_ros.reporting.race_report import race_json
from dynssm_ros.track.racing_line import LineKind
from dynssm_ros.track.tracks import load_track
from dynssm_ros.vehicle import Vehicle, load_vehicle, save_vehicle

NUMBERS = "results.json"


@dataclass(frozen=True, kw_only=True)
class DriveLaps(Step):
    """Every model of a race in the controller in turn; the output is a folder with numbers and figures."""

    marker: ClassVar[str] = NUMBERS

    race: Race  # what is driven
    trained: Mapping[str, str]  # keys of the trainings, by the models' names
    calibrated: str  # key of the calibrated car
    data: Path | None = field(repr=False)  # folder with tracks and lines

    def recipe(self) -> dict[str, Any]:
        named = {self.race.track: named_track(self.data, self.race.track), self.race.line: self._line()}
        return {
            "race": self.race.model_dump(mode="json", exclude={"title", "text", "paper", "ablation"}),
            "vehicle": load_vehicle(self.race.vehicle).model_dump(mode="json"),
            "files": {name: digest(file) for name, file in named.items() if isinstance(file, Path)},
        }

    def make(self, root: Path, there: frozenset[str]) -> None:
        race, vehicle = self.race, load_vehicle(self.race.vehicle)
        driven = vehicle.with_effects((each.name, each.parameters) for each in race.effects)
        track = load_track(named_track(self.data, race.track))
        if race.lap_length is not None:
            track = track.scaled(race.lap_length / track.length)
        reference = load_reference(str(self._line()), vehicle, track, race.speed_scale)
        settings = Settings.of(vehicle, race.objective, race.horizon, race.offset_free, evidence=False)
        course = Course(driven, track, race.plant, reference, settings, race.laps, Start(speed=race.speed))
        models = [name for name in race.models if self.trained.get(name) in there or name not in self.trained]
        races = [drive(course, self._knowledge(name, driven, root)) for name in models]
        with replacing(root / self.key) as folder:
            folder.mkdir()
            write_json(folder / NUMBERS, race_json(races))
            for figure in race.figures:
                save_figure(getattr(race_figures, figure)(races), folder / f"{figure}.png", tight=True)

    def _line(self) -> str | Path:
        return self.race.line if self.race.line in get_args(LineKind) else in_data(self.data, self.race.line)

    def _knowledge(self, name: str, driven: Vehicle, root: Path) -> PredictionModel:
        """What the controller is to know, under its name in the plan."""
        known = load_vehicle(root / self.calibrated)
        with tempfile.TemporaryDirectory(prefix="dynssm-") as folder:
            given = str(root / self.trained[name]) if name in self.trained else name
            if name == MID_RANGE:
                given = str(Path(folder) / f"{MID_RANGE}.yaml")
                save_vehicle(known.unmeasured(), Path(given), "The middle of all bounds.")
            knowledge = load_prediction_model(given, known, driven, self.race.plant, as_is=True)
        knowledge.name = name
        return knowledge
