"""A term that is missing is found as a formula where it is planted, and nothing is found in noise."""

from __future__ import annotations

import numpy as np
import pytest

from dynssm_ros.arrays import Vector
from dynssm_ros.identification.result.formula import _formula, _Missing

PARTS, EACH = 4, 300


def missing(seed: int, planted: float = 0.0, only_in: int | None = None) -> _Missing:
    """Signals of a drive in four parts; in one channel ``planted * v_x^2 * v_y`` beside noise, in one part or in all."""
    rng = np.random.default_rng(seed)
    n = PARTS * EACH
    v_x, omega = rng.uniform(8.0, 30.0, n), rng.uniform(-0.5, 0.5, n)
    signals = np.stack(
        [v_x, rng.normal(0.0, 0.3, n), omega, rng.uniform(-1, 1, n), rng.uniform(-0.2, 0.2, n), np.linspace(0, 200, n)],
        axis=1,
    )
    fold = np.arange(n) // EACH
    acts = np.ones(n) if only_in is None else fold == only_in
    acceleration = rng.normal(0.0, 1.0, (n, 3))
    acceleration[:, 2] += planted * acts * v_x**2 * signals[:, 1]
    return _Missing(signals, acceleration, fold, np.arange(n) // 4)


@pytest.mark.parametrize("planted", [0.02, -0.005])
def test_a_planted_term_is_found_with_its_coefficient(planted: float) -> None:
    found = _formula(missing(3, planted), 2)
    assert found is not None
    assert found.holds
    assert found.channel == "omega"
    assert list(found.terms) == ["v_x^2 v_y"]
    assert found.terms["v_x^2 v_y"] == pytest.approx(planted, rel=0.1)
    data = missing(3, planted)
    told = 1.0 - np.mean(missing(3).acceleration[:, 2] ** 2) / np.mean(data.acceleration[:, 2] ** 2)
    assert found.share == pytest.approx(told, abs=0.05)


def test_noise_has_no_formula() -> None:
    found = [_formula(missing(seed), channel) for seed in range(20) for channel in range(3)]
    assert [each.terms for each in found if each is not None and each.holds] == []


def test_what_is_there_in_one_part_alone_does_not_carry_over() -> None:
    found = [_formula(missing(seed, 0.005, only_in=0), 2) for seed in range(5)]
    assert not any(each.holds for each in found if each is not None)


def test_a_channel_without_error_has_none() -> None:
    exact = missing(1)._replace(acceleration=np.zeros((PARTS * EACH, 3)))
    assert _formula(exact, 0) is None


def test_units_of_a_signal_do_not_matter() -> None:
    data = missing(4, 0.02)
    scale: Vector = np.array([1e3, 1e-3, 1.0, 1.0, 1.0, 1.0])
    one, other = _formula(data, 2), _formula(data._replace(signals=data.signals * scale), 2)
    assert one is not None
    assert other is not None
    assert other.terms["v_x^2 v_y"] == pytest.approx(one.terms["v_x^2 v_y"] * 1e-3, rel=1e-6)


def test_of_time_there_is_a_trend_at_most() -> None:
    data = missing(5)
    omega, t = data.signals[:, 2], data.signals[:, 5]
    drifting = data.acceleration.copy()
    drifting[:, 1] += 0.05 * omega * t
    found = _formula(data._replace(acceleration=drifting), 1)
    assert found is not None
    assert next(iter(found.terms)) == "omega t"
    assert found.terms["omega t"] == pytest.approx(0.05, rel=0.1)
    drifting[:, 1] = data.acceleration[:, 1] + 1e-6 * t**3
    cubic = _formula(data._replace(acceleration=drifting), 1)
    assert cubic is None or not any("t^" in name for name in cubic.terms)


def test_products_that_stand_for_a_curve_over_one_signal_are_no_formula() -> None:
    data = missing(6)
    kinked = data.acceleration.copy()
    throttle = data.signals[:, 3]
    kinked[:, 0] += 3.0 * (np.abs(throttle) > 0.5) * np.sign(throttle)  # a dead band: no polynomial
    found = _formula(data._replace(acceleration=kinked), 0)
    assert found is not None
    assert found.curve_share > found.share > 0.1
    assert not found.holds
