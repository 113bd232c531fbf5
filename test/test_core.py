"""The core alone (`pip install .`): what the car needs works without torch, casadi, scipy and matplotlib."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dynssm_ros.extras import EXTRAS, MissingExtraError, require

REPOSITORY = Path(__file__).resolve().parent.parent
HIDDEN = sorted({library for extra, libraries in EXTRAS.items() if extra != "ros" for library in libraries})
BLOCKED = f"""
import sys
from importlib.abc import MetaPathFinder

class Hidden(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {HIDDEN!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
"""


def run(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Runs code in a process that has the core's libraries alone."""
    command = [sys.executable, "-c", BLOCKED + code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)


DYNSSM = f"""
import dynssm_ros.extras as extras
extras.find_spec = lambda name: None if name in {HIDDEN!r} else object()
from dynssm_ros.cli.main import main
sys.argv = ["dynssm", *sys.argv[1:]]
main()
"""


def test_a_log_is_extracted_and_replayed(laps_bag: Path, small_model: Path, tmp_path: Path) -> None:
    out = tmp_path / "laps.parquet"
    done = run(DYNSSM, "extract", laps_bag, "--signals", "default", "--rate", 50, "--out", out)
    assert (done.returncode, done.stderr) == (0, "")
    done = run(DYNSSM, "replay", laps_bag, "--model", small_model, "--out", tmp_path / "replayed")
    assert (done.returncode, done.stderr) == (0, "")
    assert "predictions" in done.stdout


def test_the_predictor_node_is_importable_with_all_that_it_uses() -> None:
    done = run("import dynssm_ros.nodes.predictor, dynssm_ros.nodes.player\nassert 'torch' not in sys.modules")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["train", "r.parquet", "--model", "dynssm", "--vehicle", "orca", "--out", "m"], "train"),
        (["calibrate", "r.parquet", "--vehicle", "orca", "--out", "c.yaml"], "train"),
        (["diagnose", "r.parquet", "--vehicle", "orca", "--out", "d"], "report,train"),
        (["race", "--vehicle", "orca", "--track", "club", "--model", "true", "--out", "r"], "race,report"),
        (["simulate", "--vehicle", "orca", "--track", "club", "--out", "b"], "race"),
        (["evaluate", "r.parquet", "--model", "persistence", "--out", "e"], "report"),
    ],
)
def test_a_missing_extra_is_one_line_that_names_it(arguments: list[str], extra: str) -> None:
    done = run(DYNSSM, *arguments)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert f"pip install 'dynssm_ros[{extra}]'" in line


def test_a_matlab_file_is_one_line_that_names_its_extra(tmp_path: Path) -> None:
    (tmp_path / "log.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(128))
    done = run(DYNSSM, "inspect", tmp_path / "log.mat")
    (line,) = done.stderr.strip().splitlines()
    assert (done.returncode, "pip install 'dynssm_ros[matlab]'" in line) == (1, True)


def test_what_is_there_is_not_asked_for() -> None:
    require("the tests", "train", "race", "report")
    with pytest.raises(KeyError):
        require("nobody", "no_such_extra")
    assert issubclass(MissingExtraError, Exception)


@pytest.fixture(params=[None, "1.26.4"], ids=["newest numpy", "numpy 1.26"])
def installed(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The interpreter of an environment installed anew from the declared requirements; with numpy 1.26 it trains too."""
    environment, numpy = tmp_path / "core", request.param
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    python, constraints = environment / "bin" / "python", tmp_path / "constraints.txt"
    lines = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if numpy is None or not line.startswith("numpy==")]
    constraints.write_text("\n".join(kept), encoding="utf-8")
    wanted = [".[ros]"] if numpy is None else [f"numpy=={numpy}", ".[ros,train]"]
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"):
        monkeypatch.delenv(name, raising=False)
    install = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", constraints, *wanted]
    subprocess.run(install, check=True, cwd=REPOSITORY, capture_output=True)
    listed = subprocess.run([python, "-m", "pip", "list"], check=True, capture_output=True, text=True).stdout
    found = dict(line.split()[:2] for line in listed.splitlines() if line)
    if numpy is None:
        assert not {"torch", "casadi", "matplotlib", "scipy"} & found.keys()
    assert found["numpy"] == numpy or numpy is None
    monkeypatch.chdir(tmp_path)  # away from the source tree
    return python


@pytest.mark.slow
@pytest.mark.live
@pytest.mark.timeout(1800)
def test_an_environment_installed_anew_extracts_replays_and_predicts_live_on_dds(
    installed: Path, laps_bag: Path, small_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node runs in that environment, the bag is played from here."""
    from benchmarks.endurance import live_run

    def dynssm(*arguments: object) -> str:
        command = [str(installed.with_name("dynssm")), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    model = small_model
    dynssm("extract", laps_bag, "--signals", "default", "--rate", 50, "--out", "laps.parquet")
    if subprocess.run([installed, "-c", "import torch"], capture_output=True, check=False).returncode == 0:
        dynssm("train", "laps.parquet", "--vehicle", "orca", "--model", "rls", "--holdout", 0.25, "--out", "model")
        model = Path("model").absolute()
    assert "predictions" in dynssm("replay", laps_bag, "--model", model, "--out", "replayed")
    monkeypatch.setattr(live_run.sys, "executable", str(installed))
    run = live_run.run_live(model, laps_bag, 0.02, duration=4.0)
    assert len(run.predicted) > 150
    assert run.lost == 0
    assert run.passed_over < 0.3 * len(run.sent), "a machine that is busy"
