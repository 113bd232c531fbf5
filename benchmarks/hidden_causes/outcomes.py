"""What became of the cases: how each is judged, the rates, and who is taken for whom."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from benchmarks.hidden_causes.cases import Case, Hidden
from dynssm_ros.identification.result.diagnosis import Cause
from dynssm_ros.vehicle.effects import EFFECTS

_NINETY = 1.645  # standard deviations of a 90 % interval


@dataclass(frozen=True)
class Outcome:
    """What became of a case."""

    case: str  # its name
    hidden: tuple[str, ...]  # effects that were hidden
    named: tuple[str, ...]  # effects that were named, the strongest first
    first: bool
    """Whether the first one named, or an alternative to it, was hidden; without effects, whether none was named."""
    all: bool  # whether each hidden effect was named, or is an alternative to one that was
    sized: bool | None
    """Whether the parameters of those named are within 15 % or two standard deviations; ``None`` if none was found."""
    values: Hidden = field(default_factory=dict)  # what was hidden, with its parameters
    found: Hidden = field(default_factory=dict)  # what was named, with its parameters
    alternatives: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """What is reported as explaining the data as well, by what was named."""
    evidence: dict[str, float] = field(default_factory=dict)
    """Difference in the information criterion, by what was named."""
    std: Hidden = field(default_factory=dict)  # stated standard deviations of what was named, with its parameters
    too_small: tuple[str, ...] = ()
    """Effects that were hidden and missed, of which the diagnosis says that they would have to be larger to be
    named."""
    verdict: str = ""  # of the diagnosis
    wrong: str = ""  # coefficient that the file has wrong
    off: tuple[str, ...] = ()  # coefficients that the diagnosis names as off
    seconds: float | None = None  # of the processor, that the diagnosis took; ``None``: it was not measured

    @property
    def missed(self) -> tuple[str, ...]:
        """Effects that were hidden and neither named nor an alternative to one that was."""
        reached = {*self.named}.union(*self.alternatives.values())
        return tuple(name for name in self.hidden if name not in reached)

    @property
    def strictly_first(self) -> bool:
        """Whether the first one named was hidden itself; without effects, whether none was named."""
        return self.named[:1] == () if not self.hidden else self.named[:1] != () and self.named[0] in self.hidden

    @property
    def covered(self) -> list[bool]:
        """Whether the stated 90 % interval of each parameter that was found and says how much holds what was hidden."""
        return [
            abs(self.found[effect][name] - value) <= _NINETY * self.std[effect][name]
            for effect, values in self.values.items()
            for name, value in values.items()
            if name in self.std.get(effect, {}) and not EFFECTS[effect].PARAMETERS[name].shape
        ]

    @property
    def recalibrated(self) -> bool:
        """Whether it is told that the file is off in the axle of which a coefficient is wrong, and nothing else."""
        axle = {f"{letter}_{self.wrong[-1:]}" for letter in "BCDE"}
        return self.verdict == "recalibrate" and bool(axle & {*self.off})

    @property
    def right(self) -> bool:
        """Whether nothing is missing that counts."""
        return self.all if len(self.hidden) > 1 else self.first


def judge(case: Case, causes: Sequence[Cause], minimum_detectable: Mapping[str, float] | None = None) -> Outcome:
    """Compares what was found with what was hidden.

    ``minimum_detectable`` says how far off neutral each effect that is not named would have to be to be named.
    """
    hidden = set(case.hidden)
    reach = [{cause.effect, *cause.alternatives} for cause in causes]
    first = bool(reach and reach[0] & hidden) if hidden else not causes
    complete = all(any(name in names for names in reach) for name in hidden) if hidden else not causes
    right = [_right_size(cause, case.hidden[cause.effect]) for cause in causes if cause.effect in hidden]
    outcome = Outcome(
        case.name,
        tuple(case.hidden),
        tuple(cause.effect for cause in causes),
        first,
        complete,
        all(right) if right else None,
        case.hidden,
        {cause.effect: dict(cause.values) for cause in causes},
        {cause.effect: tuple(cause.alternatives) for cause in causes},
        {cause.effect: cause.delta_bic for cause in causes},
        {cause.effect: dict(cause.std) for cause in causes},
    )
    least = minimum_detectable or {}
    amount = {name: EFFECTS[name].amount(case.hidden[name]) for name in outcome.missed}
    return replace(outcome, too_small=tuple(name for name, size in amount.items() if size < least.get(name, 0.0)))


def _right_size(cause: Cause, true: dict[str, float]) -> bool:
    """Whether each parameter is within 15 % of what was hidden, or two standard deviations."""
    for name, value in true.items():
        about = EFFECTS[cause.effect].PARAMETERS[name]
        if about.shape:
            continue
        room = max(0.15 * abs(value - about.neutral), 2 * cause.std.get(name, 0.0))
        if abs(cause.values.get(name, about.neutral) - value) > room:
            return False
    return True


def rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Shares of the cases that came out right, with their 95 % intervals (Wilson)."""
    one = [o for o in outcomes if len(o.hidden) == 1]
    two = [o for o in outcomes if len(o.hidden) == 2]
    none = [o for o in outcomes if not o.hidden]
    return {
        "cases": len(outcomes),
        "named_first": shared([o.first for o in one]),
        "strictly_first": shared([o.strictly_first for o in one]),
        "right_size": shared([o.sized for o in outcomes if o.sized is not None]),
        "covered": shared([covered for o in outcomes for covered in o.covered]),
        "both_found": shared([o.all for o in two]),
        "false_alarms": shared([not o.first for o in none]),
        "recalibrated": shared([o.recalibrated for o in none if o.wrong]),
        "more_named": shared([len(o.named) > 1 for o in one]),
        "too_small": shared([name in o.too_small for o in outcomes for name in o.missed]),
    }


