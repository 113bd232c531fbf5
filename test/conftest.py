"""Fixtures that several rooms share."""

from __future__ import annotations

import ast
import fcntl
import hashlib
import io
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import time

# tests run side by side; libraries read these when they are loaded
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

# the same examples in every run, so that a red test is red for everybody
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # a wrongly typed message field must fail, not corrupt

REPOSITORY = Path(__file__).resolve().parent.parent

# tests make the computer busy, so that it is set up as one; without this file `make demo` runs
os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(REPOSITORY / "config" / "fastdds.xml"))


@pytest.hookimpl(trylast=True)  # once those that are not wanted are gone
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts live tests at the beginning of each half, which is what each of two workers starts with.

    They run in real time, two at once, and not beside calculations that would keep their messages waiting.
    """
    live = [item for item in items if item.get_closest_marker("live")]
    others = [item for item in items if not item.get_closest_marker("live")]
    cut = len(live) // 2
    while 0 < cut < len(live) and live[cut].path == live[cut - 1].path:  # a file's nodes are started once
        cut += 1
    half = max(len(items) // 2 - cut, 0)
    items[:] = [*live[:cut], *others[:half], *live[cut:], *others[half:]]


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real measurements, which is not part of the repository."""
    folder = Path(os.environ.get("DYNSSM_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder} (set DYNSSM_DATA)")
    return folder


@pytest.fixture(scope="session")
def putnam(data: Path) -> Path:
    """The AV-21 log of Putnam Park as a rosbag2 folder."""
    return data / "av21" / "putnam_park_run4_2"


@pytest.fixture(scope="session")
def orca_bag(data: Path) -> Path:
    """The published ORCA run on ETHZ as a rosbag2 folder."""
    return data / "orca" / "ethz_pure_pursuit"


@pytest.fixture(scope="session")
def acting() -> Callable[..., dict[str, float]]:
    """Parameters with which the effect of a name acts: each a share of the way from neutral to its upper bound, or to
    the lower one where there is nothing above."""
    from dynssm_ros.vehicle.effects import EFFECTS

    def parameters(name: str, share: float = 0.2) -> dict[str, float]:
        described = EFFECTS[name].PARAMETERS.items()
        return {
            key: p.neutral + (0.0 if p.shape else share) * ((p.upper if p.direction > 0 else p.lower) - p.neutral)
            for key, p in described
        }

    return parameters


@pytest.fixture(scope="session")
def declared_parameters() -> Callable[[str], dict[str, object]]:
    """What a node declares in its source, a managed one with what all of these do: default values by name."""

    def declared(node: str) -> dict[str, object]:
        source = (REPOSITORY / "dynssm_ros" / "nodes" / f"{node}.py").read_text(encoding="utf-8")
        return (declared("managed") if "(ManagedNode)" in source else {}) | {
            call.args[1].value: ast.literal_eval(call.args[2])
            for call in ast.walk(ast.parse(source))
            if isinstance(call, ast.Call) and ast.unparse(call.func) in ("describe", "choose")
            if isinstance(call.args[1], ast.Constant)
        }

    return declared


@cache
def _sources() -> bytes:
    """Digest of what makes drives and models: the package, its configuration, these fixtures, the libraries' versions."""
    digest = hashlib.sha256(sys.version.encode())
    found = [*(REPOSITORY / "dynssm_ros").rglob("*.py"), *(REPOSITORY / "config").rglob("*.yaml")]
    for path in sorted([*found, REPOSITORY / "constraints.txt", Path(__file__)]):
        digest.update(path.relative_to(REPOSITORY).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.digest()


@pytest.fixture(autouse=True)
def beside_others(request: pytest.FixtureRequest) -> Iterator[None]:
    """Live tests run two at a time, but for those that need the cores for themselves to keep up with real time."""
    if request.node.get_closest_marker("live") is None:
        yield
        return
    alone = request.node.get_closest_marker("alone") is not None
    (REPOSITORY / ".pytest_cache").mkdir(exist_ok=True)
    with (REPOSITORY / ".pytest_cache" / "live.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield


Kept = Callable[[str, Callable[[Path], None]], Path]


@pytest.fixture(scope="session")
def kept() -> Kept:
    """``kept(name, make)``: the folder that ``make(folder)`` fills, made once for all workers and runs of these sources.

    Its name has the digest of the sources. It lies in ``.pytest_cache``, where those of other sources stay for a day.
    Tests read it and do not write there.
    """
    place = REPOSITORY / ".pytest_cache" / "kept"
    place.mkdir(parents=True, exist_ok=True)

    def get(name: str, make: Callable[[Path], None]) -> Path:
        folder = place / f"{name}-{hashlib.sha256(_sources() + name.encode()).hexdigest()[:16]}"
        with (place / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # others wait for what is being made
            if not folder.is_dir():
                for old in place.glob(f"{name}-*"):
                    if time.time() - old.stat().st_mtime > 86400:
                        shutil.rmtree(old)
                with tempfile.TemporaryDirectory(dir=place) as scratch:
                    made = Path(scratch) / "made"
                    made.mkdir()
                    make(made)
                    made.rename(folder)  # whole or not at all
        return folder

    return get


@pytest.fixture(scope="session")
def laps_bag(kept: Kept) -> Path:
    """20 s of the simulated ORCA car on a club track, as a rosbag2 folder with the standard topics."""

    def make(folder: Path) -> None:
        from dynssm_ros.simulation.laps import simulate, write_run
        from dynssm_ros.track.tracks import load_track
        from dynssm_ros.vehicle import load_vehicle

        write_run(simulate(load_vehicle("orca"), load_track("club"), duration=20.0), folder / "club")

    return kept("laps_bag", make) / "club"


@pytest.fixture(scope="session")
def small_model(laps_bag: Path, kept: Kept) -> Path:
    """The folder of a small DynSSM, trained for two epochs on ``laps_bag`` (T_s 0.02 s, H 5, commands from topics)."""

    def make(folder: Path) -> None:
        from dynssm_ros.learning.export import save_artifact
        from dynssm_ros.learning.models.registry import parse_model_config
        from dynssm_ros.learning.stages import train
        from dynssm_ros.signals.extraction import extract
        from dynssm_ros.signals.signal_map import load_signal_map
        from dynssm_ros.vehicle import load_vehicle

        config = parse_model_config(SMALL, "small.yaml")
        recording = extract([laps_bag], load_signal_map("default"), 50.0)
        with tempfile.TemporaryDirectory() as scratch:
            trained = train(recording, config, load_vehicle("orca"), Path(scratch) / "checkpoint.pt")
        save_artifact(trained, folder / "small")

    return kept("small_model", make) / "small"


@pytest.fixture
def vast_model(small_model: Path, tmp_path: Path) -> Path:
    """The folder of a model that is well but for a tensor of 1.5 GB in its graph; the checksums fit."""
    import onnx
    import yaml
    from onnx import helper, numpy_helper

    from dynssm_ros.files import checksum
    from dynssm_ros.runtime.artifact import CARD, ONNX

    folder = shutil.copytree(small_model, tmp_path / "vast")
    model = onnx.load(folder / ONNX)
    model.graph.initializer.append(numpy_helper.from_array(np.array([375, 1000, 1000]), "shape"))
    model.graph.node.insert(0, helper.make_node("ConstantOfShape", ["shape"], ["zeros"]))
    onnx.save(model, folder / ONNX)
    card = yaml.safe_load((folder / CARD).read_text())
    card["checksums"][ONNX] = checksum(folder / ONNX)
    (folder / CARD).write_text(yaml.safe_dump(card))
    return folder


@pytest.fixture(scope="session")
def four_wheels(kept: Kept) -> Path:
    """40 s of a small car with four wheels and load transfer on a club track, with noisy sensors, as a recording."""

    def make(folder: Path) -> None:
        from dynssm_ros.api import recorded, simulate

        noise = (0.01, 0.01, 0.03)
        recorded(simulate("orca", "club", duration=40.0, seed=5, plant="double_track", noise=noise)).save(
            folder / "laps.parquet"
        )

    return kept("four_wheels", make) / "laps.parquet"


@pytest.fixture(scope="session")
def rls_model(four_wheels: Path, kept: Kept) -> Path:
    """The folder of the online layer alone, trained on ``four_wheels``."""

    def make(folder: Path) -> None:
        import dynssm_ros

        dynssm_ros.train(four_wheels, "rls", "orca", folder / "rls")

    return kept("rls_model", make) / "rls"


SMALL: dict[str, Any] = {
    "name": "small",
    "history": 0.1,
    "ssm": {"channels": 4, "states": 2},
    "gru": {"hidden": 6},
    "fusion": {"hidden": 8, "latent": 8},
    "physics": {},
    "adaptation": {"hidden": 8, "alpha": 0.5},
    "residual": {"hidden": [8], "scale": 1.0},
    "loss": {"parameters": 0.001},
    "training": {"epochs": 2, "batch_size": 64, "learning_rate": 0.001, "patience": 5, "validation_block": 1.0},
}
TINY = """
base: dynssm_paper_orca
name: tiny
history: 0.08
ssm: {channels: 4, states: 2}
gru: {hidden: 4}
fusion: {hidden: 8, latent: 8}
physics: {nominal: vehicle}
adaptation: {hidden: 8}
residual: {hidden: [8], inputs: normalised}
loss: {scale: increment, parameters: 0.001}
training: {epochs: 4, batch_size: 64, learning_rate: 0.001, weight_decay: 0.0001, gradient_clip: 1.0, patience: 60}
"""


@pytest.fixture
def tiny_model(tmp_path: Path) -> Path:
    """A model file that trains in a second, four epochs."""
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture
def dynssm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs the command line in this process: ``dynssm(...) -> (status, stdout, stderr)``."""
    from dynssm_ros.cli import main as cli

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dynssm", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capsys.readouterr()
        return int(stopped.value.code or 0), out, err

    return run


@pytest.fixture
def told(dynssm: Callable[..., tuple[int, str, str]]) -> Callable[..., tuple[int, str]]:
    """Runs the command line; exit status and all that it says, in one line."""

    def run(*arguments: object) -> tuple[int, str]:
        status, out, err = dynssm(*arguments)
        return status, " ".join((out + err).split())

    return run


@pytest.fixture
def refused(dynssm: Callable[..., tuple[int, str, str]]) -> Callable[..., str]:
    """Runs the command line, which ends with status 1; the one line that says why."""

    def run(*arguments: object) -> str:
        status, _, err = dynssm(*arguments)
        (line,) = err.strip().splitlines()
        assert status == 1
        assert line.startswith("error: ")
        return line

    return run


@pytest.fixture
def drawn() -> Callable[[Any], list[Any]]:
    """Draws a figure and returns its visible axes."""

    def draw(figure: Any) -> list[Any]:
        sink = io.BytesIO()
        figure.savefig(sink, format="png", dpi=40)
        assert len(sink.getvalue()) > 1000
        return [axes for axes in figure.axes if axes.axison]

    return draw


@pytest.fixture(scope="session")
def laps() -> Callable[..., tuple[Any, Any]]:
    """``laps(effect, ..., seed=1)``: a quick drive with hidden effects of random size, and the nominal vehicle."""
    from benchmarks.hidden_causes.cases import Case, record, size

    def drive(*effects: str, seed: int = 1, duration: float = 70.0) -> tuple[Any, Any]:
        rng = np.random.default_rng(seed)
        return record(Case({name: size(name, rng) for name in effects}, seed, "euler", duration))

    return drive


@pytest.fixture(scope="session")
def lagging(laps: Callable[..., tuple[Any, Any]], kept: Kept) -> tuple[Any, Any, Any]:
    """A recording of a car whose steering lags, the vehicle file that does not know it, and the diagnosis."""

    def make(folder: Path) -> None:
        from dynssm_ros.identification.result.diagnose import diagnose
        from dynssm_ros.track.tracks import load_track

        recording, vehicle = laps("steering_lag")
        line = load_track("road_course").centre
        found = diagnose(recording, vehicle, integrator="euler", line=line)
        (folder / "all.pickle").write_bytes(pickle.dumps((recording, vehicle, found)))

    return pickle.loads((kept("lagging", make) / "all.pickle").read_bytes())  # what this machine has just written


@pytest.fixture(scope="session")
def orca() -> Any:
    """The small car."""
    from dynssm_ros.vehicle import load_vehicle

    return load_vehicle("orca")


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The compiled loops: those of the environment, or built here; without a compiler the test is left out."""
    from dynssm_ros import compiled

    if compiled.LIBRARY is not None:
        return compiled.LIBRARY
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("compiled")
    shutil.copy(REPOSITORY / "setup.py", folder)
    (folder / "dynssm_ros").mkdir()
    source = shutil.copy(REPOSITORY / "dynssm_ros" / "compiled.c", folder / "dynssm_ros")
    subprocess.run([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], cwd=folder, check=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "_SOURCE", Path(source))
        patch.delenv("DYNSSM_COMPILED", raising=False)
        return compiled._load()


def smooth(rng: np.random.Generator, N: int, mean: float, std: float, over: int) -> np.ndarray:
    """Coloured noise that changes over about ``over`` rows."""
    kernel = np.exp(-0.5 * (np.arange(-3 * over, 3 * over + 1) / over) ** 2)
    noise = np.convolve(rng.standard_normal(N + len(kernel) - 1), kernel / np.sqrt((kernel**2).sum()), "valid")
    return mean + std * noise


@pytest.fixture(scope="session")
def drive() -> Callable[..., Any]:
    """Drives the single-track car under smooth random inputs; the recording holds its states and commands.

    ``noise`` is the standard deviation of a random push per step (m/s, m/s, rad/s): errors of a one-step prediction
    with the true coefficients are exactly these.
    """
    from dynssm_ros.signals.inputs import WINDOW_COLUMNS
    from dynssm_ros.signals.recording import Recording, RecordingInfo
    from dynssm_ros.vehicle import Applied, CarModel, Coefficients, State, Vehicle
    from dynssm_ros.vehicle.kinematics import SCALAR

    def make(
        vehicle: Vehicle,
        N: int = 1500,
        seed: int = 0,
        throttle: tuple[float, float] = (0.32, 0.05),
        steering: float = 0.06,
        noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
        segments: int = 1,
    ) -> Recording:
        rng = np.random.default_rng(seed)
        r, delta = smooth(rng, N + 1, *throttle, 40), smooth(rng, N + 1, 0.0, steering, 15)
        pushes = rng.standard_normal((N, 3)) * noise
        theta = Coefficients(*vehicle.nominal.tolist())
        car = CarModel(vehicle.constants, vehicle.sampling_time, vehicle.active_effects, xp=SCALAR)
        state, states = State(1.8, 0.0, 0.0), np.empty((N, 3))
        for k in range(N):
            states[k] = state
            applied = Applied(float(r[k + 1]), float(delta[k + 1]))
            following, _ = car.step(state, applied, theta)
            state = State(*(value + push for value, push in zip(following, pushes[k].tolist(), strict=True)))
        matrix = np.column_stack([states, r[:-1], delta[:-1], np.diff(r), np.diff(delta)])
        info = RecordingInfo(sampling_time=vehicle.sampling_time, commands="topics", source=(f"drive {seed}",))
        time = 10**18 + np.round(np.arange(N) * vehicle.sampling_time * 1e9).astype(np.int64)
        segment = (np.arange(N) * segments // N).astype(np.int32)
        return Recording(info, time, segment, {name: matrix[:, k] for k, name in enumerate(WINDOW_COLUMNS)})

    return make
