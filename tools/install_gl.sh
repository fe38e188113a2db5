#!/usr/bin/env bash
# Install a software OpenGL library for headless rendering (Debian, Ubuntu), or print the one command that does.
# EGL first; OSMesa where EGL alone does not render. Called by `make setup` when no frame could be rendered.
set -euo pipefail
cd "$(dirname "$0")/.."

egl="libegl1 libegl-mesa0 libgl1-mesa-dri"
osmesa="libosmesa6"

renders() { .venv/bin/python tools/doctor.py --only gl > /dev/null; }

give_up() {
  echo "No OpenGL library renders here: $1" >&2
  echo "Install one, then run make again:" >&2
  echo "    sudo apt-get update && sudo apt-get install -y --no-install-recommends $egl" >&2
  exit 1
}

command -v apt-get > /dev/null || give_up "and there is no apt-get; the Debian packages are $egl (or $osmesa)."
if [ "$(id -u)" = 0 ]; then
  as_root=()
elif command -v sudo > /dev/null && sudo -n true 2> /dev/null; then
  as_root=(sudo -n)
else
  give_up "and this user may not install packages."
fi

echo "No OpenGL library renders here; installing $egl"
"${as_root[@]}" apt-get update -q || true # a stale list may still do; the install says if not
# shellcheck disable=SC2086
"${as_root[@]}" apt-get install -q -y --no-install-recommends $egl || give_up "and apt-get could not install $egl."
renders && exit 0
echo "EGL does not render here; installing $osmesa"
"${as_root[@]}" apt-get install -q -y --no-install-recommends $osmesa || give_up "and apt-get could not install $osmesa."
renders || give_up "even with $egl and $osmesa installed; tools/doctor.py says why."
