"""What a diagnosis says: causes, what recalibration moved, what is better, what is left; for people and programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from dynssm_ros.arrays import Vector
from dynssm_ros.identification import tuning
from dynssm_ros.identification.problem.car import CarEstimate
from dynssm_ros.identification.problem.levels import Level
from dynssm_ros.identification.problem.recordings import RecordingSet
from dynssm_ros.identification.problem.windows import SimulationWindows
from dynssm_ros.identification.result.formula import Formula
from dynssm_ros.identification.result.improvement import Improvement
from dynssm_ros.identification.result.recalibration import Recalibration
from dynssm_ros.identification.result.residuals import ClusteredResiduals, ExplainedVariance
from dynssm_ros.identification.search.confirmation import Confirmation
from dynssm_ros.identification.search.selection import Selection
from dynssm_ros.signals.signal_map import STATE_SIGNALS
from dynssm_ros.vehicle import Vehicle
from dynssm_ros.vehicle.effects import EFFECTS

Verdict = Literal["cause", "unexplained", "recalibrate", "healthy"]
ConclusionKind = Literal["no_better", "cause", "nearest", "recalibration", "unexplained", "small"]

GIVEN, RECALIBRATED, EXTENDED = "as given", "recalibrated", "extended"


@dataclass(frozen=True)
class Cause:
    """An effect that the data ask for.

    Attributes:
        effect: its name.
        values: parameters with which it acts.
        std: standard deviations of those that were fitted.
        delta_bic: decrease of twice the negative log-likelihood by it, less what its parameters cost.
        heldout_improvement: share of the error on the held-out rows that is gone by it, against coefficients that are
            refitted in its place.
        confirmation: what it improves on parts of the fitted rows that were left out.
        on_bound: its parameters that the data push against a bound: they are at least that far off.
        alternatives: effects that explain the data as well.
        only_in: names of the recordings in which it acts; empty: in all.
        level: what these recordings are.
        without: what the car with all other causes errs on the held-out rows, at the horizon, ``(W, 3)``.
        of_given: share of the error that is gone by it while the coefficients are those of the vehicle file.
        nearest: whether it is but the nearest effect: so much of what it explains is left that it stands for something else.
    """

    effect: str
    values: dict[str, float]
    std: dict[str, float]
    delta_bic: float
    heldout_improvement: float
    confirmation: Confirmation
    on_bound: tuple[str, ...]
    alternatives: tuple[str, ...]
    only_in: tuple[str, ...] = ()
    level: Level = "car"
    without: Vector = field(default_factory=lambda: np.empty((0, 3)), repr=False)
    of_given: float = 0.0
    nearest: bool = False

    @property
    def explains(self) -> float:
        """Share of the error on the held-out rows that it takes off the vehicle file's car, or off a recalibrated one."""
        return max(self.of_given, self.heldout_improvement)

    @property
    def kind(self) -> Literal["cause", "nearest", "small"]:
        """As what it is told."""
        return "small" if self.small else "nearest" if self.nearest else "cause"

    @property
    def small(self) -> bool:
        """Whether it hardly matters, however sure it is: no model is right to the last per mille.

        It takes little off the error of each channel of a recalibrated car, on parts that were left out and on held-out rows.
        What a recalibration would make up for is told by what was known and how far the coefficients would have to be off,
        not by the error; nor by the error of the file's car, whose coefficients are off themselves, so that an effect takes
        some of that away by chance.
        """
        little = float(self.confirmation.share.max()) < tuning.SMALL_SHARE
        return little and self.heldout_improvement < tuning.NEGLIGIBLE_SHARE and not self.confirmation.is_known


class Conclusion(NamedTuple):
    """One finding of a diagnosis, to be told in a sentence."""

    kind: ConclusionKind
    subject: str
    """The channel that is predicted no better than by persistence, or the effect; empty: the car as a whole."""
    explains: float
    """Share of the error on held-out laps that it takes away, as a mean of the channels, or that is left."""


class PatternAhead(NamedTuple):
    """A pattern of the errors that are left at the horizon."""

    channel: str
    words: str
    share: float
    """Of the channel's squared error, on stretches that it was not fitted to."""


class NotJudged(NamedTuple):
    """An effect that these recordings do not tell."""

    effect: str
    why: str
    manoeuvre: str
    """What would show it; empty where no drive of this car does."""


