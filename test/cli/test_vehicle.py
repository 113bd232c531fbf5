"""``dynssm vehicle new``: what it writes, asks and refuses."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from dynssm_ros.vehicle import load_vehicle

Run = Callable[..., tuple[int, str, str]]
MEASURED = ("--mass", 3.2, "--front-mass", 1.7, "--wheelbase", 0.32)


class Terminal(io.StringIO):
    """Somebody who types."""

    def isatty(self) -> bool:
        return True


def test_it_writes_a_file_that_is_read_back_and_is_called_like_it(dynssm: Run, tmp_path: Path) -> None:
    status, out, _ = dynssm(
        "vehicle", "new", "--like", "f1tenth", *MEASURED, "--rate", 40, "--out", tmp_path / "mine.yaml"
    )
    assert status == 0
    assert "a guess until it is calibrated" in " ".join(out.split())
    car = load_vehicle(tmp_path / "mine.yaml")
    assert (car.name, car.constants.m, car.sampling_time, car.inputs.set_point) == ("mine", 3.2, 0.025, "speed")
    assert (tmp_path / "mine.yaml").read_text().startswith("# A guess: f1tenth, scaled to 3.2 kg")


def test_a_file_that_somebody_may_have_edited_is_replaced_by_force_alone(dynssm: Run, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mine: 1\n")
    words = ("vehicle", "new", "--like", "f1tenth", *MEASURED, "--out", file)
    status, _, err = dynssm(*words)
    assert (status, file.read_text()) == (1, "mine: 1\n")
    assert "mine.yaml: exists and is not new; not replaced (another name, or --force)" in err
    assert dynssm(*words, "--force")[0] == 0
    assert load_vehicle(file).name == "mine"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--mass", 3.2, "--front-mass", 1.7), "--wheelbase is missing; expected what a scale or a ruler tells"),
        ((*MEASURED, "--front-mass", 4), "--front-mass 4: expected 0.32 to 2.88 kg, of the 3.2 kg of the car"),
        (
            (*MEASURED, "--front-mass", 55),
            "--front-mass 55: expected 0.32 to 2.88 kg, of the 3.2 kg of the car; 55 % of it are 1.76 kg",
        ),
        ((*MEASURED, "--front-mass", 0.3), "of the 3.2 kg of the car; 30 % of it are 0.96 kg"),
        ((*MEASURED, "--like", "bicycle"), "'bicycle' is neither a file nor a shipped name"),
        ((*MEASURED, "--tyre", "wood"), "--tyre"),
        (("--mass", 3200, "--front-mass", 1700, "--wheelbase", 0.32), "constants.m: 3200: in g?"),
    ],
)
def test_what_is_missing_or_wrong_is_one_line(
    dynssm: Run, tmp_path: Path, words: tuple[object, ...], said: str
) -> None:
    status, _, err = dynssm("vehicle", "new", *words, "--out", tmp_path / "mine.yaml")
    assert status == 1
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "mine.yaml").exists()


def test_somebody_at_a_terminal_is_asked_for_what_is_missing(
    dynssm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("820\n2.7\n"))
    status, _, _ = dynssm("vehicle", "new", "--mass", 1500, "--out", tmp_path / "road.yaml")
    assert status == 0
    car = load_vehicle(tmp_path / "road.yaml").constants
    assert (car.m, car.l_f + car.l_r) == (1500.0, pytest.approx(2.7))
    assert car.l_f == pytest.approx(2.7 * 680 / 1500, rel=1e-3)
