"""Several processes as one run: on one host, each with a CPU device of its own."""

import json
import os
import pathlib
import socket
import subprocess
import sys

import numpy as np
import pytest
from kill_many import KINEMATIC, MAIN, ROOT, SIZES
from safetensors.numpy import load

from mjx_nero.learn import machines


def test_one_process_is_none_of_several(monkeypatch):
    def no(**_):
        raise AssertionError("joined")

    monkeypatch.setattr(machines.jax.distributed, "initialize", no)
    for name, value in {"SLURM_STEP_NUM_TASKS": "1", "SLURM_JOB_ID": "7", "SLURM_NTASKS": "2"}.items():
        monkeypatch.setenv(name, value)
    machines.join()
    assert machines.first() and not machines.several()
    np.testing.assert_array_equal(machines.gather([3.0, 4.0]), [[3.0, 4.0]])


JOINED = [
    ({"SLURM_STEP_NUM_TASKS": "4", "SLURM_STEP_TASKS_PER_NODE": "2(x2)"}, {}),  # a process a GPU: as JAX finds out by itself
    (
        {"SLURM_STEP_NUM_TASKS": "2", "SLURM_STEP_TASKS_PER_NODE": "1(x2)", "CUDA_VISIBLE_DEVICES": "0,1,2"},
        {"local_device_ids": [0, 1, 2]},
    ),
    ({"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_LOCAL_SIZE": "2"}, {}),
    (
        {"JAX_COORDINATOR_ADDRESS": "a:1", "JAX_NUM_PROCESSES": "3", "JOB_COMPLETION_INDEX": "2"},
        {"num_processes": 3, "process_id": 2, "cluster_detection_method": "deactivate"},
    ),
]


@pytest.mark.parametrize(("env", "how"), JOINED, ids=["a process a GPU", "a process a host", "mpirun", "kubernetes"])
def test_who_joins_and_with_what(monkeypatch, env, how):
    calls = []
    monkeypatch.setattr(machines.jax.distributed, "initialize", lambda **found: calls.append(found))
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    machines.join()
    assert calls == [how]


def start(folder, *flags, **env):
    env = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", **env}
    argv = [sys.executable, "-c", KINEMATIC + MAIN, "--env", "nero_reach", "--impl", "jax", *SIZES, *flags]
    return subprocess.Popen(argv, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def ended(*processes):
    texts = [process.communicate(timeout=900)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), "\n".join(texts)
    return texts


@pytest.mark.slow
def test_two_processes_learn_what_one_does(tmp_path):
    """Two processes with a device each against one with two: the same environments, minibatches and noise."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    run = ["--num-timesteps", "320", "--eval-every", "160", "--checkpoint-every", "160"]
    joined = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    pair = [start(tmp_path, "--out", "two", *run, JAX_PROCESS_ID=str(i), **joined) for i in range(2)]
    first, second = ended(*pair)
    assert "8 environments on 2 devices" in first and "success" not in second  # the second says nothing
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    ended(start(tmp_path, "--out", "one", *run, "--num-devices", "2", XLA_FLAGS=flags))
    found = [checkpoints(tmp_path / name) for name in ("one", "two")]
    assert [name for name, _ in found] == ["000000000320.safetensors"] * 2
    for name, value in found[0][1].items():
        np.testing.assert_allclose(found[1][1][name], value, rtol=1e-4, atol=1e-5, err_msg=name)
    summary = json.loads((tmp_path / "two" / "summary.json").read_text())
    assert summary["num_devices"] == 2 and summary["stopped"] == "finished"
    assert len((tmp_path / "two" / "metrics.jsonl").read_text().splitlines()) == 6

    ended(start(tmp_path, "--restore", "two", "--num-timesteps", "448"))  # goes on with one process
    assert checkpoints(tmp_path / "two")[0] == "000000000448.safetensors"
    configs = [json.loads((tmp_path / name / "config.json").read_text()) for name in ("one", "two")]
    assert [config["hyperparameters"]["minibatch_size"] for config in configs] == [12_288] * 2


def checkpoints(run: pathlib.Path):
    newest = sorted((run / "checkpoints").iterdir())[-1]
    return newest.name, load(newest.read_bytes())
