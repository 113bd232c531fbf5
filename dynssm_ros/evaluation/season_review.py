"""A season in review: how good each model is in each session, what the car's coefficients were, and why models were wrong.

Every session is looked at alone: models are scored on it, coefficients are calibrated on it or on stretches of it, and it is
diagnosed. What comes out is compared over time: :func:`alarms` says which session was not as those before.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field, ValidationError

from dynssm_ros import __version__
from dynssm_ros.configuration import StrictModel
from dynssm_ros.errors import UserError
from dynssm_ros.evaluation.open_loop import Accuracy, accuracies, shared_commands
from dynssm_ros.evaluation.residuals.diagnosed import left_by
from dynssm_ros.files import checksum, content_key, digest, write_json
from dynssm_ros.identification.result.calibration import calibrate
from dynssm_ros.identification.result.diagnose import diagnose
from dynssm_ros.identification.result.diagnosis import Cause, Diagnosis
from dynssm_ros.parallel import Result
from dynssm_ros.runtime.coefficients import SHIFTS, daily_change
from dynssm_ros.runtime.contract import WindowModel
from dynssm_ros.runtime.registry import open_models
from dynssm_ros.signals.recording import Recording
from dynssm_ros.signals.season import Session
from dynssm_ros.vehicle import COEFFICIENTS, Vehicle

SIMPLE = ("single_track", "single_track_ewma")
"""What a model has to beat: the vehicle file, and the same with an average of its errors."""
DEVIATIONS, BEFORE = 4.0, 3  # of a coefficient that has moved; points before it that are needed to say so
_PATTERNS = 3  # of what is left, that are kept of a session
LOSS, WORSE = 1.05, 1.5  # ADE over that of the best simple model; over the median of the sessions before


class Estimate(StrictModel):
    """Of a coefficient, by the rows of a stretch."""

    value: float
    std: float


class Stretch(StrictModel):
    """A part of a session, and its coefficients."""

    start: str = Field(description="UTC")
    coefficients: dict[str, Estimate]


class Found(StrictModel):
    """A cause that the diagnosis of a session names."""

    effect: str
    values: dict[str, float]
    std: dict[str, float]
    improvement: float = Field(description="share of the error on held-out rows that is gone by it")


class LeftOver(StrictModel):
    """A pattern of the one-step errors that the diagnosed car leaves."""

    channel: str
    share: float = Field(description="of the channel's squared error")
    words: str


class Review(StrictModel):
    """What was found in a session."""

    key: str = Field(description="of what it follows from: recording, models, vehicle, settings, version")
    car: str
    track: str
    session: str
    start: str
    seconds: float
    accuracy: dict[str, Accuracy] = Field(default_factory=dict, description="by model")
    stretches: tuple[Stretch, ...] = ()
    verdict: str = Field(default="", description="of the diagnosis; empty if there is none")
    causes: tuple[Found, ...] = ()
    patterns: tuple[LeftOver, ...] = Field(default=(), description="that the diagnosed car leaves, the largest first")
    failures: tuple[str, ...] = Field(default=(), description="what could not be done, and why")


class Alarm(NamedTuple):
    """Something that was not as before, or not as it should be."""

    review: Review
    subject: str
    """Name of a coefficient or model."""
    words: str


def review(
    recording: Recording,
    session: Session,
    key: str,
    models: Mapping[str, WindowModel],
    vehicle: Vehicle,
    *,
    stretch: float | None = None,
) -> Review:
    """Looks at a session: scores models, the simple ones among them, calibrates the vehicle, and diagnoses it.

    ``stretch`` is the length of the stretches that coefficients are of (s), all of the session if not given.
    """
    failures: list[str] = []
    accuracy = _attempt(
        "models", lambda: accuracies(recording.with_commands(shared_commands(models)), models), failures
    )
    stretches = _attempt("coefficients", lambda: _stretches(recording, session, vehicle, stretch), failures)
    diagnosis = _attempt("diagnosis", lambda: diagnose(recording, vehicle), failures)
    return Review(
        key=key,
        car=session.car,
        track=session.track,
        session=session.session,
        start=session.start,
        seconds=session.seconds,
        accuracy=accuracy or {},
        stretches=stretches or (),
        verdict=diagnosis.verdict if diagnosis else "",
        causes=tuple(map(_found, diagnosis.causes)) if diagnosis else (),
        patterns=tuple(_patterns(diagnosis)) if diagnosis else (),
        failures=tuple(failures),
    )


def _attempt(what: str, work: Callable[[], Result], failures: list[str]) -> Result | None:
    try:
        return work()
    except UserError as error:
        failures.append(f"{what}: {error}")
        return None


def _stretches(recording: Recording, session: Session, vehicle: Vehicle, stretch: float | None) -> tuple[Stretch, ...]:
    found, begin = [], datetime.fromisoformat(session.start)
    loose = another_day(vehicle)
    for after, part in _parts(recording, stretch):
        fit = calibrate(part, loose, starts=1)
        both = zip(COEFFICIENTS, fit.theta, fit.std, strict=True)
        coefficients = {name: Estimate(value=float(value), std=float(std)) for name, value, std in both}
        start = (begin + timedelta(seconds=after)).isoformat(timespec="seconds")
        found.append(Stretch(start=start, coefficients=coefficients))
    return tuple(found)


def another_day(vehicle: Vehicle) -> Vehicle:
    """The same car on another day: its coefficients are known less well by what changes from one day to another."""
    of_bounds = (vehicle.upper - vehicle.lower) / np.sqrt(12.0)
    stated = [vehicle.coefficients[name].std for name in COEFFICIENTS]
    known = np.array([one if one is not None else width for one, width in zip(stated, of_bounds, strict=True)])
    covariance = vehicle.known_correlation * np.outer(known, known) + np.diag(daily_change(vehicle) ** 2)
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    return vehicle.with_nominal(vehicle.nominal, std, covariance / np.outer(scale, scale) + np.diag(1.0 * (std == 0.0)))


def _found(cause: Cause) -> Found:
    std = {name: value for name, value in cause.std.items() if np.isfinite(value)}
    return Found(effect=cause.effect, values=cause.values, std=std, improvement=cause.heldout_improvement)


def _patterns(diagnosis: Diagnosis) -> Iterator[LeftOver]:
    left = left_by(diagnosis)
    for each in () if left is None else left.patterns[:_PATTERNS]:
        yield LeftOver(channel=each.channel, share=each.share, words=each.words)


def _parts(recording: Recording, stretch: float | None) -> Iterator[tuple[float, Recording]]:
    """Parts of about equal length with the time at which they begin (s)."""
    count = 1 if stretch is None else max(1, round(recording.duration / stretch))
    edges = np.linspace(0, len(recording), count + 1).round().astype(int)
    for first, last in pairwise(edges):
        yield (recording.time[first] - recording.time[0]) / 1e9, recording.select(slice(first, last))


def review_again(
    models: list[str], car: Vehicle, out: Path, stretch: float | None, task: tuple[Session, Path]
) -> Review:
    """What is found in a session, or was found in it before and written to ``out``; see :func:`review`."""
    session, file = task
    trained = [digest(Path(name)) for name in models if os.path.exists(name)]
    key = content_key([__version__, car.model_dump(mode="json"), models, trained, stretch, checksum(file)])
    kept = out / "sessions" / f"{'-'.join(session.place)}.json"
    try:
        known = Review.model_validate_json(kept.read_bytes())
    except (OSError, ValidationError):  # there is none, or it is of another version
        known = None
    if known is not None and known.key == key:
        return known
    recording = Recording.load(file)
    recording.require_set_point(car.inputs.set_point, f"vehicle {car.name}")
    found = review(recording, session, key, open_models(models, car.in_windows), car, stretch=stretch)
    write_json(kept, found.model_dump(mode="json"))
    return found


def alarms(reviews: Sequence[Review]) -> list[Alarm]:
    """What an engineer should look at, in the order of driving.

    A coefficient has moved if it is more than :data:`DEVIATIONS` standard deviations off the mean of the stretches before it,
    of the same car and since it last moved. These are of both, and of what it varies by from stretch to stretch anyway
    (DerSimonian and Laird, 1986); :data:`BEFORE` stretches are needed. Models are worse than before where their error is 1.5
    times the median since they last were, of the same car on the same track. A model loses where the best simple one beats it
    by more than 5 %. A cause comes or is gone by comparison with the diagnosis of the car's session before.
    """
    found = [*_changed(reviews), *_worse(reviews), *_lost(reviews), *_moved(reviews)]
    order = {id(each): k for k, each in enumerate(reviews)}
    return sorted(found, key=lambda alarm: order[id(alarm.review)])


def _moved(reviews: Sequence[Review]) -> Iterator[Alarm]:
    for name in COEFFICIENTS:
        since: dict[str, list[Estimate]] = defaultdict(list)
        for each in reviews:
            for stretch in each.stretches:
                now = stretch.coefficients[name]
                if now.std <= 0.0:  # it is known
                    continue
                before = since[each.car]
                if len(before) >= BEFORE:
                    mean, std = expected(before)
                    off = (now.value - mean) / np.hypot(std, now.std)
                    if abs(off) > DEVIATIONS:
                        share = "" if name in SHIFTS else f" ({100 * (now.value / mean - 1):+.0f} %)"
                        change = f"{mean:.3g} to {now.value:.3g}{share}"
                        yield Alarm(each, name, f"{name} moved from {change}, {abs(off):.1f} standard deviations")
                        before.clear()
                before.append(now)


def expected(before: Iterable[Estimate]) -> tuple[float, float]:
    """Mean of stretches, and the standard deviation of another one about it, but for its own."""
    value, variance = (np.array(each) for each in zip(*((one.value, one.std**2) for one in before), strict=True))
    weight = 1 / variance
    mean = float((weight * value).sum() / weight.sum())
    excess = float((weight * (value - mean) ** 2).sum()) - (len(value) - 1)
    between = max(0.0, excess / float(weight.sum() - (weight**2).sum() / weight.sum())) if len(value) > 1 else 0.0
    weight = 1 / (variance + between)
    return float((weight * value).sum() / weight.sum()), float(np.sqrt(between + 1 / weight.sum()))


def _lost(reviews: Sequence[Review]) -> Iterator[Alarm]:
    for each in reviews:
        simple = {name: one.ade for name, one in each.accuracy.items() if name in SIMPLE}
        for name, one in each.accuracy.items():
            best = min(simple, key=lambda model: simple[model], default=None)
            if best is not None and name not in SIMPLE and one.ade > LOSS * simple[best]:
                words = f"{name} loses to {best}: ADE {one.ade:.3g} against {simple[best]:.3g} m"
                yield Alarm(each, name, words)


def _worse(reviews: Sequence[Review]) -> Iterator[Alarm]:
    before: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for each in reviews:
        times: dict[str, float] = {}
        for name, one in each.accuracy.items():
            known = before[each.car, each.track, name]
            if len(known) >= BEFORE and one.ade > WORSE * float(np.median(known)):
                times[name] = one.ade / float(np.median(known))
                known.clear()
            known.append(one.ade)
        if times:
            words = ", ".join(f"{name} {share:.1f}" for name, share in times.items())
            yield Alarm(each, "models", f"errors are above the median of those before, times: {words}")


def _changed(reviews: Sequence[Review]) -> Iterator[Alarm]:
    before: dict[str, set[str]] = {}
    for each in reviews:
        if not each.verdict:
            continue
        now = {cause.effect: cause for cause in each.causes}
        known = before.setdefault(each.car, set(now))
        for name in sorted(now.keys() - known):
            values = ", ".join(f"{parameter} {value:.3g}" for parameter, value in now[name].values.items())
            yield Alarm(each, name, f"cause {name} comes: {values}")
        yield from (Alarm(each, name, f"cause {name} is gone") for name in sorted(known - now.keys()))
        before[each.car] = set(now)
