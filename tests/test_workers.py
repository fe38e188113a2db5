"""Work in fresh processes and in this one: results, errors and death arrive."""

import os

import pytest

from imfvla.errors import UserError
from imfvla.workers import worker_pool


def threads_and_square(number: int) -> tuple[str | None, int]:
    return os.environ.get("OMP_NUM_THREADS"), number**2


def refuse(text: str) -> None:
    raise UserError(text)


@pytest.mark.parametrize("count", [0, 1])
def test_results_and_errors_arrive(count, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with worker_pool(count) as run_all:
        found = sorted(run_all(threads_and_square, [(2,), (1,)]))
        with pytest.raises(UserError, match="wrong"):
            list(run_all(refuse, [("wrong",)]))
    threads = "1" if count else "3"
    assert found == [(threads, 1), (threads, 4)]
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_in_this_process_work_is_done_one_by_one():
    done: list[int] = []
    with worker_pool(0) as run_all:
        results = run_all(done.append, [(1,), (2,)])
        next(results)
        assert done == [1]


def test_the_death_of_a_worker_is_told_with_the_remedy():
    with pytest.raises(UserError, match=r"died, perhaps for want of memory: choose fewer workers"):  # noqa: SIM117
        with worker_pool(1) as run_all:
            list(run_all(os._exit, [(1,)]))
