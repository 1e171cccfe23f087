# SPDX-License-Identifier: Apache-2.0
"""Memory that stays with the process, in huge pages, and threads that sleep while they wait: PyTorch takes half the time."""
import os
import sys

SETTINGS = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_THREAD_TIMEOUT": "4", "MALLOC_MMAP_MAX_": "0",
            "MALLOC_TRIM_THRESHOLD_": "20000000000", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}


def tune():
    """Starts this program anew unless it has them: they are read when a process starts."""
    if any(name not in os.environ for name in SETTINGS):
        os.execve(sys.executable, [sys.executable, "-u", *sys.argv], {**SETTINGS, **os.environ})
