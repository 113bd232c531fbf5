"""The published drives of the 1:43 car (``DYN-PP-*.npz`` of the Deep Dynamics repository) as recordings.

``python -m benchmarks.paper.published DYN-PP-ETHZMobil.npz mobil.parquet``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from dynssm_ros.errors import RecordingError
from dynssm_ros.signals.recording import Recording, RecordingInfo

_ROWS = {"states": 6, "dstates": 8, "inputs": 2}
_SOURCES = {
    "v_x": ("dstates", 3), "v_y": ("dstates", 4), "omega": ("dstates", 5), "r_fb": ("dstates", 6),
    "delta_fb": ("dstates", 7), "x": ("states", 0), "y": ("states", 1), "theta": ("states", 2),
}  # fmt: skip


def published_drive(path: Path) -> Recording:
    """A published drive, with its commands as increments on the feedback.

    The file's arrays are ``time`` ``(N,)`` in s, ``states`` ``(6, N)``: x, y (m), psi (rad) and velocities, ``dstates``
    ``(8, N)``: the same of the discrete model and its throttle and steering (rad), ``inputs`` ``(2, N - 1)``. The input that
    acts on step k is that of step k. Poses are those of ``states``, all else is of ``dstates``.

    Raises:
        RecordingError: not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name], dtype=float) for name in ("time", *_ROWS)}
    except (OSError, ValueError, KeyError) as error:
        raise RecordingError(f"{path}: {error}; expected arrays time, {', '.join(_ROWS)}") from error
    time, N = arrays.pop("time"), arrays["inputs"].shape[-1]
    for name, rows in _ROWS.items():
        expected = (rows, N if name == "inputs" else N + 1)
        if arrays[name].shape != expected or time.shape != (N + 1,):
            raise RecordingError(
                f"{path}: {name} of shape {arrays[name].shape}; expected {expected} for {len(time)} times"
            )
    T_s = round(float(np.median(np.diff(time))), 9)
    columns = {name: arrays[array][row, :N] for name, (array, row) in _SOURCES.items()}
    for name, feedback, row in (("r_cmd", "r_fb", 0), ("delta_cmd", "delta_fb", 1)):
        columns[name] = arrays["inputs"][row] - columns[feedback]
    info = RecordingInfo(sampling_time=T_s, commands="topics", source=(path.stem,))
    stamps = np.round(np.arange(N) * T_s * 1e9).astype(np.int64)
    return Recording(info, stamps, np.zeros(N, np.int32), columns)


def main(arguments: list[str]) -> None:
    """Converts one file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path, metavar="DRIVE.npz")
    parser.add_argument("out", type=Path, metavar="R.parquet")
    found = parser.parse_args(arguments)
    out, recording = found.out, published_drive(found.drive)
    recording.save(out)
    print(f"{out}: {len(recording)} rows at {1 / recording.T_s:g} Hz")


if __name__ == "__main__":
    main(sys.argv[1:])
