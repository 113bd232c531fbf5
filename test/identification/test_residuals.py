"""What of an error is systematic: planted patterns are seen, noise is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynssm_ros.identification.problem.windows import RecordedRows, SimulationWindows
from dynssm_ros.identification.result.residuals import clustered, explained_variance, lasting

N, K = 6000, 10


def driven(place: bool = True) -> SimulationWindows:
    rng = np.random.default_rng(0)
    time = 0.04 * np.arange(N)
    waves = [
        np.sin(2 * np.pi * time / period + phase)
        for period, phase in zip((7, 11, 5, 13, 9), rng.uniform(0, 6, 5), strict=True)
    ]
    rows = np.stack([30 + 5 * waves[0], waves[1], 0.3 * waves[2], waves[3], 0.1 * waves[4], 0 * time, 0 * time])
    context = {"s": (37.0 * time) % 1000.0, "lap_length": np.full(N, 1000.0)} if place else {}
    return SimulationWindows(
        RecordedRows(rows, context, 0.04, time, np.zeros(N, dtype=np.intp)), np.arange(0, N - K, K), K, 0
    )


def errors(windows: SimulationWindows, planted: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal((len(windows), 3))
    return noise + planted[:, None]


def test_noise_is_no_pattern() -> None:
    windows = driven()
    found = explained_variance(windows, errors(windows, np.zeros(len(windows))), windows.starts // 75)
    assert not found.is_there
    assert (found.share < 0.02).all()


def test_an_error_that_follows_a_signal_is_seen_and_the_signal_is_named() -> None:
    windows = driven(place=False)
    speed = windows.data.rows[0, windows.starts] - 30
    found = explained_variance(windows, errors(windows, speed / 3.5), windows.starts // 75)
    assert found.is_there
    np.testing.assert_allclose(found.share, 0.45, atol=0.1)  # half, less what estimating costs
    assert next(iter(found.pattern["v_y"])) == "speed"
    assert np.isnan(found.by_place).all()


def test_what_lasts_is_the_share_that_a_simulation_and_the_next_have_in_common() -> None:
    windows, rng = driven(), np.random.default_rng(2)
    slow = np.repeat(rng.standard_normal(len(windows) // 50 + 1), 50)[: len(windows)]
    share = np.array([0.0, 0.25, 0.8])
    planted = np.sqrt(1.0 - share) * rng.standard_normal((len(windows), 3)) + np.sqrt(share) * slow[:, None]
    np.testing.assert_allclose(lasting(windows, planted), share, atol=0.1)
    apart, every = replace(windows, starts=windows.starts[::2]), planted[::2]
    assert (lasting(apart, every) == 0.0).all(), "simulations with a gap between them are of another moment"


def test_an_error_that_repeats_at_a_place_is_seen_as_such() -> None:
    windows = driven()
    lap = windows.context(K // 2)["s"] / 1000.0
    found = explained_variance(
        windows, errors(windows, np.where(np.abs(lap - 0.4) < 0.1, 3.0, 0.0)), windows.starts // 75
    )
    assert found.is_there
    assert found.by_place == pytest.approx(np.full(3, 0.55), abs=0.12)
    low, high = found.stretch["v_y"]
    assert 300.0 <= low < high <= 500.0


def test_errors_that_come_together_are_told_from_the_same_errors_anywhere() -> None:
    rng, W = np.random.default_rng(2), 180
    time, sizes = np.arange(W) * 0.5, rng.chisquare(20, W) / 20
    block = (time // 3).astype(int)
    assert not clustered(sizes, time, block, 1.0).is_there
    oil = np.where((time >= 30) & (time < 36), 2.0, 0.0)
    found = clustered(sizes + oil, time, block, 1.0)
    assert found.is_there
    assert 30 <= found.when[0] < found.when[1] < 36
    assert not clustered(rng.permutation(sizes + oil), time, block, 1.0).is_there
    assert clustered(sizes, time, block, 5.0).is_there
