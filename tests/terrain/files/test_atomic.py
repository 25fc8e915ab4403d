"""A file, a folder and a lock: whole or not at all, one process at a time, one sentence where it cannot be."""

import subprocess
import sys
import threading
import time

import pytest

from terrain.errors import TerrainError
from terrain.files.atomic import atomic_folder, atomic_write, ensure_writable, file_lock

HOLD = """
import sys, time
from pathlib import Path
from terrain.files.atomic import file_lock
with file_lock(Path(sys.argv[1]), 5.0, "tests"):
    print("held", flush=True)
    time.sleep(60)
"""


def test_an_existing_file_is_replaced_whole_and_an_unwritable_place_is_left_clean(tmp_path):
    atomic_write(tmp_path / "a" / "report.json", "old")
    atomic_write(tmp_path / "a" / "report.json", b"new")
    assert (tmp_path / "a" / "report.json").read_bytes() == b"new"
    (tmp_path / "report.json").mkdir()  # a folder where the file should go: also root cannot write it
    (tmp_path / "file").write_text("not a folder")
    for path in (tmp_path / "report.json", tmp_path / "file" / "report.json"):
        with pytest.raises(TerrainError, match=r"report\.json: cannot be written"):
            atomic_write(path, "new")
    with pytest.raises(TerrainError, match="cannot be written"), file_lock(tmp_path / "file" / "x", 1.0, "t"):
        raise AssertionError("there is no such folder")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "file", "report.json", "report.json"]


def fill(target, text, fails=False):
    with atomic_folder(target) as unfinished:
        (unfinished / "run.json").write_text(text)
        assert not (target / "run.json").exists() or (target / "run.json").read_text() == "old"
        if fails:
            raise ZeroDivisionError


def test_a_folder_appears_only_when_it_is_whole(tmp_path):
    target = tmp_path / "SNOW_01"
    fill(target, "old")
    with pytest.raises(ZeroDivisionError):
        fill(target, "half", fails=True)
    assert (target / "run.json").read_text() == "old"
    fill(target, "new")
    assert (target / "run.json").read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


def in_threads(work):
    """Run a function in four threads at once."""
    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_only_one_holds_a_lock_at_a_time_and_folders_are_tried_by_several(tmp_path):
    """Each makes the folder to see whether it can, and removes it: never under the feet of another."""
    inside, most, failures = [], [], []

    def hold():
        for _ in range(3):
            with file_lock(tmp_path / "made" / ".lock", 30.0, "tests"):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.002)
                inside.pop()

    def probe():
        for _ in range(200):
            try:
                ensure_writable(tmp_path / "mlruns")
            except TerrainError as error:
                failures.append(error)

    in_threads(hold)
    assert most == [1] * 12
    in_threads(probe)
    assert failures == []
    assert not list(tmp_path.glob("mlruns/*"))


def test_a_lock_is_waited_for_no_longer_than_asked_and_a_process_that_dies_frees_it(tmp_path):
    lock = tmp_path / ".lock"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(TerrainError, match=r"\.lock: another process is busy and has not ended within"),
            file_lock(lock, 0.1, "is busy"),
        ):
            raise AssertionError("the lock is held by another process")
    finally:
        holder.kill()
        holder.communicate()
    with file_lock(lock, 5.0, "tests"):
        pass
