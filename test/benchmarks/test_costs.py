"""What the commands cost on long logs and on many."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import costs
from benchmarks.costs import Cost, long_logs_table, main, many_logs_table


def test_an_hour_more_is_the_slope_between_two_lengths() -> None:
    table = long_logs_table({10.0: {"extract": Cost(3.0, 2.5, 141.0)}, 60.0: {"extract": Cost(15.0, 12.5, 255.0)}})
    assert table.rows == [["extract", 2.5, 141.0, 12.5, 255.0, pytest.approx(12.0)]]
    assert long_logs_table({10.0: {"extract": Cost(3.0, 2.5, 141.0)}}).rows == [["extract", 2.5, 141.0, None]]


def test_several_processes_are_compared_with_one_by_their_medians() -> None:
    rows = many_logs_table({"1 process": [9.0, 4.0, 5.0], "2 processes": [2.5], "unchanged": [0.5]}).rows
    assert rows == [["1 process", 5.0, 1.0], ["2 processes", 2.5, 2.0], ["unchanged", 0.5, 10.0]]


def test_each_command_is_given_what_the_one_before_has_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given: list[list[str]] = []

    def run(arguments: list[str]) -> Cost:
        given.append([str(Path(word).name) for word in arguments])
        return Cost(1.0, 1.0, 1.0)

    monkeypatch.setattr(costs, "run", run)
    file = tmp_path / "costs.json"
    main(["--minutes", "10", "--logs", "0", "--json", str(file)])
    by_name = {words[0]: words for words in given}
    assert by_name["extract"][-1] == by_name["calibrate"][1] == by_name["evaluate"][1] == "laps.parquet"
    assert by_name["evaluate"][by_name["evaluate"].index("--model") + 1] == "model"
    assert set(json.loads(file.read_text())["long_logs"]["10"]) >= {"inspect", "extract", "diagnose", "replay"}


def test_a_command_that_fails_ends_the_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        costs.sys.exit(main(["--minutes", "-1", "--logs", "0"]))
    assert "error: dynssm simulate" in str(ended.value)
