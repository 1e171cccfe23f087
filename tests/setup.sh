#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Installs the Debian 12 packages that building and testing lvggt needs, if any is missing.
set -euo pipefail

packages=(
  build-essential cmake ninja-build pkg-config
  libhwy-dev libtbb-dev libeigen3-dev nlohmann-json3-dev  # kernels, threads, cameras, configuration
  libpng-dev libstb-dev libexif-dev libzip-dev            # pictures, .pth archives
  libssl-dev                                              # SHA-256
  libavformat-dev libavcodec-dev libavutil-dev libswscale-dev
  libicu-dev libgumbo-dev libsentencepiece-dev zlib1g-dev # phrases and sentences
  libopenmpi-dev openmpi-bin                              # training on several machines
  libcli11-dev doctest-dev libbenchmark-dev
)

if ! command -v dpkg-query >/dev/null; then
  echo "setup: this script knows Debian and its relatives; elsewhere install the counterparts of: ${packages[*]}" >&2
  exit 1
fi

missing=()
for package in "${packages[@]}"; do
  status=$(dpkg-query -W -f='${db:Status-Abbrev}' "$package" 2>/dev/null || true)
  [[ $status == ii* ]] || missing+=("$package")
done
if [[ ${#missing[@]} -eq 0 ]]; then
  exit 0
fi

as_root=()
if [[ $(id -u) -ne 0 ]]; then
  if ! command -v sudo >/dev/null; then
    echo "setup: these packages are missing, and there is no sudo to install them with: ${missing[*]}" >&2
    exit 1
  fi
  as_root=(sudo)
fi
echo "setup: installing ${missing[*]}"
"${as_root[@]}" apt-get update -qq
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
  apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null </dev/null
