import pytest

from terrain.errors import TerrainError
from terrain.files.atomic import atomic_folder, atomic_write


def test_an_existing_file_is_replaced_whole(tmp_path):
    atomic_write(tmp_path / "a" / "report.json", "old")
    atomic_write(tmp_path / "a" / "report.json", b"new")
    assert (tmp_path / "a" / "report.json").read_bytes() == b"new"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["report.json"]


def test_an_unwritable_path_is_refused_in_one_sentence_and_left_clean(tmp_path):
    (tmp_path / "report.json").mkdir()  # a folder where the file should go: also root cannot write it
    with pytest.raises(TerrainError, match=r"report\.json: cannot be written"):
        atomic_write(tmp_path / "report.json", "new")
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(TerrainError, match="cannot be written"):
        atomic_write(tmp_path / "file" / "report.json", "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "report.json"]


def fail_halfway(target):
    with atomic_folder(target) as unfinished:
        (unfinished / "run.json").write_text("half")
        raise ZeroDivisionError


def test_a_folder_appears_only_when_it_is_whole(tmp_path):
    target = tmp_path / "SNOW_01"
    with atomic_folder(target) as unfinished:
        (unfinished / "run.json").write_text("old")
        assert not target.exists()
    with pytest.raises(ZeroDivisionError):
        fail_halfway(target)
    assert (target / "run.json").read_text() == "old"
    with atomic_folder(target) as unfinished:
        (unfinished / "run.json").write_text("new")
    assert (target / "run.json").read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]
