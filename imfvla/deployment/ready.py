"""Graphs for an evaluation that is to be computed with them."""

from collections.abc import Mapping
from typing import Any

from imfvla.config.protocol import ONNX, EvaluationOptions
from imfvla.deployment.exporting import export_policy
from imfvla.options import require
from imfvla.robot_of import has_environment
from imfvla.runtime.graphs import FOLDER, require_packages
from imfvla.storage.run_directory import RunDirectory

# Fewer than a deployment is judged by: the evaluation itself shows more.
OBSERVATIONS, CALLS = 20, 20


def check_runtime(config: Mapping[str, Any], options: EvaluationOptions) -> None:
    """Raises UserError where rollouts of a config cannot be computed as `options.runtime` says."""
    if options.runtime == ONNX:
        require(has_environment(config), "evaluation.runtime", "eager where there is no environment", ONNX)
        require_packages()


def export_missing(run: RunDirectory, options: EvaluationOptions) -> None:
    """Exports the policy of `run` for all of `options.nfe`, unless the run has graphs or needs none."""
    folder = run.path / FOLDER
    if options.runtime == ONNX and not folder.exists():
        export_policy(run, options.checkpoint, options.nfe, folder, OBSERVATIONS, CALLS).print()
