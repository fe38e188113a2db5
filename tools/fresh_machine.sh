#!/usr/bin/env bash
# Run the README's two commands on a fresh Debian: a minimal root made by debootstrap, a clone of HEAD, nothing else.
#
#     tools/fresh_machine.sh                      # needs root, and debootstrap: apt-get install debootstrap
#     tools/fresh_machine.sh --user               # as a user who may not install packages
#     tools/fresh_machine.sh --suite trixie --test "tests/process/test_gl.py"
#
# The root takes over this machine's mirror and proxy of apt, its own certificates, and its settings of pip.
set -euo pipefail
cd "$(dirname "$0")/.."

usage() {
  cat << 'END'
usage: tools/fresh_machine.sh [options]
  --suite NAME   Debian suite (bookworm: Python 3.11; trixie: Python 3.13)
  --mirror URL   where its packages are (that of this machine's apt)
  --python PATH  interpreter for make's PYTHON= (python3); bind its folder
  --bind DIR     show this folder of this machine, read only, at the same place: wheels that pip's settings name
  --test ARGS    of make test (everything)
  --train ARGS   of make train (two demonstrations, six steps, two episodes)
  --user         as a user without root and without sudo: the remedy is printed, obeyed by root, and suffices
  --root DIR     where the root is made and kept; one that is there is used as it is (a temporary folder, removed)
END
}

die() {
  echo "fresh_machine: $1" >&2
  exit 2
}

suite=bookworm mirror="" python=python3 binds=() test="" as_user="" root=""
train="demos.episodes=2 training.steps=6 training.batch_size=8 evaluation.episodes=2 evaluation.nfe=[1]"
while [ $# -gt 0 ]; do
  case $1 in
    --user) as_user=1 && shift && continue ;;
    -h | --help) usage && exit ;;
  esac
  [ $# -ge 2 ] || die "unknown option or no value: $1 (--help lists them)"
  case $1 in
    --suite) suite=$2 ;;
    --mirror) mirror=$2 ;;
    --python) python=$2 ;;
    --bind) binds+=("$(realpath -e -- "$2")") ;;
    --test) test=$2 ;;
    --train) train=$2 ;;
    --root) root=$(realpath -m -- "$2") ;;
    *) die "unknown option: $1 (--help lists them)" ;;
  esac
  shift 2
done
[ "$(id -u)" = 0 ] || die "a root is made and entered with chroot: run this as root"
command -v debootstrap > /dev/null || die "debootstrap is missing: apt-get install debootstrap"

removed_at_end=""
if [ -z "$root" ]; then
  root=$(mktemp -d /var/tmp/fresh_machine.XXXXXX)
  removed_at_end=$root
fi

step=""
say() {
  step=$*
  printf '\n=== %s\n' "$step"
}

at_end() {
  local code=$?
  [ "$code" = 0 ] || printf '\n=== FAILED (exit code %d): %s\n' "$code" "$step" >&2
  # All mounts were in namespaces of their own, which are gone: nothing of this machine is below.
  [ -z "$removed_at_end" ] || rm -rf --one-file-system -- "$removed_at_end"
}
trap at_end EXIT

# Runs a command in the root. Its mounts end with it, whatever happens.
inside() {
  # shellcheck disable=SC2016
  unshare --mount --pid --fork --kill-child -- bash -euc '
    root=$1; shift
    mount -t proc proc "$root/proc"
    mount --rbind /sys "$root/sys"
    mount --rbind /dev "$root/dev"
    while [ "$1" != -- ]; do
      mkdir -p "$root$1"
      mount --bind "$1" "$root$1"
      mount -o remount,bind,ro "$root$1"
      shift
    done
    shift
    exec chroot "$root" env -i HOME=/root LANG=C.UTF-8 PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin "$@"
  ' bash "$root" "${binds[@]}" -- "$@"
}

# The same in the clone, as the one who makes.
as_builder() {
  if [ -n "$as_user" ]; then
    inside setpriv --reuid=1000 --regid=1000 --clear-groups env HOME=/home/fresh bash -euc "cd /home/fresh/imfvla && $1"
  else
    inside bash -euc "cd /home/fresh/imfvla && $1"
  fi
}

if [ ! -e "$root/etc/debian_version" ]; then
  say "a minimal Debian $suite in $root"
  if [ -z "$mirror" ]; then
    # shellcheck disable=SC2016
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Origin: Debian' 2> /dev/null |
      grep -v security | sed -n 1p) || true
  fi
  debootstrap --variant=minbase --include=ca-certificates,python3,python3-venv,git,make \
    "$suite" "$root" "${mirror:-http://deb.debian.org/debian}" | tail -n 3
fi

say "this machine's settings of apt, certificates and pip"
cp /etc/resolv.conf "$root/etc/resolv.conf"
# Debian's installer writes this file, debootstrap does not; torchrun's processes meet at localhost.
echo "127.0.0.1 localhost $(uname --nodename)" > "$root/etc/hosts"
apt-config dump | grep -E '^Acquire::https?::' > "$root/etc/apt/apt.conf.d/90host" || true
if compgen -G '/usr/local/share/ca-certificates/*.crt' > /dev/null; then
  cp /usr/local/share/ca-certificates/*.crt "$root/usr/local/share/ca-certificates/"
  inside update-ca-certificates > /dev/null 2>&1
fi
python3 -m pip config list 2> /dev/null | python3 -c '
import ast, configparser, sys
found = configparser.RawConfigParser()
found["global"] = {}
for line in sys.stdin:
    key, _, value = line.partition("=")
    found["global"].setdefault(key.rpartition(".")[2], ast.literal_eval(value))
found.write(sys.stdout)' > "$root/etc/pip.conf"

say "a clone of $(git rev-parse --short HEAD)"
inside sh -c 'rm -rf /home/fresh && useradd --create-home --uid 1000 --shell /bin/bash fresh 2> /dev/null || mkdir -p /home/fresh'
git bundle create --quiet "$root/home/fresh/imfvla.bundle" HEAD
inside git -c advice.detachedHead=false -c init.defaultBranch=main clone --quiet /home/fresh/imfvla.bundle /home/fresh/imfvla
[ -z "$as_user" ] || inside chown -R fresh: /home/fresh
inside python3 --version

if [ -n "$as_user" ]; then
  say "without a GL library, as a user who may not install packages"
  log=$root/home/fresh/setup.log
  if as_builder "make setup PYTHON=$python" > "$log" 2>&1; then
    die "make setup passed, although no GL library was to be there; --root needs a new folder for this"
  fi
  # shellcheck disable=SC2016
  remedy=$(sed -n 's/.*`sudo \(apt-get update && \)sudo \(apt-get install [^`]*\)`.*/\1\2/p' "$log")
  tail -n 3 "$log"
  [ -n "$remedy" ] || die "make setup named no command that installs a GL library"
  say "the administrator: $remedy"
  inside bash -c "$remedy" > /dev/null
fi

say "make train"
as_builder "make train PYTHON=$python ARGS='$train'"
say "make test"
as_builder "make test PYTHON=$python ARGS='$test'"
left=$(as_builder "git status --short")
[ -z "$left" ] || die "the clone is not clean afterwards: $left"
say "both commands work on a fresh Debian $suite"
