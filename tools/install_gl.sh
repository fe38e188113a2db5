#!/usr/bin/env bash
# Install a software OpenGL library for headless rendering (Debian, Ubuntu), or say which command does.
# EGL first; OSMesa where EGL does not render, which imfvla then takes by itself. Called by `make setup`.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${1:-.venv/bin/python}
ask() { "$python" -c "import sys; sys.path.insert(0, '.'); from imfvla.process import gl; print($1)"; }
renders() { "$python" tools/doctor.py --only gl > /dev/null; }

give_up() {
  echo "No OpenGL library renders here, and $1: $2 \`$(ask "gl.install_command()")\`, then make again." >&2
  exit 1
}

command -v apt-get > /dev/null || give_up "there is no apt-get" "install what this command would on Debian,"
if [ "$(id -u)" = 0 ]; then
  as_root=()
elif command -v sudo > /dev/null && sudo -n true 2> /dev/null; then
  as_root=(sudo -n)
else
  give_up "this user may not install packages" "let an administrator run"
fi

"${as_root[@]}" apt-get update -qq || true # a stale list may still do; the install says if not
for backend in egl osmesa; do
  packages=$(ask "*gl.PACKAGES['$backend']")
  echo "No OpenGL library renders here; installing $packages"
  # shellcheck disable=SC2086
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -qq -y --no-install-recommends --no-upgrade $packages > /dev/null || continue
  if renders; then exit 0; fi
done
"$python" tools/doctor.py --only gl >&2 # its line says why, and its exit code is ours
