import subprocess
import sys
import threading
import time

import pytest

from terrain.errors import TerrainError
from terrain.files.atomic import ensure_writable, file_lock

HOLD = """
import sys, time
from pathlib import Path
from terrain.files.atomic import file_lock
with file_lock(Path(sys.argv[1]), 5.0, "tests"):
    print("held", flush=True)
    time.sleep(60)
"""


def test_only_one_holds_it_at_a_time(tmp_path):
    inside, most, done = [], [], []

    def work():
        for _ in range(5):
            with file_lock(tmp_path / "made" / ".lock", 30.0, "tests"):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.005)
                inside.pop()
        done.append(1)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(done) == 4
    assert max(most) == 1


def test_it_waits_no_longer_than_asked_and_a_process_that_dies_frees_it(tmp_path):
    lock = tmp_path / ".lock"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(TerrainError, match=r"\.lock: another process is busy and has not ended within"),
            file_lock(lock, 0.2, "is busy"),
        ):
            raise AssertionError("the lock is held by another process")
    finally:
        holder.kill()
        holder.communicate()
    with file_lock(lock, 5.0, "tests"):
        pass


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("an obstacle")
    with pytest.raises(TerrainError, match="cannot be written"), file_lock(tmp_path / "file" / "x", 1.0, "t"):
        raise AssertionError("there is no such folder")


def test_folders_are_tried_by_several_at_once(tmp_path):
    """Each makes the folder to see whether it can, and removes it: never under the feet of another."""
    failures = []

    def work():
        for _ in range(300):
            try:
                ensure_writable(tmp_path / "mlruns")
            except TerrainError as error:
                failures.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert not list(tmp_path.glob("mlruns/*"))
