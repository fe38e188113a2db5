"""One environment per task for the whole module: building one takes as long as a short episode."""

from collections.abc import Iterator

import pytest

from imfvla import tasks
from imfvla.tasks.bimanual_environment import BimanualEnvironment


@pytest.fixture(scope="package", params=tasks.NAMES)
def env(request: pytest.FixtureRequest) -> Iterator[BimanualEnvironment]:
    """Each task in turn, at 48 x 48."""
    env = tasks.load(request.param, image_size=(48, 48))
    yield env
    env.close()


@pytest.fixture(scope="package")
def socket_env() -> Iterator[BimanualEnvironment]:
    env = tasks.load("socket")
    yield env
    env.close()


@pytest.fixture(scope="package")
def transfer_env() -> Iterator[BimanualEnvironment]:
    env = tasks.load("transfer")
    yield env
    env.close()
