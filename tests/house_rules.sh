#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# house_rules.sh SOURCE_DIR BUILD_DIR: rules of this code base that no compiler checks.
set -euo pipefail
source_dir=$1
build_dir=$2
broken=0

# report RULE MATCHES: says which rule the lines break.
report() {
  if [[ -n $2 ]]; then
    printf '%s:\n%s\n\n' "$1" "$2"
    broken=1
  fi
}

# The code of files under the given paths, as PATH:LINE:TEXT, without comments and string literals.
code() {
  (cd "$source_dir" && find "$@" \( -name '*.h' -o -name '*.cc' \) -print0 | sort -z |
    xargs -0 awk '{ line = $0; gsub(/"([^"\\]|\\.)*"/, "\"\"", line); sub(/\/\/.*/, "", line)
                    print FILENAME ":" FNR ":" line }')
}

# R9: flags that drop NaN checks or bind the binary to one machine.
flags='-ffast-math|-Ofast|-ffinite-math-only|-funsafe-math|-fassociative-math|-freciprocal-math|-march=|-mtune=native|-m(sse|avx|fma)'
report 'R9: a compile command has a forbidden flag' \
  "$(grep -oE -- "($flags)[^ \"]*" "$build_dir/compile_commands.json" | sort | uniq -c || true)"
report 'R9: a build file asks for a forbidden flag' \
  "$(cd "$source_dir" && find . -path './build*' -prune -o \
       \( -name CMakeLists.txt -o -name '*.cmake' -o -name CMakePresets.json \) -print0 |
     xargs -0 grep -HnE -- "$flags" || true)"

# R8: the library is a guest in its user's process. Programs and their helpers (cli/) may do these things.
library=(include/lvggt kernels)
not_programs='^(include/lvggt|kernels)/cli/'
calls='(std::)?(exit|_exit|quick_exit|abort|terminate|atexit|signal|sigaction|setlocale|chdir|getenv|secure_getenv|setenv|putenv|system|popen|fork)'
report 'R8: the library ends the process, or reads or changes what belongs to it' \
  "$(code "${library[@]}" | grep -vE "$not_programs" | grep -E ":[0-9]+:(.*[^_[:alnum:].>])?$calls *\(" || true)"
report 'R8: the library prints' \
  "$(code "${library[@]}" | grep -vE "$not_programs" |
     grep -E '\b(std::)?(cout|cerr|clog)\b|[^_[:alnum:]](std::)?(printf|puts|putchar|perror)\(|\b(stdout|stderr)\b' || true)"
report 'R8: the library changes the floating-point modes' \
  "$(code "${library[@]}" | grep -E '\b(fesetround|fesetenv|_mm_setcsr|_MM_SET_)' || true)"
report 'R10: the library opens the network' \
  "$(code "${library[@]}" | grep -E '#include <(sys/socket|netinet|netdb|arpa|curl)' || true)"

# R6: sizes from files are multiplied through lvggt/io/checked.h only, where a product cannot wrap.
report 'R6: a loader multiplies without checking' \
  "$(code kernels/io weights | grep -E '^(kernels/io/safetensors|weights/(pth|pickle|zip_archive|convert))' |
     grep -E '[][:alnum:]_)] \* [[:alnum:]_(]|\*= ' || true)"

# Every file says its licence first (scripts after the line that names their interpreter).
report 'A file without its licence line' \
  "$(cd "$source_dir" && find include kernels weights examples tests bench \
       \( -name '*.h' -o -name '*.cc' -o -name '*.sh' \) -print0 | sort -z |
     while IFS= read -r -d '' file; do
       head -n 2 "$file" | grep -q 'SPDX-License-Identifier: Apache-2.0' || echo "$file"
     done)"

exit "$broken"
