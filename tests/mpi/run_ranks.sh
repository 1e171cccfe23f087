#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# run_ranks.sh RANKS COMMAND...: the command under mpirun, as tests need it: more ranks than cores, as root in
# a container, on this machine only. Status 77 (skipped) when there is no mpirun.
set -euo pipefail
ranks=$1
shift
mpirun=${LVGGT_MPIEXEC:-mpirun}
if ! command -v "$mpirun" >/dev/null; then
  echo "run_ranks: skipped, because there is no mpirun (Debian: openmpi-bin)"
  exit 77
fi
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 OMPI_MCA_rmaps_base_oversubscribe=1
# Containers forbid reading another process's memory, and need no network for ranks on one machine.
export OMPI_MCA_btl_vader_single_copy_mechanism=none OMPI_MCA_btl=self,vader OMPI_MCA_hwloc_base_binding_policy=none
# Open MPI keeps memory until its process ends.
export ASAN_OPTIONS="${ASAN_OPTIONS:+$ASAN_OPTIONS:}detect_leaks=0"
exec "$mpirun" -n "$ranks" "$@"
