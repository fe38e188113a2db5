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
"${as_root[@]}" apt-get update -qq || true # a stale list may still do; the install says if not
install=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends --no-upgrade)
# shellcheck disable=SC2086
"${install[@]}" $egl || give_up "and apt-get could not install $egl."
renders && exit 0
echo "EGL does not render here; installing $osmesa"
"${install[@]}" $osmesa || give_up "and apt-get could not install $osmesa."
.venv/bin/python tools/doctor.py --only gl >&2 # its line says why, and its exit code is ours
