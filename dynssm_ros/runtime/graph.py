"""The graph of a trained model, run by ONNX Runtime on one core.

As a program, it opens the graph of a model folder within limits; it imports little, as a node that starts waits for it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnxruntime as ort

from dynssm_ros.errors import ArtifactError
from dynssm_ros.runtime.bounded import answer, ask

if TYPE_CHECKING:
    from dynssm_ros.arrays import Vector

_AT_ONCE = 32
"""Windows that a graph sees at once. Memory that it has used stays with it: two megabytes for each of them with the paper's
encoders. More at once are no faster."""
_REPEATING = re.compile(rb"(?:\"|\xa2\x80*\x00)(?:[\x04\x0b]|[\x84\x8b]\x80*\x00)(Loop|Scan|SequenceMap)")
"""Operators that run for as long as their input says, as the format has them: field 4 of a node, length, name. Those that the
export writes take the same time whatever comes in, so that a trial tells how long a prediction takes."""
_WEIGHTS_ELSEWHERE = "session.model_external_initializers_file_folder_path"


class Graph:
    """A graph that maps windows to increments, open.

    Args:
        file: that messages name.
        content: of the file.
        rows: of a window.
        columns: of a window.

    Raises:
        ArtifactError: ONNX Runtime refuses the graph, or it is not one of such a model.
    """

    def __init__(self, file: Path, content: bytes, rows: int, columns: int) -> None:
        if repeating := _REPEATING.search(content):
            raise ArtifactError(f"{file}: has the operator {repeating[1].decode()}, which may never end; expected none")
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # the export has optimised the graph; doing it again would hold up a swap
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.enable_mem_reuse = False  # small tensors: planning their reuse costs more than their effect states
        options.log_severity_level = 4  # its errors are raised too
        # a single window, as in the node, always has its place in memory
        self._window = np.zeros((1, rows, columns), dtype=np.float32)
        try:
            # of the bytes that were checked; a graph whose weights are in other files finds none here
            options.add_session_config_entry(_WEIGHTS_ELSEWHERE, str(file / "none"))
            self._session = ort.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )  # which would print, and try the same again
            self._outputs = [output.name for output in self._session.get_outputs()]
            inputs = [(each.name, each.shape[1:]) for each in self._session.get_inputs()]
            if inputs != [("window", [rows, columns])] or "increment" not in self._outputs:
                raise ArtifactError(
                    f"{file}: maps {inputs} to {self._outputs}; expected a window of {rows} rows and {columns} columns to "
                    "increment, and theta, physics, variance if it has them"
                )
            self._binding = self._session.io_binding()
            self._binding.bind_cpu_input("window", self._window)
            for name in self._outputs:
                self._binding.bind_output(name)
            self._session.run_with_iobinding(self._binding)
        except ArtifactError:
            raise
        except Exception as error:  # onnxruntime raises its own unrelated classes
            raise ArtifactError(f"{file}: ONNX Runtime refuses it ({' '.join(str(error).split())})") from error

    def run(self, windows: Vector) -> dict[str, Vector]:
        """The outputs by name for ``windows`` ``(N, H, 7)``, in single precision."""
        if len(windows) == 1:
            self._window[...] = windows
            self._session.run_with_iobinding(self._binding)
            results = self._binding.copy_outputs_to_cpu()
        else:
            blocks = np.split(windows.astype(np.float32), range(_AT_ONCE, len(windows), _AT_ONCE))
            found = [self._session.run(self._outputs, {"window": block}) for block in blocks]
            results = [np.concatenate(each) for each in zip(*found, strict=True)]
        return dict(zip(self._outputs, results, strict=True))


def try_graph(file: Path, content: bytes, rows: int, columns: int) -> None:
    """Opens a graph and runs it once, in another process; for the arguments see :class:`Graph`.

    Raises:
        ArtifactError: as :class:`Graph`, or it takes too much time or memory, or ends the process.
    """
    ask("dynssm_ros.runtime.graph", file, content, rows, columns)


if __name__ == "__main__":
    answer(Graph)
