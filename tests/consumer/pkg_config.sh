#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# pkg_config.sh COMPILER PKGCONFIG_DIR WORK_DIR: builds the consumer with nothing but pkg-config, and runs it.
set -eu
here=$(dirname "$0")
mkdir -p "$3"
PKG_CONFIG_PATH=$2
export PKG_CONFIG_PATH
# Flags are several words.
# shellcheck disable=SC2046
"$1" -std=c++20 "$here/main.cc" "$here/other.cc" -o "$3/consumer" $(pkg-config --cflags --libs lvggt)
"$3/consumer"
