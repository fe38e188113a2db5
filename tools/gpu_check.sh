#!/usr/bin/env bash
# Every measurement that needs a GPU, in under 8 minutes; without one: tools/gpu_check.sh --device cpu --quick
# What is measured, and all options: tools/gpu_check.sh --help
set -euo pipefail
cd "$(dirname "$0")/.."
exec "${PYTHON:-.venv/bin/python}" tools/gpu_check.py "$@"
