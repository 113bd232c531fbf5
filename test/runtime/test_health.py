"""What the live predictor says of itself."""

from __future__ import annotations

import math

import pytest

from dynssm_ros.runtime.health import Delivery, Health, Level
from dynssm_ros.signals.history import Refusal

ODOMETRY, FEEDBACK = "/odometry", "/feedback"


@pytest.fixture
def health() -> Health:
    """After one second of odometry at 100 Hz and feedback at 50 Hz, every message answered in 1 ms."""
    health = Health((FEEDBACK, ODOMETRY), max_silence=0.25)
    for k in range(101):
        now = k / 100
        if k % 2 == 0:
            health.arrived(FEEDBACK, now)
        health.arrived(ODOMETRY, now)
        health.predicted(0.001 + 0.00001 * k, 0.25)
    return health


def test_rates_ages_and_latencies_are_those_of_the_messages(health: Health) -> None:
    assert health.rate(ODOMETRY, 1.0) == pytest.approx(100.0)
    assert health.rate(FEEDBACK, 1.0) == pytest.approx(50.0)
    assert health.age(FEEDBACK, 1.1) == pytest.approx(0.1)
    assert health.latency(50) == pytest.approx(0.0015)
    assert health.verdict(1.05) == (Level.OK, "predicting")
    assert health.values(1.05)["share of the residual"] == "0.250"


def test_before_the_first_message_nothing_was_received() -> None:
    health = Health((FEEDBACK, ODOMETRY), 0.25)
    assert health.verdict(0.0) == (Level.ERROR, "/feedback: nothing received; /odometry: nothing received")
    assert health.rate(ODOMETRY, 0.0) == 0.0
    assert health.values(0.0)["latency p99 (ms)"] == "0.000"


def test_silence_is_an_error_and_has_no_rate(health: Health) -> None:
    for k in range(101, 200):
        health.arrived(FEEDBACK, k / 100)
    level, words = health.verdict(1.99)
    assert level is Level.ERROR
    assert words == "/odometry: silent for 1.0 s"
    assert health.rate(ODOMETRY, 1.99) == 0.0


def test_what_was_refused_before_the_silence_is_told_with_it(health: Health) -> None:
    for _ in range(20):
        health.refused(Refusal.OUTLIER)
    words = health.verdict(1.99)[1]
    assert words.startswith("/feedback: silent for 1.0 s; /odometry: silent for 1.0 s; ")
    assert words.endswith(f"% of the last messages refused, mostly: {Refusal.OUTLIER.value}")


@pytest.mark.parametrize(("refusal", "level"), [(Refusal.FILLING, Level.WARN), (Refusal.STALE, Level.ERROR)])
def test_refusals_are_told_until_a_prediction_goes_out_again(health: Health, refusal: Refusal, level: Level) -> None:
    for _ in range(5):
        assert health.verdict(1.03) == (Level.OK, "predicting"), "a single one is none"
        health.refused(refusal)
    assert health.verdict(1.03) == (level, refusal.value)
    assert health.values(1.03)[f"refused: {refusal.name.lower()}"] == "5"
    health.predicted(0.001, 0.0)
    assert health.verdict(1.05) == (Level.OK, "predicting")


def test_the_verdict_follows_the_share_that_is_refused(health: Health) -> None:
    for k in range(100):
        (health.refused(Refusal.IMPLAUSIBLE) if k % 4 == 0 else health.predicted(0.001, 0.0))
    assert health.verdict(1.05) == (
        Level.WARN, f"25% of the last messages refused, mostly: {Refusal.IMPLAUSIBLE.value}",
    )  # fmt: skip


def test_more_than_one_publisher_is_named_and_a_wrong_wiring_is_an_error(health: Health) -> None:
    health.publishers = {ODOMETRY: 2, FEEDBACK: 1}
    assert health.verdict(1.05) == (Level.WARN, "/odometry: 2 publishers")
    health.wiring = "the steering's sign is swapped"
    assert health.verdict(1.05) == (Level.ERROR, "the steering's sign is swapped")


