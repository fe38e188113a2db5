#!/usr/bin/env bash
# Write hashes.txt and hashes-cuda.txt: the packages of constraints.txt, and what PyPI's torch adds to them, with the
# SHA-256 of each of their files. Needs uv (pip install uv) and PyPI.
set -euo pipefail
cd "$(dirname "$0")/.."

# Of torch's CPU wheel for CPython 3.11, Linux x86-64, which is not on PyPI.
cpu_wheel=6746dbcbeb526eb61330b76b41ff1b4eb848951103a892eeb080dfa2b264667b

compile() {
  uv pip compile --quiet --no-header --no-annotate --generate-hashes --python-version 3.11 "$@"
}

# labmaze has no wheel for Python 3.13: see tools/labmaze.
{
  echo "# SHA-256 of every file that PyPI has of the packages of constraints.txt: make setup HASHES=1 installs no other file."
  echo "# Written by tools/hashes.sh, which is to be run after a change of constraints.txt."
  echo "# torch has one more, of its CPU wheel for CPython 3.11. A torch that is installed already is left as it is."
  compile --universal --no-deps constraints.txt |
    sed -e 's/^\(labmaze==[^ ]*\) /\1 ; python_version < "3.13" /' \
      -e "s/^torch==.*/&\n    --hash=sha256:$cpu_wheel \\\\/"
} > hashes.txt.tmp

# What is left of torch's own packages once those of constraints.txt are taken out.
torch=$(grep '^torch==' constraints.txt)
{
  echo "# SHA-256 of the CUDA packages that PyPI's torch asks for on Linux x86-64. Written by tools/hashes.sh."
  echo "$torch" | compile --python-platform x86_64-manylinux_2_28 --constraint constraints.txt - |
    awk 'NR == FNR { known[tolower($1)]; next } /==/ { shown = !(tolower($1) in known) } shown' \
      <(grep -v '^#' constraints.txt | tr '_' '-') -
} > hashes-cuda.txt.tmp

mv hashes.txt.tmp hashes.txt
mv hashes-cuda.txt.tmp hashes-cuda.txt
