"""The encoders: the discretisation, two ways to evaluate it, causality, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter

from dynssm_ros.learning.models.base import GruConfig
from dynssm_ros.learning.models.dynssm.config import FusionConfig, SsmConfig
from dynssm_ros.learning.models.dynssm.encoders import DiagonalSsm, Fusion, GruEncoder, SsmEncoder

TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-12}

sizes = st.tuples(st.integers(1, 6), st.integers(1, 8), st.integers(1, 24), st.integers(0, 1000))
precisions = st.sampled_from([torch.float32, torch.float64])


def layer(channels: int, states: int, seed: int, dtype: torch.dtype = torch.float64) -> DiagonalSsm:
    """A layer away from its initial values."""
    torch.manual_seed(seed)
    made = DiagonalSsm(channels, states)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made.to(dtype)


def test_the_discretisation_is_scipys_zero_order_hold() -> None:
    ssm = layer(3, 4, 0)
    exponent, gain = (value.detach().numpy() for value in ssm.discretised())
    a, dt = -np.exp(ssm.log_a.detach().numpy()), np.exp(ssm.log_dt.detach().numpy())
    for c in range(3):
        A, B, *_ = cont2discrete((np.diag(a[c]), np.ones((4, 1)), np.ones((1, 4)), np.zeros((1, 1))), dt[c], "zoh")
        np.testing.assert_allclose(np.exp(exponent[c]), np.diag(A), rtol=1e-13)
        np.testing.assert_allclose(gain[c], B[:, 0], rtol=1e-12)


def test_a_slow_pole_keeps_its_digits_in_single_precision() -> None:
    ssm = DiagonalSsm(1, 1)
    with torch.no_grad():
        ssm.log_a.fill_(np.log(1e-3))
        ssm.log_dt.fill_(np.log(1e-3))
    _, gain = ssm.discretised()
    assert gain.item() == pytest.approx(-np.expm1(-1e-6) / 1e-3, rel=1e-6)


def test_one_state_is_a_first_order_filter() -> None:
    ssm = layer(1, 1, 1)
    exponent, gain = (value.item() for value in ssm.discretised())
    u = torch.randn(1, 30, 1, dtype=torch.float64)
    b = ssm.C.item() * gain
    expected = lfilter([b], [1.0, -np.exp(exponent)], u[0, :, 0].numpy()) + ssm.D.item() * u[0, :, 0].numpy()
    np.testing.assert_allclose(ssm.convolution(u)[0, :, 0].detach().numpy(), expected, atol=1e-13)


@given(sizes, precisions)
@settings(max_examples=60)
def test_convolution_and_recurrence_are_the_same_map(size: tuple[int, int, int, int], dtype: torch.dtype) -> None:
    channels, states, length, seed = size
    ssm = layer(channels, states, seed, dtype)
    u = torch.randn(2, length, channels, dtype=dtype)
    with torch.no_grad():
        convolved, stepped = ssm.convolution(u), ssm.recurrence(u)
        lasts = ssm.convolved_last(u), ssm.recurred_last(u)
    scale = max(1.0, convolved.abs().max().item())
    assert convolved.shape == stepped.shape == u.shape
    assert (convolved - stepped).abs().max().item() < TOLERANCE[dtype] * scale
    for last in lasts:
        assert (convolved[:, -1] - last).abs().max().item() < TOLERANCE[dtype] * scale


@given(st.integers(1, 3), st.integers(1, 12), st.integers(0, 100), precisions)
@settings(max_examples=30)
def test_the_deployed_encoder_is_the_trained_one(layers: int, length: int, seed: int, dtype: torch.dtype) -> None:
    torch.manual_seed(seed)
    encoder = SsmEncoder(7, SsmConfig(channels=5, states=3, layers=layers)).to(dtype)
    window = torch.randn(3, length, 7, dtype=dtype)
    with torch.no_grad():
        trained = encoder(window)
        encoder.for_deployment()
        deployed = encoder(window)
    assert trained.shape == (3, 5)
    scale = max(1.0, trained.abs().max().item())
    assert (trained - deployed).abs().max().item() < TOLERANCE[dtype] * scale


@given(st.integers(2, 20), st.data())
@settings(max_examples=30)
def test_the_future_does_not_change_the_past(length: int, data: st.DataObject) -> None:
    now = data.draw(st.integers(0, length - 2))
    ssm = layer(3, 2, length)
    u = torch.randn(1, length, 3, dtype=torch.float64)
    other = u.clone()
    other[:, now + 1 :] += 10.0
    for evaluate in (ssm.convolution, ssm.recurrence):
        before, after = evaluate(u), evaluate(other)
        torch.testing.assert_close(before[:, : now + 1], after[:, : now + 1], rtol=0, atol=1e-13)
        assert not torch.allclose(before[:, now + 1], after[:, now + 1])


def test_both_evaluations_have_the_same_gradient() -> None:
    u = torch.randn(4, 12, 3, dtype=torch.float64)
    gradients = []
    for name in ("convolution", "recurrence"):
        ssm = layer(3, 4, 7)
        getattr(ssm, name)(u).square().sum().backward()
        gradients.append([parameter.grad for parameter in ssm.parameters()])
    for convolved, stepped in zip(*gradients, strict=True):
        assert convolved is not None
        assert stepped is not None
        assert convolved.abs().min() > 0
        torch.testing.assert_close(convolved, stepped, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("layers", [1, 2])
def test_gradients_reach_every_parameter_and_the_oldest_row(layers: int) -> None:
    torch.manual_seed(0)
    fusion = Fusion(
        7,
        SsmConfig(channels=4, states=2, layers=layers),
        GruConfig(hidden=4, layers=layers),
        FusionConfig(hidden=6, latent=5),
    )
    window = torch.randn(8, 6, 7, requires_grad=True)
    fusion(window).square().sum().backward()
    for name, parameter in fusion.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name
    assert window.grad is not None
    assert (window.grad.abs().sum(dim=(0, 2)) > 0).all()


def test_the_gru_encoder_is_the_last_hidden_state() -> None:
    torch.manual_seed(0)
    encoder = GruEncoder(7, GruConfig(hidden=5, layers=2))
    window = torch.randn(3, 6, 7)
    outputs, _ = encoder.gru(window)
    torch.testing.assert_close(encoder(window), outputs[:, -1])


@pytest.mark.parametrize(("ssm", "gru"), [(True, False), (False, True), (True, True)])
def test_a_missing_encoder_leaves_nothing_behind(ssm: bool, gru: bool) -> None:
    torch.manual_seed(0)
    fusion = Fusion(
        7,
        SsmConfig(channels=4, states=2) if ssm else None,
        GruConfig(hidden=3) if gru else None,
        FusionConfig(hidden=6, latent=5),
    )
    assert fusion(torch.randn(2, 6, 7)).shape == (2, 5)
    names = {name.split(".")[0] for name, _ in fusion.named_parameters()}
    assert names == {"mix"} | ({"ssm"} if ssm else set()) | ({"gru"} if gru else set())
    assert fusion.mix[0].in_features == 7 + 4 * ssm + 3 * gru
