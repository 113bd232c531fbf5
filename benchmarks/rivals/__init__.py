"""Models of the literature as plugins: ``DYNSSM_PLUGINS=benchmarks.rivals`` makes kinds and model files known by name."""

from pathlib import Path

from benchmarks.rivals.ddm import DDM
from benchmarks.rivals.ekf_fthd import EkfFTHD
from benchmarks.rivals.fthd import FTHD
from benchmarks.rivals.gp import GaussianProcess
from benchmarks.rivals.on_track import OnTrack
from dynssm_ros import register_model
from dynssm_ros.configuration import register_folder

for _model in (DDM, FTHD, EkfFTHD, GaussianProcess, OnTrack):
    register_model(_model)
register_folder("models", Path(__file__).parent)
