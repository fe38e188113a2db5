"""The same sweep through launchers that run jobs elsewhere; each runs where its package is installed."""

import pytest
import tiny_sweep

from imfvla.storage.run_directory import DONE, RunDirectory

LAUNCHERS = {
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", ["hydra.launcher.timeout_min=5"]),
    "ray": (
        "hydra_plugins.hydra_ray_launcher",
        ["+hydra.launcher.ray.init.num_cpus=1", "+hydra.launcher.ray.init.include_dashboard=false"],
    ),
}


@pytest.mark.parametrize("name", LAUNCHERS)
def test_jobs_run_elsewhere_their_failures_come_back_and_finished_ones_are_skipped(
    name, synthetic_demonstrations, tmp_path
):
    package, options = LAUNCHERS[name]
    pytest.importorskip(package)
    command = [
        "-m",
        "seed=0,13",
        f"hydra/launcher={name}",
        *options,
        *tiny_sweep.OVERRIDES,
        f"demos.directory={synthetic_demonstrations}",
    ]
    # Ray's default niceness is 15: last of all on a busy machine.
    done = tiny_sweep.launch(command, tmp_path, RAY_worker_niceness="0")
    assert done.returncode == 2, done.stderr
    assert done.stderr.endswith(
        "Jobs: 2, of which 0 were finished before, 1 ran and 1 failed.\nseed 13 is bad.\n"
    )
    (path,) = (config.parent for config in tmp_path.glob("runs/socket/*/config.yaml"))
    assert RunDirectory(path).status()["state"] == DONE
    assert len(list(path.glob("rollouts/*/episodes.jsonl"))) == 1
    assert len((tmp_path / tiny_sweep.UPDATES).read_text().splitlines()) == 2

    # Has nothing to launch.
    again = tiny_sweep.launch([text.replace("0,13", "0") for text in command], tmp_path)
    assert again.returncode == 0, again.stderr
    assert "Jobs: 1, of which 1 were finished before, 0 ran and 0 failed." in again.stderr
