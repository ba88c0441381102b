"""The same digits however a campaign is computed: workers, clusters, interruptions, more trials."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from distributed import LocalCluster
from sensor_specs import SCALAR

import fkgen
from fkgen.runtime import cache
from fkgen.study.campaigns import block, campaign, checkpoint, engine
from fkgen.study.campaigns.engine import Lost

STEPS, TRIALS = 100, 1003


@pytest.fixture(scope="module")
def spec():
    faults = {"sensor": {"noise_factor": 4.0, "problem": 2, "joint": [0.5, 0.1, 0.15, 0.25]}}
    table = {"name": "seen", "model": SCALAR, "faults": faults, "filter": {"family": "one_step"}}
    return fkgen.Spec.from_dict(table)


@pytest.fixture(scope="module")
def small_blocks():
    """Many blocks of few samples, in this process alone: their size is part of a campaign."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block, "_SAMPLES", 2000)
        yield


@pytest.fixture(scope="module")
def expected(spec, small_blocks):
    return fkgen.montecarlo(spec, TRIALS, STEPS, 5, workers=1).to_json()


def heed_interrupts():
    """A process started in the background of a script ignores SIGINT, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def stopping_after(monkeypatch, ranges, error):
    """Whoever computes stops with an error once some ranges are done."""
    whole = campaign.Checkpoint.add

    def add(self, blocks, sums):
        whole(self, blocks, sums)
        stopping.append(blocks)
        if len(stopping) == ranges:
            raise error

    stopping = []
    monkeypatch.setattr(campaign.Checkpoint, "add", add)


@pytest.mark.parametrize("workers", [2, 3])
def test_several_workers(spec, expected, workers):
    assert fkgen.montecarlo(spec, TRIALS, STEPS, 5, workers=workers).to_json() == expected


def test_an_interrupted_campaign_goes_on_from_its_checkpoint(spec, expected, tmp_path, monkeypatch):
    file = tmp_path / "kept.json"
    with monkeypatch.context() as patch:
        stopping_after(patch, 9, KeyboardInterrupt)
        with pytest.raises(
            KeyboardInterrupt, match=r"kept\.json holds \d+ of 1003 trials: the same"
        ):
            fkgen.montecarlo(spec, TRIALS, STEPS, 5, checkpoint=file, workers=2)
    kept = json.loads(file.read_text())
    assert 0 < kept["trials"] < TRIALS
    computed = []
    draw = campaign.Work.sums
    monkeypatch.setattr(
        campaign.Work, "sums", lambda w, b, s=None: computed.append(b) or draw(w, b, s)
    )
    found = fkgen.montecarlo(spec, TRIALS, STEPS, 5, checkpoint=file, workers=2)
    assert found.to_json() == expected
    done = {each for start, stop in kept["done"] for each in range(start, stop)}
    assert computed
    assert not done & {each for blocks in computed for each in blocks}  # nothing is done twice


def test_more_trials_go_on_from_an_old_checkpoint(spec, expected, tmp_path, small_blocks):
    file = tmp_path / "kept.json"
    fkgen.montecarlo(spec, 500, STEPS, 5, checkpoint=file)
    assert fkgen.montecarlo(spec, TRIALS, STEPS, 5, checkpoint=file).to_json() == expected
    with pytest.raises(fkgen.DataError, match="992 trials in it, and 500 wanted"):
        fkgen.montecarlo(spec, 500, STEPS, 5, checkpoint=file)


def test_a_precision_that_is_reached_stops_it_at_the_same_trial(spec, tmp_path, small_blocks):
    file = tmp_path / "kept.json"
    found = [
        fkgen.montecarlo(spec, 10**6, STEPS, 5, precision=0.01, workers=workers, checkpoint=path)
        for workers, path in ((1, None), (2, None), (2, file), (2, file))
    ]
    assert len({each.to_json() for each in found}) == 1
    assert 100 <= found[0].trials < 10**4
    rmse = found[0].rmse
    assert (rmse.standard_error <= 0.01 * rmse.value).all()
    fewer = fkgen.montecarlo(spec, found[0].trials // 2, STEPS, 5).rmse
    assert (fewer.standard_error > 0.01 * fewer.value).any()


def test_a_cluster_one_of_whose_workers_is_killed(spec, tmp_path, small_blocks):
    trials, file = 8000, tmp_path / "kept.json"
    wanted = fkgen.montecarlo(spec, trials, STEPS, 5).to_json()
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        address, killed = cluster.scheduler_address, []

        def kill():
            deadline = time.monotonic() + 60.0
            while time.monotonic() < deadline and not any(
                each.key.startswith("_remote") and each.state == "memory"
                for each in list(cluster.scheduler.tasks.values())
            ):
                time.sleep(0.002)
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        found = fkgen.montecarlo(spec, trials, STEPS, 5, scheduler=address, checkpoint=file)
        killer.join()
        assert killed
        assert found.to_json() == wanted
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cache, "identity", lambda: "another")
            with pytest.raises(fkgen.DataError, match="expected fkgen another on every worker"):
                fkgen.montecarlo(spec, 100, STEPS, 5, scheduler=address)
    assert fkgen.montecarlo(spec, trials, STEPS, 5, checkpoint=file).to_json() == wanted


def test_a_cluster_that_is_lost_leaves_the_checkpoint(spec, tmp_path, monkeypatch, small_blocks):
    stopping_after(
        monkeypatch, 3, Lost("scheduler", given="a cluster that is gone", expected="one")
    )
    file = tmp_path / "kept.json"
    with pytest.raises(fkgen.DataError, match=r"gone; .*kept\.json holds \d+ of 1003 trials: the"):
        fkgen.montecarlo(spec, TRIALS, STEPS, 5, checkpoint=file)
    assert json.loads(file.read_text())["trials"] > 0


def test_control_c_ends_the_command_with_one_line_and_the_checkpoint(spec, tmp_path):
    folder = Path(__file__).parents[3] / "examples" / "sensor_faults"
    file = tmp_path / "kept.json"
    command = [sys.executable, "-m", "fkgen", "montecarlo", str(folder / "example1.toml")]
    command += ["--trials", "50000000", "--checkpoint", str(file)]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_interrupts,  # noqa: PLW1509 - it starts no thread
    )
    deadline = time.monotonic() + 120.0
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert not out
    assert err.count("\n") == 1
    assert "kept.json holds" in err
    assert json.loads(file.read_text())["trials"] > 0


def test_work_that_travels_is_compiled_once_for_each_kind_of_processor(
    spec, tmp_path, monkeypatch, small_blocks
):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path))  # in which no other test puts anything
    work = campaign.work_of(spec, campaign.Request(spec, 100, STEPS, 5, 0))
    data, expected = pickle.dumps(work), work.sums(range(5)).parts
    here = pickle.loads(data)  # noqa: S301 - our own
    assert here.compiled.folder == work.compiled.folder
    assert here.drawing.compiled.folder == work.drawing.compiled.folder
    monkeypatch.setattr(cache, "processor", lambda: "of another kind")  # with the same folder
    for _ in range(2):
        there = pickle.loads(data)  # noqa: S301
        assert there.compiled.folder != work.compiled.folder
        assert there.drawing.compiled.folder != work.drawing.compiled.folder
        made = sorted(each.name for each in cache.folder().iterdir())
        assert there.sums(range(5)).parts.tobytes() == expected.tobytes()
    assert made == sorted(each.name for each in cache.folder().iterdir())


def test_a_block_is_small_and_full_of_lanes(spec):
    for steps in (1, 7, 200, 50_000, 10**6):
        size = block.block_size(spec, steps)
        assert size % 8 == 0 or size < 8
        assert size >= 1
        assert size * steps <= max(10**6, steps)


def test_blocks_in_a_ledger_are_joined():
    ledger = checkpoint.Ledger()
    for blocks in (range(4, 6), range(2), range(2, 3)):
        ledger.done = set(checkpoint._joined([*ledger.done, blocks]))
    assert ledger.done == {range(3), range(4, 6)}
    assert ledger.missing(8) == [range(3, 4), range(6, 8)]
    assert ledger.missing(2) == []
    assert ledger.blocks == 5


@pytest.mark.exhaustive
def test_a_scheduler_that_is_restarted(spec, tmp_path, monkeypatch):
    """One that goes away in the middle, and another one that goes on from the checkpoint."""
    monkeypatch.setattr(engine, "PATIENCE", 5.0)
    trials, file = 200_000, tmp_path / "kept.json"
    wanted = fkgen.montecarlo(spec, trials, STEPS, 5).to_json()
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    command += ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    command += ["--scheduler-file", str(tmp_path / "scheduler.json")]
    scheduler = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    address = started(tmp_path / "scheduler.json")
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
    one = subprocess.Popen([*worker, "--no-dashboard"], stderr=subprocess.DEVNULL)

    def kill():
        while not file.exists():
            time.sleep(0.01)
        scheduler.kill()

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    try:
        with pytest.raises(fkgen.DataError, match=r"gone.*kept\.json holds .* trials: the same"):
            fkgen.montecarlo(spec, trials, STEPS, 5, scheduler=address, checkpoint=file)
    finally:
        for each in (one, scheduler):
            each.kill()
            each.wait()
    assert 0 < json.loads(file.read_text())["trials"] < trials
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        found = fkgen.montecarlo(spec, trials, STEPS, 5, scheduler=address, checkpoint=file)
    assert found.to_json() == wanted


def started(file):
    """The address of a scheduler that writes it into a file."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        if file.exists() and (text := file.read_text()):
            return json.loads(text)["address"]
        time.sleep(0.1)
    raise TimeoutError
