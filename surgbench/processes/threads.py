"""One thread for a tracker's process, and none that waits busily: what it is told before any library loads."""

from __future__ import annotations

# Latencies compare, and results do not depend on the machine's cores. A tracker that wants more asks the library.
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",  # PyTorch too
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        # OpenCV's second thread, and the first that waits for it, yield their turns on a busy machine over and over.
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)

# For who asked for more: a thread that waits sleeps, and leaves the core to whoever has something to do.
NO_BUSY_WAITING = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",
    "KMP_BLOCKTIME": "0",
    "OPENBLAS_THREAD_TIMEOUT": "4",  # 2^4 cycles, the least it takes
    "OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN": "0",
    "OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER": "0",
}

THREADS = {**ONE_THREAD, **NO_BUSY_WAITING}
