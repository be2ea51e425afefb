"""Files that survive kills and full disks. Kills at every step of a board are in test_board_log.py."""

import errno
import os
from pathlib import Path

import pytest

from lag_envs import store


@pytest.mark.parametrize("sync", [False, True])
def test_written_whole_with_its_folder(tmp_path, sync):
    file = tmp_path / "new" / "file"
    store.write_file(file, "ä", sync=sync)
    store.write_file(file, b"second", sync=sync)
    assert file.read_bytes() == b"second" and os.listdir(file.parent) == ["file"]


@pytest.mark.parametrize("place", [(Path, "write_bytes"), (os, "replace")])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, place):
    file = tmp_path / "file"
    store.write_file(file, "old")

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*place, full)
    with pytest.raises(OSError, match="No space left"):
        store.write_file(file, "new")
    assert file.read_text() == "old" and os.listdir(tmp_path) == ["file"]


def test_rows_after_a_kill_in_the_middle_of_one(tmp_path):
    file = tmp_path / "rows.jsonl"
    for number in range(3):
        store.append(file, {"number": number})
    file.write_bytes(file.read_bytes()[:-3] + b"")
    store.append(file, {"number": 3})
    assert [row["number"] for row in store.rows(file)] == [0, 1, 3]
    with pytest.raises(ValueError):
        store.append(file, {"number": float("nan")})
    assert len(list(store.rows(file))) == 3
    assert list(store.rows(tmp_path / "none")) == []