def test_a_topic_on_another_clock_is_named() -> None:
    health = Health((FEEDBACK, "/command", ODOMETRY), 0.25)
    for k in range(100):
        for topic, off in ((FEEDBACK, -1000), ("/command", 0), (ODOMETRY, 0)):
            health.arrived(topic, 50.0 + k / 100, (2000 + off) * 10**9 + k * 10**7)
        health.predicted(0.001, 0.0)
    level, words = health.verdict(51.0)
    assert level is Level.ERROR
    assert words == "/feedback: its stamps are 1e+03 s behind those of other topics"


def test_answers_to_messages_that_waited_longer_than_a_step_are_late() -> None:
    health = Health((ODOMETRY,), 0.25, period=0.02)
    for k in range(50):
        delay = 0.03 if k % 10 == 9 else 0.001
        health.arrived(ODOMETRY, k / 50 + delay, k * 20_000_000)
        health.predicted(0.001, 0.0, health.delivery(ODOMETRY).newest)
    assert health.late == 5
    assert health.values(1.0)["late answers"] == "5"


def delivered(delays: list[float], *, rate: float = 1.0, max_late: float = math.inf) -> Delivery:
    """After messages every 20 ms, each with its delay (s); of a log that is played ``rate`` times as fast."""
    delivery = Delivery(0.25, max_late)
    for k, delay in enumerate(delays):
        delivery.arrived(100.0 + 0.02 * k / rate + delay, 1_000_000_000 + 20_000_000 * k)
    return delivery


def test_how_late_messages_come_is_told_whatever_their_clock_is() -> None:
    usual = [0.003, 0.001, 0.004, 0.002] * 50
    assert delivered(usual).behind < 0.003
    assert delivered([*usual, *[0.15] * 5]).behind == pytest.approx(0.149, abs=0.001)
    assert delivered([*usual, *[0.15] * 4, 0.002]).behind < 0.003, "one that is in time"


def test_lateness_is_not_got_used_to_where_it_must_not_be() -> None:
    late = [*[0.0] * 200, *[0.15] * 10_000]
    assert delivered(late).behind < 0.001
    assert delivered(late, max_late=0.1).behind == pytest.approx(0.15, abs=0.005)


@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_of_a_log_that_is_played_slowly_or_fast_nothing_is_late(rate: float) -> None:
    assert delivered([0.0] * 500, rate=rate).behind == 0.0


def test_time_that_jumps_back_is_no_lateness() -> None:
    delivery = delivered([0.0] * 200)
    for k in range(200):
        delivery.arrived(104.02 + 0.02 * k, 500_000_000 + 20_000_000 * k)
    assert delivery.behind == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("latency", "delay", "level", "words"),
    [
        (0.03, 0.0, Level.WARN, "answers come 0.03 s after the odometry: it cannot keep up"),
        (0.3, 0.0, Level.ERROR, "answers come 0.30 s after the odometry: it cannot keep up"),
        (0.001, 0.1, Level.WARN, "/odometry: comes 0.10 s later than its fastest lately"),
        (0.001, 0.3, Level.ERROR, "/odometry: comes 0.30 s later than its fastest lately"),
    ],
)
def test_what_is_late_for_longer_is_said(latency: float, delay: float, level: Level, words: str) -> None:
    health = Health((ODOMETRY,), 0.25, period=0.02)
    for k in range(400):
        now = 0.02 * k + (delay * min(1.0, (k - 190) / 100) if k >= 200 else 0.0)
        health.arrived(ODOMETRY, now, k * 20_000_000)
        health.predicted(latency if k >= 200 else 0.001, 0.0)
        if k == 199:
            assert health.verdict(now) == (Level.OK, "predicting")
    assert health.verdict(now) == (level, words)


def test_passed_over_odometry_is_counted_and_said_if_it_is_much(health: Health) -> None:
    for _ in range(6):
        health.refused(Refusal.SKIPPED)
        health.predicted(0.001, 0.0)
    level, words = health.verdict(1.05)
    assert level is Level.WARN
    assert words == "6% of the last messages refused, mostly: newer odometry waited"
    assert health.values(1.05)["refused: skipped"] == "6"


def test_predictions_that_were_worse_than_none_are_an_error(health: Health) -> None:
    health.hindsight = (Level.ERROR, "predictions were off by 9 usual steps lately, the state before them by 1")
    assert health.verdict(1.05) == health.hindsight
