"""The baselines that need no training."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dynssm_ros.errors import ConfigurationError
from dynssm_ros.runtime.baselines import Persistence, SingleTrack, SingleTrackEwma
from dynssm_ros.runtime.kalman import SingleTrackEkf
from dynssm_ros.runtime.operations import count_operations
from dynssm_ros.runtime.registry import load_model
from dynssm_ros.signals.inputs import applied_inputs
from dynssm_ros.vehicle import COEFFICIENTS, CarModel, Coefficients, State, Vehicle, load_vehicle

CAR = load_vehicle("orca")


def drive(bias: np.ndarray, rows: int = 80, car: Vehicle = CAR) -> np.ndarray:
    """Window rows of the ORCA car under smooth inputs, with ``bias`` added to each step: ``(rows, 7)``."""
    t = np.arange(rows) * CAR.sampling_time
    drive = np.zeros((rows, 7))
    drive[:, 3], drive[:, 4] = 0.5 + 0.1 * np.sin(3 * t), 0.1 * np.sin(2 * t)
    drive[0, :3] = 1.5, 0.0, 0.0
    for k in range(rows - 1):
        applied = applied_inputs(drive[k])
        state = CarModel(CAR.constants, CAR.sampling_time).step(
            State(*drive[k, :3]), applied, Coefficients(*car.nominal)
        )[0]
        drive[k + 1, :3] = np.array(state) + bias
    return drive


def windows(rows: np.ndarray, H: int) -> tuple[np.ndarray, np.ndarray]:
    """All windows of ``H`` rows and the states that follow them."""
    ends = np.arange(H - 1, len(rows) - 1)
    return np.stack([rows[end - H + 1 : end + 1] for end in ends]), rows[ends + 1, :3]


def test_persistence_repeats_the_last_state_and_the_single_track_its_own_drive() -> None:
    given, following = windows(drive(np.zeros(3)), 1)
    still, driven = Persistence().predict(given), SingleTrack(CAR).predict(given)
    np.testing.assert_array_equal(still.state, given[:, -1, :3])
    np.testing.assert_allclose(driven.state, following, rtol=0, atol=1e-14)
    assert still.variance is driven.variance is None


def test_the_average_of_past_errors_takes_a_constant_bias_off_and_nothing_else() -> None:
    model = SingleTrackEwma(CAR)
    bias = np.array([0.01, -0.02, 0.3])
    given, following = windows(drive(bias), model.H)
    prediction = model.predict(given)
    np.testing.assert_allclose(prediction.state, following, rtol=0, atol=1e-12)
    assert prediction.physics is not None
    np.testing.assert_allclose(following - prediction.physics, np.tile(bias, (len(given), 1)), atol=1e-12)
    assert prediction.variance is None


def test_a_changing_bias_is_followed_within_the_memory_of_the_average() -> None:
    model = SingleTrackEwma(CAR)
    before, after = drive(np.zeros(3), 40), drive(np.array([0.0, 0.01, 0.0]), 120)
    rows = np.concatenate([before, after])
    state, following = windows(rows[45:], model.H)
    left = model.predict(state).state[:, 1] - following[:, 1]
    assert abs(left[-1]) < 1e-12


@pytest.mark.parametrize(
    ("call", "count"),
    [
        (lambda x: x, 0),
        (lambda x: np.sin(x) * 2.0 + x, 15),
        (lambda x: x * (np.sin(2.0) ** 2 + np.arange(5.0)), 5),  # constants are known beforehand
        (lambda x: x.sum() / 2.0, 6),
        (lambda x: np.stack([x, x]).T, 0),
        (lambda x: np.arctan2(x[:2], abs(x[:2])), 4),
    ],
)
def test_operations_on_the_argument_are_counted_one_by_one(call: Callable[[np.ndarray], object], count: int) -> None:
    assert count_operations(call, np.linspace(0.1, 1.0, 5)) == count


def test_operations_of_the_single_track_are_those_of_its_stages() -> None:
    euler = SingleTrack(CAR).flops
    ewma = SingleTrackEwma(CAR)
    # another step costs all but the sums that make the inputs (2) and the new state (3), and two sums of increments
    assert SingleTrack(CAR, substeps=2).flops - euler == euler - 2 - 3 + 2 * 3
    assert count_operations(SingleTrack(CAR).predict, np.ones((7, 1, 7))) == 7 * euler
    # of each channel: the errors, their weighting and its sum, then the correction
    assert ewma.flops == ewma.H * euler + 3 * (3 * (ewma.H - 1) + 1)
    assert Persistence().flops == 0


def noisy(rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
    measured = rows.copy()
    measured[:, :3] += noise * np.random.default_rng(0).standard_normal((len(rows), 3))
    return measured


def test_the_filter_takes_a_share_of_the_measurement_noise_off() -> None:
    true, model = drive(np.zeros(3), 400), SingleTrackEkf(CAR)
    _, following = windows(true, model.H)
    given, _ = windows(noisy(true, np.array([0.01, 0.01, 0.1])), model.H)
    filtered, plain = (
        np.sqrt(np.mean((m.predict(given).state - following) ** 2, axis=0)) for m in (model, SingleTrack(CAR))
    )
    assert np.all(filtered < 0.7 * plain)


def test_the_filter_leaves_the_known_car_as_it_is() -> None:
    model = SingleTrackEkf(CAR)
    given, following = windows(drive(np.zeros(3), 200), model.H)
    prediction = model.predict(given)
    np.testing.assert_allclose(prediction.state, following, atol=1e-4)
    assert prediction.theta is not None
    np.testing.assert_allclose(prediction.theta, np.tile(CAR.nominal, (len(given), 1)), rtol=0.02)


def test_the_filter_follows_a_car_that_has_changed() -> None:
    theta = dict(zip(COEFFICIENTS, CAR.nominal, strict=True))
    changed = CAR.with_nominal(np.array([v * (0.85 if n == "D_f" else 1.0) for n, v in theta.items()]))
    rows, model = noisy(drive(np.zeros(3), 600, changed), np.array([0.002, 0.002, 0.01])), SingleTrackEkf(CAR)
    given, following = windows(rows, model.H)
    prediction = model.predict(given)
    left, plain = (
        np.mean((state - following) ** 2, axis=0) for state in (prediction.state, SingleTrack(CAR).predict(given).state)
    )
    assert left[2] < 0.5 * plain[2]
    assert prediction.theta is not None
    moved = np.median(prediction.theta[:, COEFFICIENTS.index("D_f")]) / theta["D_f"] - 1
    assert -0.2 < moved < -0.05


@pytest.mark.parametrize("name", ["single_track", "single_track_ewma", "single_track_ekf"])
def test_single_track_models_need_a_vehicle(name: str) -> None:
    assert load_model(name, CAR).name == name
    with pytest.raises(ConfigurationError, match=f"model {name}: needs --vehicle"):
        load_model(name)
    with pytest.raises(ConfigurationError, match=rf"'nothing'.*persistence, .*\b{name}\b"):
        load_model("nothing")
