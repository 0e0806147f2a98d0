"""One thread for linear algebra, before NumPy is loaded: small matrices are quicker that way."""

import os

for name in ("MKL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
