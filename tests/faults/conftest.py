"""What the tests of faults share."""

import faults_run
import pytest
from faults_run import FLAGS, STEPS, last
from kinematic import Kinematic

from mjx_nero import ManipulationEnv
from mjx_nero.runs import compiled, logs


@pytest.fixture
def train(call, monkeypatch):
    """``train(*flags) -> (exit status, stdout, stderr)``: a tiny run of ``STEPS`` steps, in the test's own folder."""
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())
    monkeypatch.setattr(compiled, "make_learner", faults_run.learner)
    monkeypatch.setattr(compiled, "Fresh", faults_run.fresh)
    monkeypatch.setattr(compiled, "compile", faults_run.compile)

    def run(*flags, steps=STEPS):
        sizes = ["--num-timesteps", steps] if steps else []
        return call("train", *FLAGS, *sizes, "--eval-every", 128, "--checkpoint-every", 128, *flags)

    return run


@pytest.fixture
def at_row(monkeypatch):
    """``at_row(n, what)``: calls ``what()`` when the n-th row of metrics has been noted."""

    def use(n, what):
        write, rows = logs.Logs.write, []

        def noted(self, row):
            write(self, row)
            rows.append(row)
            if len(rows) == n:
                what()

        monkeypatch.setattr(logs.Logs, "write", noted)

    return use


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Keeps the last checkpoint of a run that nothing disturbed, once a test has made it."""
    return {"folder": tmp_path_factory.mktemp("whole")}


@pytest.fixture
def undisturbed(train, whole, tmp_path):
    """What a run comes to that nothing disturbs."""
    if "last" not in whole:
        code, _, err = train("--out", whole["folder"] / "run")
        assert code == 0, err
        whole["last"] = last(whole["folder"] / "run")
    return whole["last"]