@dataclass(frozen=True)
class Diagnosis:
    """What the simulation gets wrong, and why.

    Attributes:
        found: the causes, then the nearest effects and the small ones, the strongest of each first.
        moved: coefficients, and ``m``, that are now more than three of the stated standard deviations off what the vehicle
            file has, or that :attr:`recalibration` names; by name, how many.
        vehicle: the vehicle with effects and refitted nominal values.
        improvement: on the held-out rows.
        left: what is systematic in the errors of the car with the causes alone, on the rows of the fit.
        clustered: how those errors are spread over time.
        minimum_detectable: how far off neutral each effect that is not named would have to be to be named (the unit of its
            first parameter).
        selection: how it was found.
        car: the extended car as fitted.
        named: that with the causes and small effects alone.
        notes: what limits the diagnosis.
        protocol: how it was obtained, by name.
        windows: of the fit.
        recordings: what was diagnosed.
        formulas: terms that the extended car lacks, where it leaves errors that are no noise and no cause is named.
        recalibration: what is off in the vehicle file beside the causes; ``None``: nothing that is noticed on held-out laps.
        not_judged: effects that these recordings do not tell.
        structure: patterns that take a noticeable part of an error at the horizon away, the largest share first.
    """

    found: tuple[Cause, ...]
    moved: Mapping[str, float]
    vehicle: Vehicle
    improvement: Improvement
    left: ExplainedVariance
    clustered: ClusteredResiduals
    minimum_detectable: Mapping[str, float]
    selection: Selection
    car: CarEstimate
    named: CarEstimate
    notes: tuple[str, ...]
    protocol: Mapping[str, str]
    windows: SimulationWindows
    recordings: RecordingSet
    formulas: tuple[Formula, ...] = ()
    recalibration: Recalibration | None = None
    not_judged: tuple[NotJudged, ...] = ()
    structure: tuple[PatternAhead, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The first that holds of what needs most to be mended.

        ``cause``: causes are named; ``unexplained``: errors are left that have no name; ``recalibrate``: coefficients of the
        file are off, and nothing else, or its car errs noticeably more than the one to write; ``healthy``: right within the
        noise, as the file has it.
        """
        if self.causes:
            return "cause"
        if self.nearest_effects or self.is_left or self.no_better:
            return "unexplained"
        return "recalibrate" if self.moved or self.improvement.is_noticed else "healthy"

    @property
    def is_left(self) -> bool:
        """Whether the car with the causes leaves errors that are no noise."""
        return self.left.is_there or self.clustered.is_there or bool(self.structure)

    @property
    def no_better(self) -> tuple[str, ...]:
        """Channels that the extended car predicts hardly better than persistence, or worse, at the horizon."""
        improvement = self.improvement
        error, still = improvement.rmse[EXTENDED][improvement.horizon], improvement.persistence[improvement.horizon]
        return tuple(
            channel
            for channel, ours, none in zip(STATE_SIGNALS, error, still, strict=True)
            if ours > (1.0 - tuning.NOTICEABLE_SHARE) * none
        )

    @property
    def conclusions(self) -> tuple[Conclusion, ...]:
        """The findings: what is no better than persistence first, then the rest, that which explains most error first."""
        found = [Conclusion(cause.kind, cause.effect, cause.explains) for cause in self.found]
        if self.moved:
            explains = 0.0 if self.recalibration is None else self.recalibration.explains
            found.append(Conclusion("recalibration", "", explains))
        if self.is_left:
            share = self.left.share if self.left.is_there else np.zeros(3)
            told = [sum(one.share for one in self.structure if one.channel == channel) for channel in STATE_SIGNALS]
            most = np.minimum(np.maximum(share, told), 1.0)
            found.append(Conclusion("unexplained", "", float((1.0 - np.sqrt(1.0 - most)).mean())))
        found.sort(key=lambda one: -one.explains)
        return (*(Conclusion("no_better", channel, 0.0) for channel in self.no_better), *found)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """What is wrong, the strongest first."""
        return tuple(cause for cause in self.found if cause.kind == "cause")

    @property
    def nearest_effects(self) -> tuple[Cause, ...]:
        """What stands for something that no effect has, the strongest first."""
        return tuple(cause for cause in self.found if cause.kind == "nearest")

    @property
    def small_effects(self) -> tuple[Cause, ...]:
        """What is sure but small, within the structure of the model."""
        return tuple(cause for cause in self.found if cause.small)

    @property
    def recalibrated(self) -> dict[str, tuple[float, float]]:
        """What :attr:`moved` names: as the vehicle file has it, and now."""
        given, now = (
            {name: c.nominal for name, c in car.coefficients.items()} | {"m": car.constants.m}
            for car in (self.car.vehicle, self.vehicle)
        )
        return {name: (given[name], now[name]) for name in self.moved}

    def to_json(self, vehicle_path: str) -> dict[str, Any]:
        """For programs; ``vehicle_path`` is where the extended vehicle was written."""
        improvement, at = self.improvement, self.improvement.horizon
        names = {"before": GIVEN, "recalibrated": RECALIBRATED, "after": EXTENDED}
        systematic = {key: improvement.explained_variance[name][at].share for key, name in names.items()}
        return {
            "verdict": self.verdict,
            "causes": [_cause_to_json(cause) for cause in self.causes],
            "nearest_effects": [_cause_to_json(cause) for cause in self.nearest_effects],
            "small_effects": [_cause_to_json(cause) for cause in self.small_effects],
            "improvement": {
                "horizon_s": float(improvement.horizons[at]),
                **{key: by_channel(improvement.rmse[name][at]) for key, name in names.items()},
                "reduction": by_channel(improvement.reduction[at]),
                "interval_95": _intervals(improvement.interval[:, at]),
                "reduction_from_recalibrated": by_channel(improvement.reduction_from(RECALIBRATED)[at]),
                "interval_95_from_recalibrated": _intervals(improvement.interval_from(RECALIBRATED)[:, at]),
            },
            "systematic": {key: by_channel(share) for key, share in systematic.items()}
            | {"gone": by_channel(improvement.systematic_gone(GIVEN)[at])},
            "minimum_detectable": {
                effect: size if np.isfinite(size) else None for effect, size in self.minimum_detectable.items()
            },
            "moved": {
                name: {"from": was, "to": now, "standard_deviations": self.moved[name]}
                for name, (was, now) in self.recalibrated.items()
            },
            "recalibration": None if self.recalibration is None else _recalibration_to_json(self),
            "conclusions": [one._asdict() for one in self.conclusions],
            "structure": [one._asdict() for one in self.structure],
            "not_judged": [one._asdict() for one in self.not_judged],
            "formulas": [
                {
                    "channel": formula.channel,
                    "terms": formula.terms,
                    "share": formula.share,
                    "units": formula.improvement.tolist(),
                    "std": formula.std,
                }
                for formula in self.formulas
            ],
            "findings": [finding.model_dump() for finding in self.recordings.recording.info.findings],
            "notes": list(self.notes),
            "vehicle": vehicle_path,
        }


def _recalibration_to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    found = diagnosis.recalibration
    assert found is not None
    return {
        "reduction": by_channel(found.share),
        "interval_95": _intervals(found.interval),
        "coefficients": [
            {
                "name": one.name,
                "from": one.given,
                "to": one.value,
                "std": one.std,
                "standard_deviations": one.deviations,
                "reduction": by_channel(one.share),
                "alternatives": list(one.alike),
            }
            for one in found.coefficients
        ],
        "candidates": [
            {
                "effect": one.effect,
                "parameters": one.values,
                "minimum_detectable": diagnosis.minimum_detectable.get(one.effect),
            }
            for one in found.candidates
        ],
    }


def _cause_to_json(cause: Cause) -> dict[str, Any]:
    about = EFFECTS[cause.effect].PARAMETERS
    return {
        "effect": cause.effect,
        "parameters": {
            name: {"value": value, "std": cause.std.get(name), "unit": about[name].unit}
            for name, value in cause.values.items()
        },
        "evidence": {
            "delta_bic": cause.delta_bic,
            "heldout_improvement": cause.heldout_improvement,
            "of_given": cause.of_given,
            "left_out": {
                "improvement": cause.confirmation.total,
                "std": cause.confirmation.std,
                "units": cause.confirmation.improvement.tolist(),
                "error_gone": by_channel(cause.confirmation.share),
            },
        },
        "on_bound": list(cause.on_bound),
        "alternatives": list(cause.alternatives),
        "only_in": list(cause.only_in),
        "level": cause.level,
        "small": cause.small,
    }


def by_channel(values: Vector) -> dict[str, float | None]:
    """Values of the three channels by name; ``None`` where there is none."""
    return {c: float(value) if np.isfinite(value) else None for c, value in zip(STATE_SIGNALS, values, strict=True)}


def _intervals(bounds: Vector) -> dict[str, list[float]]:
    return {channel: [float(low), float(high)] for channel, low, high in zip(STATE_SIGNALS, *bounds, strict=True)}
