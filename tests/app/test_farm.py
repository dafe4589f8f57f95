"""Work in many pieces: the same results in one process, in several and on Dask, and after a kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from holocal.app import farm
from holocal.app.farm import Farm, arriving, farm_of, gathered
from holocal.errors import ConfigError, DeviceError, UsageError
from holocal.records.journal import Journal

HERE = Path(__file__).parent
ITEMS = {f"item/{k:02d}": k for k in range(20)}


def squared(item: int) -> dict[str, float | None]:
    """A piece of work: quick, and with a number that JSON does not have."""
    return {"square": item**2 / 7, "unknown": float("nan")}


def slow(item: int) -> int:
    """A piece of work that takes long enough to be killed in."""
    time.sleep(0.05)
    return item + 1


def dies(item: int) -> int:
    """A piece of work whose process is killed, as by a system that is out of memory."""
    os.kill(os.getpid(), signal.SIGKILL)
    return item


def refuses(item: int) -> int:
    """A piece of work that fails."""
    raise ConfigError(f"item {item} cannot be.", fix="Leave it out.")


def test_several_processes_give_what_one_gives_in_the_order_of_the_items(tmp_path):
    one = gathered(squared, ITEMS, Farm(), Journal(tmp_path / "one.jsonl"))
    two = gathered(squared, ITEMS, Farm(workers=2), Journal(tmp_path / "two.jsonl"))
    assert json.dumps(one) == json.dumps(two)
    assert list(one) == list(ITEMS)
    assert one["item/03"] == {"square": 9 / 7, "unknown": None}
    lines = {name: sorted((tmp_path / name).read_text().splitlines()) for name in ("one.jsonl", "two.jsonl")}
    assert lines["one.jsonl"] == lines["two.jsonl"]


def test_what_the_journal_has_is_not_done_again_and_a_torn_line_is(tmp_path):
    journal = Journal(tmp_path / "done.jsonl")
    whole = gathered(squared, ITEMS, Farm(), journal)
    lines = journal.path.read_bytes().splitlines(keepends=True)
    journal.path.write_bytes(b"".join(lines[:7]) + lines[7][:-9])
    told, did = [], []

    def counted(item: int) -> dict[str, float | None]:
        did.append(item)
        return squared(item)

    again = gathered(counted, ITEMS, Farm(), journal, lambda done, of: told.append((done, of)))
    assert json.dumps(again) == json.dumps(whole)
    assert did == list(range(7, 20))
    assert told[0] == (7, 20)
    assert told[-1] == (20, 20)
    assert sorted(journal.path.read_bytes().splitlines(keepends=True)) == sorted(lines)


@pytest.mark.parametrize("harm", [b"", b"\n", b"{}\n", b'{"key": "item/04", "value": {"square": 1}, "check": "0"}\n'])
def test_a_line_that_is_not_what_was_written_ends_the_journal(tmp_path, harm):
    journal = Journal(tmp_path / "done.jsonl")
    gathered(squared, ITEMS, Farm(), journal)
    lines = journal.path.read_bytes().splitlines(keepends=True)
    journal.path.write_bytes(b"".join(lines[:4]) + harm + b"".join(lines[5:]))
    kept = journal.read()
    assert len(kept) == (4 if harm else 19)
    assert journal.read() == kept


def test_a_killed_program_goes_on_where_it_was(tmp_path):
    script = (
        "from pathlib import Path; from test_farm import slow, ITEMS; from holocal.app.farm import Farm, gathered\n"
        "from holocal.records.journal import Journal\n"
        f"if __name__ == '__main__': gathered(slow, ITEMS, Farm(workers=2), Journal(Path({str(tmp_path / 'j')!r})))\n"
    )
    (tmp_path / "script.py").write_text(script)
    paths = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    running = subprocess.Popen([sys.executable, str(tmp_path / "script.py")], env={**os.environ, "PYTHONPATH": paths})
    until = time.monotonic() + 60
    while time.monotonic() < until and (not (tmp_path / "j").exists() or (tmp_path / "j").stat().st_size < 200):
        time.sleep(0.02)
    running.send_signal(signal.SIGKILL)
    running.wait()
    before = Journal(tmp_path / "j").read()
    assert 0 < len(before) < len(ITEMS)
    assert gathered(slow, ITEMS, Farm(), Journal(tmp_path / "j")) == {key: item + 1 for key, item in ITEMS.items()}
    assert _gone(tmp_path / "script.py")


def _gone(script: Path) -> bool:
    """Whether no worker of a killed program is left: they end with their parent."""
    until = time.monotonic() + 10
    while time.monotonic() < until:
        named = [path for path in Path("/proc").glob("[0-9]*/cmdline") if _says(path, str(script))]
        if not named:
            return True
        time.sleep(0.1)
    return False


def _says(path: Path, text: str) -> bool:
    try:
        return text.encode() in path.read_bytes()
    except OSError:
        return False


def test_a_worker_that_dies_is_told_and_so_is_an_error_in_one():
    with pytest.raises(DeviceError, match="worker was lost") as lost:
        list(arriving(dies, ITEMS, Farm(workers=2)))
    assert lost.value.exit_status == 6
    with pytest.raises(ConfigError, match="cannot be") as refused:
        list(arriving(refuses, ITEMS, Farm(workers=2)))
    assert refused.value.fix == "Leave it out."


def test_a_scheduler_and_workers_exclude_each_other_and_one_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(farm, "CONNECT_S", 0.5)
    with pytest.raises(UsageError):
        farm_of(2, "tcp://127.0.0.1:1")
    with pytest.raises(ConfigError) as absent:
        list(arriving(squared, ITEMS, Farm(scheduler="tcp://127.0.0.1:1")))
    assert absent.value.exit_status == 2


@pytest.mark.slow
def test_a_dask_cluster_gives_what_one_process_gives(tmp_path):
    import distributed

    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        there = Farm(scheduler=cluster.scheduler_address)
        here = gathered(squared, ITEMS, Farm(), Journal(tmp_path / "here"))
        assert gathered(squared, ITEMS, there, Journal(tmp_path / "there")) == here
