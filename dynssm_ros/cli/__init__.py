"""The ``dynssm`` command, one file per subcommand: a thin shell around functions of the other rooms."""

import os

# long thin matrices on few cores: threads of numpy's and scipy's BLAS wait for each other longer than they compute
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
