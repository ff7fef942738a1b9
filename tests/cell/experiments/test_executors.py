"""Executors: every piece of work ends with a result or with a reason, and costs no other."""

from __future__ import annotations

import importlib.util
import os
import signal
import time

import pytest

from touchcell.cell.experiments.executors import EXECUTORS, Lost, Workers
from touchcell.cell.experiments.remote_work import send_by_value

ELSEWHERE = [("dask", "distributed"), ("slurm:local", "submitit"), ("ray", "ray")]


def square(item: int | str) -> int:
    if item == "raise":
        raise ValueError("no square")
    if item == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if item == "hang":
        while True:
            time.sleep(1.0)
    if item == "eat":
        return len(bytearray(1 << 40))
    assert isinstance(item, int)
    return item * item


def results(executor: str, items: list[int | str], workers: Workers) -> dict[int, object]:
    name, _, address = executor.partition(":")
    run = EXECUTORS.load(name).run
    return dict(run(square, items, Workers(workers.jobs, workers.time_limit_s, workers.memory_limit_mb, address)))


def test_one_job_without_limits_runs_in_this_process_and_in_order():
    run = EXECUTORS.load("local").run
    assert list(run(square, [1, 2, 3], Workers())) == [(0, 1), (1, 4), (2, 9)]


def test_work_that_raises_hangs_or_is_killed_costs_only_itself():
    items: list[int | str] = [1, "raise", 2, "kill", 3, "hang", 4, "eat", 5]
    found = results("local", items, Workers(jobs=2, time_limit_s=8.0))
    assert {index: value for index, value in found.items() if not isinstance(value, Lost)} == {
        0: 1,
        2: 4,
        4: 9,
        6: 16,
        8: 25,
    }
    reasons = {items[index]: value.reason for index, value in found.items() if isinstance(value, Lost)}
    assert "no square" in reasons["raise"]
    assert "SIGKILL" in reasons["kill"]
    assert "8 s" in reasons["hang"]
    assert "MemoryError" in reasons["eat"]


def test_memory_is_limited():
    found = results("local", [1, "eat"], Workers(jobs=1, memory_limit_mb=4096))
    assert found[0] == 1
    assert isinstance(found[1], Lost)


@pytest.mark.parametrize(("executor", "module"), ELSEWHERE)
def test_workers_elsewhere_give_the_same_and_name_what_was_lost(executor, module, tmp_path, monkeypatch):
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    monkeypatch.chdir(tmp_path)
    send_by_value(square)
    found = results(executor, [1, "raise", 2, "kill", 3], Workers(jobs=2, time_limit_s=60.0))
    assert {index: value for index, value in found.items() if not isinstance(value, Lost)} == {0: 1, 2: 4, 4: 9}, found
    assert isinstance(found[1], Lost)
    assert "no square" in found[1].reason
    assert isinstance(found[3], Lost)
    assert found[3].reason
