"""What a sweep tells: settings and error of all trials, drawn by Optuna from the sweep's own file.

python -m examples.what_a_sweep_tells SWEEP_FOLDER PICTURE.png
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import matplotlib as mpl
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.visualization.matplotlib import plot_parallel_coordinate


def main(sweep: Path, picture: Path) -> Path:
    """Draws each trial as a line through its settings to its displacement error (m)."""
    mpl.use("agg")
    storage = JournalStorage(JournalFileBackend(str(sweep / "sweep.journal")))
    study = optuna.load_study(study_name="sweep", storage=storage)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        axes = plot_parallel_coordinate(study, target_name="ADE (m)")
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(picture, dpi=150, bbox_inches="tight")
    return picture


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