def processor_seconds(outcomes: Sequence[Outcome]) -> tuple[float, float] | None:
    """Median and maximum of what a diagnosis took, as far as it was measured."""
    taken = [o.seconds for o in outcomes if o.seconds is not None]
    return (float(np.median(taken)), max(taken)) if taken else None


def shared(right: Sequence[bool]) -> dict[str, Any]:
    """Which share of cases came out right, with its 95 % interval (Wilson)."""
    count, of = sum(right), len(right)
    if not of:
        return {"of": 0, "count": 0, "share": None, "interval_95": None}
    interval = binomtest(count, of).proportion_ci(method="wilson")
    return {"of": of, "count": count, "share": count / of, "interval_95": [float(interval.low), float(interval.high)]}


def share_of_range(effect: str, values: Mapping[str, float]) -> float:
    """Where a size lies between just noticeable (0) and large (1), in its logarithm."""
    least, most = EFFECTS[effect].TYPICAL
    return float(np.log(EFFECTS[effect].amount(values) / least) / np.log(most / least))


def by_size(outcomes: Sequence[Outcome], parts: int = 3) -> list[dict[str, Any]]:
    """Shares of cases of one effect that are named first, by size: from the range's least part to its greatest."""
    one = [o for o in outcomes if len(o.values) == 1]
    part = [min(int(parts * max(share_of_range(*next(iter(o.values.items()))), 0.0)), parts - 1) for o in one]
    return [shared([o.strictly_first for o, p in zip(one, part, strict=True) if p == k]) for k in range(parts)]


def matrix(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], npt.NDArray[np.intp]]:
    """Cases of one effect or none, by what was hidden and what was named first."""
    labels = [*EFFECTS, "none"]
    count = np.zeros((len(labels), len(labels)), dtype=np.intp)
    for outcome in outcomes:
        if len(outcome.hidden) < 2:
            hidden = outcome.hidden[0] if outcome.hidden else "none"
            named = outcome.named[0] if outcome.named else "none"
            count[labels.index(hidden), labels.index(hidden if outcome.first else named)] += 1
    return labels, labels, count
